//! Conversion of a request's signals to the model's sample rate, where the client asks for it.

use serde::Serialize;

use super::needed;
use crate::engine::model::RigModel;
use crate::engine::resample::{MAX_GROWTH, resample};
use crate::engine::{EngineError, Signal, rounded};
use crate::http::problem::{Answer, FieldError, Problem};
use crate::http::{codes, errors};
use crate::models::LoadedModel;

/// Most values of a drive after its conversion, as many as a JSON body may hold.
const MAX_VALUES: usize = 31_000_000;

/// The conversions of a request.
#[derive(Debug)]
pub struct Conversion {
    to_hz: f64,
    allowed: bool,
    from: ConvertedFrom,
}

/// Sample rates of the signals that were converted.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize)]
pub struct ConvertedFrom {
    #[serde(skip_serializing_if = "Option::is_none")]
    drive: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    target: Option<f64>,
}

/// One of the signals of a request.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Part {
    /// The drive.
    Drive,
    /// The target.
    Target,
}

impl Part {
    /// JSON pointer of the signal.
    pub fn pointer(self) -> &'static str {
        match self {
            Self::Drive => "/drive",
            Self::Target => "/target",
        }
    }
}

impl ConvertedFrom {
    /// Whether nothing was converted.
    pub fn is_none(&self) -> bool {
        *self == Self::default()
    }
}

impl Conversion {
    /// To the rate of a model; without `allowed`, signals of another rate are refused.
    pub fn to_rate_of(model: &RigModel, allowed: bool) -> Self {
        Self { to_hz: model.sample_rate_hz, allowed, from: ConvertedFrom::default() }
    }

    /// The conversions that were made.
    pub fn made(&self) -> ConvertedFrom {
        self.from
    }

    /// Notes a conversion of the drive that was made before.
    pub fn note_drive(&mut self, from_hz: f64, to_hz: f64) {
        if !Signal::same_rate(from_hz, to_hz) {
            self.from.drive = Some(from_hz);
        }
    }

    /// Bytes of the signals of a prediction, before and behind the conversion.
    ///
    /// # Errors
    /// `body.too_large` for a drive that is too long behind it.
    pub fn bytes(&self, model: &LoadedModel, samples: usize, from_hz: f64, target: bool) -> Answer<usize> {
        let converted = self.converted(samples, from_hz);
        if converted == samples {
            return Ok(needed(model, samples, target));
        }
        self.check_size(model, converted)?;
        let before = samples.saturating_mul(model.model().inputs.len() * size_of::<f64>());
        Ok(needed(model, converted, target).saturating_add(before))
    }

    /// Refuses a converted drive that is too long.
    ///
    /// # Errors
    /// `body.too_large`.
    pub fn check_size(&self, model: &LoadedModel, samples: usize) -> Answer<()> {
        if samples.saturating_mul(model.model().inputs.len()) <= MAX_VALUES {
            return Ok(());
        }
        let limit = format!("{MAX_VALUES} values at {} Hz", rounded(self.to_hz, 10));
        let detail = format!("The drive is longer than {limit}, the model's sample rate.");
        Err(Problem::new(codes::BODY_TOO_LARGE, detail).with(FieldError::new("", limit)))
    }

    /// A signal at the model's rate.
    ///
    /// # Errors
    /// `predict.sample_rate` for another rate that must not or cannot be converted; a result that is not finite.
    pub fn apply(&mut self, signal: Signal, names: &[String], part: Part) -> Answer<Signal> {
        self.check(&signal, part)?;
        let (found_hz, at) = (signal.sample_rate_hz(), part.pointer());
        if Signal::same_rate(found_hz, self.to_hz) {
            return Ok(signal);
        }
        match part {
            Part::Drive => self.from.drive = Some(found_hz),
            Part::Target => self.from.target = Some(found_hz),
        }
        resample(&signal, self.to_hz).map_err(|error| match error {
            EngineError::Setting { limit, .. } => {
                let place = format!("{at}/sample_rate_hz");
                let detail = format!(
                    "{place} is {} Hz; it cannot be converted to the model's {} Hz, which must be {limit}.",
                    rounded(found_hz, 10),
                    rounded(self.to_hz, 10)
                );
                Problem::new(codes::PREDICT_SAMPLE_RATE, detail).with(FieldError::new(place, limit))
            }
            error => errors::engine(&error, names, &format!("{at}/channels")),
        })
    }

    /// Refuses another rate than the model's, unless it may be converted.
    ///
    /// # Errors
    /// `predict.sample_rate`.
    pub fn check(&self, signal: &Signal, part: Part) -> Answer<()> {
        if self.allowed {
            return Ok(());
        }
        check_rate(self.to_hz, signal.sample_rate_hz(), &format!("{}/sample_rate_hz", part.pointer()))
    }

    /// Samples of a signal behind its conversion, one more or less.
    pub fn converted(&self, samples: usize, from_hz: f64) -> usize {
        let ratio = self.to_hz / from_hz;
        // Other ratios are refused when they are applied.
        let is_converted = self.allowed && ratio > 0.0 && ratio <= MAX_GROWTH;
        if !is_converted || Signal::same_rate(from_hz, self.to_hz) {
            return samples;
        }
        (samples as f64 * ratio).ceil() as usize
    }
}

/// Refuses another sample rate than the model's `expected_hz`.
///
/// # Errors
/// `predict.sample_rate`, which points at `at`.
pub fn check_rate(expected_hz: f64, found_hz: f64, at: &str) -> Answer<()> {
    if Signal::same_rate(found_hz, expected_hz) {
        return Ok(());
    }
    let limit = format!("{} Hz", rounded(expected_hz, 10));
    let detail = format!("{at} is {} Hz; the model was fitted at {limit}.", rounded(found_hz, 10));
    Err(Problem::new(codes::PREDICT_SAMPLE_RATE, detail).with(FieldError::new(at, limit)))
}
