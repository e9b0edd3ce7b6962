//! A fit: data and settings in, model and report out.

use serde::{Deserialize, Serialize};

use super::{FitSettings, Preprocess, RigModel};
use crate::engine::frf::FrfSettings;
use crate::engine::lstm::LstmSettings;
use crate::engine::{EngineError, Signal, Watch};

/// One run, split into the model's inputs and outputs; equally long, one sample rate.
#[derive(Debug, Clone, PartialEq)]
pub struct Pair {
    /// Inputs, in the order of the settings.
    pub x: Signal,
    /// Outputs, in the order of the settings.
    pub y: Signal,
}

/// A stretch that models are compared on, with real context before the part that is scored.
#[derive(Debug, Clone, PartialEq)]
pub struct Validation {
    /// Context, then the scored part.
    pub pair: Pair,
    /// First sample that is scored.
    pub score_from: usize,
}

/// The data of a fit. No sample that `validation` scores may be in `training` or `frf`.
#[derive(Debug, Clone, PartialEq)]
pub struct FitData {
    /// What the LSTM (or, without one, the FRF) is trained on.
    pub training: Vec<Pair>,
    /// What the FRF part is estimated on when that is something else.
    pub frf: Option<Vec<Pair>>,
    /// What chooses among models, epochs, seeds and recombinations.
    pub validation: Vec<Validation>,
}

/// First sample of the last 10 % of a run: what a fit without validation runs holds out.
pub fn hold_out_from(n_samples: usize) -> usize {
    n_samples - n_samples / 10
}

impl Pair {
    /// Splits off the last 10 %: the training part, and the rest with context before it.
    pub fn hold_out(&self) -> (Pair, Validation) {
        let n = self.x.n_samples();
        let at = hold_out_from(n);
        let context = at.saturating_sub(CONTEXT_SAMPLES);
        let part = |r: std::ops::Range<usize>| Pair { x: self.x.slice(r.clone()), y: self.y.slice(r) };
        (part(0..at), Validation { pair: part(context..n), score_from: at - context })
    }
}

/// Context before a held-out stretch: several ring-downs of any rig at its usual sample rate.
const CONTEXT_SAMPLES: usize = 8192;

/// What a fit found; stored and shown with the model. All figures on validation data.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct FitReport {
    /// Filter used.
    pub preprocess: Preprocess,
    /// FRF settings used, none left open.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub frf: Option<FrfSettings>,
    /// LSTM settings used.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub lstm: Option<LstmSettings>,
    /// RMS error per output, in the order of the outputs.
    pub validation_rms: Vec<f64>,
    /// Seed whose network was kept.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub best_seed: Option<u64>,
    /// Epoch whose weights were kept, from 1.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub best_epoch: Option<usize>,
    /// Seconds of training and validation data.
    pub training_s: f64,
    /// Seconds of validation data.
    pub validation_s: f64,
    /// What an engineer should know: correlated drives, few averages, dead band.
    pub warnings: Vec<String>,
}

/// A fit's result.
#[derive(Debug, Clone, PartialEq)]
pub struct Fitted {
    /// The model.
    pub model: RigModel,
    /// How it came about.
    pub report: FitReport,
}

/// Fits a model.
///
/// The result depends on data, settings, seeds and the machine's instruction set only, bit for
/// bit, whatever the number of threads.
///
/// # Errors
/// Data that do not fit the settings, dead channels, too few samples, divergence, cancellation.
pub fn fit(_data: &FitData, _settings: &FitSettings, _watch: Watch<'_>) -> Result<Fitted, EngineError> {
    todo!()
}
