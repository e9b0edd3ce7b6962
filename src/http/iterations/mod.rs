//! Drive-file iterations: checked while the client waits, done as jobs, their drives stored as runs.

mod target;

use axum::extract::State;

use super::Shared;
use super::auth::Caller;
use super::idempotency::{RequestKey, created};
use super::json::{self, SignalsJson};
use super::params::{NoParams, Params, page};
use super::paths::{OfIteration, OfRig, no_iteration, no_rig};
use super::problem::Answer;
use crate::domain::{Created, IterationRequest};
use target::{SentTarget, Target};

/// `POST /v1/rigs/{rig}/iterations`
pub async fn start(
    State(http): State<Shared>,
    caller: Caller,
    OfRig(id): OfRig,
    _: NoParams,
    key: RequestKey,
    SignalsJson(request): SignalsJson<IterationRequest<SentTarget>>,
) -> Answer {
    let rig = http.store.rig(&id).await?.ok_or_else(|| no_rig(id.as_str()))?;
    let (token, key) = (caller.token_id(), key.stored());
    let (request, sent) = request.with_target(());
    let job = match sent.target()? {
        Target::Run(target) => {
            let (request, ()) = request.with_target(target);
            http.jobs.submit_iteration(&rig, &request, token, key.as_ref()).await?
        }
        Target::Signals(names, signal) => {
            http.jobs.submit_iteration_for(&rig, request, (&names, signal), token, key).await?
        }
    };
    created(Created::job(&job))
}

/// `GET /v1/rigs/{rig}/iterations`
pub async fn list(State(http): State<Shared>, OfRig(rig): OfRig, mut params: Params) -> Answer {
    let page = page(&mut params)?;
    params.finish()?;
    json::answer(&http.store.iterations(&rig, &page).await?.ok_or_else(|| no_rig(rig.as_str()))?)
}

/// `GET /v1/rigs/{rig}/iterations/{iteration}`
pub async fn show(State(http): State<Shared>, OfIteration(rig, id): OfIteration, _: NoParams) -> Answer {
    let found = http.store.iteration(&rig, id).await?;
    json::answer(&found.ok_or_else(|| no_iteration(&id.to_string()))?)
}
