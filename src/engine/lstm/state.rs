//! The state of a training under way: all that its further course depends on.

use rand_chacha::ChaCha8Rng;
use serde::{Deserialize, Serialize};

use super::optimizer::Descent;
use super::train::EpochRecord;
use crate::checkpoint::floats;

/// The state of a training after a mini-batch.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(super) struct State {
    /// Epoch under way, from 1; at the end one more than the number of epochs.
    pub epoch: usize,
    /// Its mini-batches that are done.
    pub batches: usize,
    /// Sum of their squared errors.
    pub squared_error: f64,
    /// Steps of all epochs.
    pub step: usize,
    /// Position in the random stream at which this epoch begins, high and low half.
    pub random: [u64; 2],
    /// Weights.
    #[serde(with = "floats")]
    pub row: Vec<f32>,
    /// Optimiser.
    pub descent: Descent,
    /// Best epoch so far; 0 is the start.
    pub best_epoch: usize,
    /// Its validation error.
    pub best_mse: f64,
    /// Its weights.
    #[serde(with = "floats")]
    pub best: Vec<f32>,
    /// Epochs that were validated.
    pub history: Vec<EpochRecord>,
}

impl State {
    /// The beginning of a training from `row`, whose validation error is `mse`.
    pub(super) fn new(row: Vec<f32>, descent: Descent, mse: f64) -> Self {
        Self {
            epoch: 1,
            batches: 0,
            squared_error: 0.0,
            step: 0,
            random: [0, 0],
            best: row.clone(),
            row,
            descent,
            best_epoch: 0,
            best_mse: mse,
            history: Vec::new(),
        }
    }

    /// Notes the position in the random stream at which the epoch begins.
    pub(super) fn mark(&mut self, rng: &ChaCha8Rng) {
        let at = rng.get_word_pos();
        self.random = [(at >> 64) as u64, at as u64];
    }

    /// Sets the random stream to the position at which the epoch begins.
    pub(super) fn resume(&self, rng: &mut ChaCha8Rng) {
        rng.set_word_pos(u128::from(self.random[0]) << 64 | u128::from(self.random[1]));
    }

    /// As bytes.
    pub(super) fn to_bytes(&self) -> Vec<u8> {
        serde_json::to_vec(self).expect("numbers and text always serialise")
    }

    /// Reads a checkpoint; `None` unless it is the state of a training of so many weights and epochs.
    pub(super) fn from_bytes(bytes: &[u8], weights: usize, epochs: usize) -> Option<Self> {
        let state: Self = serde_json::from_slice(bytes).ok()?;
        let fits = state.row.len() == weights
            && state.best.len() == weights
            && state.descent.suits(weights)
            && (1..=epochs + 1).contains(&state.epoch)
            && state.row.iter().chain(&state.best).all(|w| w.is_finite());
        fits.then_some(state)
    }
}
