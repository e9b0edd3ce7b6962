//! A rig's model: FRF, LSTM or a hybrid of both, fitted from runs and applied to drives.

mod fit;
mod preprocess;
mod scaler;
mod settings;
mod start;
#[cfg(test)]
mod tests;
mod trust;
mod weights;

use serde::{Deserialize, Serialize};

use super::frf::Frf;
use super::lstm::{self, LstmNet, Recombine};
use super::{EngineError, Signal};

pub use fit::{FitData, FitReport, Fitted, Pair, Validation, fit, hold_out_from};
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
}

impl RigModel {
    /// Response to `x`, whose channels are the model's inputs in order; as long as `x`.
    ///
    /// # Errors
    /// Another channel count or sample rate, no samples, a result that is not finite.
    pub fn predict(&self, x: &Signal) -> Result<Signal, EngineError> {
        let x = &self.filtered(x)?;
        let linear = self.frf.as_ref().map(|frf| frf.apply(x)).transpose()?;
        match &self.lstm {
            None => linear.ok_or_else(|| EngineError::Weights("a model has an FRF or an LSTM".into())),
            Some(part) => part.predict(self.kind, x, linear.as_ref()),
        }
        .map_err(EngineError::of_result)
    }

    /// Where `x` leaves what the model was fitted on.
    ///
    /// # Errors
    /// As [`RigModel::predict`] for senseless inputs.
    pub fn trust(&self, x: &Signal) -> Result<Trust, EngineError> {
        Ok(trust::trust(&self.inputs, &self.range, &self.filtered(x)?))
    }

    fn filtered(&self, x: &Signal) -> Result<Signal, EngineError> {
        if x.n_channels() != self.inputs.len() {
            return Err(EngineError::ChannelCount {
                what: "drive",
                expected: self.inputs.len(),
                found: x.n_channels(),
            });
        }
        if !Signal::same_rate(x.sample_rate_hz(), self.sample_rate_hz) {
            return Err(EngineError::SampleRate {
                what: "drive",
                expected_hz: self.sample_rate_hz,
                found_hz: x.sample_rate_hz(),
            });
        }
        if x.n_samples() == 0 {
            return Err(EngineError::TooShort { what: "drive", needed: 1, found: 0 });
        }
        self.preprocess.apply(x)
    }
}

impl LstmPart {
    /// The network's part of a prediction, combined with the FRF's as `kind` says.
    fn predict(&self, kind: ModelKind, x: &Signal, linear: Option<&Signal>) -> Result<Signal, EngineError> {
        let z = network_inputs(&self.x, kind, x, linear);
        let out = lstm::predict(&self.net, &z, self.window_len, self.hop, self.recombine)?;
        let mut channels: Vec<Vec<f64>> =
            out.iter().enumerate().map(|(channel, z)| self.y.restore(channel, z)).collect();
        if let (ModelKind::Hybrid1, Some(linear)) = (kind, linear) {
            for (channel, samples) in channels.iter_mut().enumerate() {
                for (v, l) in samples.iter_mut().zip(linear.channel(channel)) {
                    *v += l;
                }
            }
        }
        Signal::new(x.sample_rate_hz(), channels)
    }
}

/// What the network sees: the standardised inputs, for hybrid 2 followed by FRF(x).
fn network_inputs(scaler: &Scaler, kind: ModelKind, x: &Signal, linear: Option<&Signal>) -> Vec<Vec<f32>> {
    let linear = linear.filter(|_| kind == ModelKind::Hybrid2);
    let channels = x.channels().iter().chain(linear.iter().flat_map(|l| l.channels()));
    channels.enumerate().map(|(channel, samples)| scaler.standardise(channel, samples)).collect()
}
