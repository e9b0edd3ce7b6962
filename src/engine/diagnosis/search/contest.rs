//! Candidates of every response with a gap, fitted, scored and ranked together.

use std::sync::atomic::{AtomicUsize, Ordering};

use rayon::prelude::*;

use super::catalogue::{FreeRanges, parts};
use super::decide::{Ranked, allowed, rank};
use super::placement::Placement;
use super::propagation::BaselineScore;
use super::score::{Scored, score};
use super::with_linear_change::remaining_with_linear_change;
use crate::EngineError;
use crate::diagnosis::core::FEW_DRIVES;
use crate::diagnosis::data::overview::Overview;
use crate::diagnosis::data::prepare::Prepared;
use crate::diagnosis::data::problem::Problem;
use crate::diagnosis::effects::candidate::Candidate;
use crate::diagnosis::effects::effect::Effect;
use crate::diagnosis::fit::fitting::{Effort, Fitted, finish, fit, tolerant};
use crate::diagnosis::fit::start::Regression;
use crate::diagnosis::fit::twins::exchange;
use crate::diagnosis::input::{Input, Mode};
use crate::progress::{Watch, report};

/// Candidates of one host whose propagation to other responses is fitted.
const PROPAGATED: usize = 8;

/// Jacobians of a candidate's first fit; only those that come near the best are fitted to their end.
const FIRST: usize = 8;
/// How many times what the best leaves above the noise a candidate may leave to be fitted further,
const BEHIND: f64 = 6.0;
/// and the least, in noise floors squared, that this is counted from.
const NEAR: f64 = 0.3;
/// Of more than a few drives, for each of which a linear part that gives way has some thirteen columns: so many of a response
/// are fitted with one,
const GIVING_WAY: usize = 8;
/// where the best leaves less than this share of its gap: a core errs by little.
const CORE_SHARE: f64 = 0.25;

/// The contest's outcome.
pub struct Outcome<'p> {
    /// The most believable first.
    pub ranked: Vec<Ranked>,
    /// What every response with a gap was regressed with.
    pub regressions: Vec<(usize, Regression<'p>)>,
    /// What is left without any effect, over all responses with a gap.
    pub chi2_none: f64,
    /// Rows that this is the mean square of.
    pub rows: f64,
}

/// Fits every candidate of a catalogue at its host, carries the best to the other responses and ranks all.
///
/// # Errors
/// [`EngineError::Cancelled`].
pub fn contest<'p>(
    input: &Input,
    catalogue: &[Effect],
    prepared: &'p Prepared,
    overview: &Overview,
    watch: Watch<'_>,
) -> Result<Outcome<'p>, EngineError> {
    let in_situ = input.mode == Mode::InSitu;
    let rate = input.sample_rate_hz();
    let placement = Placement::of(input, prepared, overview);
    let regressions: Vec<(usize, Regression<'p>)> =
        overview.seen.par_iter().map(|&r| (r, Regression::new(&prepared.problems[r], true))).collect();
    let mut tasks = Vec::new();
    for (r, regression) in &regressions {
        let problem = &prepared.problems[*r];
        let ranges = FreeRanges::of(problem, &regression.smooth);
        for part in parts(problem, catalogue, in_situ, ranges) {
            if placement.seek(part.effect, part.drive, *r) {
                tasks.push((*r, regression, Candidate::of(part, in_situ)));
            }
        }
    }
    let done = AtomicUsize::new(0);
    let fitted: Vec<Option<(usize, Fitted)>> = tasks
        .par_iter()
        .map(|(r, regression, candidate)| {
            let share = done.load(Ordering::Relaxed) as f64 / tasks.len() as f64;
            report(watch, &candidate.parts[0].effect.name(), 0.1 + 0.5 * share)?;
            let problem = &prepared.problems[*r];
            let fitted = fit(problem, regression, candidate, &[], Effort { rounds: FIRST });
            done.fetch_add(1, Ordering::Relaxed);
            Ok(fitted.map(|f| (*r, f)))
        })
        .collect::<Result<_, EngineError>>()?;
    let mut fitted: Vec<(usize, Fitted)> = fitted.into_iter().flatten().collect();
    exchange(prepared, &mut fitted);
    let mut fitted = further(prepared, fitted, usize::MAX, |problem, f, _| {
        report(watch, &f.candidate.parts[0].effect.name(), 0.6)?;
        Ok(finish(problem, f, Effort { rounds: 40 }))
    })?;
    // Where only one of them got on.
    exchange(prepared, &mut fitted);
    let many = input.drives.len() > FEW_DRIVES;
    let most = if many { GIVING_WAY } else { usize::MAX };
    let gap = |p: &Problem| if many { p.chi2_none(&p.fit) - 1.0 } else { f64::INFINITY };
    let gaps: Vec<f64> = prepared.problems.iter().map(gap).collect();
    let fitted = further(prepared, fitted, most, |problem, f, least| {
        report(watch, &f.candidate.parts[0].effect.name(), 0.6)?;
        let near = least - 1.0 < CORE_SHARE * gaps[problem.response];
        Ok(if near { tolerant(problem, f, least) } else { f })
    })?;
    let scored: Vec<Option<Scored>> = fitted
        .into_par_iter()
        .map(|(r, fitted)| score(r, &prepared.problems[r], fitted, overview.chi2_select[r], rate))
        .collect();
    report(watch, "other responses", 0.6)?;
    let baseline = BaselineScore::of(prepared, overview, rate);
    let mut by_host: Vec<Vec<Scored>> = vec![Vec::new(); prepared.problems.len()];
    for scored in scored.into_iter().flatten() {
        by_host[scored.problem].push(scored);
    }
    let mut to_join = Vec::new();
    for mut of_host in by_host {
        of_host.sort_by(|a, b| a.remaining.total_cmp(&b.remaining));
        to_join.extend(of_host.into_iter().enumerate().map(|(place, scored)| (scored, place < PROPAGATED)));
    }
    let joined: Vec<Scored> = to_join
        .into_par_iter()
        .map(|(scored, propagates)| baseline.join(prepared, scored, rate, propagates))
        .collect();
    report(watch, "other responses", 0.8)?;
    // A retune, or a path to every further response, errs a little of its own.
    let plain = overview.sim_is_core && !in_situ && overview.seen.len() == 1;
    let rank = |scored| rank(scored, baseline.chi2, baseline.rows, allowed(plain));
    let mut ranked = rank(joined);
    if let Some(scored) = remaining_with_linear_change(prepared, &ranked) {
        ranked = rank(scored);
    }
    Ok(Outcome { ranked, regressions, chi2_none: baseline.chi2, rows: baseline.rows })
}

/// Fits what comes near the best of its response further, by what that best leaves, and of each response so many at most.
fn further(
    prepared: &Prepared,
    fitted: Vec<(usize, Fitted)>,
    most: usize,
    fit: impl Fn(&Problem, Fitted, f64) -> Result<Fitted, EngineError> + Sync,
) -> Result<Vec<(usize, Fitted)>, EngineError> {
    let of_response = |r: usize| -> Vec<f64> {
        let mut left: Vec<f64> = fitted.iter().filter(|f| f.0 == r).map(|f| f.1.chi2_fit).collect();
        left.sort_by(f64::total_cmp);
        left
    };
    let left: Vec<Vec<f64>> = (0..prepared.problems.len()).map(of_response).collect();
    let near = |r: usize, f: &Fitted| {
        f.chi2_fit - 1.0 < BEHIND * (left[r][0] - 1.0).max(NEAR)
            && left[r].get(most).is_none_or(|next| f.chi2_fit < *next)
    };
    fitted
        .into_par_iter()
        .map(|(r, f)| Ok((r, if near(r, &f) { fit(&prepared.problems[r], f, left[r][0])? } else { f })))
        .collect()
}
