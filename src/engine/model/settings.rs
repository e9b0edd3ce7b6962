//! What a client may say about a fit, and the presets that say the rest.

use serde::{Deserialize, Serialize};

use super::ModelKind;
use super::preprocess::Preprocess;
use crate::engine::EngineError;
use crate::engine::frf::FrfSettings;
use crate::engine::lstm::{LstmSettings, Optimizer, RecombineChoice, Schedule};

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
    #[serde(skip_serializing_if = "Option::is_none")]
    pub blocks: Option<Vec<usize>>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub window_len: Option<usize>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub hop: Option<usize>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub optimizer: Option<Optimizer>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub learning_rate: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub schedule: Option<Schedule>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub warmup_steps: Option<usize>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub epochs: Option<usize>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub batch_size: Option<usize>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub burn_in: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub clip_norm: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub forget_bias: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub recombine: Option<RecombineChoice>,
    #[serde(skip_serializing_if = "Option::is_none")]
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

/// Optimiser steps that the default preset spends on a network.
const DEFAULT_STEPS: usize = 6000;

impl LstmOptions {
    /// Fills what is open from `preset` for a fit of `kind` on runs of `run_lens` samples.
    ///
    /// The default preset's epochs follow from the data: as many as make about 6000 steps.
    ///
    /// # Errors
    /// [`EngineError::Setting`] for values outside their limits.
    pub fn resolve(
        &self,
        preset: Preset,
        kind: ModelKind,
        run_lens: &[usize],
    ) -> Result<LstmSettings, EngineError> {
        let base = match preset {
            Preset::Default => ours(),
            Preset::Paper => papers(kind),
        };
        let window_len = self.window_len.unwrap_or(base.window_len);
        let mut settings = LstmSettings {
            blocks: self.blocks.clone().unwrap_or(base.blocks),
            window_len,
            hop: self.hop.unwrap_or(window_len / 2),
            optimizer: self.optimizer.unwrap_or(base.optimizer),
            learning_rate: self.learning_rate.unwrap_or(base.learning_rate),
            schedule: self.schedule.unwrap_or(base.schedule),
            warmup_steps: self.warmup_steps.unwrap_or(base.warmup_steps),
            epochs: base.epochs,
            batch_size: self.batch_size.unwrap_or(base.batch_size),
            burn_in: self.burn_in.unwrap_or(base.burn_in),
            clip_norm: self.clip_norm.or(base.clip_norm),
            forget_bias: self.forget_bias.unwrap_or(base.forget_bias),
            recombine: self.recombine.unwrap_or(base.recombine),
            seeds: self.seeds.clone().unwrap_or(base.seeds),
        };
        settings.check()?;
        settings.epochs = match (self.epochs, preset) {
            (Some(epochs), _) => epochs,
            (None, Preset::Paper) => settings.epochs,
            (None, Preset::Default) => {
                let windows: usize = run_lens
                    .iter()
                    .filter(|&&n| n >= settings.window_len)
                    .map(|n| (n - settings.window_len) / settings.hop + 1)
                    .sum();
                let steps_per_epoch = windows.div_ceil(settings.batch_size).max(1);
                (DEFAULT_STEPS / steps_per_epoch).clamp(10, 1000)
            }
        };
        settings.check()?;
        Ok(settings)
    }

    /// The values that a request gave, checked against their limits before any data are read.
    ///
    /// # Errors
    /// [`EngineError::Setting`] for values outside their limits.
    pub fn check(&self, preset: Preset, kind: ModelKind) -> Result<(), EngineError> {
        self.resolve(preset, kind, &[]).map(drop)
    }
}

/// Starting point: a plain recipe that worked on measured benchmarks (README, "Settings").
fn ours() -> LstmSettings {
    LstmSettings {
        blocks: vec![39],
        window_len: 256,
        hop: 128,
        optimizer: Optimizer::Adam,
        learning_rate: 5e-3,
        schedule: Schedule::Cosine,
        warmup_steps: 100,
        // Set by `resolve`.
        epochs: 1,
        batch_size: 32,
        burn_in: 0.25,
        clip_norm: Some(1.0),
        forget_bias: 1.0,
        recombine: RecombineChoice::Auto,
        seeds: vec![1, 2, 3],
    }
}

/// Heindel et al., section 3.3 (forward prediction); batch size and forget bias, of which the
/// paper is silent, are Keras' defaults.
fn papers(kind: ModelKind) -> LstmSettings {
    let (blocks, epochs, learning_rate) = match kind {
        ModelKind::Hybrid1 => (vec![25, 25], 75, 3e-3),
        ModelKind::Hybrid2 => (vec![39], 800, 1e-4),
        ModelKind::Lstm | ModelKind::Frf => (vec![39], 253, 2e-4),
    };
    LstmSettings {
        blocks,
        epochs,
        learning_rate,
        optimizer: Optimizer::Rmsprop,
        schedule: Schedule::Constant,
        warmup_steps: 0,
        burn_in: 0.0,
        clip_norm: None,
        recombine: RecombineChoice::Welch,
        ..ours()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_paper_preset_is_the_papers() {
        let s = LstmOptions::default().resolve(Preset::Paper, ModelKind::Hybrid2, &[100_000]).unwrap();
        assert_eq!((s.blocks.as_slice(), s.epochs, s.learning_rate), (&[39][..], 800, 1e-4));
        assert_eq!((s.window_len, s.hop, s.optimizer), (256, 128, Optimizer::Rmsprop));
        let s = LstmOptions::default().resolve(Preset::Paper, ModelKind::Hybrid1, &[100_000]).unwrap();
        assert_eq!((s.blocks.as_slice(), s.epochs, s.learning_rate), (&[25, 25][..], 75, 3e-3));
    }

    #[test]
    fn default_epochs_fall_as_data_grow_and_stay_within_bounds() {
        let epochs =
            |n: usize| LstmOptions::default().resolve(Preset::Default, ModelKind::Lstm, &[n]).unwrap().epochs;
        assert_eq!(epochs(1_000), 1000);
        assert!(epochs(60_000) > epochs(600_000));
        assert_eq!(epochs(100_000_000), 10);
    }

    #[test]
    fn a_senseless_value_is_refused_by_name() {
        let refused = |options: LstmOptions| match options.check(Preset::Default, ModelKind::Lstm) {
            Err(EngineError::Setting { setting, .. }) => setting,
            other => panic!("{other:?}"),
        };
        let none = LstmOptions::default;
        assert_eq!(refused(LstmOptions { hop: Some(129), ..none() }), "lstm.hop");
        assert_eq!(refused(LstmOptions { hop: Some(0), ..none() }), "lstm.hop");
        assert_eq!(refused(LstmOptions { blocks: Some(vec![]), ..none() }), "lstm.blocks");
        assert_eq!(refused(LstmOptions { learning_rate: Some(f64::NAN), ..none() }), "lstm.learning_rate");
        assert_eq!(refused(LstmOptions { seeds: Some(vec![]), ..none() }), "lstm.seeds");
        assert_eq!(refused(LstmOptions { epochs: Some(0), ..none() }), "lstm.epochs");
        assert_eq!(refused(LstmOptions { burn_in: Some(1.0), ..none() }), "lstm.burn_in");
    }
}
