//! A rig's model: FRF, LSTM or a hybrid of both, fitted from runs and applied to drives.

mod effect;
mod fit;
mod predict;
mod preprocess;
mod scaler;
mod settings;
mod start;
#[cfg(test)]
mod tests;
mod trust;
mod weights;

use std::ops::Range;

use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use super::frf::Frf;
use super::lstm::{LstmNet, Recombine};
use super::{EngineError, Signal};

pub use effect::AddedEffect;
pub use fit::{FitData, FitReport, Fitted, Pair, Validation, fit, fit_resumable, hold_out_from};
pub use predict::{Prediction, Predictor};
pub use preprocess::Preprocess;
pub use scaler::Scaler;
pub use settings::{FitSettings, LstmOptions, Preset};
pub use trust::{InputRange, Trust, TrustSpan};
pub use weights::{from_safetensors, to_safetensors};

/// Which parts a model has and how they combine (Heindel et al., section 2.3).
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum ModelKind {
    /// `y = FRF(x)`.
    Frf,
    /// `y = LSTM(x)`.
    Lstm,
    /// `y = FRF(x) + LSTM(x)`, the LSTM trained on the FRF's error.
    Hybrid1,
    /// `y = LSTM(x, FRF(x))`.
    Hybrid2,
}

impl ModelKind {
    /// Its name in the contract.
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Frf => "frf",
            Self::Lstm => "lstm",
            Self::Hybrid1 => "hybrid1",
            Self::Hybrid2 => "hybrid2",
        }
    }
}

/// The LSTM part of a model with everything that its prediction depends on.
#[derive(Debug, Clone, PartialEq)]
pub struct LstmPart {
    /// Weights.
    pub net: LstmNet,
    /// Scaler of the network's inputs; for hybrid 2 the model's inputs, then FRF(x).
    pub x: Scaler,
    /// Scaler of the network's outputs; for hybrid 1 of the FRF's error.
    pub y: Scaler,
    /// Window length `L`, samples.
    pub window_len: usize,
    /// Step between window starts, samples.
    pub hop: usize,
    /// How windows become a signal.
    pub recombine: Recombine,
}

/// A fitted or imported model, ready to predict.
#[derive(Debug, Clone, PartialEq)]
pub struct RigModel {
    /// Kind.
    pub kind: ModelKind,
    /// Names of the input channels, in order.
    pub inputs: Vec<String>,
    /// Names of the output channels, in order.
    pub outputs: Vec<String>,
    /// Sample rate of inputs and outputs.
    pub sample_rate_hz: f64,
    /// Filter that inputs pass before the model.
    pub preprocess: Preprocess,
    /// Present for all kinds but `lstm`.
    pub frf: Option<Frf>,
    /// Present for all kinds but `frf`.
    pub lstm: Option<LstmPart>,
    /// What each input did in the training data; empty when unknown (imported weights).
    pub range: Vec<InputRange>,
    /// Effects that were found on top of it, the first found first.
    pub effects: Vec<AddedEffect>,
}

impl RigModel {
    /// Response to `x`, whose channels are the model's inputs in order; as long as `x`. Whoever
    /// predicts more than once with a model makes a [`Predictor`] of it.
    ///
    /// # Errors
    /// Another channel count or sample rate, no samples, a result that is not finite.
    pub fn predict(&self, x: &Signal) -> Result<Signal, EngineError> {
        predict::whole(self, x)
    }
}

/// What the network sees of a range of samples: the standardised inputs, for hybrid 2 followed by
/// FRF(x), of which `linear` is that range.
fn network_inputs(
    scaler: &Scaler,
    kind: ModelKind,
    x: &Signal,
    range: Range<usize>,
    linear: Option<&[Vec<f64>]>,
) -> Vec<Vec<f32>> {
    let linear = linear.filter(|_| kind == ModelKind::Hybrid2).unwrap_or_default();
    let x = x.channels().iter().map(|channel| &channel[range.clone()]);
    let channels: Vec<&[f64]> = x.chain(linear.iter().map(Vec::as_slice)).collect();
    channels.par_iter().enumerate().map(|(channel, samples)| scaler.standardise(channel, samples)).collect()
}
