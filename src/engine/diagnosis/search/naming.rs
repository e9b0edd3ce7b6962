//! Fits that should not be told by the name of their effect, however well they close the gap: a free
//! shape that does as well as a straight line is a linear change, a sandwich whose first linear part
//! passes the drive as it is, is a map of that drive, and friction that drives the rig is no friction.

use realfft::num_complex::Complex64;
use rigcast_numerics::fft::RealFftPlanner;

use crate::diagnosis::data::problem::{Problem, Stretch};
use crate::diagnosis::effects::candidate::{Candidate, INNER_KNOTS, Part, inner_signal, inner_spline};
use crate::diagnosis::effects::effect::Family;
use crate::diagnosis::effects::input_map::InputMap;
use crate::diagnosis::effects::kernel;
use crate::diagnosis::effects::law::Law;
use crate::diagnosis::fit::fitting::Fitted;
use crate::diagnosis::numerics::linear::{dot, mean};
use crate::diagnosis::numerics::rows::fast_len;
use crate::diagnosis::numerics::spline::Spline;

/// Squared correlation with the drive above which the inner signal of a sandwich is the drive.
const IS_DRIVE: f64 = 0.98;

/// The same with the core's response: a law of the response, and no block before the rig.
const IS_RESPONSE: f64 = 0.95;

/// A straight line.
struct Line {
    middle: f64,
    centre: f64,
    slope: f64,
}

impl Line {
    /// The line nearest to `y` over `x`; level where `x` does not move.
    fn through(x: &[f64], y: &[f64], weights: &[f64]) -> Self {
        let total: f64 = weights.iter().sum();
        let (middle, centre) = (dot(weights, x) / total, dot(weights, y) / total);
        let (mut product, mut square) = (0.0, 0.0);
        for ((x, y), w) in x.iter().zip(y).zip(weights) {
            product += w * (x - middle) * (y - centre);
            square += w * (x - middle) * (x - middle);
        }
        Self { middle, centre, slope: if square > 0.0 { product / square } else { 0.0 } }
    }

    fn at(&self, x: f64) -> f64 {
        self.centre + self.slope * (x - self.middle)
    }
}

/// Times what a law leaves above the noise that a straight line must leave for the law to be worth its bend,
const WORTH: f64 = 1.5;
/// and what this is counted from at least, in noise floors squared.
const NOISE: f64 = 0.05;

/// How far a force must work as one at the response's own place does, where the linear part is known. Rigs
/// that are struck elsewhere pass for less than 1.
const PASSIVE: f64 = 0.4;

/// Free function of a part: its spline and where its knots stand in the parameters.
fn free_function(part: &Part, order: usize) -> Option<(Spline, usize)> {
    if part.sandwich {
        return Some((inner_spline(), order + 1));
    }
    match (&part.input, part.forces.first()) {
        (Some(InputMap::Free(spline)), _)
        | (None, Some(Law::FreeStiffness(spline) | Law::FreeDamping(spline))) => Some((spline.clone(), 0)),
        _ => None,
    }
}

/// Mean square in noise floors, on the select stretches, with the free function straightened;
/// `None` for effects without one, or where the straightened run runs away.
pub fn straightened(problem: &Problem, fitted: &Fitted) -> Option<f64> {
    let part = fitted.candidate.parts.first()?;
    let (spline, at) = free_function(part, problem.core.modes.order())?;
    let places = spline.places();
    let knots = &fitted.p[at..at + spline.knots()];
    let line = if part.sandwich {
        // How large its inner signal is, is its own affair.
        let (path, direct) = (&fitted.p[..at - 1], fitted.p[at - 1]);
        let inner = |s: &Stretch| inner_signal(problem, s, part.drive, path, direct).split_off(s.lead);
        let x: Vec<f64> = problem.select.iter().flat_map(inner).collect();
        let values: Vec<f64> = x.iter().map(|x| spline.at(knots, *x)).collect();
        Line::through(&x, &values, &vec![1.0; x.len()])
    } else {
        // Weights of the knots: how often the argument comes near them.
        let variance = if part.input.is_some() {
            let peak = problem.drive_peak[part.drive];
            let power: Vec<f64> = problem
                .fit
                .iter()
                .flat_map(|s| s.drives[part.drive].iter().map(|u| (u / peak) * (u / peak)))
                .collect();
            mean(&power).max(1e-6)
        } else {
            1.0
        };
        let weights: Vec<f64> = places.iter().map(|x| (-0.5 * x * x / variance).exp()).collect();
        Line::through(&places, knots, &weights)
    };
    let mut p = fitted.p.clone();
    for (value, x) in p[at..].iter_mut().zip(&places) {
        *value = line.at(*x);
    }
    let predictions = fitted.candidate.predictions(problem, &problem.select, &p)?;
    Some(problem.chi2(&problem.select, &predictions))
}

/// Whether the candidate is a sandwich whose inner signal is no other than its drive or the response.
pub fn open_sandwich(problem: &Problem, candidate: &Candidate, p: &[f64]) -> bool {
    let order = problem.core.modes.order();
    let Some(part) = candidate.parts.first().filter(|part| part.sandwich) else { return false };
    let (path, direct) = (&p[..order], p[order]);
    debug_assert!(p.len() >= order + 1 + INNER_KNOTS);
    let is = |least: f64, of: fn(&Stretch, usize) -> Vec<f64>| {
        let (mut uu, mut ss, mut us) = (0.0, 0.0, 0.0);
        for stretch in &problem.select {
            let inner = stretch.scored(inner_signal(problem, stretch, part.drive, path, direct));
            let other = stretch.scored(of(stretch, part.drive));
            uu += dot(&other, &other);
            ss += dot(&inner, &inner);
            us += dot(&inner, &other);
        }
        us * us > least * uu * ss
    };
    is(IS_DRIVE, |s, drive| s.drives[drive].clone()) || is(IS_RESPONSE, |s, _| s.core.to_vec())
}

/// How far the forces of laws of the response work as a force at the response's own place does, from
/// -1 to 1, of several effects the least; 1 for other effects.
///
/// There the velocity that a force causes has a share in phase with it at every frequency (a passive
/// rig returns no work), and dry friction and damping take work out. A law with a path that turns its
/// phase stands for another effect: damping told as stiffness, or friction that drives.
pub fn passivity(problem: &Problem, fitted: &Fitted, predictions: &[Vec<f64>]) -> f64 {
    let mut rest = fitted.p.as_slice();
    let mut least = 1.0_f64;
    for part in &fitted.candidate.parts {
        let (own, further) = rest.split_at(part.parameters(problem.core.modes.order()));
        least = least.min(of_part(problem, part, own, predictions));
        rest = further;
    }
    least
}

/// Whether forces that are passive so far are none of this response's: with the linear part free there is a
/// doubt about all but the sign.
pub fn not_collocated(problem: &Problem, candidate: &Candidate, passivity: f64) -> bool {
    passivity < if problem.retunes_freely(candidate) { 0.0 } else { PASSIVE }
}

fn of_part(problem: &Problem, part: &Part, p: &[f64], predictions: &[Vec<f64>]) -> f64 {
    let family = part.effect.family();
    let loses = matches!(family, Family::FrictionHysteresis | Family::Damping);
    let [law] = part.forces.as_slice() else { return 1.0 };
    if !(loses || family == Family::Stiffness) {
        return 1.0;
    }
    let modes = &problem.core.modes;
    let (shape, rest) = p.split_at(law.shapes());
    let path = &rest[..modes.order()];
    let (mut sum, mut size, mut taken) = (0.0, 0.0, 0.0);
    for (stretch, prediction) in problem.select.iter().zip(predictions) {
        let force = kernel::along(law, shape, prediction, &[], problem.scales, stretch.clock);
        // A mean does no work, and leaks into the lines beside it.
        let force = stretch.scored(force);
        let moves = prediction[stretch.lead..].windows(2).map(|w| w[1] - w[0]);
        taken += force.iter().zip(moves).map(|(f, dy)| f * dy).sum::<f64>();
        let (n, lines) = power_lines(&force);
        for (line, power) in lines.iter().enumerate() {
            let f = line as f64 / n as f64;
            let z = Complex64::from_polar(1.0, std::f64::consts::TAU * f);
            // From a force midway between two samples to the change between them.
            let in_phase = ((z - 1.0) * modes.transfer(path, f)).re * power;
            sum += in_phase;
            size += in_phase.abs();
        }
    }
    // What does not act here is no worse for it.
    if size == 0.0 {
        return 1.0;
    }
    let share = sum / size;
    if loses { -share * taken.signum() } else { share.abs() }
}

/// Whether a stop, a gap or a bent spring, which leaves `chi2`, does no better than the straight line nearest
/// to it along the free run: a clearance that the response hardly leaves, a stop that touches at rest where
/// the rig does not pass on what its kink adds. With the linear part free no line is left to stand for.
pub fn line_in_disguise(problem: &Problem, fitted: &Fitted, predictions: &[Vec<f64>], chi2: f64) -> bool {
    let [law @ (Law::Cubic | Law::BumpStop | Law::OneSided(_) | Law::Clearance)] =
        fitted.candidate.parts[0].forces.as_slice()
    else {
        return false;
    };
    if problem.retunes_freely(&fitted.candidate) {
        return false;
    }
    let (shape, rest) = fitted.p.split_at(law.shapes());
    let (mut square, mut product) = (0.0, 0.0);
    for (stretch, prediction) in problem.select.iter().zip(predictions) {
        let of = |law: &Law| {
            stretch.scored(kernel::along(law, shape, prediction, &[], problem.scales, stretch.clock))
        };
        let y = of(&Law::Linear);
        square += dot(&y, &y);
        product += dot(&y, &of(law));
    }
    let mut line = fitted.candidate.clone();
    line.parts[0].forces = vec![Law::Linear];
    let mut p = rest.to_vec();
    p[..problem.core.modes.order()].iter_mut().for_each(|e| *e *= product / square);
    let predictions = line.predictions(problem, &problem.select, &p);
    let leaves = predictions.map_or(f64::INFINITY, |p| problem.chi2(&problem.select, &p));
    leaves - 1.0 < WORTH * (chi2 - 1.0).max(NOISE)
}

/// Whether a bump stop or a clearance goes by the other's name. With the linear part free they are one
/// law: what is a stop to a soft rig is a clearance to a stiff one. A stop is then what the response
/// meets for less than a third of the time, a clearance what it stays in for less than two thirds.
pub fn alias_preferred(problem: &Problem, fitted: &Fitted, predictions: &[Vec<f64>]) -> bool {
    let part = &fitted.candidate.parts[0];
    if !problem.retunes_freely(&fitted.candidate)
        || !matches!(part.forces.as_slice(), [Law::BumpStop | Law::Clearance])
    {
        return false;
    }
    let gap = fitted.p[0].abs() * problem.scales.y;
    let (mut inside, mut all) = (0, 0);
    for (stretch, prediction) in problem.select.iter().zip(predictions) {
        let scored = &prediction[stretch.lead..];
        inside += scored.iter().filter(|y| (*y - problem.scales.y_mean).abs() < gap).count();
        all += scored.len();
    }
    (3 * inside > 2 * all) == (part.forces[0] == Law::Clearance)
}

/// Whether a map of a drive that comes in any size bends it by more than all of it, its straight part left aside. No
/// actuator does so: what the drive moves next to nothing of in a straight way answers to its square by another path, as
/// through the motion of an axis that nobody measures.
pub fn more_than_its_drive(problem: &Problem, fitted: &Fitted) -> bool {
    let part = &fitted.candidate.parts[0];
    let Some(map @ (InputMap::Polynomial | InputMap::Free(_))) = &part.input else { return false };
    if problem.retunes_freely(&fitted.candidate) {
        return false;
    }
    let p = &fitted.p[..map.parameters()];
    let (mut drive, mut bend, mut both) = (0.0, 0.0, 0.0);
    for stretch in &problem.select {
        let u = problem.drive(stretch, part.drive);
        let (change, u) = (stretch.scored(map.change(p, &u)), stretch.scored(u));
        drive += dot(&u, &u);
        bend += dot(&change, &change);
        both += dot(&u, &change);
    }
    bend - both * both / drive.max(f64::MIN_POSITIVE) > drive
}

/// Power of the lines of a signal below a quarter of the sample rate, and the length that they are of.
fn power_lines(x: &[f64]) -> (usize, Vec<f64>) {
    let n = fast_len(x.len());
    let fft = RealFftPlanner::new().plan_fft_forward(n);
    let mut input: Vec<f64> = x[..n]
        .iter()
        .enumerate()
        .map(|(i, x)| x * (1.0 - (std::f64::consts::TAU * (i as f64 + 0.5) / n as f64).cos()))
        .collect();
    let mut lines = fft.make_output_vec();
    fft.process(&mut input, &mut lines).expect("buffers are the plan's own");
    (n, lines[..n / 4].iter().map(|z| z.norm_sqr()).collect())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::diagnosis::data::prepare::prepare;
    use crate::diagnosis::effects::effect::Effect;
    use crate::diagnosis::tests::rig::{friction, request};
    use crate::progress::unwatched;

    #[test]
    fn the_nearest_line_goes_through_points_on_one_and_is_level_where_nothing_moves() {
        let x = [-1.0, 0.5, 2.0];
        let line = Line::through(&x, &x.map(|x| 3.0 - 2.0 * x), &[1.0, 0.2, 3.0]);
        assert!((line.at(7.0) + 11.0).abs() < 1e-12);
        let level = Line::through(&[4.0; 2], &[1.0, 2.0], &[1.0; 2]);
        assert_eq!(level.at(100.0), 1.5);
    }

    #[test]
    fn a_spring_pushes_and_what_arrives_a_quarter_turn_later_is_no_spring() {
        let prepared = prepare(&request(friction, 0.01), &unwatched).unwrap();
        let problem = &prepared.problems[0];
        let candidate = Candidate::of(Part::force(Effect::CubicStiffness, vec![Law::Cubic], None), false);
        let work = |path: &[f64]| {
            let mut p = vec![0.0];
            p.extend(path.iter().map(|e| 1e-3 * e));
            let predictions = candidate.predictions(problem, &problem.select, &p).unwrap();
            let scale = vec![1.0; p.len()];
            let fitted = Fitted { candidate: candidate.clone(), p, scale, chi2_fit: 1.0 };
            passivity(problem, &fitted, &predictions)
        };
        // The drive acts at the response's own mass.
        let here = &problem.core.input[0];
        let turned: Vec<f64> = here.chunks(2).flat_map(|c| [-c[1], c[0]]).collect();
        assert!(work(here) > 0.9 && !not_collocated(problem, &candidate, work(here)), "{}", work(here));
        assert!(not_collocated(problem, &candidate, work(&turned)), "{}", work(&turned));
        assert_eq!(work(&vec![0.0; here.len()]), 1.0, "what does nothing is no worse for it");
    }

    #[test]
    fn an_actuator_bends_a_drive_by_less_than_all_of_it() {
        let prepared = prepare(&request(friction, 0.01), &unwatched).unwrap();
        let problem = &prepared.problems[0];
        let candidate = Candidate::of(Part::input(Effect::DrivePolynomial, 0, InputMap::Polynomial), false);
        let more = |candidate: &Candidate, p: &[f64]| {
            let scale = vec![1.0; p.len()];
            let fitted = Fitted { candidate: candidate.clone(), p: p.to_vec(), scale, chi2_fit: 1.0 };
            more_than_its_drive(problem, &fitted)
        };
        assert!(!more(&candidate, &[0.4, -0.5]));
        assert!(more(&candidate, &[20.0, 0.0]) && more(&candidate, &[0.0, -40.0]));
        let law = Candidate::of(Part::force(Effect::CubicStiffness, vec![Law::Cubic], None), false);
        assert!(!more(&law, &[20.0; 9]), "a law of the response is of any size");
        let gain = Candidate::of(Part::input(Effect::Gain, 0, InputMap::Gain), false);
        assert!(!more(&gain, &[20.0]), "a straight one is a gain");
    }

    #[test]
    fn a_sandwich_needs_a_block_of_its_own_before_its_middle() {
        let prepared = prepare(&request(friction, 0.01), &unwatched).unwrap();
        let problem = &prepared.problems[0];
        let core = &problem.core;
        let candidate = Candidate::of(Part::sandwich(0), false);
        let open = |path: &[f64], direct: f64| {
            let mut p = path.to_vec();
            p.push(direct);
            p.resize(candidate.parameters(problem), 0.0);
            open_sandwich(problem, &candidate, &p)
        };
        let nothing = vec![0.0; core.modes.order()];
        assert!(open(&nothing, 1.0), "the drive as it is");
        assert!(open(&core.input[0], core.direct[0]), "the response: a law of its own");
        let mut one_mode = nothing;
        one_mode[0] = 1.0;
        assert!(!open(&one_mode, 0.0), "a filter");
    }
}
