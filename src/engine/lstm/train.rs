//! Training: mini-batches of windows, best epoch by validation.

use std::ops::ControlFlow;

use rand::seq::SliceRandom;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use super::bptt::{Backprop, Group, TrainWeights};
use super::net::LstmNet;
use super::optimizer::{Descent, clip, relative_rate};
use super::params::{Shape, flatten, unflatten};
use super::predict::check_channels;
use super::settings::{HybridStart, LstmSettings, WindowOffset};
use super::state::State;
use super::validate::Scored;
use crate::checkpoint::CheckpointStore;
use crate::progress::report;
use crate::simd::Isa;
use crate::simd::{LANES, dispatch};
use crate::{EngineError, Loss, Progress, Watch};

/// Standardised inputs and outputs of one run, planar `[channel][sample]`.
#[derive(Debug, Clone, PartialEq)]
pub struct Segment {
    /// Inputs.
    pub x: Vec<Vec<f32>>,
    /// Outputs, as long as the inputs.
    pub y: Vec<Vec<f32>>,
    /// First sample that validation scores; the samples before it are context. Training uses all.
    pub score_from: usize,
}

/// How long a network is trained.
#[derive(Debug, Clone, Copy)]
pub enum Until<'a> {
    /// Over all epochs; kept are the weights of the epoch with the least error on these data.
    Best(&'a [Segment]),
    /// As [`Until::Best`], but the start is one of the candidates: it stays unless an epoch has less error.
    BetterThanStart(&'a [Segment]),
    /// Until the end of this epoch of the settings' schedule, whose weights are kept; 0: not at all.
    Epoch(usize),
}

/// The result of a training.
#[derive(Debug, Clone, PartialEq)]
pub struct Trained {
    /// The network of the best epoch.
    pub net: LstmNet,
    /// Its epoch, from 1; 0 is the start itself.
    pub best_epoch: usize,
    /// Its mean squared error on validation data, standardised; on the training data of the epoch where it was
    /// told which epoch to keep.
    pub validation_mse: f64,
    /// Every epoch that was validated.
    pub history: Vec<EpochRecord>,
}

/// One validated epoch.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct EpochRecord {
    /// From 1.
    pub epoch: usize,
    /// Mean over the mini-batches of this epoch, each before its step; standardised.
    pub training_mse: f64,
    /// Mean over the scored samples and outputs after this epoch; standardised.
    pub validation_mse: f64,
}

/// A fit is validated at least this often, or every epoch if it has fewer, where the settings leave
/// that open.
const VALIDATIONS: usize = 100;

/// The errors of about this many epochs are told while a training goes on.
const TOLD: usize = 300;

/// A hybrid that starts as a copy of its FRF leaves it only for a mean squared error that is lower by this
/// factor (5 % in RMS). On a short validation segment a smaller difference is chance, and the FRF is the
/// safer model.
const LEAVE_START: f64 = 0.9;

/// Memory that one training may take for its mini-batch.
const MEMORY_LIMIT: usize = 4 << 30;

/// Trains a network from `start` (Heindel et al., section 2.2): windows of `window_len` every `hop`
/// samples from the settings' window offset on, reshuffled each epoch (both drawn from `seed`), the
/// mean squared error after the burn-in, the optimiser and schedule of the settings; keeps the weights
/// of the epoch with the lowest validation error, or `start` where that is the copy of an FRF and no
/// epoch is clearly better, or a model's and none is better; or, told an epoch, its weights.
///
/// A last incomplete window is left out. The result depends on the arguments and the instruction set
/// only, bit for bit, whatever the number of threads. `watch` is called after every mini-batch. The state
/// is saved under the given name when `watch` breaks and whenever a checkpoint is due; a later call with
/// the same arguments goes on from it to the same result.
///
/// # Errors
/// Settings outside their limits; data whose channels do not fit together or are not finite;
/// [`EngineError::TooShort`] for a training segment shorter than a window and for validation without
/// a sample; [`EngineError::Diverged`]; [`EngineError::Cancelled`].
pub fn train(
    training: &[Segment],
    until: Until<'_>,
    start: &LstmNet,
    (settings, seed): (&LstmSettings, u64),
    kept: (&dyn CheckpointStore, &str),
    watch: Watch<'_>,
) -> Result<Trained, EngineError> {
    train_on(Isa::of_process()?, training, until, start, (settings, seed), kept, watch)
}

/// [`train`] on a given instruction set.
///
/// # Errors
/// As [`train`].
pub(super) fn train_on(
    isa: Isa,
    training: &[Segment],
    until: Until<'_>,
    start: &LstmNet,
    (settings, seed): (&LstmSettings, u64),
    (checkpoints, part): (&dyn CheckpointStore, &str),
    watch: Watch<'_>,
) -> Result<Trained, EngineError> {
    settings.check()?;
    start.check()?;
    check_segments(training, start.inputs(), start.outputs)?;
    if let Until::Best(validation) | Until::BetterThanStart(validation) = until {
        check_segments(validation, start.inputs(), start.outputs)?;
    }
    let needed = settings.window_len;
    let shortest = training.iter().map(|s| s.x[0].len()).min().unwrap_or(0);
    if shortest < needed {
        return Err(EngineError::TooShort {
            what: "training run for lstm.window_len",
            needed,
            found: shortest,
        });
    }
    let shape = Shape::of(start);
    let groups = settings.batch_size.div_ceil(LANES);
    if groups * Group::bytes(&shape, needed) > MEMORY_LIMIT {
        return Err(EngineError::Setting {
            setting: "lstm.batch_size",
            found: settings.batch_size.to_string(),
            limit: format!(
                "mini-batch, window_len and blocks that fit into {} GiB together",
                MEMORY_LIMIT >> 30
            ),
        });
    }
    let (scored, last_epoch) = match until {
        Until::Best(validation) | Until::BetterThanStart(validation) => {
            (Some(Scored::new(validation, settings)?), settings.epochs)
        }
        Until::Epoch(epoch) => (None, epoch.min(settings.epochs)),
    };
    let leave_start = match (until, settings.hybrid_start) {
        (Until::BetterThanStart(_), _) => Some(1.0),
        (_, HybridStart::Copy) => Some(LEAVE_START),
        (_, HybridStart::Random) => None,
    };
    let task = Training {
        isa,
        shape,
        training,
        scored,
        last_epoch,
        leave_start,
        settings,
        seed,
        checkpoints,
        part,
        watch,
    };
    let row = flatten(start);
    if isa == Isa::Avx512 { task.run::<16, true>(row, seed) } else { task.run::<4, false>(row, seed) }
}

/// Checks channels, lengths and finiteness of all segments.
fn check_segments(segments: &[Segment], inputs: usize, outputs: usize) -> Result<(), EngineError> {
    for segment in segments {
        let samples = check_channels("LSTM input", &segment.x, inputs)?;
        let found = check_channels("LSTM output", &segment.y, outputs)?;
        if found != samples {
            return Err(EngineError::UnequalLength {
                what: "LSTM output",
                channel: 0,
                expected: samples,
                found,
            });
        }
    }
    Ok(())
}

/// Everything that a training reads.
struct Training<'a> {
    isa: Isa,
    shape: Shape,
    training: &'a [Segment],
    /// Without it the last epoch is kept.
    scored: Option<Scored<'a>>,
    last_epoch: usize,
    /// The start stays unless an epoch has less than this share of its mean squared error; `None`: it never stays.
    leave_start: Option<f64>,
    settings: &'a LstmSettings,
    seed: u64,
    checkpoints: &'a dyn CheckpointStore,
    part: &'a str,
    watch: Watch<'a>,
}

impl Training<'_> {
    fn run<const R: usize, const WIDE: bool>(
        &self,
        row: Vec<f32>,
        seed: u64,
    ) -> Result<Trained, EngineError> {
        let settings = self.settings;
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let mut weights = TrainWeights::<R>::new(&self.shape, &row);
        let burn_in = settings.burn_in_samples();
        let mut groups: Vec<Group> = (0..settings.batch_size.div_ceil(LANES))
            .map(|_| Group::new(&self.shape, settings.window_len, burn_in))
            .collect();
        let mut gradient = vec![0.0; row.len()];
        let per_window = ((settings.window_len - burn_in) * self.shape.outputs) as f64;
        let validate_every = settings.validate_every.unwrap_or((settings.epochs / VALIDATIONS).max(1));
        let mut state = match self.kept(row.len()) {
            Some(state) => {
                weights.set(&state.row);
                state.resume(&mut rng);
                state
            }
            None => {
                // A start may be good already (a hybrid starts as its FRF): it is the one to beat.
                let start_mse = self.scored.as_ref().map_or(0.0, |s| s.mse(self.isa, &weights.forward));
                if !start_mse.is_finite() {
                    return Err(EngineError::Diverged { epoch: 0 });
                }
                let descent = Descent::new(settings.optimizer, row.len());
                State::new(row, descent, start_mse)
            }
        };

        while state.epoch <= self.last_epoch {
            state.mark(&rng);
            let windows = self.windows(&mut rng);
            for (index, batch) in windows.chunks(settings.batch_size).enumerate().skip(state.batches) {
                let scale = (2.0 / (batch.len() as f64 * per_window)) as f32;
                let used = &mut groups[..batch.len().div_ceil(LANES)];
                used.par_iter_mut().zip(batch.par_chunks(LANES)).for_each(|(group, windows)| {
                    group.set_windows(windows.iter().map(|&(segment, start)| {
                        let segment = &self.training[segment];
                        (&segment.x[..], &segment.y[..], start)
                    }));
                    dispatch(self.isa, Backprop::<R, WIDE> { weights: &weights, group, scale });
                });
                // Always in the order of the groups, whichever thread was first.
                gradient.fill(0.0);
                for group in used.iter() {
                    gradient.iter_mut().zip(&group.gradient).for_each(|(sum, g)| *sum += g);
                    state.squared_error += group.squared_error;
                }
                let norm = clip(&mut gradient, settings.clip_norm);
                if !(norm.is_finite() && state.squared_error.is_finite()) {
                    return Err(EngineError::Diverged { epoch: state.epoch });
                }
                let first = index * settings.batch_size;
                let done =
                    ((state.epoch - 1) as f64 + first as f64 / windows.len() as f64) / settings.epochs as f64;
                let rate = settings.learning_rate
                    * relative_rate(settings.schedule, settings.warmup_steps, state.step, done);
                state.descent.step(&mut state.row, &gradient, rate);
                weights.set(&state.row);
                state.step += 1;
                state.batches = index + 1;
                self.tell(&state, done)?;
            }
            let values = windows.len() as f64 * per_window;
            self.validate(&mut state, &weights, validate_every, values)?;
            let loss = self.loss(&state, validate_every, values);
            (state.epoch, state.batches, state.squared_error) = (state.epoch + 1, 0, 0.0);
            if let Some(loss) = loss
                && self.tell_loss(loss).is_break()
            {
                state.mark(&rng);
                self.checkpoints.save(self.part, state.to_bytes());
                return Err(EngineError::Cancelled);
            }
        }
        if self.checkpoints.is_due(self.part, true) {
            state.mark(&rng);
            self.checkpoints.save(self.part, state.to_bytes());
        }
        report(self.watch, "LSTM", 1.0)?;
        Ok(Trained {
            net: unflatten(&self.shape, &state.best),
            best_epoch: state.best_epoch,
            validation_mse: state.best_mse,
            history: state.history,
        })
    }

    /// The checkpoint of an interrupted call with the same arguments.
    fn kept(&self, weights: usize) -> Option<State> {
        State::from_bytes(&self.checkpoints.load(self.part)?, weights, self.settings.epochs)
    }

    /// Reports progress, and saves the state when a checkpoint is due or the training must stop.
    fn tell(&self, state: &State, done: f64) -> Result<(), EngineError> {
        let told = report(self.watch, "LSTM", done);
        if told.is_err() || self.checkpoints.is_due(self.part, false) {
            self.checkpoints.save(self.part, state.to_bytes());
        }
        told
    }

    /// The errors of the epoch that has just ended, if it is one that is validated, or would be, and they are to be told.
    fn loss(&self, state: &State, every: usize, values: f64) -> Option<Loss> {
        let (epoch, training) = (state.epoch, state.squared_error / values);
        let step = (self.settings.epochs / TOLD).max(1).next_multiple_of(every);
        if !epoch.is_multiple_of(step) && epoch != self.last_epoch {
            return None;
        }
        let stopping = match (&self.scored, state.history.last()) {
            (Some(_), Some(last)) if last.epoch == epoch => Some(last.validation_mse),
            (Some(_), _) => return None,
            (None, _) => None,
        };
        Some(Loss { seed: self.seed, epoch, training, stopping })
    }

    fn tell_loss(&self, loss: Loss) -> ControlFlow<()> {
        let fraction = loss.epoch as f64 / self.settings.epochs as f64;
        (self.watch)(Progress { stage: "LSTM", fraction, loss: Some(loss) })
    }

    /// Scores the epoch that has just ended, if it is one that is validated, and keeps the best.
    fn validate<const R: usize>(
        &self,
        state: &mut State,
        weights: &TrainWeights<R>,
        every: usize,
        values: f64,
    ) -> Result<(), EngineError> {
        let epoch = state.epoch;
        let Some(scored) = &self.scored else { return self.keep_last(state, values) };
        if !epoch.is_multiple_of(every) && epoch != self.settings.epochs {
            return Ok(());
        }
        let record = EpochRecord {
            epoch,
            training_mse: state.squared_error / values,
            validation_mse: scored.mse(self.isa, &weights.forward),
        };
        if !record.validation_mse.is_finite() || state.row.iter().any(|w| !w.is_finite()) {
            return Err(EngineError::Diverged { epoch });
        }
        state.history.push(record);
        let better = match (state.best_epoch, self.leave_start) {
            (0, Some(share)) => record.validation_mse < share * state.best_mse,
            (0, None) => true,
            _ => record.validation_mse < state.best_mse,
        };
        if better {
            (state.best_epoch, state.best_mse) = (epoch, record.validation_mse);
            state.best.copy_from_slice(&state.row);
        }
        Ok(())
    }

    /// Keeps the weights of the epoch that has just ended, if it is the last.
    fn keep_last(&self, state: &mut State, values: f64) -> Result<(), EngineError> {
        let epoch = state.epoch;
        if !(state.squared_error.is_finite() && state.row.iter().all(|w| w.is_finite())) {
            return Err(EngineError::Diverged { epoch });
        }
        if epoch == self.last_epoch {
            (state.best_epoch, state.best_mse) = (epoch, state.squared_error / values);
            state.best.copy_from_slice(&state.row);
        }
        Ok(())
    }

    /// The windows of an epoch, `(segment, first sample)`, in the order in which they are used.
    fn windows(&self, rng: &mut ChaCha8Rng) -> Vec<(usize, usize)> {
        let (len, hop) = (self.settings.window_len, self.settings.hop);
        let mut windows = Vec::new();
        for (index, segment) in self.training.iter().enumerate() {
            let last = segment.x[0].len() - len;
            let offset = match self.settings.window_offset {
                WindowOffset::Drawn => rng.random_range(0..=last.min(hop - 1) as u64) as usize,
                WindowOffset::Fixed => 0,
            };
            windows.extend((offset..=last).step_by(hop).map(|start| (index, start)));
        }
        windows.shuffle(rng);
        windows
    }
}

#[cfg(test)]
mod tests;
