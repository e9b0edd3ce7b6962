//! One hypothesis of the report, and the sim with its effect in it.

use super::held_out::{Place, held_out_at};
use super::parameters;
use crate::diagnosis::augmented::{Augmented, Member};
use crate::diagnosis::data::overview::Overview;
use crate::diagnosis::data::prepare::Prepared;
use crate::diagnosis::data::problem::Stretch;
use crate::diagnosis::effects::candidate::Part;
use crate::diagnosis::effects::effect::Effect;
use crate::diagnosis::input::Input;
use crate::diagnosis::numerics::linear::rms;
use crate::diagnosis::report::Hypothesis;
use crate::diagnosis::search::decide::Ranked;
use crate::diagnosis::search::score::remaining;

/// Of an effect's places the one on which it closes most, in noise floors.
pub fn closes_most(mut places: Vec<Place>, overview: &Overview) -> Place {
    let at = closing(&places, overview);
    places.swap_remove(at)
}

fn closing(places: &[Place], overview: &Overview) -> usize {
    let closed = |place: &Place| {
        let none = overview.chi2_select[place.problem.response];
        (1.0 - remaining(place.chi2, none)).max(0.0) * none.ln().max(0.0)
    };
    // Of equals the first, which is the host.
    let best = (0..places.len()).rev().max_by(|&a, &b| closed(&places[a]).total_cmp(&closed(&places[b])));
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

/// A ranked candidate as the report has it; `None` where its free run of a test stretch runs away.
pub fn hypothesis(
    input: &Input,
    prepared: &Prepared,
    overview: &Overview,
    ranked: &Ranked,
) -> Option<(Hypothesis, Augmented)> {
    let effect = ranked.scored.effect();
    let places = ranked.scored.places(prepared);
    let responses = held_out_at(input, prepared, &places)?;
    let at = closing(&places, overview);
    let (host, fitted) = (&places[0].problem, &places[0].fitted);
    let units: Vec<String> = input.drives.iter().map(|d| d.unit.clone()).collect();
    let limit = input.limits(&host.drive_peak);
    let loudest = host.fit.iter().max_by(|a, b| {
        let level = |s: &Stretch| s.drives.iter().map(|d| rms(d)).sum::<f64>();
        level(a).total_cmp(&level(b))
    });
    let member = |place: &Place| Member {
        plant: place.problem.plant.clone(),
        candidate: place.fitted.candidate.clone(),
        p: place.fitted.p.clone(),
        alone: prepared.stands[place.problem.response] && better_alone(input, place),
    };
    let augmented = Augmented {
        added: None,
        members: places.iter().map(member).collect(),
        time: host.fit.iter().chain(&host.test).map(|s| s.clock.start).fold(0.0, f64::max),
        on_effects: input.has_adopted(),
    };
    let stable_over_envelope = loudest.is_some_and(|s| augmented.bounded(&s.drives, &limit));
    Some((
        Hypothesis {
            effect,
            family: effect.family(),
            axis: axis(input, host.response, &fitted.candidate.parts[0]),
            at: place(input, host.response, &fitted.candidate.parts[0]),
            between: None,
            channel: responses[at].channel.clone(),
            probability: ranked.probability,
            remaining_share: ranked.scored.remaining,
            strength: None,
            shape: None,
            transfer: Vec::new(),
            parameters: parameters::named(host, fitted, (&input.responses[host.response].unit, &units)),
            held_out: responses[at].held_out.clone(),
            responses,
            stable_over_envelope,
        },
        augmented,
    ))
}
