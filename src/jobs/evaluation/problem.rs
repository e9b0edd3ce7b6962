//! Why an evaluation cannot be done, as problem documents.

use crate::domain::{FieldError, Problem};
use crate::storage::StoreError;

use crate::jobs::problem::{JobError, codes, rig_gone, sentence, store_failed, too_many_waiting};

/// Why an evaluation cannot be done.
#[derive(Debug, thiserror::Error)]
pub enum EvaluationProblem {
    /// Fields of the request that make no sense, or do not fit the rig (422 `evaluation.invalid`).
    #[error("the evaluation does not suit the rig")]
    Invalid(Vec<FieldError>),
    /// A model that none of the runs can be compared with (422 `evaluation.no_common_channels`).
    #[error("a model and the runs have no channels in common")]
    NoCommonChannels(Vec<FieldError>),
    /// A class without runs (422 `evaluation.empty_class`).
    #[error("a class has no runs")]
    EmptyClass(Vec<FieldError>),
    /// No run matches the selection (409 `evaluation.no_runs`).
    #[error("no run matches the selection")]
    NoRuns,
    /// The rig has no active model (409 `model.none_active`).
    #[error("the rig has no active model; fit one, or name a version")]
    NoneActive(String),
    /// The rig has no such version (404 `model.not_found`).
    #[error("the rig has no model version {version}")]
    NoModel {
        /// Version.
        version: u32,
        /// Its place in the request.
        pointer: String,
    },
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

impl EvaluationProblem {
    /// As a problem document, which does not repeat a message of the store.
    pub fn problem(&self) -> Problem {
        let named = |code, title: &str, errors: &[FieldError]| {
            let detail = errors.iter().map(sentence).collect::<Vec<_>>().join("; ");
            Problem::new(422, code, title, format!("{self}: {detail}.")).with(errors.to_vec())
        };
        let at = |pointer: &str| vec![FieldError::new(pointer, "a version of the rig")];
        match self {
            Self::Invalid(errors) => {
                named(codes::EVALUATION_INVALID, "The evaluation does not suit the rig", errors)
            }
            Self::NoCommonChannels(errors) => {
                let title = "A model and the runs have no channels in common";
                named(codes::EVALUATION_NO_COMMON_CHANNELS, title, errors)
            }
            Self::EmptyClass(errors) => {
                named(codes::EVALUATION_EMPTY_CLASS, "A class of the evaluation has no runs", errors)
            }
            Self::NoRuns => {
                let title = "No run matches the selection of the evaluation";
                Problem::new(409, codes::EVALUATION_NO_RUNS, title, format!("{self}."))
                    .with(vec![FieldError::new("/runs", "at least one run of the rig")])
            }
            Self::NoneActive(pointer) => {
                let title = "The rig has no active model";
                Problem::new(409, codes::MODEL_NONE_ACTIVE, title, format!("{self}.")).with(at(pointer))
            }
            Self::NoModel { pointer, .. } => {
                let title = "No such model version";
                Problem::new(404, codes::MODEL_NOT_FOUND, title, format!("{self}.")).with(at(pointer))
            }
            Self::RigGone => rig_gone(format!("{self}.")),
            Self::TooManyWaiting(most) => too_many_waiting(*most),
            Self::Store(_) => store_failed("the evaluation"),
        }
    }
}

impl From<EvaluationProblem> for JobError {
    fn from(problem: EvaluationProblem) -> Self {
        match problem {
            EvaluationProblem::Store(error) => error.into(),
            problem => Self::failed(problem.problem()),
        }
    }
}
