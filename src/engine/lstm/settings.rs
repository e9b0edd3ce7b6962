//! Settings of a network's shape, training and application.

use serde::{Deserialize, Serialize};

use crate::EngineError;
use crate::windowing::check_window;

/// Optimiser of the weights.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Optimizer {
    /// RMSProp as Keras defined it when the paper was written (rho 0.9, epsilon 1e-7 added to the
    /// root, no momentum): the paper's.
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

/// The way in which window predictions become one signal.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Recombine {
    /// Sum of windows weighted with the tenth power of Welch's window (paper, section 2.2.2).
    Welch,
    /// The state carried through the whole signal after a pre-roll of the first value held.
    Stream,
}

/// The recombination that a fit is asked for.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum RecombineChoice {
    /// The better of the two on validation data.
    #[default]
    Auto,
    /// [`Recombine::Welch`].
    Welch,
    /// [`Recombine::Stream`].
    Stream,
}

/// Where in a training run its windows begin.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum WindowOffset {
    /// At a sample below one hop that is drawn anew for each epoch, and every hop from there.
    #[default]
    Drawn,
    /// At its first sample and every hop from there (paper, section 2.2.2).
    Fixed,
}

/// What the network of a hybrid starts from.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum HybridStart {
    /// A copy of its FRF (hybrid 1: no correction), which is left only for an epoch that is clearly
    /// better.
    #[default]
    Copy,
    /// Random weights (paper, section 2.2.1), which are no model to keep: one of the epochs is.
    /// Networks without an FRF always start so.
    Random,
}

/// All settings of the LSTM part of a fit, none left open. Those that came later have the value of
/// the fits before them where a stored report lacks them.
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
    /// Epochs from one validation to the next, each a candidate for the best; `None`: as many as
    /// make a hundred validations of a fit.
    #[serde(default)]
    pub validate_every: Option<usize>,
    /// Windows per mini-batch.
    pub batch_size: usize,
    /// Where in a training run its windows begin.
    #[serde(default)]
    pub window_offset: WindowOffset,
    /// Leading share of each window that the loss leaves out, 0 <= burn_in < 1.
    pub burn_in: f64,
    /// The gradient is scaled down to this Euclidean norm; `None`: never.
    pub clip_norm: Option<f64>,
    /// Start value of the forget gates' biases.
    pub forget_bias: f64,
    /// What the network of a hybrid starts from.
    #[serde(default)]
    pub hybrid_start: HybridStart,
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
    /// Samples at the start of each window that the loss leaves out.
    pub fn burn_in_samples(&self) -> usize {
        ((self.burn_in * self.window_len as f64).floor() as usize).min(self.window_len - 1)
    }

    /// Checks that every setting is within its limits.
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
        whole("lstm.validate_every", self.validate_every.unwrap_or(1), MAX_EPOCHS)?;
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
        let cases: [(&str, Spoil); 15] = [
            ("lstm.blocks", |s| s.blocks.clear()),
            ("lstm.blocks", |s| s.blocks = vec![3, 0]),
            ("lstm.blocks", |s| s.blocks = vec![MAX_CELLS + 1]),
            ("lstm.window_len", |s| s.window_len = 1),
            ("lstm.window_len", |s| s.window_len = MAX_WINDOW_LEN + 1),
            ("lstm.hop", |s| s.hop = 33),
            ("lstm.learning_rate", |s| s.learning_rate = 0.0),
            ("lstm.epochs", |s| s.epochs = 0),
            ("lstm.validate_every", |s| s.validate_every = Some(0)),
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
    fn a_report_from_before_a_setting_existed_says_what_was_done_then() {
        let settings = super::super::samples::settings();
        let mut json = serde_json::to_value(&settings).unwrap();
        for later in ["validate_every", "window_offset", "hybrid_start"] {
            json.as_object_mut().unwrap().remove(later).unwrap();
        }
        let old: LstmSettings = serde_json::from_value(json.clone()).unwrap();
        assert_eq!((old.validate_every, old.window_offset), (None, WindowOffset::Drawn));
        assert_eq!(old.hybrid_start, HybridStart::Copy);
        json["forgotten"] = 1.into();
        assert!(serde_json::from_value::<LstmSettings>(json).is_err(), "unknown fields are refused");
    }

    #[test]
    fn burn_in_never_takes_the_whole_window() {
        let mut settings = super::super::samples::settings();
        assert_eq!(settings.burn_in_samples(), 16);
        settings.burn_in = 0.999_999_999;
        assert_eq!(settings.burn_in_samples(), 63);
    }
}
