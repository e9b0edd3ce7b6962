//! Why a study cannot be done, as problem documents.

use crate::domain::{FieldError, Problem};
use crate::jobs::fit::FitProblem;
use crate::jobs::problem::{
    JobError, codes, no_model, none_active, rig_gone, sentence, store_failed, too_many_waiting,
};
use crate::storage::StoreError;

/// Why a study cannot be done.
#[derive(Debug, thiserror::Error)]
pub enum StudyProblem {
    /// Fields of the request that leave their limits or do not go together (422 `study.invalid`).
    #[error("the study cannot be done as it is asked for")]
    Invalid(Vec<FieldError>),
    /// The fit that is studied cannot be done.
    #[error("the fit of the study: {0}")]
    Fit(FitProblem),
    /// No trial came to an end (422 `study.no_trial`).
    #[error("no trial came to an end: {0}")]
    NoTrial(String),
    /// The rig has no active model (409 `model.none_active`).
    #[error("the rig has no active model; fit one, or name a version")]
    NoneActive,
    /// The rig has no such version (404 `model.not_found`).
    #[error("the rig has no model version {0}")]
    NoModel(u32),
    /// A version without an FRF (409 `model.no_frf`).
    #[error("model version {0} has no FRF to make files with")]
    NoFrf(u32),
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

impl From<FitProblem> for StudyProblem {
    fn from(problem: FitProblem) -> Self {
        match problem {
            FitProblem::Store(error) => Self::Store(error),
            FitProblem::RigGone => Self::RigGone,
            other => Self::Fit(other),
        }
    }
}

impl StudyProblem {
    /// As a problem document, which does not repeat a message of the store.
    pub fn problem(&self) -> Problem {
        match self {
            Self::Invalid(errors) => {
                let detail = errors.iter().map(sentence).collect::<Vec<_>>().join("; ");
                let title = "The study cannot be done as it is asked for";
                Problem::new(422, codes::STUDY_INVALID, title, format!("{self}: {detail}."))
                    .with(errors.clone())
            }
            Self::Fit(fit) => {
                let mut problem = fit.problem();
                for error in &mut problem.errors {
                    error.pointer.insert_str(0, "/fit");
                }
                problem
            }
            Self::NoTrial(_) => {
                let title = "No trial of the study came to an end";
                Problem::new(422, codes::STUDY_NO_TRIAL, title, format!("{self}."))
            }
            Self::NoneActive => none_active(format!("{self}.")),
            Self::NoModel(_) => no_model(format!("{self}.")),
            Self::NoFrf(_) => {
                Problem::new(409, codes::MODEL_NO_FRF, "The model has no FRF", format!("{self}."))
                    .with(vec![FieldError::new("/model", "a version with an FRF")])
            }
            Self::RigGone => rig_gone(format!("{self}.")),
            Self::TooManyWaiting(most) => too_many_waiting(*most),
            Self::Store(_) => store_failed("the study"),
        }
    }
}

impl From<StudyProblem> for JobError {
    fn from(problem: StudyProblem) -> Self {
        match problem {
            StudyProblem::Store(error) => error.into(),
            problem => Self::failed(problem.problem()),
        }
    }
}
