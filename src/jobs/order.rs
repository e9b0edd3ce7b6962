//! What work is asked for and what comes of it, in a form that passes between processes.

use bytes::Bytes;
use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};

use crate::domain::{JobId, JobKind, Problem, RigId};
use crate::storage::{Activation, Claim, NewDiagnosis, NewModel};

use super::problem::{JobError, codes};

/// What is to be made: of a claimed job all that its work needs to know, and nothing of its lease.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(super) struct Order {
    pub job: JobId,
    pub rig: RigId,
    pub kind: JobKind,
    pub request: serde_json::Value,
}

impl Order {
    /// The request as its kind of job reads it.
    pub(super) fn request<T: DeserializeOwned>(&self) -> Result<T, JobError> {
        serde_json::from_value(self.request.clone()).map_err(|error| {
            let detail = format!("This version of the program cannot read the job: {error}.");
            JobError::failed(Problem::new(500, codes::JOB_UNKNOWN, "The job cannot be read", detail))
        })
    }
}

impl From<&Claim> for Order {
    fn from(claim: &Claim) -> Self {
        Self {
            job: claim.job.id,
            rig: claim.job.rig.clone(),
            kind: claim.job.kind,
            request: claim.request.clone(),
        }
    }
}

/// What work has made; not yet stored.
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub(super) enum Made {
    Model(Box<MadeModel>),
    Diagnosis(Box<MadeDiagnosis>),
}

/// A fitted model and what is to become of the active one.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub(super) struct MadeModel {
    pub model: NewModel,
    pub activation: Activation,
    /// Why, in an engineer's words.
    pub why: String,
}

/// A diagnosis.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub(super) struct MadeDiagnosis {
    pub diagnosis: NewDiagnosis,
    /// The job's last words.
    pub stage: String,
}

impl Made {
    /// Its large part, which does not pass through JSON.
    pub(super) fn bytes(&mut self) -> &mut Bytes {
        match self {
            Self::Model(made) => &mut made.model.weights,
            Self::Diagnosis(made) => &mut made.diagnosis.findings,
        }
    }
}
