//! The run that would separate two effects best: linearised T-optimality (Atkinson and Fedorov 1975).
//!
//! The plain distance of two predictions misleads: the rival would re-adapt to the new run. So the
//! rival's parameters are moved, linearised, to fit the leader's prediction of old and new runs
//! together, and what difference is left on the new run counts.

use std::sync::Arc;

use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};
use rayon::prelude::*;

use super::ar::Ar;
use super::decide::Ranked;
use super::effect::Tier;
use super::fitting::Fitted;
use super::input::Input;
use super::kernel::Clock;
use super::levmar::quotients;
use super::linear::{dot, least_squares};
use super::prepare::Prepared;
use super::problem::{Course, Problem, Stretch};
use super::report::{NextDrive, NextExperiment};
use super::rows::Rows;

/// Length of a proposed run.
const LENGTH_S: f64 = 12.0;
/// How much further than so far a proposed run takes the response at its usual level.
const FURTHER: f64 = 1.5;
/// Mean square in noise floors below which a run separates nothing.
const SEPARATED: f64 = 0.3;

/// A drive of the menu with its samples, `[drive][sample]`.
struct Proposal {
    drive: NextDrive,
    samples: Vec<Vec<f64>>,
}

/// The run that tells the leader from its strongest rival best, if there is a rival.
pub(super) fn next_experiment(
    input: &Input,
    prepared: &Prepared,
    ranked: &[Ranked],
) -> Option<NextExperiment> {
    let leader = ranked.first()?;
    let problem = &prepared.problems[leader.scored.problem];
    let effect = leader.scored.effect();
    // What is more flexible than the leader can follow it anywhere: no run tells them apart.
    let rival = ranked.iter().find(|r| {
        r.scored.problem == leader.scored.problem
            && r.scored.effect() != effect
            && r.scored.effect().tier() <= effect.tier().max(Tier::Law)
    })?;
    let noise = &prepared.noises[problem.response].ar;
    let limit = input.limits(&problem.drive_peak);
    let menu = menu(problem, &limit, prepared.band, input.sample_rate_hz(), input.seed);
    let (a, b) = (&leader.scored.fitted, &rival.scored.fitted);
    let separated: Vec<Option<(f64, Proposal)>> = menu
        .into_par_iter()
        .map(|proposal| {
            let proposal = spared(problem, a, proposal, noise, prepared.band)?;
            Some((separation(problem, a, b, &proposal, noise, prepared.band)?, proposal))
        })
        .collect();
    let (best, proposal) = separated.into_iter().flatten().max_by(|a, b| a.0.total_cmp(&b.0))?;
    Some(NextExperiment {
        drive: proposal.drive,
        separates: vec![effect, rival.scored.effect()],
        expected_separation: best,
        inseparable_in_envelope: best < SEPARATED,
    })
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

/// The proposal, weakened where it would take the response much further than the runs so far did: a sine at
/// a sharp resonance may break the specimen inside the limits of the drive, and what breaks away from all
/// that was measured tells little of it. `None` where the leader's free run runs away.
fn spared(
    problem: &Problem,
    leader: &Fitted,
    mut proposal: Proposal,
    noise: &Ar,
    band: [f64; 2],
) -> Option<Proposal> {
    let centre = problem.scales.y_mean;
    let reach = |y: &[f64]| y.iter().fold(0.0_f64, |m, y| m.max((y - centre).abs()));
    let so_far = problem.fit.iter().map(|s| reach(&s.measured)).fold(0.0, f64::max);
    let new = stretch(problem, &proposal, noise, band);
    let furthest = FURTHER * so_far * proposal.drive.level_rel.max(1.0);
    let share = furthest / reach(&leader.candidate.predict(problem, &new, &leader.p)?);
    if share < 1.0 {
        // A level that can be set at a rig.
        let level = (100.0 * share * proposal.drive.level_rel).ceil() / 100.0;
        let share = level / proposal.drive.level_rel;
        proposal.drive.level_rel = level;
        proposal.samples.iter_mut().flatten().for_each(|u| *u *= share);
    }
    Some(proposal)
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

/// Mean square difference in noise floors, on the proposed run, between the leader and a rival that
/// has re-adapted to all runs; `None` where either runs away.
fn separation(
    problem: &Problem,
    leader: &Fitted,
    rival: &Fitted,
    proposal: &Proposal,
    noise: &Ar,
    band: [f64; 2],
) -> Option<f64> {
    let new = stretch(problem, proposal, noise, band);
    let rows = |of: &Fitted, p: &[f64], new_only: bool| -> Option<Vec<f64>> {
        let mut out = Vec::new();
        if !new_only {
            for old in &problem.fit {
                old.extend(&of.candidate.predict(problem, old, p)?, &mut out);
            }
        }
        new.extend(&of.candidate.predict(problem, &new, p)?, &mut out);
        Some(out)
    };
    let of_rival = |p: &[f64]| rows(rival, p, false);
    let now = of_rival(&rival.p)?;
    let target: Vec<f64> = rows(leader, &leader.p, false)?.iter().zip(&now).map(|(a, b)| a - b).collect();
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
    use crate::engine::diagnosis::effect::Effect;
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
        let reach = |y: &[f64]| y.iter().fold(0.0_f64, |m, y| m.max((y - problem.scales.y_mean).abs()));
        let so_far = problem.fit.iter().map(|s| reach(&s.measured)).fold(0.0, f64::max);
        for proposal in menu(problem, &problem.drive_peak, prepared.band, 256.0, 1) {
            let before = proposal.drive.clone();
            let after = spared(problem, &leader, proposal, noise, prepared.band).unwrap();
            let new = stretch(problem, &after, noise, prepared.band);
            let most = 1.6 * so_far * before.level_rel.max(1.0);
            assert!(reach(&leader.candidate.predict(problem, &new, &leader.p).unwrap()) < most, "{before:?}");
            let weakened = after.drive.level_rel < before.level_rel;
            match before.kind.as_str() {
                "slow_sine" => assert!(!weakened, "{before:?}"),
                "resonance_sine" if before.level_rel == 1.0 => assert!(weakened, "{before:?}"),
                _ => {}
            }
        }
    }
}
