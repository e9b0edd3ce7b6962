//! A second effect where the first leaves a gap.

use rayon::prelude::*;

use super::further::further;
use super::held_out::{Place, held_out};
use super::hypothesis::{Explanation, Held, axis};
use crate::EngineError;
use crate::diagnosis::data::overview::Overview;
use crate::diagnosis::data::prepare::Prepared;
use crate::diagnosis::data::problem::{Problem, scored_rows};
use crate::diagnosis::effects::candidate::{Candidate, Part};
use crate::diagnosis::effects::effect::{Effect, Tier};
use crate::diagnosis::fit::fitting::{Effort, Fitted, fit};
use crate::diagnosis::fit::start::Regression;
use crate::diagnosis::input::{Input, Mode};
use crate::diagnosis::report::SecondEffect;
use crate::diagnosis::search::catalogue::{FreeRanges, parts};
use crate::diagnosis::search::contest::Outcome;
use crate::diagnosis::search::decide::{Ranked, charged, of_several};
use crate::diagnosis::search::pairs::best_pair;
use crate::diagnosis::search::placement::Placement;
use crate::diagnosis::search::propagation::BaselineScore;
use crate::diagnosis::search::score::{Scored, remaining, score};
use crate::progress::Watch;

/// Above this, in noise floors squared, a second effect is tried; beside a shape that bends to what it
/// meets always.
const SECOND: f64 = 1.2;
/// Candidates that are fitted after a regression has sorted them.
const FITTED: usize = 6;
/// Share of the first hypothesis' rest that a second effect must close.
pub const CLOSES: f64 = 0.5;
/// Below this probability two effects together are no answer.
const SURE: f64 = 0.7;

/// The response with the largest rest, with what the first effect does there: of those that move, else, where it leaves only
/// noise of these, of all with a gap, as of a force sensor that drifts by itself. `None` where it leaves only noise.
fn rest(prepared: &Prepared, overview: &Overview, placement: &Placement, first: &Scored) -> Option<Place> {
    let mut places = first.places(prepared);
    let mut left: Vec<(usize, f64)> = places.iter().map(|p| (p.problem.response, p.chi2)).collect();
    let untouched = overview.seen.iter().filter(|&&r| left.iter().all(|(touched, _)| *touched != r));
    let untouched: Vec<(usize, f64)> = untouched.map(|&r| (r, overview.chi2_select[r])).collect();
    left.extend(untouched);
    let moves = |r: usize| r == first.problem || placement.motion.contains(&r);
    let largest = |moving: bool| {
        let of = left.iter().filter(|(r, _)| moves(*r) == moving);
        of.max_by(|a, b| a.1.total_cmp(&b.1)).copied()
    };
    let bends = first.effect().tier() == Tier::Free;
    let remains = |(_, chi2): &(usize, f64)| *chi2 > SECOND;
    let (r, chi2) =
        largest(true).filter(|l| bends || remains(l)).or_else(|| largest(false).filter(remains))?;
    if let Some(at) = places.iter().position(|place| place.problem.response == r) {
        return Some(places.swap_remove(at));
    }
    let candidate = Candidate { parts: Vec::new(), retune: false };
    let fitted = Fitted { candidate, p: Vec::new(), scale: Vec::new(), chi2_fit: f64::NAN };
    Some(Place { problem: prepared.problems[r].clone(), fitted, chi2 })
}

/// Effects that together close what one alone does not.
pub struct Two {
    /// The first's place among the ranked ones.
    pub first: usize,
    pub second: SecondEffect,
    /// How believable it is that these are what the sim lacks; 0 where two were not sought together at one response, or
    /// are of one family there, and where one of them works as it cannot.
    pub probability: f64,
    /// All of them.
    pub explanation: Explanation,
}

impl Two {
    /// Whether together they are an answer.
    pub fn answers(&self) -> bool {
        self.probability >= SURE
    }
}

/// Two effects at one response before they are scored over all.
struct Found {
    first: usize,
    second: SecondEffect,
    probability: f64,
    both: Scored,
}

/// A second effect where one leaves more than the noise. At the first's host it is of the best pair, if the verdict
/// names nothing or a member of that pair, else what closes most of the first's rest; elsewhere see [`further`].
///
/// # Errors
/// [`EngineError::Cancelled`].
pub fn second_effect(
    input: &Input,
    prepared: &Prepared,
    overview: &Overview,
    outcome: &Outcome<'_>,
    named: Option<Effect>,
    watch: Watch<'_>,
) -> Result<Option<Two>, EngineError> {
    let ranked = &outcome.ranked;
    let Some(Ranked { scored: first, .. }) = ranked.first() else { return Ok(None) };
    let placement = Placement::of(input, prepared, overview);
    let Some(rest) = rest(prepared, overview, &placement, first) else { return Ok(None) };
    let elsewhere = || further(input, prepared, overview, (ranked, named.is_some()), watch);
    if rest.problem.response != first.problem {
        return elsewhere();
    }
    let at_host = || {
        let (_, regression) = outcome.regressions.iter().find(|(r, _)| *r == first.problem)?;
        let found = together(input, prepared, overview, regression, ranked, named)
            .or_else(|| on_top(input, prepared, overview, first, &rest))?;
        Some(found.over_all(input, prepared, overview, ranked))
    };
    let at_host = at_host();
    // On a rig of several axes the first's host may feel what acts on another.
    if placement.motion.len() > 1
        && at_host.as_ref().is_none_or(|two| !two.answers())
        && let Some(two) = elsewhere()?
        && at_host.as_ref().is_none_or(|here| here.probability < two.probability)
    {
        return Ok(Some(two));
    }
    Ok(at_host)
}

impl Found {
    fn over_all(self, input: &Input, prepared: &Prepared, overview: &Overview, ranked: &[Ranked]) -> Two {
        let rate = input.sample_rate_hz();
        let baseline = BaselineScore::of(prepared, overview, rate);
        let alone = &ranked[self.first].scored;
        let both = baseline.join(prepared, self.both, rate, true);
        let members = &both.fitted.candidate.parts;
        let gained = (alone.chi2 - both.chi2) / (baseline.chi2 - 1.0).max(f64::MIN_POSITIVE);
        let held = |part: &Part, share: f64| Held {
            response: both.problem,
            part: part.clone(),
            share: share.clamp(0.0, 1.0),
        };
        let held = vec![held(&members[0], 1.0 - alone.remaining), held(&members[members.len() - 1], gained)];
        let explanation =
            Explanation { layers: vec![both.places(prepared)], held, remaining: both.remaining };
        // What they leave at other responses is not explained either.
        let probability =
            self.probability.min(of_several(both.remaining, baseline.chi2, baseline.rows, true));
        Two { first: self.first, second: self.second, probability, explanation }
    }
}

/// The best pair of effects on one response, if it closes a good part of what the best one leaves.
fn together(
    input: &Input,
    prepared: &Prepared,
    overview: &Overview,
    regression: &Regression<'_>,
    ranked: &[Ranked],
    named: Option<Effect>,
) -> Option<Found> {
    let in_situ = input.mode == Mode::InSitu;
    let problem = regression.problem;
    let ranges = FreeRanges::of(problem, &regression.smooth);
    let parts = parts(problem, &input.catalogue, in_situ, ranges);
    let mut pair = best_pair(regression, &parts, in_situ, named)?;
    let best = &ranked[0].scored;
    let members = &pair.fitted.candidate.parts;
    let none = problem.chi2_none(&problem.select);
    let rows = scored_rows(&problem.select);
    let left = remaining(pair.chi2, none);
    let closes = if best.effect().tier() == Tier::Free {
        // It leaves little of whatever there is: two that leave as much are the plainer account.
        let alone = &best.fitted.candidate.parts[..1];
        charged(members, left, none, rows) < charged(alone, remaining(best.host_chi2, none), none, rows)
    } else {
        pair.chi2 - 1.0 <= CLOSES * (best.host_chi2 - 1.0)
    };
    if !closes {
        return None;
    }
    let at = |part: &Part| {
        ranked
            .iter()
            .position(|r| r.scored.problem == problem.response && r.scored.fitted.candidate.parts[0] == *part)
    };
    // The one that closes more alone comes first.
    let (first, exchanged) = match [at(&members[0]), at(&members[1])] {
        [Some(a), Some(b)] => (a.min(b), b < a),
        [Some(a), None] => (a, false),
        [None, Some(b)] => (b, true),
        [None, None] => return None,
    };
    if exchanged {
        pair.fitted.exchange(problem.core.modes.order());
    }
    // Two of one family bend to almost anything, and friction that drives the rig is no friction.
    let members = &pair.fitted.candidate.parts;
    let believable = members[0].effect.family() != members[1].effect.family() && !pair.not_collocated;
    Some(Found {
        first,
        probability: if believable { of_several(left, none, rows, false) } else { 0.0 },
        second: told(input, prepared, problem, &pair.fitted, pair.chi2)?,
        both: {
            let (r, rate) = (problem.response, input.sample_rate_hz());
            score(r, problem, pair.fitted, overview.chi2_select[r], rate)?
        },
    })
}

/// The last part of a fit as the report has a second effect.
pub fn told(
    input: &Input,
    prepared: &Prepared,
    problem: &Problem,
    fitted: &Fitted,
    chi2: f64,
) -> Option<SecondEffect> {
    let part = fitted.candidate.parts.last()?;
    Some(SecondEffect {
        effect: part.effect,
        family: part.effect.family(),
        axis: axis(input, problem.response, part),
        channel: input.responses[problem.response].name.clone(),
        chi2,
        closure: held_out(input, prepared, problem, fitted)?.closure,
    })
}

/// The effect that closes most of what the first leaves at its host, if it closes a good part of it.
fn on_top(
    input: &Input,
    prepared: &Prepared,
    overview: &Overview,
    first: &Scored,
    Place { problem, fitted: of_first, chi2 }: &Place,
) -> Option<Found> {
    let r = problem.response;
    let retune = problem.retunes_freely(&of_first.candidate);
    let regression = Regression::new(problem, retune);
    let ranges = FreeRanges::of(problem, &regression.smooth);
    let known = &of_first.p[..of_first.p.len() - of_first.candidate.retuned(problem)];
    let differs = |part: &Part| {
        part.effect.tier() != Tier::Free
            && part.effect != first.effect()
            && (part.effect != Effect::LinearChange || retune)
    };
    let pairs: Vec<Candidate> = parts(problem, &input.catalogue, input.mode == Mode::InSitu, ranges)
        .into_iter()
        .filter(differs)
        .map(|part| {
            let mut parts = of_first.candidate.parts.clone();
            parts.push(part);
            Candidate { parts, retune }
        })
        .collect();
    let mut sorted: Vec<(f64, &Candidate)> =
        pairs.par_iter().filter_map(|c| Some((regression.starts(c, known).first()?.cost, c))).collect();
    sorted.sort_by(|a, b| a.0.total_cmp(&b.0));
    let rate = input.sample_rate_hz();
    let fitted: Vec<Scored> = sorted
        .par_iter()
        .take(FITTED)
        .filter_map(|(_, c)| {
            let fitted = fit(problem, &regression, c, known, Effort { rounds: 10 })?;
            score(r, problem, fitted, overview.chi2_select[r], rate)
        })
        .collect();
    let best = fitted.into_iter().min_by(|a, b| a.chi2.total_cmp(&b.chi2))?;
    if best.chi2 - 1.0 > CLOSES * (chi2 - 1.0) {
        return None;
    }
    let second = told(input, prepared, problem, &best.fitted, best.chi2)?;
    Some(Found { first: 0, second, probability: 0.0, both: best })
}
