//! Settings of an iteration.

use serde::{Deserialize, Serialize};

use crate::EngineError;
use crate::fatigue::DamageSettings;
use crate::frf::DEFAULT_RIDGE;

/// Most iterations of one search.
pub const MAX_ITERATIONS: usize = 200;

/// Most bands with a gain of their own.
pub const MAX_GAIN_BANDS: usize = 100;

/// What an iteration does, apart from what belongs to single channels.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct IterationSettings {
    /// Corrections at most, 1..=200; the start drive is not counted.
    pub iterations: usize,
    /// Share of the linear correction that is applied, in (0, 2].
    pub gain: f64,
    /// Factors on the gain over parts of the frequency axis.
    pub gain_bands: Vec<GainBand>,
    /// First and last frequency of the correction, Hz. Left out: wherever the FRF is reliable.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub band_hz: Option<[f64; 2]>,
    /// Lines on which the multiple coherence of a response is below this take no part, in 0..=1. Between it
    /// and 1 the gain rises to its full value half way.
    pub min_coherence: f64,
    /// Tikhonov's parameter of the inverse FRF, relative to its median squared gain.
    pub ridge: f64,
    /// Time over which corrections fade to zero at both ends, s.
    pub taper_s: f64,
    /// Whether the model's own gradient takes over where the linear step leads no further.
    pub gradient: bool,
    /// What happens to drives outside what the model was fitted on.
    pub outside: Outside,
    /// When the search ends before the last iteration.
    pub stop: StopAt,
    /// Settings of the damage.
    pub damage: DamageSettings,
}

/// A factor on the gain over a part of the frequency axis.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct GainBand {
    /// First frequency, Hz.
    pub from_hz: f64,
    /// Last frequency, Hz.
    pub to_hz: f64,
    /// Factor, 0..=2.
    pub gain: f64,
}

/// What happens to drives outside what the model was fitted on, as its trust tells it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Outside {
    /// Each iteration takes values beyond the range half of the way back, and what is left counts as error in the choice
    /// of the best.
    #[default]
    Penalised,
    /// The same of all that the trust tells: values, rates, windows, spectra, and all drives together.
    Strict,
    /// Nothing.
    Allowed,
}

/// When a search ends before the last iteration.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct StopAt {
    /// Every channel's RMS error is at most this.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub error: Option<f64>,
    /// Every channel's damage ratio lies between these.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub damage_ratio: Option<[f64; 2]>,
}

impl Default for IterationSettings {
    fn default() -> Self {
        Self {
            iterations: 15,
            gain: 1.0,
            gain_bands: Vec::new(),
            band_hz: None,
            min_coherence: 0.5,
            ridge: DEFAULT_RIDGE,
            taper_s: 0.0,
            gradient: true,
            outside: Outside::default(),
            stop: StopAt::default(),
            damage: DamageSettings::default(),
        }
    }
}

impl IterationSettings {
    /// # Errors
    /// [`EngineError::Setting`] for the first setting outside its limits.
    pub fn check(&self) -> Result<(), EngineError> {
        let refuse = |setting, found: String, limit: &str| {
            Err(EngineError::Setting { setting, found, limit: limit.into() })
        };
        if !(1..=MAX_ITERATIONS).contains(&self.iterations) {
            return refuse("iterations", self.iterations.to_string(), "from 1 to 200");
        }
        if !(self.gain > 0.0 && self.gain <= 2.0) {
            return refuse("gain", self.gain.to_string(), "above 0, at most 2");
        }
        if self.gain_bands.len() > MAX_GAIN_BANDS {
            return refuse("gain_bands", self.gain_bands.len().to_string(), "at most 100 bands");
        }
        for band in &self.gain_bands {
            if !rising([band.from_hz, band.to_hz]) {
                let found = format!("{} to {} Hz", band.from_hz, band.to_hz);
                return refuse("gain_bands", found, "from_hz below to_hz, both finite, not negative");
            }
            if !(0.0..=2.0).contains(&band.gain) {
                return refuse("gain_bands", band.gain.to_string(), "gains from 0 to 2");
            }
        }
        if let Some(band) = self.band_hz.filter(|band| !rising(*band)) {
            let found = format!("{} to {} Hz", band[0], band[1]);
            return refuse("band_hz", found, "the first frequency below the last, both finite, not negative");
        }
        if !(0.0..=1.0).contains(&self.min_coherence) {
            return refuse("min_coherence", self.min_coherence.to_string(), "from 0 to 1");
        }
        if !(self.ridge.is_finite() && self.ridge >= 0.0) {
            return refuse("ridge", self.ridge.to_string(), "a finite number, not negative");
        }
        if !(self.taper_s.is_finite() && self.taper_s >= 0.0) {
            return refuse("taper_s", self.taper_s.to_string(), "a finite number of seconds, not negative");
        }
        if let Some(error) = self.stop.error.filter(|error| !(*error > 0.0 && *error < 1.0)) {
            return refuse("stop.error", error.to_string(), "above 0, below 1");
        }
        if let Some([low, high]) = self.stop.damage_ratio
            && !(low > 0.0 && low <= 1.0 && high >= 1.0 && high.is_finite())
        {
            return refuse("stop.damage_ratio", format!("{low} to {high}"), "two numbers about 1, above 0");
        }
        self.damage.check()
    }
}

fn rising([from, to]: [f64; 2]) -> bool {
    from >= 0.0 && from < to && to.is_finite()
}

/// Limits of one drive, in its unit.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct DriveLimit {
    /// Largest magnitude.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub peak: Option<f64>,
    /// Largest RMS about the mean.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub rms: Option<f64>,
    /// Largest rate of change, unit per second.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub rate: Option<f64>,
}

impl DriveLimit {
    /// The first limit that is not a positive, finite number.
    pub fn fault(&self) -> Option<&'static str> {
        let named = [("peak", self.peak), ("rms", self.rms), ("rate", self.rate)];
        named
            .into_iter()
            .find_map(|(name, limit)| limit.is_some_and(|v| !(v.is_finite() && v > 0.0)).then_some(name))
    }
}
