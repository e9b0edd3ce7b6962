//! A rig's model: FRF, LSTM or a hybrid of both, fitted from runs and applied to drives.

mod fit;
mod preprocess;
mod settings;
mod trust;
mod weights;

use serde::{Deserialize, Serialize};

use super::frf::Frf;
use super::lstm::{LstmNet, Recombine};
use super::{EngineError, Signal};

pub use fit::{FitData, FitReport, Fitted, Pair, Validation, fit, hold_out_from};
pub use preprocess::Preprocess;
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

/// Mean and standard deviation per channel: `z = (v - mean) / std`.
#[derive(Debug, Clone, PartialEq)]
pub struct Scaler {
    /// Mean of each channel, in its unit.
    pub mean: Vec<f64>,
    /// Standard deviation of each channel, in its unit, positive.
    pub std: Vec<f64>,
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
}

impl RigModel {
    /// Response to `x`, whose channels are the model's inputs in order; as long as `x`.
    ///
    /// # Errors
    /// Another channel count or sample rate, no samples, a result that is not finite.
    pub fn predict(&self, _x: &Signal) -> Result<Signal, EngineError> {
        todo!()
    }

    /// Where `x` leaves what the model was fitted on.
    pub fn trust(&self, x: &Signal) -> Trust {
        trust::trust(&self.inputs, &self.range, x)
    }
}
