//! The decision: one linear score for each family of laws, against none of them.
//!
//! The laws that ran freely, the foremost of each family, are alternatives, and so is that none of them is right, whose
//! score is 0. The probability of each follows from the scores (conditional logit, McFadden 1974). The weights are
//! fitted by `examples/fit_decision` to a population of simulated rigs, and to nothing else.

use std::sync::LazyLock;

use serde::{Deserialize, Serialize};

use crate::diagnosis::effects::effect::{Effect, Family};
use crate::diagnosis::numerics::linear::rms;
use crate::diagnosis::screen::{FreeRun, Place, Screening, Standing, Transfer};

use super::refit::Refits;

/// Logarithms are kept within these: what leaves less is as sure as it gets, what leaves more is no law.
const LEAST_LEFT: f64 = -4.0;
const MOST_LEFT: f64 = 0.2;
const LEAST_ERROR: f64 = -7.0;
/// Below this a regression over measured motions tells no more: where a strong law has moved them, wrong laws leave
/// little too, and only free runs tell them apart.
const LEAST_BY_REGRESSION: f64 = 0.5;
/// Spread of a law's gains from which on its numbers hold nowhere.
const WIDEST: f64 = 1.5;

/// Of the population's rigs that no law of the catalogue is right for, the share that has an effect outside of it; the
/// others are linear.
const OUTSIDE: f64 = 1.0 / 5.0;

/// Features, in the order of the weights.
pub const FEATURES: [&str; 29] = [
    "one",
    "left_by_regression",
    "left_by_free_run",
    "left_where_it_does_worst",
    "error_of_linear_part",
    "spread_of_gains",
    "number_of_coefficients",
    "over_a_drive",
    "over_the_output",
    "between_two_responses",
    "over_a_drive_less_a_response",
    "left_by_free_run_at_one_level",
    "over_a_predicted_motion",
    "alike_in_every_mode",
    "error_of_linear_part_squared",
    "fitted_again",
    "left_by_refit",
    "left_by_free_run_where_fitted_again",
    "left_by_refit_of_another_family",
    "friction_hysteresis",
    "damping",
    "actuator",
    "deadband_backlash",
    "cross_axis",
    "time_variance",
    "sensor",
    "block_structure",
    "valve_flow",
    "friction_that_drives",
];

/// Families with a weight of their own; the others share that of `one`.
const FAMILIES: [Family; 8] = [
    Family::FrictionHysteresis,
    Family::Damping,
    Family::Actuator,
    Family::DeadbandBacklash,
    Family::CrossAxis,
    Family::TimeVariance,
    Family::Sensor,
    Family::BlockStructure,
];

/// The foremost law of a family, with what speaks for it.
#[derive(Debug, Clone)]
pub struct Alternative<'a> {
    /// The law at its place.
    pub standing: &'a Standing,
    /// Its free run.
    pub free: &'a FreeRun,
    /// What the best law of its family leaves where it is fitted together with the linear part.
    pub refitted: Option<f64>,
    /// Its features, in the order of [`FEATURES`].
    pub features: [f64; FEATURES.len()],
}

/// The fitted weights.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Weights {
    /// Names of the features.
    pub features: Vec<String>,
    /// A weight for each.
    pub weights: Vec<f64>,
}

static WEIGHTS: LazyLock<Weights> = LazyLock::new(|| {
    serde_json::from_str(include_str!("weights.json")).expect("the weights in the program are JSON")
});

/// The foremost law of each family. What a linear part can do needs no law.
pub(super) fn laws(screening: &Screening) -> impl Iterator<Item = &Standing> {
    screening.foremost().into_iter().filter(|s| !super::linear(s.effect))
}

/// The alternatives of a screening: the foremost laws that could be simulated forward.
pub fn alternatives<'a>(screening: &'a Screening, refits: &Refits) -> Vec<Alternative<'a>> {
    laws(screening).filter_map(|standing| of(screening, refits, standing, standing.free.as_ref()?)).collect()
}

fn of<'a>(
    screening: &'a Screening,
    refits: &Refits,
    standing: &'a Standing,
    free: &'a FreeRun,
) -> Option<Alternative<'a>> {
    let refitted = refits.left(standing.family, standing.place);
    let kept = |ratio: f64| ratio.max(f64::MIN_POSITIVE).ln().clamp(LEAST_LEFT, MOST_LEFT);
    let yes = |is: bool| f64::from(u8::from(is));
    let error = rms(&screening.linear.errors[standing.response]);
    let error = error.max(f64::MIN_POSITIVE).ln().clamp(LEAST_ERROR, 0.0);
    let one_level = matches!(screening.transfer, Transfer::Runs | Transfer::Stretches);
    // The linear part's modes tell how a law over what it predicts moves each of them.
    let by_modes = standing.predicted && standing.place.is_of_structure() && screening.linear.modes.is_some();
    let general = [
        1.0,
        kept(standing.ratio.max(LEAST_BY_REGRESSION)),
        kept(free.ratio),
        kept(free.worst),
        error,
        standing.spread().map_or(WIDEST, |spread| spread.min(WIDEST)),
        f64::from(standing.law.count() as u32).ln(),
        yes(matches!(standing.place, Place::Drive(_))),
        yes(matches!(standing.place, Place::Output(_))),
        yes(matches!(standing.place, Place::Between(..))),
        yes(standing.place.is_less_a_response()),
        yes(one_level) * kept(free.ratio),
        yes(by_modes),
        yes(by_modes) * standing.gain.abs(),
        error * error,
        yes(refitted.is_some()),
        refitted.map_or(0.0, kept),
        yes(refitted.is_some()) * kept(free.ratio),
        // A law that cannot be fitted again is less likely where one of another family leaves next to nothing.
        refits.left_by_others(standing.family).map_or(0.0, kept),
    ];
    let families = FAMILIES.into_iter().map(|family| yes(standing.family == family));
    let physics = [yes(standing.effect == Effect::ValveFlow), yes(drives(standing))];
    let all: Vec<f64> = general.into_iter().chain(families).chain(physics).collect();
    Some(Alternative { standing, free, refitted, features: all.try_into().ok()? })
}

/// Whether a law of dry friction or hysteresis goes with the motion instead of against it.
fn drives(standing: &Standing) -> bool {
    standing.place.is_of_structure() && standing.family == Family::FrictionHysteresis && standing.gain > 0.0
}

/// Factor of the odds that no law is right where repeats tell the noise, `noise` being its share of what the linear
/// part leaves, by power. A linear rig leaves noise and nothing else; an effect outside the catalogue leaves any share.
pub(super) fn odds_of_none(noise: f64) -> f64 {
    OUTSIDE + (1.0 - OUTSIDE) * noise.clamp(0.0, 1.0)
}

impl Weights {
    /// The weights that the program holds.
    pub fn fitted() -> &'static Self {
        &WEIGHTS
    }

    /// Probability of each alternative; what is missing to 1 is that of none, whose odds are `none` times those of
    /// the population.
    pub fn probabilities(&self, alternatives: &[[f64; FEATURES.len()]], none: f64) -> Vec<f64> {
        let score = |x: &[f64; FEATURES.len()]| x.iter().zip(&self.weights).map(|(x, w)| x * w).sum::<f64>();
        let scores: Vec<f64> = alternatives.iter().map(score).collect();
        let most = scores.iter().copied().fold(0.0, f64::max);
        let total = none * (-most).exp() + scores.iter().map(|s| (s - most).exp()).sum::<f64>();
        scores.iter().map(|s| (s - most).exp() / total).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_weights_belong_to_the_features() {
        let fitted = Weights::fitted();
        assert_eq!(fitted.features, FEATURES);
        assert_eq!(fitted.weights.len(), FEATURES.len());
        assert!(fitted.weights.iter().all(|w| w.is_finite()));
    }

    #[test]
    fn probabilities_grow_with_the_score_and_leave_the_rest_to_none() {
        let mut weights = Weights { features: Vec::new(), weights: vec![0.0; FEATURES.len()] };
        weights.weights[0] = 2.0_f64.ln();
        let mut alone = [0.0; FEATURES.len()];
        alone[0] = 1.0;
        let found = weights.probabilities(&[alone, [0.0; FEATURES.len()]], 1.0);
        assert!((found[0] - 0.5).abs() < 1e-12 && (found[1] - 0.25).abs() < 1e-12, "{found:?}");
        let sure = weights.probabilities(&[alone], 0.0);
        assert!((sure[0] - 1.0).abs() < 1e-12, "{sure:?}");
        assert!(weights.probabilities(&[], 1.0).is_empty());
    }
}
