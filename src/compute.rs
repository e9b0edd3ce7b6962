//! The only door from async code to work for the processor: permits, blocking threads, spans.

use std::sync::Arc;

/// What kind of work it is; each has permits and threads of its own.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Class {
    /// An answer that somebody waits for: predictions, damage, parsing.
    Predict,
    /// A fit: long, and at a lower priority.
    Fit,
}

/// How much may happen at once.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ComputeSettings {
    /// Predictions at once.
    pub predict_permits: usize,
    /// Predictions that may wait; more are told that the service is busy.
    pub predict_queue: usize,
    /// Threads that share the work of predictions.
    pub predict_threads: usize,
    /// Fits at once.
    pub fit_permits: usize,
    /// Threads that share the work of fits.
    pub fit_threads: usize,
}

impl Default for ComputeSettings {
    fn default() -> Self {
        todo!()
    }
}

/// Why work was not done.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum ComputeError {
    /// Too many wait already: try again later.
    #[error("busy: {waiting} tasks wait already")]
    Busy {
        /// How many.
        waiting: usize,
    },
    /// A defect of ours; the message is for the log, not for a client.
    #[error("panicked: {0}")]
    Panicked(String),
    /// Thread pools could not be made.
    #[error("threads: {0}")]
    Threads(String),
}

/// The door. Clones share it.
#[derive(Debug, Clone)]
pub struct Compute {
    _inner: Arc<()>,
}

impl Compute {
    /// Makes the thread pools.
    ///
    /// # Errors
    /// [`ComputeError::Threads`] when the system gives no threads.
    pub fn new(_settings: &ComputeSettings) -> Result<Self, ComputeError> {
        todo!()
    }

    /// Does `work` on a thread for it, inside the current tracing span, and waits.
    ///
    /// # Errors
    /// [`ComputeError::Busy`] at once when too many wait; [`ComputeError::Panicked`].
    pub async fn run<T, F>(&self, _class: Class, _work: F) -> Result<T, ComputeError>
    where
        T: Send + 'static,
        F: FnOnce() -> T + Send + 'static,
    {
        todo!()
    }
}
