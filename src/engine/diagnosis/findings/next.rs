//! The run that would separate two effects best: T-optimality (Atkinson and Fedorov 1975), either of the two taken
//! for the true one by its probability (Ponce de Leon and Atkinson 1991).
//!
//! The plain distance of two predictions misleads: the other would re-adapt to the new run. So what the one that
//! is taken for true says of the runs so far and of the new one stands in the place of what is measured, the
//! other is fitted to it, and what squares that leaves on all of these runs count, as they will when they decide:
//! beside those that it takes to decide, which are more where the new run has a larger gap.

use std::sync::Arc;

use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};
use rayon::prelude::*;

use crate::diagnosis::data::prepare::Prepared;
use crate::diagnosis::data::problem::{Problem, Stretch, scored_rows};
use crate::diagnosis::effects::effect::{Effect, Tier};
use crate::diagnosis::effects::kernel::Clock;
use crate::diagnosis::effects::plant::Course;
use crate::diagnosis::fit::fitting::{Effort, Fitted, fit};
use crate::diagnosis::fit::start::Regression;
use crate::diagnosis::input::Input;
use crate::diagnosis::numerics::ar::Ar;
use crate::diagnosis::numerics::levmar::{Limits, minimise, quotients};
use crate::diagnosis::numerics::linear::{dot, least_squares};
use crate::diagnosis::numerics::rows::Rows;
use crate::diagnosis::report::{NextDrive, NextExperiment, Verdict, VerdictKind};
use crate::diagnosis::search::decide::{Ranked, apart};

/// Length of a proposed run.
const LENGTH_S: f64 = 12.0;
/// How much further than so far a proposed run takes the response at its usual level.
const FURTHER: f64 = 1.5;
/// Times the smallest gap that is material, to which a proposed run may dilute it: what is small beside a sine at
/// resonance is no gap.
const MATERIAL: f64 = 1.5;
/// Jacobians that a fit to what another effect says may take.
const ROUNDS: usize = 8;

/// A drive of the menu with its samples, `[drive][sample]`.
struct Proposal {
    drive: NextDrive,
    samples: Vec<Vec<f64>>,
}

/// The run that tells the leader best from its rivals, if there are any: those of the verdict's set, which the runs
/// so far leave open, else the strongest. Fits say which run, where one of the set may be right; derivatives do, in
/// a fraction of the time, where nothing is in doubt or none of the catalogue is what the sim lacks.
pub fn next_experiment(
    input: &Input,
    prepared: &Prepared,
    ranked: &[Ranked],
    verdict: &Verdict,
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
        if verdict.equivalence_set.contains(&rival.scored.effect()) && !open.iter().any(stands) {
            open.push(rival);
        }
    }
    let in_doubt = !open.is_empty() && verdict.kind != VerdictKind::NoneOfCatalogue;
    if open.is_empty() {
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
    let behind = if in_doubt { refitted } else { linearised };
    let squares = |rival: &Ranked, new: &Stretch| {
        let fits = [leading, &rival.scored.fitted];
        let named = [leader, rival].map(|r| (r.scored.effect(), r.probability));
        expected(named, |truth| behind(problem, fits[truth], fits[1 - truth], new))
    };
    let with_new: Vec<Option<Problem>> =
        runs.par_iter().map(|(_, new)| imagined(problem, leading, new)).collect();
    let shows = |imagined: &Problem| gap_of(imagined) > MATERIAL * input.material_gap;
    // A gap that no run shows as well is none to be choosy about.
    let choosy = with_new.iter().flatten().any(shows);
    let of_runs: Vec<Vec<Option<Separation>>> = runs
        .par_iter()
        .zip(&with_new)
        .map(|((_, new), with_new)| {
            let needed = with_new
                .as_ref()
                .filter(|with_new| !choosy || shows(with_new))
                .map(|with_new| told_apart(with_new, leader.scored.chi2));
            let Some(needed) = needed else { return vec![None; open.len()] };
            open.iter().map(|rival| Some(Separation { squares: squares(rival, new)?, needed })).collect()
        })
        .collect();
    let of_all = most_separating(&of_runs, open.len())?;
    let seen = |s: &Separating| s.separation.share() >= 1.0;
    // Where one of several cannot be told apart by any run, the strongest may be.
    let best = if seen(&of_all) { of_all } else { most_separating(&of_runs, 1).unwrap_or(of_all) };
    let (drive, new) = &runs[best.run];
    Some(NextExperiment {
        drive: drive.clone(),
        separates: vec![effect, open[best.rival].scored.effect()],
        expected_separation: best.separation.squares / new.rows.len() as f64,
        inseparable_in_envelope: !seen(&best),
    })
}

/// Gap relative to how far the response moves, both as imagined.
fn gap_of(imagined: &Problem) -> f64 {
    let (mut gap, mut response) = (0.0, 0.0);
    for stretch in &imagined.fit {
        let own = &stretch.gap(imagined.response)[stretch.lead..];
        let moves = stretch.scored(stretch.measured.to_vec());
        gap += dot(own, own);
        response += dot(&moves, &moves);
    }
    (gap / response.max(f64::MIN_POSITIVE)).sqrt()
}

/// Squared noise floors that tell the leader, which leaves the mean square `left`, from another effect on the runs
/// as imagined with a new one: the more, the larger their gap, since what equations err by grows with it.
fn told_apart(imagined: &Problem, left: f64) -> f64 {
    // What is imagined is without noise.
    let none = 1.0 + imagined.chi2_none(&imagined.fit);
    apart(none, scored_rows(&imagined.fit), left)
}

/// What a run is expected to leave between two effects, in squared noise floors, and what it takes to tell them.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Separation {
    squares: f64,
    needed: f64,
}

impl Separation {
    fn share(self) -> f64 {
        self.squares / self.needed
    }
}

/// A run, and the rival that it separates from the leader least.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Separating {
    run: usize,
    rival: usize,
    separation: Separation,
}

/// Of what each run is expected to leave between the leader and its rivals, `[run][rival]`, the most beside what it
/// takes: what counts is the one of the first so many rivals that comes nearest. `None` where every one runs away.
fn most_separating(of_runs: &[Vec<Option<Separation>>], rivals: usize) -> Option<Separating> {
    let by_share = |a: &Separating, b: &Separating| a.separation.share().total_cmp(&b.separation.share());
    let nearest = |(run, of): (usize, &Vec<Option<Separation>>)| {
        let known = of[..rivals].iter().enumerate();
        let known = known.filter_map(|(rival, x)| Some(Separating { run, rival, separation: (*x)? }));
        known.min_by(by_share)
    };
    of_runs.iter().enumerate().filter_map(nearest).max_by(by_share)
}

/// Squares that one of two effects, given with their probabilities, is expected to leave where the other is true,
/// `behind(which is true)`: the geometric mean, since what is far apart already gains little by more, and one of
/// the two mostly gains much by any run that is loud. `None` where neither is known.
fn expected(of: [(Effect, f64); 2], behind: impl Fn(usize) -> Option<f64>) -> Option<f64> {
    let (mut sum, mut probability) = (0.0, 0.0);
    for truth in [0, 1] {
        // What holds the true law as a special case follows it through any run.
        if of[1 - truth].0.contains(of[truth].0) {
            continue;
        }
        let Some(squares) = behind(truth) else { continue };
        sum += of[truth].1 * squares.ln_1p();
        probability += of[truth].1;
    }
    (probability > 0.0).then(|| (sum / probability).exp_m1())
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

/// Squared noise floors that `other` leaves, moved as its derivatives say, on the runs so far and a new one where
/// `truth` is true; `None` where either runs away.
fn linearised(problem: &Problem, truth: &Fitted, other: &Fitted, new: &Stretch) -> Option<f64> {
    let rows = |of: &Fitted, p: &[f64]| -> Option<Vec<f64>> {
        let mut out = Vec::new();
        for stretch in problem.fit.iter().chain([new]) {
            stretch.extend(&of.candidate.predict(problem, stretch, p)?, &mut out);
        }
        Some(out)
    };
    let of_other = |p: &[f64]| rows(other, p);
    let now = of_other(&other.p)?;
    let mut left: Vec<f64> = rows(truth, &truth.p)?.iter().zip(&now).map(|(a, b)| a - b).collect();
    let jacobian = quotients(&of_other, &other.p, &other.scale, &now);
    let columns: Vec<&[f64]> = jacobian.iter().map(|c| c.values.as_slice()).collect();
    for (column, x) in columns.iter().zip(least_squares(&columns, &left)) {
        left.iter_mut().zip(*column).for_each(|(l, c)| *l -= x * c);
    }
    let squares = dot(&left, &left);
    squares.is_finite().then_some(squares)
}

/// The same with `other` fitted, from where it is and anew: friction with a yield displacement may turn into one
/// without.
fn refitted(problem: &Problem, truth: &Fitted, other: &Fitted, new: &Stretch) -> Option<f64> {
    let imagined = imagined(problem, truth, new)?;
    let candidate = &other.candidate;
    let rows = |p: &[f64]| candidate.fit_rows(&imagined, p);
    let limits = Limits { rounds: ROUNDS, still: 1e-3, enough: 0.0 };
    let anew = fit(&imagined, &Regression::new(&imagined, true), candidate, &[], Effort { rounds: ROUNDS });
    let costs = [Some(other), anew.as_ref()].into_iter().flatten().filter_map(|from| {
        let derivatives = |p: &[f64]| candidate.jacobian(&imagined, p, &from.scale);
        Some(minimise(rows, derivatives, &from.p, &from.scale, limits)?.cost)
    });
    costs.filter(|cost| cost.is_finite()).min_by(f64::total_cmp)
}

/// The response with what an effect says of the runs so far and of a new one in the place of what was
/// measured.
fn imagined(problem: &Problem, truth: &Fitted, new: &Stretch) -> Option<Problem> {
    let says = |stretch: &Stretch| {
        let measured = Arc::new(truth.candidate.predict(problem, stretch, &truth.p)?);
        Some(Stretch { measured, ..stretch.clone() })
    };
    let fit: Option<Vec<Stretch>> = problem.fit.iter().chain([new]).map(says).collect();
    Some(Problem { fit: fit?, ..problem.clone() })
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
    use crate::diagnosis::data::prepare::prepare;
    use crate::diagnosis::effects::candidate::{Candidate, Part};
    use crate::diagnosis::effects::law::Law;
    use crate::diagnosis::tests::rig::{hardening, request};
    use crate::progress::unwatched;

    #[test]
    fn either_effect_counts_as_the_true_one_by_its_probability_but_not_where_the_other_holds_it() {
        let coulomb = (Effect::CoulombFriction, 0.6);
        let stribeck = (Effect::StribeckFriction, 0.2);
        let stop = (Effect::BumpStop, 0.2);
        let of = |pair, squares: [Option<f64>; 2]| expected(pair, |truth| squares[truth]);
        let near = |found: Option<f64>, x: f64| assert!((found.unwrap() - x).abs() < 1e-9, "{found:?} {x}");
        let mean = (0.75 * 100.0_f64.ln() + 0.25 * 10.0_f64.ln()).exp() - 1.0;
        near(of([coulomb, stop], [Some(99.0), Some(9.0)]), mean);
        near(of([coulomb, stop], [None, Some(9.0)]), 9.0);
        assert_eq!(of([coulomb, stop], [None, None]), None);
        // Stribeck's friction follows Coulomb's anywhere; the other way round it shows.
        near(of([coulomb, stribeck], [Some(0.0), Some(50.0)]), 50.0);
        near(of([stribeck, coulomb], [Some(50.0), Some(0.0)]), 50.0);
    }

    #[test]
    fn of_runs_the_one_counts_whose_nearest_rival_is_farthest() {
        let of = |squares, needed| Separation { squares, needed };
        let of_runs = vec![
            vec![Some(of(90.0, 10.0)), Some(of(2.0, 10.0))],
            vec![Some(of(40.0, 10.0)), Some(of(30.0, 10.0))],
            vec![None, Some(of(35.0, 10.0))],
            vec![None, None],
            // A loud one, whose gap hides far more.
            vec![Some(of(900.0, 1000.0)), Some(of(800.0, 1000.0))],
        ];
        let found = |run, rival, separation| Some(Separating { run, rival, separation });
        assert_eq!(most_separating(&of_runs, 2), found(2, 1, of(35.0, 10.0)));
        assert_eq!(most_separating(&of_runs, 1), found(0, 0, of(90.0, 10.0)));
        assert_eq!(most_separating(&of_runs[3..4], 2), None);
    }

    #[test]
    fn a_run_with_more_gap_shows_it_better_and_takes_more_to_tell() {
        let prepared = prepare(&request(hardening, 0.01), &unwatched).unwrap();
        let problem = &prepared.problems[0];
        let candidate = Candidate::of(Part::force(Effect::CubicStiffness, vec![Law::Cubic], None), false);
        let mut p = vec![0.0; candidate.parameters(problem)];
        let path = candidate.parts[0].forces[0].shapes();
        p[path..]
            .iter_mut()
            .zip(&problem.core.input[0])
            .for_each(|(p, b)| *p = -0.001 * b * problem.drive_peak[0]);
        let leader = Fitted { candidate, scale: p.clone(), p, chi2_fit: 1.0 };
        let noise = &prepared.noises[0].ar;
        let of = |level: f64| {
            let proposals = menu(problem, &[10.0 * problem.drive_peak[0]], prepared.band, 256.0, 1);
            let mut loud = proposals.into_iter().find(|p| p.drive.kind == "noise").unwrap();
            loud.samples.iter_mut().flatten().for_each(|u| *u *= level / loud.drive.level_rel);
            let with_new =
                imagined(problem, &leader, &stretch(problem, &loud, noise, prepared.band)).unwrap();
            (gap_of(&with_new), told_apart(&with_new, 1.0), told_apart(&with_new, 2.0))
        };
        let (low, usual, high) = (of(0.3), of(1.0), of(2.0));
        assert!(usual.0 < 0.9 * high.0, "{} {}", usual.0, high.0);
        assert!(low.1 < usual.1 && usual.1 < high.1, "{} {} {}", low.1, usual.1, high.1);
        assert!(usual.2 > usual.1 + 10.0, "what errs tells less: {} {}", usual.1, usual.2);
    }

    #[test]
    fn a_sine_at_resonance_is_weakened_and_a_slow_one_is_not() {
        let prepared = prepare(&request(hardening, 0.01), &unwatched).unwrap();
        let problem = &prepared.problems[0];
        let candidate = Candidate::of(Part::force(Effect::CubicStiffness, vec![Law::Cubic], None), false);
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
