//! How a network is shaped, trained and applied.

use serde::{Deserialize, Serialize};

use crate::engine::EngineError;
use crate::engine::windowing::check_window;

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

/// Blocks of a network at most.
pub const MAX_BLOCKS: usize = 8;
/// Cells of a block at most.
pub const MAX_CELLS: usize = 512;
/// Window length at most, samples.
pub const MAX_WINDOW_LEN: usize = 16_384;
/// Epochs at most.
pub const MAX_EPOCHS: usize = 1_000_000;
/// Networks of one fit at most.
pub const MAX_SEEDS: usize = 32;
/// Windows per mini-batch at most.
pub const MAX_BATCH: usize = 4_096;

impl LstmSettings {
    /// Samples at the start of each window that stay out of the loss.
    pub fn burn_in_samples(&self) -> usize {
        ((self.burn_in * self.window_len as f64).floor() as usize).min(self.window_len - 1)
    }

    /// Whether every setting is within its limits.
    ///
    /// # Errors
    /// [`EngineError::Setting`] with the setting's name in the contract and its limit.
    pub fn check(&self) -> Result<(), EngineError> {
        let within = |setting, ok: bool, found: String, limit: String| {
            if ok { Ok(()) } else { Err(EngineError::Setting { setting, found, limit }) }
        };
        let blocks = !self.blocks.is_empty()
            && self.blocks.len() <= MAX_BLOCKS
            && self.blocks.iter().all(|c| (1..=MAX_CELLS).contains(c));
        within(
            "lstm.blocks",
            blocks,
            format!("{:?}", self.blocks),
            format!("1 to {MAX_BLOCKS} blocks of 1 to {MAX_CELLS} cells"),
        )?;
        within(
            "lstm.window_len",
            self.window_len <= MAX_WINDOW_LEN,
            self.window_len.to_string(),
            format!("at most {MAX_WINDOW_LEN} samples"),
        )?;
        check_window(self.window_len, self.hop)?;
        let rate = self.learning_rate;
        within(
            "lstm.learning_rate",
            rate.is_finite() && rate > 0.0,
            rate.to_string(),
            "positive and finite".into(),
        )?;
        let whole = |setting, value: usize, most: usize| {
            within(setting, (1..=most).contains(&value), value.to_string(), format!("1 to {most}"))
        };
        whole("lstm.epochs", self.epochs, MAX_EPOCHS)?;
        whole("lstm.batch_size", self.batch_size, MAX_BATCH)?;
        within(
            "lstm.burn_in",
            (0.0..1.0).contains(&self.burn_in),
            self.burn_in.to_string(),
            "0 or more, below 1".into(),
        )?;
        if let Some(norm) = self.clip_norm {
            within(
                "lstm.clip_norm",
                norm.is_finite() && norm > 0.0,
                norm.to_string(),
                "positive and finite, or absent".into(),
            )?;
        }
        within(
            "lstm.forget_bias",
            self.forget_bias.is_finite() && self.forget_bias.abs() <= 100.0,
            self.forget_bias.to_string(),
            "within +-100".into(),
        )?;
        let seeds = self.seeds.len();
        within(
            "lstm.seeds",
            (1..=MAX_SEEDS).contains(&seeds),
            seeds.to_string(),
            format!("1 to {MAX_SEEDS} seeds"),
        )
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_setting_outside_its_limits_is_refused_by_name() {
        type Spoil = fn(&mut LstmSettings);
        let cases: [(&str, Spoil); 14] = [
            ("lstm.blocks", |s| s.blocks.clear()),
            ("lstm.blocks", |s| s.blocks = vec![3, 0]),
            ("lstm.blocks", |s| s.blocks = vec![MAX_CELLS + 1]),
            ("lstm.window_len", |s| s.window_len = 1),
            ("lstm.window_len", |s| s.window_len = MAX_WINDOW_LEN + 1),
            ("lstm.hop", |s| s.hop = 33),
            ("lstm.learning_rate", |s| s.learning_rate = 0.0),
            ("lstm.epochs", |s| s.epochs = 0),
            ("lstm.batch_size", |s| s.batch_size = MAX_BATCH + 1),
            ("lstm.burn_in", |s| s.burn_in = 1.0),
            ("lstm.burn_in", |s| s.burn_in = f64::NAN),
            ("lstm.clip_norm", |s| s.clip_norm = Some(-1.0)),
            ("lstm.forget_bias", |s| s.forget_bias = f64::INFINITY),
            ("lstm.seeds", |s| s.seeds.clear()),
        ];
        let good = super::super::samples::settings();
        assert_eq!(good.check(), Ok(()));
        for (name, spoil) in cases {
            let mut settings = good.clone();
            spoil(&mut settings);
            match settings.check() {
                Err(EngineError::Setting { setting, .. }) => assert_eq!(setting, name),
                other => panic!("{name}: {other:?}"),
            }
        }
    }

    #[test]
    fn burn_in_never_takes_the_whole_window() {
        let mut settings = super::super::samples::settings();
        assert_eq!(settings.burn_in_samples(), 16);
        settings.burn_in = 0.999_999_999;
        assert_eq!(settings.burn_in_samples(), 63);
    }
}
