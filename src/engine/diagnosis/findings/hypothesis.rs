//! One hypothesis of the report, and the sim with its effect in it.

use super::held_out::{Place, held_out_at};
use super::parameters;
use crate::diagnosis::augmented::{Augmented, Member};
use crate::diagnosis::data::overview::Overview;
use crate::diagnosis::data::prepare::Prepared;
use crate::diagnosis::effects::candidate::Part;
use crate::diagnosis::effects::effect::Effect;
use crate::diagnosis::input::{Input, level};
use crate::diagnosis::report::{ChannelHeldOut, EffectShare, Hypothesis, Parameter};
use crate::diagnosis::search::score::{Scored, remaining};

/// Of an effect's places the one on which it closes most, in noise floors.
pub fn closes_most<'a>(places: &[&'a Place], overview: &Overview) -> &'a Place {
    places[closing(places, overview)]
}

/// Index of the response on which an effect closes most.
pub fn closed_most(prepared: &Prepared, overview: &Overview, scored: &Scored) -> usize {
    let places = scored.places(prepared);
    closes_most(&places.iter().collect::<Vec<_>>(), overview).problem.response
}

fn closing(places: &[&Place], overview: &Overview) -> usize {
    let closed = |place: &Place| {
        let none = overview.chi2_select[place.problem.response];
        (1.0 - remaining(place.chi2, none)).max(0.0) * none.ln().max(0.0)
    };
    // Of equals the first, which is the host.
    let best = (0..places.len()).rev().max_by(|&a, &b| closed(places[a]).total_cmp(&closed(places[b])));
    best.unwrap_or(0)
}

/// Axis of an effect: that of its drive, or that of the response whose signal it takes.
pub fn axis(input: &Input, response: usize, part: &Part) -> Option<String> {
    if part.effect.on_drive() {
        input.drives[part.drive].axis.clone()
    } else {
        input.responses[response].axis.clone()
    }
}

/// Where an effect acts: at its drive, or at the response whose motion it takes.
pub fn place(input: &Input, response: usize, part: &Part) -> Option<String> {
    let at = if part.effect.on_drive() { &input.drives[part.drive] } else { &input.responses[response] };
    (part.effect != Effect::LinearChange).then(|| at.name.clone())
}

/// Whether the augmented core without the FRF that it stands for leaves less of the select stretches
/// than with it.
fn better_alone(input: &Input, place: &Place) -> bool {
    let (problem, r) = (&place.problem, place.problem.response);
    let Some(alone) = place.fitted.candidate.predictions(problem, &problem.select, &place.fitted.p) else {
        return false;
    };
    let with_sim: Option<Vec<Vec<f64>>> = problem
        .select
        .iter()
        .zip(&alone)
        .map(|(stretch, alone)| {
            let simulated = input.runs[stretch.run].simulated.as_ref()?.channel(r);
            let simulated = &simulated[stretch.from..stretch.from + alone.len()];
            let difference = alone.iter().zip(stretch.core.iter());
            Some(simulated.iter().zip(difference).map(|(s, (y, c))| s + y - c).collect())
        })
        .collect();
    with_sim.is_none_or(|with_sim| {
        problem.chi2(&problem.select, &alone) <= problem.chi2(&problem.select, &with_sim)
    })
}

/// One of the effects of an explanation: the response at whose motion it acts, and what falls to it.
pub struct Held {
    pub response: usize,
    pub part: Part,
    /// Share of the gap.
    pub share: f64,
}

impl Held {
    fn share(&self, input: &Input) -> EffectShare {
        EffectShare {
            effect: self.part.effect,
            family: self.part.effect.family(),
            axis: axis(input, self.response, &self.part),
            at: place(input, self.response, &self.part),
            between: None,
            share_of_gap: self.share,
        }
    }

    /// Its numbers, from the place that fitted them.
    fn parameters(&self, input: &Input, places: &[Place]) -> Vec<Parameter> {
        let units: Vec<String> = input.drives.iter().map(|d| d.unit.clone()).collect();
        let own = places.iter().find_map(|place| {
            let part = place.fitted.candidate.parts.iter().position(|part| *part == self.part)?;
            (place.problem.response == self.response).then_some((place, part))
        });
        own.map_or_else(Vec::new, |(Place { problem, fitted, .. }, part)| {
            parameters::named(problem, fitted, part, (&input.responses[self.response].unit, &units))
        })
    }
}

/// Effects that are simulated together.
pub struct Explanation {
    /// Where they act. The effects of a later layer act in the motion that those before it make.
    pub layers: Vec<Vec<Place>>,
    /// Each of them, the first one first.
    pub held: Vec<Held>,
    /// Share of the gap that they leave on the select runs.
    pub remaining: f64,
}

impl Explanation {
    /// All that a candidate explains.
    pub fn of(prepared: &Prepared, scored: &Scored) -> Self {
        let share = (1.0 - scored.remaining).max(0.0);
        let part = scored.part().clone();
        let held = vec![Held { response: scored.problem, part, share }];
        Self { layers: vec![scored.places(prepared)], held, remaining: scored.remaining }
    }

    /// Where they act with all that acts there, the first one's host first.
    pub fn places(&self) -> Vec<&Place> {
        let mut all: Vec<&Place> = Vec::new();
        for place in self.layers.iter().flatten() {
            match all.iter_mut().find(|known| known.problem.response == place.problem.response) {
                Some(known) => *known = place,
                None => all.push(place),
            }
        }
        all
    }

    /// The sim with them.
    fn augmented(&self, input: &Input, prepared: &Prepared) -> Augmented {
        let mut acted: Vec<usize> = Vec::new();
        let mut layers = self.layers.iter().enumerate().map(|(k, places)| {
            let host = &places[0].problem;
            let stands = |r: usize| prepared.stands[r] && !acted.contains(&r);
            let member = |place: &Place| Member {
                plant: place.problem.plant.clone(),
                candidate: place.fitted.candidate.clone(),
                p: place.fitted.p.clone(),
                alone: stands(place.problem.response) && better_alone(input, place),
            };
            let of_layer = Augmented {
                added: None,
                members: places.iter().map(member).collect(),
                time: host.fit.iter().chain(&host.test).map(|s| s.clock.start).fold(0.0, f64::max),
                on_effects: k > 0 || input.has_adopted(),
                further: Vec::new(),
            };
            acted.extend(places.iter().map(|place| place.problem.response));
            of_layer
        });
        let first = layers.next().expect("an explanation has an effect");
        Augmented { further: layers.collect(), ..first }
    }
}

impl Hypothesis {
    /// Whether a further effect, which this one holds beside that of `alone`, helps on the test runs too, and does not
    /// run away where `alone` does not.
    pub fn helps_beyond(&self, alone: &Self) -> bool {
        let left_alone = |r: &ChannelHeldOut| {
            let same = alone.responses.iter().find(|other| other.channel == r.channel);
            same.map_or(r.held_out.chi2_before, |same| same.held_out.chi2_after)
        };
        let alone_leaves: f64 = self.responses.iter().map(left_alone).sum();
        let leaves: f64 = self.responses.iter().map(|r| r.held_out.chi2_after).sum();
        self.remaining_share < alone.remaining_share
            && leaves < alone_leaves
            && (self.stable_over_envelope || !alone.stable_over_envelope)
    }
}

/// An explanation as the report has it, with the probability of its first effect; `None` where its free run of a test
/// stretch runs away.
pub fn hypothesis(
    input: &Input,
    prepared: &Prepared,
    overview: &Overview,
    explanation: &Explanation,
    probability: f64,
) -> Option<(Hypothesis, Augmented)> {
    let Explanation { layers, held, remaining } = explanation;
    let places = explanation.places();
    let responses = held_out_at(input, prepared, &places)?;
    let at = closing(&places, overview);
    let host = &layers[0][0];
    let limit = input.limits(&host.problem.drive_peak);
    let loudest = host.problem.fit.iter().max_by(|a, b| level(&a.drives).total_cmp(&level(&b.drives)));
    let augmented = explanation.augmented(input, prepared);
    let stable_over_envelope = loudest.is_some_and(|s| augmented.bounded(&s.drives, &limit));
    let mut numbers = Vec::new();
    for one in held {
        let (effect, share) = (one.part.effect, one.share(input));
        let of_one = match share.at {
            Some(at) if held.iter().filter(|other| other.part.effect == effect).count() > 1 => {
                format!("{}@{at}", effect.name())
            }
            _ => effect.name(),
        };
        let named = |p: Parameter| Parameter { name: format!("{of_one}.{}", p.name), ..p };
        let own = layers.iter().map(|places| one.parameters(input, places)).find(|own| !own.is_empty());
        let own = own.into_iter().flatten();
        numbers.extend(own.map(|p| if held.len() > 1 { named(p) } else { p }));
    }
    numbers.extend(parameters::modes(&host.problem, &host.fitted));
    let first = held.first()?.share(input);
    Some((
        Hypothesis {
            effect: first.effect,
            family: first.family,
            axis: first.axis,
            at: first.at,
            between: None,
            channel: responses[at].channel.clone(),
            probability,
            remaining_share: *remaining,
            effects: held.iter().map(|held| held.share(input)).collect(),
            strength: None,
            shape: None,
            transfer: Vec::new(),
            parameters: numbers,
            held_out: responses[at].held_out.clone(),
            responses,
            stable_over_envelope,
        },
        augmented,
    ))
}
