//! Why an iteration cannot be done, as problem documents.

use crate::domain::{FieldError, Problem};
use crate::engine::EngineError;
use crate::storage::StoreError;

use crate::jobs::problem::{
    JobError, codes, no_model, none_active, of_engine, of_setting, rig_gone, sentence, store_failed,
    too_many_waiting,
};

use super::plan::IterationPlan;

/// Why an iteration cannot be done.
#[derive(Debug, thiserror::Error)]
pub enum IterationProblem {
    /// Fields of the request that do not fit the rig, the model or each other (422 `iteration.invalid`).
    #[error("the iteration does not suit the rig")]
    Invalid(Vec<FieldError>),
    /// A run of another rate than the model's (422 `signal.sample_rate`).
    #[error("a run has another sample rate than the model")]
    SampleRate(FieldError),
    /// A model that has an input which is no drive (422 `model.not_forward`).
    #[error("model version {version} has inputs that are not drives: {inputs}")]
    NotForward {
        /// Version.
        version: u32,
        /// The inputs that are not drives.
        inputs: String,
    },
    /// The rig has no active model (409 `model.none_active`).
    #[error("the rig has no active model; fit one, or name a version")]
    NoneActive,
    /// The rig has no such version (404 `model.not_found`).
    #[error("the rig has no model version {0}")]
    NoModel(u32),
    /// The rig was deleted meanwhile (404 `rig.not_found`).
    #[error("the rig is gone")]
    RigGone,
    /// This many jobs of the token wait, as many as it may have (429 `job.too_many_waiting`).
    #[error("{0} jobs of the token wait already")]
    TooManyWaiting(u64),
    /// The store.
    #[error(transparent)]
    Store(#[from] StoreError),
}

impl IterationProblem {
    /// As a problem document, which does not repeat a message of the store.
    pub fn problem(&self) -> Problem {
        let at = |pointer: &str, limit: &str| vec![FieldError::new(pointer, limit)];
        match self {
            Self::Invalid(errors) => {
                let detail = errors.iter().map(sentence).collect::<Vec<_>>().join("; ");
                let title = "The iteration does not suit the rig";
                Problem::new(422, codes::ITERATION_INVALID, title, format!("{self}: {detail}."))
                    .with(errors.clone())
            }
            Self::SampleRate(error) => {
                let detail = format!("{self}: {}.", sentence(error));
                Problem::new(422, "signal.sample_rate", "Another sample rate", detail)
                    .with(vec![error.clone()])
            }
            Self::NotForward { .. } => {
                let title = "The model does not map drives to responses";
                Problem::new(422, codes::MODEL_NOT_FORWARD, title, format!("{self}."))
                    .with(at("/model", "a model whose inputs are drives"))
            }
            Self::NoneActive => none_active(format!("{self}.")),
            Self::NoModel(_) => no_model(format!("{self}.")),
            Self::RigGone => rig_gone(format!("{self}.")),
            Self::TooManyWaiting(most) => too_many_waiting(*most),
            Self::Store(_) => store_failed("the iteration"),
        }
    }
}

impl From<IterationProblem> for JobError {
    fn from(problem: IterationProblem) -> Self {
        match problem {
            IterationProblem::Store(error) => error.into(),
            problem => Self::failed(problem.problem()),
        }
    }
}

/// An engine error about an iteration, with channel names in place of numbers.
pub(super) fn of_iteration(error: &EngineError, plan: &IterationPlan) -> JobError {
    match error {
        EngineError::DeadChannel { .. } => {
            let limit = "a target that is other than zero at some sample";
            IterationProblem::Invalid(vec![FieldError::new("/target", limit)]).into()
        }
        EngineError::Setting { .. } => IterationProblem::Invalid(vec![of_setting(error)]).into(),
        other => of_engine(other, &plan.channels()),
    }
}
