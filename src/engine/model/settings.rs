//! Settings of a fit that a client may give, and the presets that supply the rest.

use serde::{Deserialize, Serialize};

use super::preprocess::Preprocess;
use super::{FitData, LstmPart, ModelKind, RigModel};
use crate::frf::{Estimator, FrfSettings};
use crate::lstm::{HybridStart, LstmSettings, Optimizer, RecombineChoice, Schedule, WindowOffset};
use crate::{EngineError, Signal};

/// The source of values that a request leaves open.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Preset {
    /// The default: the most accurate model in a few minutes.
    #[default]
    Default,
    /// The source paper's settings and its way of training, nothing of ours where the paper speaks.
    ///
    /// Of the paper: blocks, epochs and learning rate per kind and task (sections 3.3 and 3.4);
    /// windows of 256 samples every 128, from the first sample of each run (2.2.2); random weights as
    /// Keras draws them, for hybrids too (2.2.1); the mean squared error of whole windows; RMSProp as
    /// Keras defined it then, at a constant rate; mini-batches reshuffled each epoch; three starts, of
    /// which validation data choose one; `welch` recombination with the window that begins half a
    /// length before the start; `H_kl = S_kl / S_kk` (2.1).
    ///
    /// Ours, because the paper is silent: mini-batches of 32 windows (Keras' default); the validation
    /// error, which is that of whole windows laid end to end from a zero state, after each epoch, and
    /// the best epoch by it; the last incomplete window of a run left out of training, and inputs held
    /// at their last value beyond the end of a signal in prediction; of the FRF the segments (a Hann
    /// window, 75 % overlap, the length by held-out prediction) and H1 where the drives correlate, for
    /// which the ratio does not hold.
    Paper,
}

/// What a model is fitted for. The paper's settings differ between the two.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Task {
    /// Responses from drives (paper, section 3.3).
    #[default]
    Forward,
    /// Anything else, such as forces from displacements (paper, section 3.4).
    VirtualSensing,
}

impl Preset {
    /// FRF settings where a request leaves them open.
    pub fn frf(self) -> FrfSettings {
        match self {
            Self::Default => FrfSettings::default(),
            Self::Paper => FrfSettings { estimator: Estimator::Auto, ..FrfSettings::default() },
        }
    }
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
    pub validate_every: Option<usize>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub batch_size: Option<usize>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub window_offset: Option<WindowOffset>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub burn_in: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub clip_norm: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub forget_bias: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub hybrid_start: Option<HybridStart>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub recombine: Option<RecombineChoice>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub seeds: Option<Vec<u64>>,
}

/// Everything that a fit needs but its data.
#[derive(Debug, Clone, PartialEq)]
pub struct FitSettings {
    /// Kind of model.
    pub kind: ModelKind,
    /// What it is for.
    pub task: Task,
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
    /// The network at whose function the training begins: that of a model of the same kind and channels, with
    /// the same blocks. Without one a network starts as the settings say.
    pub start: Option<LstmPart>,
    /// An FRF with effects, of the same channels, rate and filter, in place of the FRF of a hybrid. It is used as it is:
    /// no FRF is estimated.
    pub core: Option<RigModel>,
}

impl FitSettings {
    /// Whether the network to start from suits the fit.
    ///
    /// # Errors
    /// [`EngineError::Setting`] for a kind without a network and for other channels or blocks;
    /// [`EngineError::Weights`] for tensors that do not fit together.
    fn check_start(&self) -> Result<(), EngineError> {
        let Some(start) = &self.start else { return Ok(()) };
        start.net.check()?;
        let x = match self.kind {
            ModelKind::Hybrid2 => self.inputs.len() + self.outputs.len(),
            _ => self.inputs.len(),
        };
        let blocks = self.lstm.resolve(self.preset, self.kind, self.task, &[])?.blocks;
        let found = start.net.cells();
        let fits = self.kind != ModelKind::Frf
            && (start.net.inputs(), start.net.outputs) == (x, self.outputs.len())
            && (start.x.mean.len(), start.y.mean.len()) == (x, self.outputs.len())
            && found == blocks;
        if fits {
            return Ok(());
        }
        Err(EngineError::Setting {
            setting: "start",
            found: format!("blocks {found:?}, {} inputs, {} outputs", start.net.inputs(), start.net.outputs),
            limit: format!("blocks {blocks:?}, {x} inputs, {} outputs", self.outputs.len()),
        })
    }
}

impl FitSettings {
    /// Whether the network to start from and the core suit a fit of these data.
    ///
    /// # Errors
    /// Those of [`FitSettings::check_start`] and [`FitSettings::check_core`].
    pub(super) fn check_parts(&self, data: &FitData) -> Result<(), EngineError> {
        self.check_start()?;
        self.check_core(data.training[0].x.sample_rate_hz())
    }

    /// Whether the core suits a fit on data of this sample rate.
    ///
    /// # Errors
    /// [`EngineError::Setting`] for a kind that is no hybrid; for a core that is no FRF with effects; for other channels,
    /// another sample rate or another filter than the fit's.
    fn check_core(&self, sample_rate_hz: f64) -> Result<(), EngineError> {
        let Some(core) = &self.core else { return Ok(()) };
        let refuse =
            |found: String, limit: String| Err(EngineError::Setting { setting: "core", found, limit });
        if !matches!(self.kind, ModelKind::Hybrid1 | ModelKind::Hybrid2) {
            return refuse(format!("kind {}", self.kind.as_str()), "kind hybrid1 or hybrid2".into());
        }
        if core.kind != ModelKind::Frf || core.effects.is_empty() {
            let found = format!("a {} with {} effects", core.kind.as_str(), core.effects.len());
            return refuse(found, "an FRF with effects".into());
        }
        for (wanted, found) in [(&self.inputs, &core.inputs), (&self.outputs, &core.outputs)] {
            if wanted != found {
                return refuse(found.join(", "), wanted.join(", "));
            }
        }
        if !Signal::same_rate(core.sample_rate_hz, sample_rate_hz) {
            return refuse(format!("{} Hz", core.sample_rate_hz), format!("{sample_rate_hz} Hz"));
        }
        if core.preprocess != self.preprocess {
            return refuse(format!("{:?}", core.preprocess), format!("{:?}", self.preprocess));
        }
        Ok(())
    }
}

/// Optimiser steps that the default preset spends on a network.
const DEFAULT_STEPS: usize = 6000;

impl LstmOptions {
    /// Fills the open values from `preset` for a fit of `kind` for `task` on runs of `run_lens` samples.
    ///
    /// The default preset's epochs follow from the data: as many as make about 6000 steps. A network
    /// without an FRF has none to start as a copy of.
    ///
    /// # Errors
    /// [`EngineError::Setting`] for values outside their limits.
    pub fn resolve(
        &self,
        preset: Preset,
        kind: ModelKind,
        task: Task,
        run_lens: &[usize],
    ) -> Result<LstmSettings, EngineError> {
        let base = match preset {
            Preset::Default => ours(),
            Preset::Paper => papers(kind, task),
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
            validate_every: self.validate_every.or(base.validate_every),
            batch_size: self.batch_size.unwrap_or(base.batch_size),
            window_offset: self.window_offset.unwrap_or(base.window_offset),
            burn_in: self.burn_in.unwrap_or(base.burn_in),
            clip_norm: self.clip_norm.or(base.clip_norm),
            forget_bias: self.forget_bias.unwrap_or(base.forget_bias),
            hybrid_start: match kind {
                ModelKind::Hybrid1 | ModelKind::Hybrid2 => self.hybrid_start.unwrap_or(base.hybrid_start),
                ModelKind::Lstm | ModelKind::Frf => HybridStart::Random,
            },
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
    pub fn check(&self, preset: Preset, kind: ModelKind, task: Task) -> Result<(), EngineError> {
        self.resolve(preset, kind, task, &[]).map(drop)
    }
}

/// Starting point: a plain recipe that worked on measured benchmarks (docs/fits.md, "Settings").
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
        validate_every: None,
        batch_size: 32,
        window_offset: WindowOffset::Drawn,
        burn_in: 0.25,
        clip_norm: Some(1.0),
        forget_bias: 1.0,
        hybrid_start: HybridStart::Copy,
        recombine: RecombineChoice::Auto,
        seeds: vec![1, 2, 3],
    }
}

/// Heindel et al., sections 2.2, 3.3 and 3.4; [`Preset::Paper`] names each setting's source.
fn papers(kind: ModelKind, task: Task) -> LstmSettings {
    let (blocks, epochs, learning_rate) = match (task, kind) {
        (Task::Forward, ModelKind::Lstm | ModelKind::Frf) => (vec![39], 253, 2e-4),
        (Task::Forward, ModelKind::Hybrid1) => (vec![25, 25], 75, 3e-3),
        (Task::Forward, ModelKind::Hybrid2) => (vec![39], 800, 1e-4),
        (Task::VirtualSensing, ModelKind::Lstm | ModelKind::Frf) => (vec![29], 501, 2e-4),
        (Task::VirtualSensing, ModelKind::Hybrid1) => (vec![39], 402, 1e-4),
        (Task::VirtualSensing, ModelKind::Hybrid2) => (vec![39], 501, 2e-4),
    };
    LstmSettings {
        blocks,
        epochs,
        learning_rate,
        window_len: 256,
        hop: 128,
        window_offset: WindowOffset::Fixed,
        optimizer: Optimizer::Rmsprop,
        schedule: Schedule::Constant,
        warmup_steps: 0,
        // Keras' default.
        batch_size: 32,
        validate_every: Some(1),
        burn_in: 0.0,
        clip_norm: None,
        // Keras' `unit_forget_bias`.
        forget_bias: 1.0,
        hybrid_start: HybridStart::Random,
        recombine: RecombineChoice::Welch,
        seeds: vec![1, 2, 3],
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_paper_preset_has_the_network_of_each_kind_and_task() {
        use {ModelKind as Kind, Task::Forward, Task::VirtualSensing};
        for (task, kind, blocks, epochs, rate) in [
            (Forward, Kind::Lstm, &[39][..], 253, 2e-4),
            (Forward, Kind::Hybrid1, &[25, 25], 75, 3e-3),
            (Forward, Kind::Hybrid2, &[39], 800, 1e-4),
            (VirtualSensing, Kind::Lstm, &[29], 501, 2e-4),
            (VirtualSensing, Kind::Hybrid1, &[39], 402, 1e-4),
            (VirtualSensing, Kind::Hybrid2, &[39], 501, 2e-4),
        ] {
            let s = LstmOptions::default().resolve(Preset::Paper, kind, task, &[100_000]).unwrap();
            assert_eq!(
                (&s.blocks[..], s.epochs, s.learning_rate),
                (blocks, epochs, rate),
                "{task:?} {kind:?}"
            );
        }
    }

    #[test]
    fn the_paper_preset_trains_in_the_way_of_the_paper_and_the_default_in_ours() {
        for kind in [ModelKind::Lstm, ModelKind::Hybrid1, ModelKind::Hybrid2] {
            for task in [Task::Forward, Task::VirtualSensing] {
                let s = LstmOptions::default().resolve(Preset::Paper, kind, task, &[100_000]).unwrap();
                assert_eq!((s.window_len, s.hop, s.window_offset), (256, 128, WindowOffset::Fixed));
                assert_eq!(
                    (s.optimizer, s.schedule, s.warmup_steps),
                    (Optimizer::Rmsprop, Schedule::Constant, 0)
                );
                assert_eq!((s.burn_in, s.clip_norm, s.validate_every), (0.0, None, Some(1)));
                assert_eq!((s.hybrid_start, s.forget_bias), (HybridStart::Random, 1.0));
                assert_eq!((s.recombine, s.seeds.len()), (RecombineChoice::Welch, 3));
                let s = LstmOptions::default().resolve(Preset::Default, kind, task, &[100_000]).unwrap();
                assert_eq!((s.window_offset, s.validate_every), (WindowOffset::Drawn, None));
                let copies = kind != ModelKind::Lstm;
                assert_eq!(s.hybrid_start == HybridStart::Copy, copies, "{kind:?}");
            }
        }
        assert_eq!(Preset::Paper.frf(), FrfSettings { estimator: Estimator::Auto, ..FrfSettings::default() });
        assert_eq!(Preset::Default.frf(), FrfSettings::default());
    }

    #[test]
    fn default_epochs_fall_as_data_grow_and_stay_within_bounds() {
        let epochs = |n| {
            LstmOptions::default()
                .resolve(Preset::Default, ModelKind::Lstm, Task::Forward, &[n])
                .unwrap()
                .epochs
        };
        assert_eq!(epochs(1_000), 1000);
        assert!(epochs(60_000) > epochs(600_000));
        assert_eq!(epochs(100_000_000), 10);
    }

    #[test]
    fn a_senseless_value_is_refused_by_name() {
        let refused =
            |options: LstmOptions| match options.check(Preset::Default, ModelKind::Lstm, Task::Forward) {
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
