//! The specification and the output of a job, in a form that passes between processes.

use bytes::Bytes;
use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};

use crate::domain::{JobId, JobKind, Problem, RigId};
use crate::storage::{Activation, Claim, NewDiagnosis, NewEvaluation, NewIteration, NewModel, NewStudy};

use super::problem::{JobError, codes};

/// Everything that the work of a claimed job needs, without its lease.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(super) struct JobSpec {
    pub job: JobId,
    pub rig: RigId,
    pub kind: JobKind,
    pub request: serde_json::Value,
    /// Whether the job is another worker's, which this work helps with. It has no output then.
    pub helps: bool,
}

impl JobSpec {
    /// The request, parsed for this kind of job.
    pub(super) fn request<T: DeserializeOwned>(&self) -> Result<T, JobError> {
        serde_json::from_value(self.request.clone()).map_err(|error| {
            let detail = format!("This version of the program cannot read the job: {error}.");
            JobError::failed(Problem::new(500, codes::JOB_UNKNOWN, "The job cannot be read", detail))
        })
    }
}

impl From<&Claim> for JobSpec {
    fn from(claim: &Claim) -> Self {
        Self {
            job: claim.job.id,
            rig: claim.job.rig.clone(),
            kind: claim.job.kind,
            request: claim.request.clone(),
            helps: false,
        }
    }
}

/// The output of a job, not yet stored.
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub(super) enum JobOutput {
    Model(Box<ModelOutput>),
    Diagnosis(Box<DiagnosisOutput>),
    Iteration(Box<IterationOutput>),
    Evaluation(Box<EvaluationOutput>),
    Study(Box<StudyOutput>),
}

/// A fitted model, and whether it becomes the active one.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub(super) struct ModelOutput {
    pub model: NewModel,
    pub activation: Activation,
    /// Why, in an engineer's words.
    pub why: String,
}

/// A diagnosis.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub(super) struct DiagnosisOutput {
    pub diagnosis: NewDiagnosis,
    /// The last stage text of the job.
    pub stage: String,
}

/// An iterated drive.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub(super) struct IterationOutput {
    pub iteration: NewIteration,
    /// The last stage text of the job.
    pub stage: String,
}

/// An evaluation.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub(super) struct EvaluationOutput {
    pub evaluation: NewEvaluation,
    /// The last stage text of the job.
    pub stage: String,
}

/// What a study has found.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub(super) struct StudyOutput {
    pub study: NewStudy,
    /// The last stage text of the job, without the model.
    pub said: String,
    /// Why its model becomes the active one or not, in an engineer's words.
    pub why: String,
    /// In place of the weights of a study without a model.
    #[serde(skip)]
    pub no_bytes: Bytes,
}

impl JobOutput {
    /// The large part, which is sent beside the JSON.
    pub(super) fn bytes(&mut self) -> &mut Bytes {
        match self {
            Self::Model(made) => &mut made.model.weights,
            Self::Diagnosis(made) => &mut made.diagnosis.findings,
            Self::Iteration(made) => &mut made.iteration.samples,
            Self::Evaluation(made) => &mut made.evaluation.report,
            Self::Study(made) => match &mut made.study.model {
                Some((model, _)) => &mut model.weights,
                None => &mut made.no_bytes,
            },
        }
    }
}
