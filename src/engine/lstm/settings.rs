//! How a network is shaped, trained and applied.

use serde::{Deserialize, Serialize};

/// Optimiser of the weights.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Optimizer {
    /// RMSProp as Keras defines it (rho 0.9, epsilon 1e-7): the paper's.
    Rmsprop,
    /// Adam (beta 0.9, 0.999, epsilon 1e-8).
    Adam,
}

/// Learning rate over the steps of a fit.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Schedule {
    /// The same rate throughout.
    Constant,
    /// Half a cosine from the rate to zero over all steps.
    Cosine,
}

/// How window predictions become one signal.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Recombine {
    /// Sum of windows weighted with the tenth power of Welch's window (paper, section 2.2.2).
    Welch,
    /// The state carried through the whole signal after a pre-roll of the first value held.
    Stream,
}

/// What a fit is told about recombination.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum RecombineChoice {
    /// The better of both on validation data.
    #[default]
    Auto,
    /// [`Recombine::Welch`].
    Welch,
    /// [`Recombine::Stream`].
    Stream,
}

/// All settings of the LSTM part of a fit, none left open.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct LstmSettings {
    /// Cells of each block, at least one block.
    pub blocks: Vec<usize>,
    /// Window length `L`, samples.
    pub window_len: usize,
    /// Step between window starts, samples; `1 <= hop <= L / 2`.
    pub hop: usize,
    /// Optimiser.
    pub optimizer: Optimizer,
    /// Learning rate after the warm-up.
    pub learning_rate: f64,
    /// Learning rate over the steps.
    pub schedule: Schedule,
    /// Steps over which the rate rises linearly from zero.
    pub warmup_steps: usize,
    /// Repetitions of the training data.
    pub epochs: usize,
    /// Windows per mini-batch.
    pub batch_size: usize,
    /// Leading share of each window that stays out of the loss, 0 <= burn_in < 1.
    pub burn_in: f64,
    /// The gradient is scaled down to this Euclidean norm; `None`: never.
    pub clip_norm: Option<f64>,
    /// Start value of the forget gates' biases.
    pub forget_bias: f64,
    /// Recombination.
    pub recombine: RecombineChoice,
    /// One network is trained per seed; the best on validation data is kept.
    pub seeds: Vec<u64>,
}
