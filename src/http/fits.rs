//! Fits: checked while the client waits, done as jobs.

use axum::extract::State;
use axum::http::StatusCode;
use axum::http::header::LOCATION;
use axum::response::IntoResponse;

use super::Shared;
use super::json::{self, Json};
use super::params::NoParams;
use super::paths::{OfRig, no_rig};
use super::problem::Answer;
use crate::domain::fits::FitRequest;

/// `POST /v1/rigs/{rig}/fits`
pub async fn start(
    State(http): State<Shared>,
    OfRig(id): OfRig,
    _: NoParams,
    Json(request): Json<FitRequest>,
) -> Answer {
    let rig = http.store.rig(&id).await?.ok_or_else(|| no_rig(id.as_str()))?;
    let job = http.jobs.submit_fit(&rig, &request).await?;
    let location = [(LOCATION, format!("/v1/jobs/{}", job.id))];
    Ok((StatusCode::ACCEPTED, location, json::answer(&job)?).into_response())
}
