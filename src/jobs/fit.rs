//! The fit job: runs in, a model version out.

use crate::domain::fits::FitRequest;
use crate::domain::{FieldError, Problem, Rig, Run};
use crate::storage::{Store, StoreError};

/// A fit with everything resolved: channels by name, runs by row.
#[derive(Debug, Clone, PartialEq)]
pub struct FitPlan {
    /// The request with channels and runs filled in; what the model stores.
    pub request: FitRequest,
    /// Input channels.
    pub inputs: Vec<String>,
    /// Output channels.
    pub outputs: Vec<String>,
    /// Training runs.
    pub training: Vec<Run>,
    /// Runs of the FRF part, where they are others.
    pub frf: Option<Vec<Run>>,
    /// Validation runs; empty: the last 10 % of each training run.
    pub validation: Vec<Run>,
}

/// Why a fit cannot be done.
#[derive(Debug, thiserror::Error)]
pub enum FitProblem {
    /// Fields of the request that do not fit the rig (422 `fit.invalid`).
    #[error("the fit does not suit the rig")]
    Invalid(Vec<FieldError>),
    /// No run matches a selection (409 `fit.no_runs`).
    #[error("no run matches {pointer}")]
    NoRuns {
        /// The selection.
        pointer: &'static str,
    },
    /// The store.
    #[error(transparent)]
    Store(#[from] StoreError),
}

impl FitProblem {
    /// As a problem document; of the store's failure only that it happened.
    pub fn problem(&self) -> Problem {
        todo!()
    }
}

/// Resolves a request against the rig and its runs, without loading a sample.
///
/// # Errors
/// See [`FitProblem`].
pub async fn check(_store: &Store, _rig: &Rig, _request: &FitRequest) -> Result<FitPlan, FitProblem> {
    todo!()
}
