//! A further effect on top of the first, where that leaves a gap.

use rayon::prelude::*;

use super::candidate::{Candidate, Part};
use super::catalogue::{FreeRanges, parts};
use super::effect::{Effect, Tier};
use super::fitting::{Effort, Fitted, fit};
use super::held_out::{Place, held_out};
use super::hosts::Hosts;
use super::hypothesis::axis;
use super::input::{Input, Mode};
use super::overview::Overview;
use super::prepare::Prepared;
use super::report::SecondEffect;
use super::score::{Scored, score};
use super::start::Regression;

/// Above this a second effect is tried.
const SECOND: f64 = 1.6;
/// Candidates that are fitted after a regression has sorted them.
const FITTED: usize = 6;
/// Share of the first hypothesis' rest that a second effect must close.
const CLOSES: f64 = 0.5;

/// The response with the largest rest, and what is known of the first effect there.
fn place(prepared: &Prepared, overview: &Overview, hosts: &Hosts, first: &Scored) -> Option<(Place, bool)> {
    let mut places = first.places(prepared);
    places.retain(|p| p.problem.response == first.problem || hosts.motion.contains(&p.problem.response));
    let untouched = hosts.motion.iter().filter(|&&r| places.iter().all(|p| p.problem.response != r));
    let bare = |&r: &usize| {
        let candidate = Candidate { parts: Vec::new(), retune: first.fitted.candidate.retune };
        let fitted = Fitted { candidate, p: Vec::new(), scale: Vec::new(), chi2_fit: f64::NAN };
        (Place { problem: prepared.problems[r].clone(), fitted, chi2: overview.chi2_select[r] }, false)
    };
    let untouched: Vec<(Place, bool)> = untouched.map(bare).collect();
    let all = places.into_iter().map(|p| (p, true)).chain(untouched);
    all.max_by(|a, b| a.0.chi2.total_cmp(&b.0.chi2)).filter(|p| p.0.chi2 > SECOND)
}

/// The effect that closes most of what the first leaves, if it closes a good part of it.
pub(super) fn second_effect(
    input: &Input,
    prepared: &Prepared,
    overview: &Overview,
    first: &Scored,
) -> Option<SecondEffect> {
    let hosts = Hosts::of(input, prepared, overview);
    let (Place { problem, fitted: of_first, chi2 }, acts) = place(prepared, overview, &hosts, first)?;
    let r = problem.response;
    let retune = of_first.candidate.retune;
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
