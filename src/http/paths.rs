//! Ids in paths. Text that cannot be an id is not found, like an id of nothing.

use axum::extract::{FromRequestParts, RawPathParams};
use axum::http::request::Parts;

use super::codes::{self, Code};
use super::problem::{Answer, Problem};
use crate::domain::{DiagnosisId, EvaluationId, IterationId, JobId, RigId, RunId, StudyId, TokenId};

/// `/v1/rigs/{rig}...`
#[derive(Debug)]
pub struct OfRig(pub RigId);

/// `/v1/rigs/{rig}/runs/{run}...`
#[derive(Debug)]
pub struct OfRun(pub RigId, pub RunId);

/// `/v1/rigs/{rig}/models/{version}...`
#[derive(Debug)]
pub struct OfModel(pub RigId, pub u32);

/// `/v1/rigs/{rig}/diagnoses/{diagnosis}...`
#[derive(Debug)]
pub struct OfDiagnosis(pub RigId, pub DiagnosisId);

/// `/v1/rigs/{rig}/evaluations/{evaluation}`
#[derive(Debug)]
pub struct OfEvaluation(pub RigId, pub EvaluationId);

/// `/v1/rigs/{rig}/iterations/{iteration}`
#[derive(Debug)]
pub struct OfIteration(pub RigId, pub IterationId);

/// `/v1/rigs/{rig}/studies/{study}`
#[derive(Debug)]
pub struct OfStudy(pub RigId, pub StudyId);

/// `/v1/jobs/{job}...`
#[derive(Debug)]
pub struct OfJob(pub JobId);

/// `/v1/tokens/{token}`
#[derive(Debug)]
pub struct OfToken(pub TokenId);

/// The refusal of a rig that is not there.
pub fn no_rig(id: &str) -> Problem {
    Problem::new(codes::RIG_NOT_FOUND, format!("There is no rig {id:?}."))
}

/// The refusal of a run that is not there.
pub fn no_run(id: &str) -> Problem {
    Problem::new(codes::RUN_NOT_FOUND, format!("The rig has no run {id:?}."))
}

/// The refusal of a model version that is not there.
pub fn no_model(version: &str) -> Problem {
    Problem::new(codes::MODEL_NOT_FOUND, format!("The rig has no model version {version:?}."))
}

/// The refusal of a diagnosis that is not there.
pub fn no_diagnosis(id: &str) -> Problem {
    Problem::new(codes::DIAGNOSIS_NOT_FOUND, format!("The rig has no diagnosis {id:?}."))
}

/// The refusal of an evaluation that is not there.
pub fn no_evaluation(id: &str) -> Problem {
    Problem::new(codes::EVALUATION_NOT_FOUND, format!("The rig has no evaluation {id:?}."))
}

/// The refusal of an iteration that is not there.
pub fn no_iteration(id: &str) -> Problem {
    Problem::new(codes::ITERATION_NOT_FOUND, format!("The rig has no iteration {id:?}."))
}

/// The refusal of a study that is not there.
pub fn no_study(id: &str) -> Problem {
    Problem::new(codes::STUDY_NOT_FOUND, format!("The rig has no study {id:?}."))
}

/// The refusal of a job that is not there.
pub fn no_job(id: &str) -> Problem {
    Problem::new(codes::JOB_NOT_FOUND, format!("There is no job {id:?}."))
}

/// The refusal of a token that is not there. It does not repeat the id, which may be a secret sent by
/// mistake.
pub fn no_token() -> Problem {
    Problem::new(codes::TOKEN_NOT_FOUND, "There is no token of this id.")
}

/// Reads and parses one parameter of the path.
async fn parameter<T: std::str::FromStr, S: Send + Sync>(
    parts: &mut Parts,
    state: &S,
    name: &str,
    refuse: fn(&str) -> Problem,
) -> Answer<T> {
    let raw = RawPathParams::from_request_parts(parts, state).await;
    let raw = raw.map_err(|_| unreadable(codes::ROUTE_NOT_FOUND))?;
    let text = raw.iter().find(|(key, _)| *key == name).map(|(_, value)| value).unwrap_or_default();
    text.parse().map_err(|_| refuse(text))
}

fn unreadable(code: Code) -> Problem {
    Problem::new(code, "The path is not UTF-8.")
}

impl<S: Send + Sync> FromRequestParts<S> for OfRig {
    type Rejection = Problem;

    async fn from_request_parts(parts: &mut Parts, state: &S) -> Answer<Self> {
        parameter(parts, state, "rig", no_rig).await.map(Self)
    }
}

impl<S: Send + Sync> FromRequestParts<S> for OfRun {
    type Rejection = Problem;

    async fn from_request_parts(parts: &mut Parts, state: &S) -> Answer<Self> {
        let rig = parameter(parts, state, "rig", no_rig).await?;
        Ok(Self(rig, parameter(parts, state, "run", no_run).await?))
    }
}

impl<S: Send + Sync> FromRequestParts<S> for OfModel {
    type Rejection = Problem;

    async fn from_request_parts(parts: &mut Parts, state: &S) -> Answer<Self> {
        let rig = parameter(parts, state, "rig", no_rig).await?;
        Ok(Self(rig, parameter(parts, state, "version", no_model).await?))
    }
}

impl<S: Send + Sync> FromRequestParts<S> for OfDiagnosis {
    type Rejection = Problem;

    async fn from_request_parts(parts: &mut Parts, state: &S) -> Answer<Self> {
        let rig = parameter(parts, state, "rig", no_rig).await?;
        Ok(Self(rig, parameter(parts, state, "diagnosis", no_diagnosis).await?))
    }
}

impl<S: Send + Sync> FromRequestParts<S> for OfEvaluation {
    type Rejection = Problem;

    async fn from_request_parts(parts: &mut Parts, state: &S) -> Answer<Self> {
        let rig = parameter(parts, state, "rig", no_rig).await?;
        Ok(Self(rig, parameter(parts, state, "evaluation", no_evaluation).await?))
    }
}

impl<S: Send + Sync> FromRequestParts<S> for OfIteration {
    type Rejection = Problem;

    async fn from_request_parts(parts: &mut Parts, state: &S) -> Answer<Self> {
        let rig = parameter(parts, state, "rig", no_rig).await?;
        Ok(Self(rig, parameter(parts, state, "iteration", no_iteration).await?))
    }
}

impl<S: Send + Sync> FromRequestParts<S> for OfStudy {
    type Rejection = Problem;

    async fn from_request_parts(parts: &mut Parts, state: &S) -> Answer<Self> {
        let rig = parameter(parts, state, "rig", no_rig).await?;
        Ok(Self(rig, parameter(parts, state, "study", no_study).await?))
    }
}

impl<S: Send + Sync> FromRequestParts<S> for OfJob {
    type Rejection = Problem;

    async fn from_request_parts(parts: &mut Parts, state: &S) -> Answer<Self> {
        parameter(parts, state, "job", no_job).await.map(Self)
    }
}

impl<S: Send + Sync> FromRequestParts<S> for OfToken {
    type Rejection = Problem;

    async fn from_request_parts(parts: &mut Parts, state: &S) -> Answer<Self> {
        parameter(parts, state, "token", |_| no_token()).await.map(Self)
    }
}
