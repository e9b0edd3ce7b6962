//! What a client may say about a fit, and the presets that say the rest.

use serde::{Deserialize, Serialize};

use super::ModelKind;
use super::preprocess::Preprocess;
use crate::engine::frf::FrfSettings;
use crate::engine::lstm::{Optimizer, RecombineChoice, Schedule};

/// Where values come from that a request leaves open.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Preset {
    /// Ours: the most accurate model in a few minutes.
    #[default]
    Default,
    /// The source paper's settings (section 3.3).
    Paper,
}

/// LSTM settings as a request may give them: what is `None` comes from the preset.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
#[expect(missing_docs, reason = "each field is that of LstmSettings")]
pub struct LstmOptions {
    pub blocks: Option<Vec<usize>>,
    pub window_len: Option<usize>,
    pub hop: Option<usize>,
    pub optimizer: Option<Optimizer>,
    pub learning_rate: Option<f64>,
    pub schedule: Option<Schedule>,
    pub warmup_steps: Option<usize>,
    pub epochs: Option<usize>,
    pub batch_size: Option<usize>,
    pub burn_in: Option<f64>,
    pub clip_norm: Option<f64>,
    pub forget_bias: Option<f64>,
    pub recombine: Option<RecombineChoice>,
    pub seeds: Option<Vec<u64>>,
}

/// Everything that a fit is told but its data.
#[derive(Debug, Clone, PartialEq)]
pub struct FitSettings {
    /// Kind of model.
    pub kind: ModelKind,
    /// Names of the input channels.
    pub inputs: Vec<String>,
    /// Names of the output channels.
    pub outputs: Vec<String>,
    /// Filter.
    pub preprocess: Preprocess,
    /// FRF part.
    pub frf: FrfSettings,
    /// LSTM part.
    pub lstm: LstmOptions,
    /// Source of what is left open.
    pub preset: Preset,
}
