//! The band about a response, and the damage of the signals within it.

use std::collections::BTreeMap;

use serde::Serialize;

use super::Setting;
use crate::engine::fatigue::{DamageSettings, damage_band};
use crate::engine::model::{BAND_COVERAGE, Predictor, RigModel};
use crate::engine::{Signal, rounded};
use crate::http::json::Object;
use crate::http::problem::{Answer, FieldError, Problem};
use crate::http::{codes, errors};

/// Digits of a half width.
const DIGITS: usize = 6;

/// The reason of a model without a band.
const NO_BAND: &str = "the weights carry no band: no data compared the model when it was fitted, or they were made elsewhere or \
                       by an earlier version";

/// The reason of a model with effects on top.
const ADOPTED: &str = "the model has adopted effects, and no data have compared it with them";

/// Most values of a band, which is text in memory as a whole: half an hour of a response at 500 Hz.
const MAX_BAND_VALUES: u64 = 1_000_000;

/// The reason why a model has no band.
pub(in crate::http::predict) fn reason(model: &RigModel) -> &'static str {
    if model.effects.is_empty() { NO_BAND } else { ADOPTED }
}

/// Damage of the least and of the largest swings within the band about a response, by output.
///
/// # Errors
/// Settings of the damage outside their limits, damage beyond its range.
pub(in crate::http::predict) fn damages_within(
    predictor: &Predictor,
    response: &Signal,
    half_width: &Signal,
    settings: &DamageSettings,
) -> Answer<Vec<[f64; 2]>> {
    let of_cycles = predictor.cycle_factors();
    let of = |(k, h): (usize, &Vec<f64>)| {
        let wider: Vec<f64> = h.iter().map(|h| of_cycles[k] * h).collect();
        damage_band(response.channel(k), &wider, settings)
            .map_err(|error| errors::engine(&error, &predictor.model().outputs, ""))
    };
    half_width.channels().iter().enumerate().map(of).collect()
}

/// Refuses a band of too many values, all outputs and drives together.
pub(super) fn check(values: u64) -> Answer<()> {
    if values <= MAX_BAND_VALUES {
        return Ok(());
    }
    let limit = format!("a response of at most {MAX_BAND_VALUES} values, all outputs together");
    let detail = format!("The response has {values} values; a band is told for {limit}.");
    Err(Problem::new(codes::PREDICT_BAND_TOO_LONG, detail).with(FieldError::new("/include", limit)))
}

#[derive(Debug, Serialize)]
struct BandAnswer<'a> {
    coverage: f64,
    channels: BTreeMap<&'a str, HalfWidth>,
    damage: BTreeMap<&'a str, [f64; 2]>,
}

#[derive(Debug, Serialize)]
struct HalfWidth {
    half_width: Vec<f64>,
}

impl Setting<'_> {
    /// Adds the band about a response, or the reason of its absence.
    ///
    /// # Errors
    /// Settings of the damage outside their limits, damage beyond its range.
    pub(super) fn add_band(
        &self,
        answer: &mut Object,
        response: &Signal,
        half_width: Option<&Signal>,
    ) -> Answer<()> {
        let model = self.loaded.model();
        let Some(half_width) = half_width else {
            answer.add("band", &None::<()>)?;
            return answer.add("band_reason", &reason(model));
        };
        let mut band =
            BandAnswer { coverage: BAND_COVERAGE, channels: BTreeMap::new(), damage: BTreeMap::new() };
        let damages = damages_within(&self.loaded.predictor, response, half_width, &self.damage)?;
        for ((name, h), damage) in model.outputs.iter().zip(half_width.channels()).zip(damages) {
            band.damage.insert(name, damage);
            let half_width = h.iter().map(|h| rounded(*h, DIGITS)).collect();
            band.channels.insert(name, HalfWidth { half_width });
        }
        answer.add("band", &band)
    }
}
