//! Progress and cancellation of long work: one callback argument.

use std::ops::ControlFlow;

use super::EngineError;

/// Progress of a long computation.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Progress<'a> {
    /// The present stage in an engineer's words ("FRF", "LSTM seed 2 of 3").
    pub stage: &'a str,
    /// Share of this computation that is done, 0..=1, never falling.
    pub fraction: f64,
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
    match watch(Progress { stage, fraction }) {
        ControlFlow::Continue(()) => Ok(()),
        ControlFlow::Break(()) => Err(EngineError::Cancelled),
    }
}

/// A callback that does nothing.
pub fn unwatched(_: Progress<'_>) -> ControlFlow<()> {
    ControlFlow::Continue(())
}
