//! Fits: checked while the client waits, done as jobs.

use axum::extract::State;

use super::Shared;
use super::auth::Caller;
use super::idempotency::{RequestKey, created};
use super::json::Json;
use super::params::NoParams;
use super::paths::{OfRig, no_rig};
use super::problem::Answer;
use crate::domain::Created;
use crate::domain::fits::FitRequest;

/// `POST /v1/rigs/{rig}/fits`
pub async fn start(
    State(http): State<Shared>,
    caller: Caller,
    OfRig(id): OfRig,
    _: NoParams,
    key: RequestKey,
    Json(request): Json<FitRequest>,
) -> Answer {
    let rig = http.store.rig(&id).await?.ok_or_else(|| no_rig(id.as_str()))?;
    let job = http.jobs.submit_fit(&rig, &request, caller.token_id(), key.stored().as_ref()).await?;
    created(Created::job(&job))
}
