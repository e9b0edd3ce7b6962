//! Studies: checked while the client waits, done as jobs, whose table shows while they run.

use axum::extract::State;

use super::Shared;
use super::auth::Caller;
use super::idempotency::{RequestKey, created};
use super::json::{self, Json};
use super::params::{NoParams, Params, page};
use super::paths::{OfRig, OfStudy, no_rig, no_study};
use super::problem::Answer;
use crate::domain::{Created, StudyRequest};

/// `POST /v1/rigs/{rig}/studies`
pub async fn start(
    State(http): State<Shared>,
    caller: Caller,
    OfRig(id): OfRig,
    _: NoParams,
    key: RequestKey,
    Json(request): Json<StudyRequest>,
) -> Answer {
    let rig = http.store.rig(&id).await?.ok_or_else(|| no_rig(id.as_str()))?;
    let (token, key) = (caller.token_id(), key.stored());
    let job = http.jobs.submit_study(&rig, &request, token, key.as_ref()).await?;
    created(Created::job(&job))
}

/// `GET /v1/rigs/{rig}/studies`
pub async fn list(State(http): State<Shared>, OfRig(rig): OfRig, mut params: Params) -> Answer {
    let page = page(&mut params)?;
    params.finish()?;
    json::answer(&http.store.studies(&rig, &page).await?.ok_or_else(|| no_rig(rig.as_str()))?)
}

/// `GET /v1/rigs/{rig}/studies/{study}`
pub async fn show(State(http): State<Shared>, OfStudy(rig, id): OfStudy, _: NoParams) -> Answer {
    let found = http.store.study(&rig, id).await?;
    json::answer(&found.ok_or_else(|| no_study(&id.to_string()))?)
}
