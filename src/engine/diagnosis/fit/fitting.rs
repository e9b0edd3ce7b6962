//! From a candidate to its best free run: start, then Levenberg and Marquardt.

use super::start::{Regression, Start};
use crate::diagnosis::data::problem::{Problem, scored_rows};
use crate::diagnosis::effects::candidate::{Candidate, Part};
use crate::diagnosis::effects::effect::Tier;
use crate::diagnosis::numerics::levmar::{Limits, minimise};
use crate::diagnosis::numerics::linear::dot;

/// Starts that are followed to their end,
const FOLLOWED: usize = 2;
/// and of a law of several shape numbers, which is stuck sooner.
const FOLLOWED_OF_SHAPES: usize = 3;
/// Jacobians of a fit that only makes a start.
const PLAIN_ROUNDS: usize = 10;

/// Mean square, in noise floors, from which what the best leaves may be the core's own error,
const CORE_ERRS: f64 = 1.05;
/// and the Jacobians in which the core may be corrected.
const TOLERANT_ROUNDS: usize = 8;

/// A fitted candidate.
#[derive(Debug, Clone)]
pub struct Fitted {
    pub candidate: Candidate,
    pub p: Vec<f64>,
    pub scale: Vec<f64>,
    /// Mean square in noise floors on the fit stretches.
    pub chi2_fit: f64,
}

impl Fitted {
    /// Puts the second of two effects first; `order` is that of the core.
    pub fn exchange(&mut self, order: usize) {
        let [first, second] = [0, 1].map(|k| self.candidate.parts[k].parameters(order));
        self.candidate.parts.swap(0, 1);
        self.p[..first + second].rotate_left(first);
        self.scale[..first + second].rotate_left(first);
    }
}

/// How much work a fit may be.
#[derive(Debug, Clone, Copy)]
pub struct Effort {
    /// Jacobians.
    pub rounds: usize,
}

/// Fits the last part of a candidate on top of `known`, then all parameters together; `None` if
/// no start gives a free run that stays finite.
pub fn fit(
    problem: &Problem,
    regression: &Regression<'_>,
    candidate: &Candidate,
    known: &[f64],
    effort: Effort,
) -> Option<Fitted> {
    let mut starts = regression.starts(candidate, known);
    let law = |part: &Part| part.effect.tier() == Tier::Law && part.shapes() > 1;
    let shapes = candidate.parts.last().is_some_and(law);
    let followed = if shapes { FOLLOWED_OF_SHAPES } else { FOLLOWED };
    starts.truncate(followed);
    if let Some(stiff) = starts.first().and_then(|s| without_retune(problem, regression, candidate, known, s))
    {
        starts.insert(1, stiff);
        starts.truncate(followed);
    }
    let mut best: Option<Fitted> = None;
    for start in &starts {
        let Some(found) = improve(problem, candidate, start, effort) else { continue };
        if best.as_ref().is_none_or(|b| found.chi2_fit < b.chi2_fit) {
            best = Some(found);
        }
        // Nothing left: another start cannot be better.
        if !shapes && best.as_ref().is_some_and(|b| b.chi2_fit < 1.1) {
            break;
        }
    }
    best
}

/// Goes on where a fit was left off; where nothing is gained the fit stays as it was.
pub fn finish(problem: &Problem, fitted: Fitted, effort: Effort) -> Fitted {
    refit(problem, &fitted, fitted.candidate.clone(), effort).unwrap_or(fitted)
}

/// The fit, of which the best on this response leaves `least`, with its linear part let go as far as the
/// baseline runs leave it open; as it was where nothing is left, where they are no bound, or where it is free
/// already.
pub fn tolerant(problem: &Problem, fitted: Fitted, least: f64) -> Fitted {
    if least <= CORE_ERRS || fitted.candidate.retune || problem.tolerance.is_none() {
        return fitted;
    }
    let candidate = Candidate { retune: true, ..fitted.candidate.clone() };
    refit(problem, &fitted, candidate, Effort { rounds: TOLERANT_ROUNDS }).unwrap_or(fitted)
}

/// Fits a candidate from where a fit left off that differs by a retune at most: without it, or with one that is
/// held. `None` if its free run does not stay finite.
pub fn refit(problem: &Problem, fitted: &Fitted, candidate: Candidate, effort: Effort) -> Option<Fitted> {
    let count = candidate.parameters(problem);
    let (mut p, mut scale) = (fitted.p.clone(), fitted.scale.clone());
    p.resize(count, 0.0);
    // The slopes of a retune need no step.
    scale.resize(count, 1.0);
    let start = Start { p, scale, cost: fitted.chi2_fit, linear: vec![false; count] };
    improve(problem, &candidate, &start, effort)
}

/// Improves one start; with no rounds the start itself is the answer. `None` if its free run does not
/// stay finite.
pub fn improve(problem: &Problem, candidate: &Candidate, start: &Start, effort: Effort) -> Option<Fitted> {
    let rows = scored_rows(&problem.fit);
    let residual = |p: &[f64]| candidate.fit_rows(problem, p);
    let p = steady(start, &residual)?;
    let (p, cost) = if effort.rounds == 0 {
        let left = residual(&p)?;
        (p, dot(&left, &left))
    } else {
        let limits = Limits { rounds: effort.rounds, still: 1e-3, enough: 0.9 * rows };
        let derivatives = |p: &[f64]| candidate.jacobian(problem, p, &start.scale);
        let found = minimise(residual, derivatives, &p, &start.scale, limits)?;
        (found.p, found.cost)
    };
    Some(Fitted { candidate: candidate.clone(), p, scale: start.scale.clone(), chi2_fit: cost / rows })
}

/// The candidate fitted with the linear part as it is: what noise in a measured response does to the
/// regression of a retune, it cannot do here. `like` gives the retune's scales.
fn without_retune(
    problem: &Problem,
    regression: &Regression<'_>,
    candidate: &Candidate,
    known: &[f64],
    like: &Start,
) -> Option<Start> {
    let retuned = candidate.retuned(problem);
    let plain = Candidate { retune: false, ..candidate.clone() };
    if retuned == 0 || plain.parameters(problem) == known.len() {
        return None;
    }
    let residual = |p: &[f64]| plain.residual_rows(problem, &problem.fit, p);
    let start = regression.starts(&plain, known).into_iter().next()?;
    let p = steady(&start, &residual)?;
    let derivatives = |p: &[f64]| plain.jacobian(problem, p, &start.scale);
    let limits = Limits { rounds: PLAIN_ROUNDS, still: 1e-2, enough: 0.0 };
    let found = minimise(residual, derivatives, &p, &start.scale, limits)?;
    let (mut p, mut scale) = (found.p, start.scale);
    p.resize(like.p.len(), 0.0);
    scale.extend(&like.scale[scale.len()..]);
    // Shrinking would take away what the fit has found.
    let linear = vec![false; p.len()];
    Some(Start { p, scale, cost: found.cost, linear })
}

/// The start with its linear parameters shrunk until its free run is finite and best.
fn steady(start: &Start, residual: &impl Fn(&[f64]) -> Option<Vec<f64>>) -> Option<Vec<f64>> {
    let mut best: Option<(f64, Vec<f64>)> = None;
    for share in [1.0, 0.7, 0.4, 0.15, 0.03] {
        let p: Vec<f64> =
            start.p.iter().zip(&start.linear).map(|(p, &l)| if l { p * share } else { *p }).collect();
        if let Some(rows) = residual(&p) {
            let cost = dot(&rows, &rows);
            if best.as_ref().is_none_or(|(b, _)| cost < *b) {
                best = Some((cost, p));
            } else {
                break;
            }
        }
    }
    best.map(|b| b.1)
}
