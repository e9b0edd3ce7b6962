//! Progress and cancellation of long work: one callback argument.

use std::ops::{ControlFlow, Range};

use serde::{Deserialize, Serialize};

use super::EngineError;

/// Progress of a long computation.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Progress<'a> {
    /// The present stage in an engineer's words ("FRF", "LSTM seed 2 of 3").
    pub stage: &'a str,
    /// Share of this computation that is done, 0..=1, never falling.
    pub fraction: f64,
    /// The errors of the epoch that has just ended, if one was scored.
    pub loss: Option<Loss>,
}

/// Mean squared errors of a network, standardised, at the end of an epoch of its training.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Loss {
    /// Seed of the training.
    pub seed: u64,
    /// From 1.
    pub epoch: usize,
    /// On the training data, as the mean over the mini-batches of the epoch.
    pub training: f64,
    /// On the data that stop the training; `None` in a training that nothing stops.
    pub stopping: Option<f64>,
}

impl<'a> Progress<'a> {
    /// Progress without the errors of an epoch.
    pub fn new(stage: &'a str, fraction: f64) -> Self {
        Self { stage, fraction, loss: None }
    }

    /// The same as a part of longer work, which it takes from the first of these shares to the second.
    pub(crate) fn within(self, share: &Range<f64>) -> Self {
        Self { fraction: within(self.fraction, share), ..self }
    }
}

/// The share of longer work that is done when this share of its part is done.
pub(super) fn within(fraction: f64, share: &Range<f64>) -> f64 {
    share.start + (share.end - share.start) * fraction
}

/// Called often by long work; returning [`ControlFlow::Break`] cancels it.
///
/// `Sync`, so that training of several seeds can report from several threads.
pub type Watch<'a> = &'a (dyn Fn(Progress<'_>) -> ControlFlow<()> + Sync);

/// Reports progress, and returns [`EngineError::Cancelled`] when the callback breaks.
///
/// # Errors
/// [`EngineError::Cancelled`] when the callback breaks.
pub fn report(watch: Watch<'_>, stage: &str, fraction: f64) -> Result<(), EngineError> {
    match watch(Progress::new(stage, fraction)) {
        ControlFlow::Continue(()) => Ok(()),
        ControlFlow::Break(()) => Err(EngineError::Cancelled),
    }
}

/// A callback that does nothing.
pub fn unwatched(_: Progress<'_>) -> ControlFlow<()> {
    ControlFlow::Continue(())
}
