//! Further effects, one at a time, each in the motion that the rig has with those before it.

use std::sync::Arc;

use super::held_out::Place;
use super::hypothesis::{Explanation, Held};
use super::second::{CLOSES, Two, told};
use crate::EngineError;
use crate::diagnosis::core::FEW_DRIVES;
use crate::diagnosis::data::overview::Overview;
use crate::diagnosis::data::prepare::Prepared;
use crate::diagnosis::data::problem::{Problem, Stretch};
use crate::diagnosis::effects::effect::{Effect, Tier};
use crate::diagnosis::effects::plant::Course;
use crate::diagnosis::input::Input;
use crate::diagnosis::search::contest::contest;
use crate::diagnosis::search::decide::{Ranked, of_several};
use crate::diagnosis::search::propagation::BaselineScore;
use crate::diagnosis::search::score::{Scored, remaining};
use crate::progress::{Progress, Watch};

/// Effects that are simulated together at most.
const MOST: usize = 4;
/// Share of the gap that a law closes at least where others are sought beside it on a rig of more than a few drives, where the
/// candidates of one response are hundreds: so many of which none closes more leave half of the gap, and are no answer.
const BEGINS: f64 = 0.5 / MOST as f64;

/// What further effects explain beside a first one that leaves a gap at other responses than its own. The first is the
/// likeliest of `ranked`. Where none is `named`, and these are no answer, it is then the law that closes most alone: what
/// acts on one axis only closes little of what acts on several.
///
/// # Errors
/// [`EngineError::Cancelled`].
pub fn further(
    input: &Input,
    prepared: &Prepared,
    overview: &Overview,
    (ranked, named): (&[Ranked], bool),
    watch: Watch<'_>,
) -> Result<Option<Two>, EngineError> {
    let closes = ranked
        .iter()
        .filter(|ranked| may_be_named(&ranked.scored))
        .map(|ranked| 1.0 - ranked.scored.remaining);
    if input.drives.len() > FEW_DRIVES && closes.fold(0.0, f64::max) < BEGINS {
        return Ok(None);
    }
    let sought = Sought { input, prepared, overview, watch };
    let of_likeliest = sought.beside(ranked, 0)?;
    let answers = of_likeliest.as_ref().is_some_and(Two::answers);
    let Some(first) = closes_most(ranked).filter(|&first| first > 0 && !named && !answers) else {
        return Ok(of_likeliest);
    };
    let of_most = sought.beside(ranked, first)?;
    Ok([of_most, of_likeliest].into_iter().flatten().max_by(|a, b| a.probability.total_cmp(&b.probability)))
}

/// The law that closes most alone. A linear change is none: that of every response takes part of whatever acts on any of them.
fn closes_most(ranked: &[Ranked]) -> Option<usize> {
    let law = |scored: &Scored| may_be_named(scored) && scored.effect() != Effect::LinearChange;
    let laws = ranked.iter().enumerate().filter(|(_, ranked)| law(&ranked.scored));
    laws.min_by(|(_, a), (_, b)| a.scored.chi2.total_cmp(&b.scored.chi2)).map(|(first, _)| first)
}

/// Where further effects are sought.
struct Sought<'a> {
    input: &'a Input,
    prepared: &'a Prepared,
    overview: &'a Overview,
    watch: Watch<'a>,
}

impl Sought<'_> {
    /// What further effects explain beside a first one: each of the whole catalogue is tried in the motion that the rig
    /// has with those before it, and stays if it closes a good part of what these leave. The others are then sought once
    /// more in the motion that it makes. `None` where none stays.
    fn beside(&self, ranked: &[Ranked], first: usize) -> Result<Option<Two>, EngineError> {
        let mut effects = vec![ranked[first].scored.clone()];
        while effects.len() < MOST {
            let Some(moved) = moved_by(self.prepared, &effects) else { break };
            let rest = self.overview.mean_of_seen(&leaves(&moved));
            let Some(next) = self.best(&moved, &effects)? else { break };
            if self.overview.mean_of_seen(&left_by(&moved, &next)) - 1.0 > CLOSES * (rest - 1.0) {
                break;
            }
            effects.push(next);
            effects = self.again(effects)?;
        }
        self.together(&effects, first)
    }

    /// The foremost effect of the catalogue in the motion that others make, which is none of them.
    fn best(&self, moved: &Prepared, others: &[Scored]) -> Result<Option<Scored>, EngineError> {
        let now = Overview::new(self.input, moved);
        if now.seen.is_empty() {
            return Ok(None);
        }
        let in_part = |p: Progress<'_>| (self.watch)(p.within(&(0.8..0.88)));
        let outcome = contest(self.input, &self.input.catalogue, moved, &now, &in_part)?;
        let best = outcome.ranked.into_iter().map(|ranked| ranked.scored).find(may_be_named);
        // What was fitted while a later effect was not there yet may ask for a little of itself again.
        let again = |found: &Scored| {
            others.iter().any(|o| o.problem == found.problem && o.part().is_alike(found.part()))
        };
        Ok(best.filter(|found| !again(found)))
    }

    /// Each effect once more, in the motion that all others make: a first one was fitted while they were not there, and
    /// has bent to part of them. The same ones where that leaves no less.
    fn again(&self, effects: Vec<Scored>) -> Result<Vec<Scored>, EngineError> {
        let left = |effects: &[Scored]| {
            moved_by(self.prepared, effects)
                .map_or(f64::INFINITY, |moved| self.overview.mean_of_seen(&leaves(&moved)))
        };
        let mut all = effects.clone();
        for _ in 0..effects.len() {
            all.remove(0);
            let Some(moved) = moved_by(self.prepared, &all) else { return Ok(effects) };
            let Some(found) = self.best(&moved, &all)? else { return Ok(effects) };
            all.push(found);
        }
        Ok(if left(&all) < left(&effects) { all } else { effects })
    }

    /// All of them as one explanation, beside the `first` of the ranked ones; `None` of one alone.
    fn together(&self, effects: &[Scored], first: usize) -> Result<Option<Two>, EngineError> {
        let (input, prepared, overview) = (self.input, self.prepared, self.overview);
        let baseline = BaselineScore::of(prepared, overview, input.sample_rate_hz());
        let mut chi2 = overview.chi2_select.clone();
        let mut moved = prepared.clone();
        let (mut layers, mut held) = (Vec::new(), Vec::new());
        for scored in effects {
            let Some(places) = places(scored, &moved) else { return Ok(None) };
            let before = overview.mean_of_seen(&chi2);
            leave(&mut chi2, &places);
            let closed = before - overview.mean_of_seen(&chi2);
            let share = (closed / (baseline.chi2 - 1.0).max(f64::MIN_POSITIVE)).clamp(0.0, 1.0);
            held.push(Held { response: scored.problem, part: scored.part().clone(), share });
            let Some(with) = acted_on(&moved, &places) else { return Ok(None) };
            moved = with;
            layers.push(places);
        }
        let second = layers.get(1).and_then(|places| {
            let Place { problem, fitted, chi2 } = &places[0];
            told(input, prepared, problem, fitted, *chi2)
        });
        let Some(second) = second else { return Ok(None) };
        let remaining = remaining(overview.mean_of_seen(&chi2), baseline.chi2);
        let apart = (1..held.len()).all(|k| held[..k].iter().all(|other| other.response != held[k].response));
        let probability = of_several(remaining, baseline.chi2, baseline.rows, apart);
        let probability = if effects.iter().all(may_be_named) { probability } else { 0.0 };
        Ok(Some(Two { first, second, probability, explanation: Explanation { layers, held, remaining } }))
    }
}

/// The request with effects in its sim, one after the other; `None` where a free run runs away.
fn moved_by(prepared: &Prepared, effects: &[Scored]) -> Option<Prepared> {
    effects.iter().try_fold(prepared.clone(), |moved, scored| acted_on(&moved, &scored.places(&moved)))
}

/// Where an effect acts, with what it leaves there in the motion that others make; `None` where it runs away.
fn places(scored: &Scored, moved: &Prepared) -> Option<Vec<Place>> {
    let scored_there = |place: Place| {
        let Place { problem, fitted, .. } = &place;
        let made = fitted.candidate.predictions(problem, &problem.select, &fitted.p)?;
        Some(Place { chi2: problem.chi2(&problem.select, &made), ..place })
    };
    scored.places(moved).into_iter().map(scored_there).collect()
}

/// What is left of the select stretches of each response, in noise floors squared.
fn leaves(prepared: &Prepared) -> Vec<f64> {
    prepared.problems.iter().map(|p| p.chi2_none(&p.select)).collect()
}

/// The same with an effect that was found in this motion.
fn left_by(moved: &Prepared, found: &Scored) -> Vec<f64> {
    let mut chi2 = leaves(moved);
    leave(&mut chi2, &found.places(moved));
    chi2
}

/// Whether an effect is a law of the catalogue that acts as it can.
fn may_be_named(scored: &Scored) -> bool {
    scored.effect().tier() != Tier::Free && !scored.unnamed()
}

/// What is left, by response, with an effect at these places.
fn leave(chi2: &mut [f64], places: &[Place]) {
    for place in places {
        chi2[place.problem.response] = place.chi2;
    }
}

/// The stretches of each role.
const ROLES: [fn(&mut Problem) -> &mut Vec<Stretch>; 3] =
    [|p| &mut p.fit, |p| &mut p.select, |p| &mut p.test];

/// What an effect makes of one response.
struct Acted {
    response: usize,
    /// Sim and core with it, `[role][stretch]`.
    runs: [Vec<[Arc<Vec<f64>>; 2]>; 3],
}

impl Acted {
    fn of(place: &Place) -> Option<Self> {
        let Place { problem, fitted, .. } = place;
        let (r, candidate) = (problem.response, &fitted.candidate);
        let of_stretch = |stretch: &Stretch| -> Option<[Arc<Vec<f64>>; 2]> {
            let mut simulated = stretch.simulated.to_vec();
            simulated[r] = stretch.core.to_vec();
            let of_core = Course { simulated: simulated.into(), ..stretch.course.clone() };
            let free = |course: &Course| candidate.predict(problem, course, &fitted.p).map(Arc::new);
            Some([free(stretch)?, free(&of_core)?])
        };
        let of_role = |stretches: &[Stretch]| candidate.map_unique(stretches, of_stretch);
        let runs = [of_role(&problem.fit)?, of_role(&problem.select)?, of_role(&problem.test)?];
        Some(Self { response: r, runs })
    }
}

/// The request with an effect in its sim, which acts at these places; `None` where a free run runs away.
fn acted_on(prepared: &Prepared, places: &[Place]) -> Option<Prepared> {
    let acted: Vec<Acted> = places.iter().map(Acted::of).collect::<Option<_>>()?;
    let mut moved = prepared.clone();
    for at in &acted {
        // The sim is what was adopted there.
        moved.stands[at.response] = false;
    }
    for (role, stretches) in ROLES.iter().enumerate() {
        let before: Vec<Arc<Vec<Vec<f64>>>> =
            stretches(&mut moved.problems[0]).iter().map(|s| Arc::clone(&s.simulated)).collect();
        let mut sims: Vec<Arc<Vec<Vec<f64>>>> = Vec::new();
        for (i, sim) in before.iter().enumerate() {
            // Repeats that shared their runs share them still.
            let alike = (0..i).find(|&j| {
                let same = |at: &Acted| Arc::ptr_eq(&at.runs[role][i][0], &at.runs[role][j][0]);
                Arc::ptr_eq(sim, &before[j]) && acted.iter().all(same)
            });
            let with = || {
                let mut sim = sim.to_vec();
                for at in &acted {
                    sim[at.response] = at.runs[role][i][0].to_vec();
                }
                Arc::new(sim)
            };
            sims.push(alike.map_or_else(with, |j| Arc::clone(&sims[j])));
        }
        for problem in &mut moved.problems {
            let own = acted.iter().find(|at| at.response == problem.response);
            for (i, (stretch, sim)) in stretches(problem).iter_mut().zip(&sims).enumerate() {
                if let Some(own) = own {
                    stretch.course.core = Arc::clone(&own.runs[role][i][1]);
                }
                stretch.course.simulated = Arc::clone(sim);
            }
        }
    }
    Some(moved)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::diagnosis::effects::candidate::Part;
    use crate::diagnosis::effects::input_map::InputMap;
    use crate::diagnosis::search::decide::rank;

    const GAP: f64 = 1000.0;
    const ROWS: f64 = 10_000.0;

    fn scored(part: Part, chi2: f64) -> Scored {
        Scored::leaving(part, chi2, GAP, ROWS)
    }

    #[test]
    fn a_law_that_closes_one_axis_begins_and_not_a_linear_change_of_all() {
        let map = |effect, drive| Part::input(effect, drive, InputMap::DeadZone);
        let all = || {
            vec![
                scored(Part::linear_change(), 200.0),
                scored(map(Effect::Gain, 1), 700.0),
                scored(map(Effect::DeadZone, 1), 460.0),
                scored(Part::sandwich(0), 300.0),
            ]
        };
        let begins = |scored| {
            let ranked = rank(scored, GAP, ROWS, 0.01);
            closes_most(&ranked).map(|first| ranked[first].scored.effect())
        };
        assert_eq!(begins(all()), Some(Effect::DeadZone));
        let only_the_change = all().into_iter().take(1).collect();
        assert_eq!(begins(only_the_change), None);
    }
}
