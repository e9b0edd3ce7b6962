//! The law that transfer names, fitted once more together with the linear part of the whole rig.
//!
//! Transfer takes the linear part from regressions and stands by what carries over. The sim with the law in it is to
//! predict as well as it can: all poles, zeros and numbers of the law are fitted together, to what every response does.

use super::hypothesis::{Explanation, hypothesis, place};
use crate::EngineError;
use crate::diagnosis::augmented::Augmented;
use crate::diagnosis::data::overview::Overview;
use crate::diagnosis::data::prepare::prepare_down_to;
use crate::diagnosis::effects::effect::{Effect, Tier};
use crate::diagnosis::input::{Channel, Input};
use crate::diagnosis::report::{ChannelHeldOut, EffectShare, Hypothesis};
use crate::diagnosis::search::contest::contest;
use crate::diagnosis::search::score::Scored;
use crate::diagnosis::transfer::FLOOR;
use crate::progress::{Progress, Watch};

/// Share of what the named law leaves, fitted alike, below which another of its family takes its place.
const RENAMES: f64 = 0.5;
/// Share of what the law leaves by transfer below which the fit takes its place.
const CLEARLY: f64 = 0.8;
/// Samples of all responses together that are fitted at most: more would take minutes.
const SAMPLES: usize = 500_000;

/// The named law fitted so, where that leaves clearly less of the gap on unseen stretches than `by_transfer` does.
/// `None` for laws between two responses, drifts, couplings and bends between two filters, beside adopted effects, and
/// of requests that are too long.
///
/// # Errors
/// [`EngineError::Cancelled`].
pub fn fitted_again(
    input: &Input,
    by_transfer: &Hypothesis,
    watch: Watch<'_>,
) -> Result<Option<(Hypothesis, Augmented)>, EngineError> {
    let Hypothesis { effect: named, family, at, .. } = by_transfer;
    let (named, family) = (*named, *family);
    let samples: usize = input.runs.iter().map(|run| run.response.n_samples()).sum();
    let long = samples * input.responses.len() > SAMPLES;
    // A force acts over a displacement, which neither a velocity nor an acceleration is.
    let of = |r: &&Channel| Some(&r.name) == at.as_ref();
    let integrated = |r: &Channel| r.quantity.integrals() > 0;
    let over_none = family.is_of_structure() && input.responses.iter().find(of).is_none_or(integrated);
    let of_one_place = family.is_of_structure() || family.is_of_channel();
    if long
        || over_none
        || by_transfer.between.is_some()
        || input.has_adopted()
        || !of_one_place
        || named == Effect::ValveFlow
    {
        return Ok(None);
    }
    let of_family = |e: &&Effect| e.family() == family && e.tier() == Tier::Law && **e != Effect::ValveFlow;
    let effects: Vec<Effect> = input.catalogue.iter().filter(of_family).copied().collect();
    let Ok(prepared) = prepare_down_to(FLOOR, 0, input) else { return Ok(None) };
    let overview = Overview::new(input, &prepared);
    if overview.seen.is_empty() || effects.is_empty() {
        return Ok(None);
    }
    let of_contest = |p: Progress<'_>| watch(Progress::new("refit", p.fraction));
    let outcome = contest(input, &effects, &prepared, &overview, &of_contest)?;
    let here = |s: &&Scored| !s.unnamed() && place(input, s.problem, s.part()) == *at;
    let scored: Vec<&Scored> = outcome.ranked.iter().map(|ranked| &ranked.scored).filter(here).collect();
    let best = scored.first().copied();
    let own = scored.iter().copied().find(|s| s.effect() == named);
    let chosen = match (own, best) {
        (Some(own), Some(best)) if best.remaining >= RENAMES * own.remaining => Some(own),
        (_, best) => best,
    };
    let Some(chosen) = chosen else { return Ok(None) };
    let explanation = Explanation::of(&prepared, chosen);
    let made = hypothesis(input, &prepared, &overview, &explanation, by_transfer.probability);
    Ok(made
        .filter(|(made, _)| {
            leaves_less(made, by_transfer, input, &overview)
                && (made.stable_over_envelope || !by_transfer.stable_over_envelope)
        })
        .map(|(made, augmented)| (beside_transfer(made, by_transfer), augmented)))
}

/// Whether a fit leaves clearly less of the response that the law helps most by transfer. Both count in what the sim
/// leaves of the runs to explain: what transfer counts from may be what a linear part leaves of runs that it has not seen.
fn leaves_less(made: &Hypothesis, by_transfer: &Hypothesis, input: &Input, overview: &Overview) -> bool {
    let channel = &by_transfer.channel;
    let of_fit = made.responses.iter().find(|r| r.channel == *channel);
    let of_sim = input.responses.iter().position(|r| r.name == *channel);
    of_fit.zip(of_sim).is_some_and(|(of_fit, r)| {
        let by_transfer = by_transfer.held_out.rms_after / overview.power[r].rms_error.max(f64::MIN_POSITIVE);
        of_fit.held_out.left() < CLEARLY * by_transfer.powi(2)
    })
}

/// A fit with what transfer tells: the law's strength, its curve, and what is left of each group. The noise that was
/// assumed to fit it is none of the rig's: without repeats all of what is left counts, and all of it may be noise.
fn beside_transfer(made: Hypothesis, by_transfer: &Hypothesis) -> Hypothesis {
    let noise = |channel: &str| {
        let same = by_transfer.responses.iter().find(|r| r.channel == channel);
        same.map_or(0.0, |r| r.held_out.noise_rms)
    };
    let held_out = made.held_out.above_noise(noise(&made.channel));
    let responses = made.responses.into_iter().map(|ChannelHeldOut { channel, held_out }| ChannelHeldOut {
        held_out: held_out.above_noise(noise(&channel)),
        channel,
    });
    let remaining_share = held_out.left();
    let share_of_gap = (1.0 - remaining_share).max(0.0);
    Hypothesis {
        remaining_share,
        effects: made.effects.into_iter().map(|effect| EffectShare { share_of_gap, ..effect }).collect(),
        held_out,
        responses: responses.collect(),
        strength: by_transfer.strength.clone(),
        shape: by_transfer.shape.clone(),
        transfer: by_transfer.transfer.clone(),
        ..made
    }
}
