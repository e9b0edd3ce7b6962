//! A rig's model: FRF, LSTM or a hybrid of both, fitted from runs and applied to drives.

mod band;
#[cfg(test)]
mod band_tests;
#[cfg(test)]
mod core_tests;
mod effect;
#[cfg(test)]
mod elsewhere_tests;
mod fallback;
mod fit;
mod fit_data;
mod fit_network;
mod fit_record;
mod fit_report;
mod kind;
mod memory;
#[cfg(test)]
mod paper;
mod predict;
mod preprocess;
mod scaler;
mod score;
mod settings;
mod split;
mod start;
#[cfg(test)]
mod tests;
mod trust;
mod weights;

use std::ops::Range;

use rayon::prelude::*;

use super::frf::{Frf, FrfQuality, FrfSummary};
use super::lstm::{LstmNet, Recombine};
use super::progress::unwatched;
use super::{EngineError, Signal};

pub use band::{Band, COVERAGE as BAND_COVERAGE};
pub use effect::{AddedEffect, apply_effects};
pub use fallback::{FallbackSpan, FallbackUse};
pub use fit::{Fitted, fit, fit_resumable, train_for, try_out};
pub use fit_data::{FitData, Pair};
pub use fit_record::{
    Autocorrelation, FitRecord, InputCoverage, Residual, ResidualOf, ResidualSpectra, ResidualSpectrum,
};
pub use fit_report::{Comparison, FitReport, SeedReport};
pub use kind::{ModelKind, VersionKind};
pub use memory::FitSize;
pub use predict::{Prediction, Predictor};
pub use preprocess::Preprocess;
pub use scaler::Scaler;
pub use score::{CONTEXT_SAMPLES, SectionScore, Squares, with_context};
pub use settings::{FitSettings, LstmOptions, Preset, Task};
pub use split::{FitSplit, RunLengths, Section, Sections, SplitRule, own_frf_sections};
pub use trust::{Excursion, InputRange, JointRange, LocalRange, Remedy, Trust, TrustSpan, WindowRange};
pub use weights::{from_safetensors, to_safetensors};

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
    /// Its parts and how they combine, without its effects.
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
    /// Quality of its FRF; absent in weights made elsewhere or by earlier versions.
    pub frf_quality: Option<FrfQuality>,
    /// Effects between the FRF and the network of a hybrid, the first found first: the FRF with them is the
    /// core, which then takes the FRF's place in the hybrid.
    pub core: Vec<AddedEffect>,
    /// Present for all kinds but `frf`.
    pub lstm: Option<LstmPart>,
    /// Range of each input in the training data; empty when unknown (imported weights).
    pub range: Vec<InputRange>,
    /// Range of the response of its FRF at each output over windows of the training data, without an FRF that of each
    /// input; empty when unknown.
    pub window_range: Vec<WindowRange>,
    /// Range of the means of all inputs together over those windows; `None` when unknown, and for one input.
    pub joint_range: Option<JointRange>,
    /// The band about its predictions, without its effects; absent where no data compared it, and in weights made elsewhere
    /// or by earlier versions.
    pub band: Option<Band>,
    /// Effects that were found on top of it, the first found first.
    pub effects: Vec<AddedEffect>,
}

impl RigModel {
    /// What kind of version it makes: `adopted` if it has effects.
    pub fn version_kind(&self) -> VersionKind {
        if self.effects.is_empty() { self.kind.into() } else { VersionKind::Adopted }
    }

    /// Response to `x`, whose channels are the model's inputs in order; as long as `x`. For several
    /// predictions with one model a [`Predictor`] is faster.
    ///
    /// # Errors
    /// Another channel count or sample rate, no samples, a result that is not finite.
    pub fn predict(&self, x: &Signal) -> Result<Signal, EngineError> {
        predict::whole(self, x)
    }

    /// Response of its FRF, with the effects of its core, to inputs behind its filter, `[output, sample]`; `None`
    /// without an FRF.
    fn linear(&self, x: &Signal) -> Result<Option<Signal>, EngineError> {
        let Some(frf) = &self.frf else { return Ok(None) };
        effect::apply_all(&self.core, x, frf.apply(x)?, &unwatched).map(Some)
    }

    /// Its FRF in a few figures, if it has one.
    pub fn frf_summary(&self) -> Option<FrfSummary> {
        let quality = self.frf_quality.as_ref();
        self.frf.as_ref().map(|frf| FrfSummary::of(frf, quality, &self.inputs, &self.outputs))
    }
}

/// The network's inputs for a range of samples: the standardised inputs, for hybrid 2 followed by FRF(x), or by
/// the response of its core, of which `linear` is that range.
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
