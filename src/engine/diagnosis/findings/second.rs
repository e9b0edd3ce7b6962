//! A further effect on top of the first, where that leaves a gap.

use rayon::prelude::*;

use super::held_out::{Place, held_out};
use super::hypothesis::axis;
use crate::diagnosis::data::overview::Overview;
use crate::diagnosis::data::prepare::Prepared;
use crate::diagnosis::data::problem::scored_rows;
use crate::diagnosis::effects::candidate::{Candidate, Part};
use crate::diagnosis::effects::effect::{Effect, Tier};
use crate::diagnosis::fit::fitting::{Effort, Fitted, fit};
use crate::diagnosis::fit::start::Regression;
use crate::diagnosis::input::{Input, Mode};
use crate::diagnosis::report::SecondEffect;
use crate::diagnosis::search::catalogue::{FreeRanges, parts};
use crate::diagnosis::search::contest::Outcome;
use crate::diagnosis::search::decide::{Ranked, charged, of_two};
use crate::diagnosis::search::pairs::best_pair;
use crate::diagnosis::search::placement::Placement;
use crate::diagnosis::search::score::{Scored, remaining, score};

/// Above this, in noise floors squared, a second effect is tried; beside a shape that bends to what it
/// meets always.
const SECOND: f64 = 1.2;
/// Candidates that are fitted after a regression has sorted them.
const FITTED: usize = 6;
/// Share of the first hypothesis' rest that a second effect must close.
const CLOSES: f64 = 0.5;

/// The response with the largest rest, and what is known of the first effect there.
fn place(
    prepared: &Prepared,
    overview: &Overview,
    placement: &Placement,
    first: &Scored,
) -> Option<(Place, bool)> {
    let mut places = first.places(prepared);
    places.retain(|p| p.problem.response == first.problem || placement.motion.contains(&p.problem.response));
    let untouched = placement.motion.iter().filter(|&&r| places.iter().all(|p| p.problem.response != r));
    let bare = |&r: &usize| {
        let retune = prepared.problems[first.problem].retunes_freely(&first.fitted.candidate);
        let candidate = Candidate { parts: Vec::new(), retune };
        let fitted = Fitted { candidate, p: Vec::new(), scale: Vec::new(), chi2_fit: f64::NAN };
        (Place { problem: prepared.problems[r].clone(), fitted, chi2: overview.chi2_select[r] }, false)
    };
    let untouched: Vec<(Place, bool)> = untouched.map(bare).collect();
    let all = places.into_iter().map(|p| (p, true)).chain(untouched);
    let bends = first.effect().tier() == Tier::Free;
    all.max_by(|a, b| a.0.chi2.total_cmp(&b.0.chi2)).filter(|p| bends || p.0.chi2 > SECOND)
}

/// Two effects that together close what one alone does not.
pub struct Two {
    /// The first's place among the ranked ones.
    pub first: usize,
    pub second: SecondEffect,
    /// How believable it is that these two, of two families, are what the sim lacks; 0 where they were not
    /// sought together, and where one of them works as it cannot.
    pub probability: f64,
}

/// A second effect where one leaves more than the noise: the best pair at the first's host if the verdict
/// names nothing or a member of that pair, else what closes most of the first's rest.
pub fn second_effect(
    input: &Input,
    prepared: &Prepared,
    overview: &Overview,
    outcome: &Outcome<'_>,
    named: Option<Effect>,
) -> Option<Two> {
    let ranked = &outcome.ranked;
    let first = &ranked.first()?.scored;
    let placement = Placement::of(input, prepared, overview);
    let (rest, acts) = place(prepared, overview, &placement, first)?;
    if rest.problem.response == first.problem {
        let (_, regression) = outcome.regressions.iter().find(|(r, _)| *r == first.problem)?;
        if let Some(two) = together(input, prepared, regression, ranked, named) {
            return Some(two);
        }
    }
    let second = on_top(input, prepared, overview, first, (rest, acts))?;
    Some(Two { first: 0, second, probability: 0.0 })
}

/// The best pair of effects on one response, if it closes a good part of what the best one leaves.
fn together(
    input: &Input,
    prepared: &Prepared,
    regression: &Regression<'_>,
    ranked: &[Ranked],
    named: Option<Effect>,
) -> Option<Two> {
    let in_situ = input.mode == Mode::InSitu;
    let problem = regression.problem;
    let ranges = FreeRanges::of(problem, &regression.smooth);
    let parts = parts(problem, &input.catalogue, in_situ, ranges);
    let pair = best_pair(regression, &parts, in_situ, named)?;
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
    let (first, second) = match [at(&members[0]), at(&members[1])] {
        [Some(a), Some(b)] => (a.min(b), if a < b { &members[1] } else { &members[0] }),
        [Some(a), None] => (a, &members[1]),
        [None, Some(b)] => (b, &members[0]),
        [None, None] => return None,
    };
    let held = held_out(input, prepared, problem, &pair.fitted)?;
    // Two of one family bend to almost anything, and friction that drives the rig is no friction.
    let believable = members[0].effect.family() != members[1].effect.family() && !pair.not_collocated;
    Some(Two {
        first,
        probability: if believable { of_two(left, none, rows) } else { 0.0 },
        second: SecondEffect {
            effect: second.effect,
            family: second.effect.family(),
            axis: axis(input, problem.response, second),
            channel: input.responses[problem.response].name.clone(),
            chi2: pair.chi2,
            closure: held.closure,
        },
    })
}

/// The effect that closes most of what the first leaves, if it closes a good part of it.
fn on_top(
    input: &Input,
    prepared: &Prepared,
    overview: &Overview,
    first: &Scored,
    (Place { problem, fitted: of_first, chi2 }, acts): (Place, bool),
) -> Option<SecondEffect> {
    let r = problem.response;
    let retune = problem.retunes_freely(&of_first.candidate);
    let regression = Regression::new(&problem, retune);
    let ranges = FreeRanges::of(&problem, &regression.smooth);
    let known: &[f64] =
        if acts { &of_first.p[..of_first.p.len() - of_first.candidate.retuned(&problem)] } else { &[] };
    let differs = |part: &Part| {
        part.effect.tier() != Tier::Free
            && (r != first.problem || part.effect != first.effect())
            && (part.effect != Effect::LinearChange || retune)
    };
    let pairs: Vec<Candidate> = parts(&problem, &input.catalogue, input.mode == Mode::InSitu, ranges)
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
            let fitted = fit(&problem, &regression, c, known, Effort { rounds: 10 })?;
            score(r, &problem, fitted, overview.chi2_select[r], rate)
        })
        .collect();
    let best = fitted.into_iter().min_by(|a, b| a.chi2.total_cmp(&b.chi2))?;
    if best.chi2 - 1.0 > CLOSES * (chi2 - 1.0) {
        return None;
    }
    let part = best.fitted.candidate.parts.last()?;
    let held = held_out(input, prepared, &problem, &best.fitted)?;
    Some(SecondEffect {
        effect: part.effect,
        family: part.effect.family(),
        axis: axis(input, r, part),
        channel: input.responses[r].name.clone(),
        chi2: best.chi2,
        closure: held.closure,
    })
}
