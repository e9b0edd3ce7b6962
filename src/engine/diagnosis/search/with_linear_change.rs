//! What laws leave beside a linear change, where the one that leads leaves more than noise by itself: of two laws
//! with their own errors the right one may lack no more than a linear part, as the flow of a valve does its
//! leakage, where the wrong one has bent to what it was given.

use rayon::prelude::*;

use super::decide::{ABSTAIN, NOISE_LEFT, Ranked};
use super::score::{Scored, remaining};
use crate::diagnosis::data::prepare::Prepared;
use crate::diagnosis::data::problem::Problem;
use crate::diagnosis::effects::candidate::{Candidate, Part};
use crate::diagnosis::effects::effect::{Effect, Tier};
use crate::diagnosis::fit::fitting::{Effort, refit};

/// Laws that are fitted once more.
const LAWS: usize = 4;
/// Jacobians of such a fit.
const ROUNDS: usize = 15;

/// Share of what a linear change leaves alone, that a law beside one has to leave less than: else it is the change
/// that closes the gap.
const OF_CHANGE: f64 = 0.5;

/// The same candidates, with what the foremost laws leave beside a linear change. `None` where nothing is open (the
/// first leaves nothing but noise, it is a shape that bends to anything, or every linear part is free already), and
/// where it would be the change that closes the gap.
pub fn remaining_with_linear_change(prepared: &Prepared, ranked: &[Ranked]) -> Option<Vec<Scored>> {
    let first = &ranked.first()?.scored;
    let change = ranked.iter().find(|r| r.scored.effect() == Effect::LinearChange)?.scored.remaining;
    let free = prepared.problems[first.problem].retunes_freely(&first.fitted.candidate);
    let bends = first.effect().tier() == Tier::Free || free && first.effect() != Effect::LinearChange;
    if first.chi2 <= NOISE_LEFT || first.remaining > ABSTAIN || bends {
        return None;
    }
    let mut scored: Vec<Scored> = ranked.iter().map(|r| r.scored.clone()).collect();
    let law = |s: &Scored| s.effect().tier() == Tier::Law && s.remaining <= ABSTAIN;
    let foremost: Vec<&mut Scored> = scored.iter_mut().filter(|s| law(s)).take(LAWS).collect();
    foremost
        .into_par_iter()
        .for_each(|s| s.beside = left_with_linear_change(&prepared.problems[s.problem], s));
    let least = scored.iter().filter_map(|s| s.beside).fold(f64::INFINITY, f64::min);
    (least < OF_CHANGE * change).then_some(scored)
}

/// What remains of the gap where a linear change may take its share of what the law leaves; `None` where its free
/// run does not stay finite.
fn left_with_linear_change(problem: &Problem, scored: &Scored) -> Option<f64> {
    let mut parts = scored.fitted.candidate.parts.clone();
    parts.push(Part::linear_change());
    let candidate = Candidate { parts, retune: true };
    let fitted = refit(problem, &scored.fitted, candidate, Effort { rounds: ROUNDS })?;
    let predictions = fitted.candidate.predictions(problem, &problem.select, &fitted.p)?;
    let chi2 = problem.chi2(&problem.select, &predictions);
    // At the other responses as much is left as was.
    Some(scored.remaining * remaining(chi2, scored.host_chi2).min(1.0))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::diagnosis::data::overview::Overview;
    use crate::diagnosis::data::prepare::prepare;
    use crate::diagnosis::search::contest::contest;
    use crate::diagnosis::tests::rig::{Force, few, friction, request};
    use crate::diagnosis::{Effect, Input, diagnose};
    use crate::progress::unwatched;

    /// The first of the ranking, and how many were asked what they leave beside a linear change.
    fn first(force: Force) -> (Scored, usize) {
        let input = Input { catalogue: few(), ..request(force, 0.01) };
        let prepared = prepare(&input, &unwatched).unwrap();
        let overview = Overview::new(&input, &prepared);
        let ranked = contest(&input, &input.catalogue, &prepared, &overview, &unwatched).unwrap().ranked;
        let asked = ranked.iter().filter(|r| r.scored.beside.is_some()).count();
        (ranked[0].scored.clone(), asked)
    }

    #[test]
    fn a_law_with_a_linear_part_that_it_lacks_leaves_far_less_beside_a_linear_change() {
        let (best, asked) = first(|x, v| friction(x, v) + 20.0 * x);
        assert_eq!(best.effect(), Effect::CoulombFriction);
        assert!(best.chi2 > NOISE_LEFT && asked >= 1, "{} {asked}", best.chi2);
        let beside = best.beside.unwrap();
        assert!(beside < 0.3 * best.remaining, "{beside} {}", best.remaining);
    }

    #[test]
    fn where_it_would_be_the_change_that_closes_the_gap_no_law_is_believed_for_it() {
        let few = few().into_iter().filter(|e| *e != Effect::LinearChange);
        let input = Input { catalogue: few.collect(), ..request(|x, _| 60.0 * x, 0.01) };
        let verdict = diagnose(&input, &unwatched).unwrap().report.verdict;
        assert!(verdict.effect.is_none(), "{verdict:?}");
    }

    #[test]
    fn where_the_first_leaves_nothing_none_is_asked() {
        let (best, asked) = first(|_, v| 0.1 * v * v.abs());
        assert_eq!(best.effect(), Effect::QuadraticDamping);
        assert!(best.chi2 <= NOISE_LEFT && asked == 0, "{} {asked}", best.chi2);
    }
}
