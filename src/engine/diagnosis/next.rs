//! The run that would separate two effects best: linearised T-optimality (Atkinson and Fedorov 1975).
//!
//! The plain distance of two predictions misleads: the rival would re-adapt to the new run. So the
//! rival's parameters are moved, linearised, to fit the leader's prediction of old and new runs
//! together, and what difference is left on the new run counts. Of the few runs that separate best by this
//! the rival is fitted to what the leader says of them.

use std::sync::Arc;

use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};
use rayon::prelude::*;

use super::ar::Ar;
use super::decide::Ranked;
use super::effect::{Effect, Tier};
use super::fitting::{Effort, Fitted, fit};
use super::input::Input;
use super::kernel::Clock;
use super::levmar::{Limits, minimise, quotients};
use super::linear::{dot, least_squares};
use super::prepare::Prepared;
use super::problem::{Course, Problem, Stretch};
use super::report::{NextDrive, NextExperiment};
use super::rows::Rows;
use super::start::Regression;

/// Length of a proposed run.
const LENGTH_S: f64 = 12.0;
/// How much further than so far a proposed run takes the response at its usual level.
const FURTHER: f64 = 1.5;
/// Mean square in noise floors below which a run separates nothing.
const SEPARATED: f64 = 0.3;

/// Runs for which rivals are fitted anew,
const FITTED: usize = 2;
/// and the Jacobians that this may take.
const ROUNDS: usize = 8;

/// A drive of the menu with its samples, `[drive][sample]`.
struct Proposal {
    drive: NextDrive,
    samples: Vec<Vec<f64>>,
}

/// The run that tells the leader best from its rivals, if there are any: those of `set`, which the runs so far
/// leave open, else the strongest.
pub(super) fn next_experiment(
    input: &Input,
    prepared: &Prepared,
    ranked: &[Ranked],
    set: &[Effect],
) -> Option<NextExperiment> {
    let leader = ranked.first()?;
    let problem = &prepared.problems[leader.scored.problem];
    let effect = leader.scored.effect();
    // What is more flexible than the leader can follow it anywhere: no run tells them apart.
    let rivals: Vec<&Ranked> = ranked
        .iter()
        .filter(|r| {
            r.scored.problem == leader.scored.problem
                && r.scored.effect() != effect
                && r.scored.effect().tier() <= effect.tier().max(Tier::Law)
        })
        .collect();
    let mut open: Vec<&Ranked> = Vec::new();
    for rival in &rivals {
        let stands = |r: &&Ranked| r.scored.effect() == rival.scored.effect();
        if set.contains(&rival.scored.effect()) && !open.iter().any(stands) {
            open.push(rival);
        }
    }
    let in_doubt = !open.is_empty();
    if !in_doubt {
        open.extend(rivals.first());
    }
    let noise = &prepared.noises[problem.response].ar;
    let limit = input.limits(&problem.drive_peak);
    let leading = &leader.scored.fitted;
    let so_far = problem.fit.iter().map(|s| reach(problem, &s.measured)).fold(0.0, f64::max);
    let runs: Vec<(NextDrive, Stretch)> =
        menu(problem, &limit, prepared.band, input.sample_rate_hz(), input.seed)
            .into_par_iter()
            .filter_map(|proposal| spared(problem, leading, so_far, proposal, noise, prepared.band))
            .collect();
    let of_all = most_separating(problem, leading, &runs, &open, in_doubt)?;
    // Where one of several cannot be told apart by any run, the strongest may be.
    let best = match open.as_slice() {
        [first, _, ..] if of_all.separation < SEPARATED => {
            most_separating(problem, leading, &runs, &[first], in_doubt).unwrap_or(of_all)
        }
        _ => of_all,
    };
    Some(NextExperiment {
        drive: runs[best.run].0.clone(),
        separates: vec![effect, open[best.rival].scored.effect()],
        expected_separation: best.separation,
        inseparable_in_envelope: best.separation < SEPARATED,
    })
}

/// A run, and the rival that it separates from the leader least.
struct Separating {
    run: usize,
    rival: usize,
    /// By how much, in noise floors squared.
    separation: f64,
}

/// The run on which the leader differs most from the rival that comes nearest to it: sought with rivals that
/// re-adapt linearly, and, where they are `in_doubt`, among the best few with rivals that are fitted anew. `None`
/// where every rival runs away.
fn most_separating(
    problem: &Problem,
    leader: &Fitted,
    runs: &[(NextDrive, Stretch)],
    rivals: &[&Ranked],
    in_doubt: bool,
) -> Option<Separating> {
    let nearest = |run: usize, of: &dyn Fn(&Fitted) -> Option<f64>| {
        let separations = rivals.iter().map(|r| of(&r.scored.fitted)).enumerate();
        let known = separations.filter_map(|(rival, x)| Some(Separating { run, rival, separation: x? }));
        known.min_by(|a, b| a.separation.total_cmp(&b.separation))
    };
    let mut sorted: Vec<Separating> = (0..runs.len())
        .into_par_iter()
        .filter_map(|run| nearest(run, &|rival| separation(problem, leader, rival, &runs[run].1)))
        .collect();
    sorted.sort_by(|a, b| b.separation.total_cmp(&a.separation));
    if !in_doubt {
        return sorted.into_iter().next();
    }
    sorted.truncate(FITTED);
    let fitted: Vec<Separating> = sorted
        .par_iter()
        .filter_map(|s| {
            let imagined = imagined(problem, leader, &runs[s.run].1)?;
            let regression = Regression::new(&imagined, true);
            nearest(s.run, &|rival| readapted(&imagined, &regression, rival))
        })
        .collect();
    fitted.into_iter().max_by(|a, b| a.separation.total_cmp(&b.separation))
}

/// The menu inside the limits of each drive (largest magnitude).
fn menu(problem: &Problem, limit: &[f64], band: [f64; 2], rate_hz: f64, seed: u64) -> Vec<Proposal> {
    let n = (LENGTH_S * rate_hz) as usize;
    let t = |k: usize| k as f64 / rate_hz;
    let tau = std::f64::consts::TAU;
    let top = band[1] * rate_hz;
    let resonance = problem.core.natural().first().map_or(0.3 * top, |f| f.0);
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let noise: Vec<Vec<f64>> = limit.iter().map(|_| band_noise(n, band[1], &mut rng)).collect();
    let same = |x: Vec<f64>| vec![x; limit.len()];
    let sine = |f: f64| same((0..n).map(|k| (tau * f * t(k)).sin()).collect());
    let (low, high) = ((band[0] * rate_hz).max(0.02 * top), 0.9 * top);
    let sweep = same(
        (0..n)
            .map(|k| {
                let rate = (high / low).ln() / LENGTH_S;
                (tau * low * ((rate * t(k)).exp() - 1.0) / rate).sin()
            })
            .collect(),
    );
    let offset: Vec<Vec<f64>> = noise.iter().map(|x| x.iter().map(|u| 0.5 * u + 0.5).collect()).collect();
    let mut out = Vec::new();
    let mut add = |kind: &str, frequency_hz: Option<f64>, level_rel: f64, shapes: &[Vec<f64>]| {
        let peaks: Vec<f64> = problem.drive_peak.iter().map(|p| p * level_rel).collect();
        // A drive that may not go so far takes the whole run out of the menu.
        if peaks.iter().zip(limit).any(|(p, l)| *p > l * (1.0 + 1e-9)) {
            return;
        }
        let samples = shapes.iter().zip(&peaks).map(|(x, p)| x.iter().map(|u| u * p).collect()).collect();
        out.push(Proposal { drive: NextDrive { kind: kind.into(), frequency_hz, level_rel }, samples });
    };
    for level in [0.3, 1.0, 2.0] {
        add("noise", None, level, &noise);
    }
    let slow = (0.05 * resonance).max(2.0 / LENGTH_S);
    for level in [0.3, 1.0] {
        add("slow_sine", Some(slow), level, &sine(slow));
    }
    add("resonance_sine", Some(resonance), 0.3, &sine(resonance));
    add("resonance_sine", Some(resonance), 1.0, &sine(resonance));
    add("sweep", None, 1.0, &sweep);
    add("offset_noise", None, 1.0, &offset);
    out
}

/// Largest distance of a response from the working point.
fn reach(problem: &Problem, y: &[f64]) -> f64 {
    let centre = problem.scales.y_mean;
    y.iter().fold(0.0, |m, y| m.max((y - centre).abs()))
}

/// The proposed drive with its run, weakened where it would take the response much further than the runs did
/// that there are, which is `so_far`: a sine at a sharp resonance may break the specimen inside the limits of
/// the drive, and what breaks away from all that was measured tells little of it. `None` where the leader's free
/// run runs away.
fn spared(
    problem: &Problem,
    leader: &Fitted,
    so_far: f64,
    mut proposal: Proposal,
    noise: &Ar,
    band: [f64; 2],
) -> Option<(NextDrive, Stretch)> {
    let mut new = stretch(problem, &proposal, noise, band);
    let furthest = FURTHER * so_far * proposal.drive.level_rel.max(1.0);
    let share = furthest / reach(problem, &leader.candidate.predict(problem, &new, &leader.p)?);
    if share < 1.0 {
        // A level that can be set at a rig.
        let level = (100.0 * share * proposal.drive.level_rel).ceil() / 100.0;
        let share = level / proposal.drive.level_rel;
        proposal.drive.level_rel = level;
        proposal.samples.iter_mut().flatten().for_each(|u| *u *= share);
        new = stretch(problem, &proposal, noise, band);
    }
    Some((proposal.drive, new))
}

/// Noise up to the band's edge with a peak of 1.
fn band_noise(n: usize, edge: f64, rng: &mut ChaCha8Rng) -> Vec<f64> {
    let share = 1.0 - (-std::f64::consts::TAU * edge).exp();
    let mut stages = [0.0; 4];
    let mut out: Vec<f64> = (0..n)
        .map(|_| {
            let mut x: f64 = StandardNormal.sample(rng);
            for s in &mut stages {
                *s += share * (x - *s);
                x = *s;
            }
            x
        })
        .collect();
    let peak = out.iter().fold(0.0_f64, |m, x| m.max(x.abs())).max(f64::MIN_POSITIVE);
    out.iter_mut().for_each(|x| *x /= peak);
    out
}

/// Mean square difference in noise floors, on a new run, between the leader and a rival that
/// has re-adapted to all runs; `None` where either runs away.
fn separation(problem: &Problem, leader: &Fitted, rival: &Fitted, new: &Stretch) -> Option<f64> {
    let rows = |of: &Fitted, p: &[f64]| -> Option<Vec<f64>> {
        let mut out = Vec::new();
        for stretch in problem.fit.iter().chain([new]) {
            stretch.extend(&of.candidate.predict(problem, stretch, p)?, &mut out);
        }
        Some(out)
    };
    let of_rival = |p: &[f64]| rows(rival, p);
    let now = of_rival(&rival.p)?;
    let target: Vec<f64> = rows(leader, &leader.p)?.iter().zip(&now).map(|(a, b)| a - b).collect();
    let jacobian = quotients(&of_rival, &rival.p, &rival.scale, &now);
    let columns: Vec<&[f64]> = jacobian.iter().map(|c| c.values.as_slice()).collect();
    let mut left = target.clone();
    for (column, x) in columns.iter().zip(least_squares(&columns, &target)) {
        left.iter_mut().zip(*column).for_each(|(l, c)| *l -= x * c);
    }
    let scored = new.rows.len();
    let part = &left[left.len() - scored..];
    let found = dot(part, part) / scored as f64;
    found.is_finite().then_some(found)
}

/// The response with what the leader says of the runs so far and of a new one in the place of what was
/// measured.
fn imagined(problem: &Problem, leader: &Fitted, new: &Stretch) -> Option<Problem> {
    let says = |stretch: &Stretch| {
        let measured = Arc::new(leader.candidate.predict(problem, stretch, &leader.p)?);
        Some(Stretch { measured, ..stretch.clone() })
    };
    let fit: Option<Vec<Stretch>> = problem.fit.iter().chain([new]).map(says).collect();
    Some(Problem { fit: fit?, ..problem.clone() })
}

/// Mean square difference in noise floors, on the last of the imagined runs, that a rival keeps when it is fitted
/// to all of them, from where it is and anew: friction with a yield displacement may turn into one without.
/// `None` where it runs away.
fn readapted(imagined: &Problem, regression: &Regression<'_>, rival: &Fitted) -> Option<f64> {
    let candidate = &rival.candidate;
    let rows = |p: &[f64]| candidate.fit_rows(imagined, p);
    let limits = Limits { rounds: ROUNDS, still: 1e-3, enough: 0.0 };
    let anew = fit(imagined, regression, candidate, &[], Effort { rounds: ROUNDS });
    let best = [Some(rival), anew.as_ref()]
        .into_iter()
        .flatten()
        .filter_map(|from| {
            let derivatives = |p: &[f64]| candidate.jacobian(imagined, p, &from.scale);
            minimise(rows, derivatives, &from.p, &from.scale, limits)
        })
        .min_by(|a, b| a.cost.total_cmp(&b.cost))?;
    let new = imagined.fit.last()?;
    let mut left = Vec::new();
    new.extend(&new.residual(&candidate.predict(imagined, new, &best.p)?), &mut left);
    let separation = dot(&left, &left) / left.len() as f64;
    separation.is_finite().then_some(separation)
}

fn stretch(problem: &Problem, proposal: &Proposal, noise: &Ar, band: [f64; 2]) -> Stretch {
    let core = problem.core.simulate(&proposal.samples);
    let n = core.len();
    let lead = problem.core.settling(n);
    let end = problem.fit.iter().map(|s| s.clock.start).fold(0.0, f64::max);
    // Another response has no sim for a drive that was never run: it is at rest.
    let simulated: Vec<Vec<f64>> = problem
        .other_mean
        .iter()
        .enumerate()
        .map(|(r, mean)| if r == problem.response { core.clone() } else { vec![*mean; n] })
        .collect();
    Stretch {
        run: 0,
        from: 0,
        group: 0,
        measured: Arc::new(vec![0.0; n]),
        lead,
        rows: Arc::new(Rows::new(n - lead, band, noise)),
        course: Course {
            drives: Arc::new(proposal.samples.clone()),
            simulated: Arc::new(simulated),
            core: Arc::new(core),
            clock: Clock { start: end, step: 0.0 },
            carried: Arc::default(),
        },
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::engine::diagnosis::candidate::{Candidate, Part};
    use crate::engine::diagnosis::law::Law;
    use crate::engine::diagnosis::prepare::prepare;
    use crate::engine::diagnosis::tests::rig::{hardening, request};

    #[test]
    fn a_sine_at_resonance_is_weakened_and_a_slow_one_is_not() {
        let prepared = prepare(&request(hardening, 0.01)).unwrap();
        let problem = &prepared.problems[0];
        let part = Part::force(Effect::CubicStiffness, vec![Law::Cubic], None);
        let candidate = Candidate { parts: vec![part], retune: false };
        let p = vec![0.0; candidate.parameters(problem)];
        let leader = Fitted { candidate, scale: p.clone(), p, chi2_fit: 1.0 };
        let noise = &prepared.noises[0].ar;
        let so_far = problem.fit.iter().map(|s| reach(problem, &s.measured)).fold(0.0, f64::max);
        for proposal in menu(problem, &problem.drive_peak, prepared.band, 256.0, 1) {
            let before = proposal.drive.clone();
            let (after, new) = spared(problem, &leader, so_far, proposal, noise, prepared.band).unwrap();
            let most = 1.6 * so_far * before.level_rel.max(1.0);
            let found = reach(problem, &leader.candidate.predict(problem, &new, &leader.p).unwrap());
            assert!(found < most, "{before:?}");
            let weakened = after.level_rel < before.level_rel;
            match before.kind.as_str() {
                "slow_sine" => assert!(!weakened, "{before:?}"),
                "resonance_sine" if before.level_rel == 1.0 => assert!(weakened, "{before:?}"),
                _ => {}
            }
        }
    }
}
