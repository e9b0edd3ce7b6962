//! Runs: uploads, lists and descriptions. Samples are in [`data`].

pub mod data;
mod file;
mod form;
mod receive;
mod understood;

use axum::body::Body;
use axum::extract::State;
use axum::http::{HeaderMap, StatusCode};
use axum::response::IntoResponse;

use crate::compute::Class;
use crate::domain::text::limit_of;
use crate::domain::{Created, RunPatch};
use crate::http::auth::Caller;
use crate::http::idempotency::{RequestKey, created};
use crate::http::jobs::word;
use crate::http::params::{NoParams, Params, invalid, page};
use crate::http::paths::{OfRig, OfRun, no_rig, no_run};
use crate::http::problem::{Answer, FieldError, Problem};
use crate::http::{Shared, codes, errors, json, rigs};
use crate::storage::{RunInsert, RunQuery, RunUpdate};

use receive::{Description, Received};
use understood::DryRun;

const KINDS: &str = "noise, service, sine, sweep or other";
const SPLITS: &str = "training, validation or test";

/// `GET /v1/rigs/{rig}/runs`
pub async fn list(State(http): State<Shared>, OfRig(rig): OfRig, mut params: Params) -> Answer {
    let query = RunQuery {
        kind: word(&mut params, "kind", KINDS)?,
        split: word(&mut params, "split", SPLITS)?,
        tag: params.one("tag")?,
    };
    if let Some(limit) = query.tag.as_deref().and_then(|tag| limit_of(tag, 0)) {
        return Err(invalid("tag", "does not fit", &limit));
    }
    let page = page(&mut params)?;
    params.finish()?;
    json::answer(&http.store.runs(&rig, &query, &page).await?.ok_or_else(|| no_rig(rig.as_str()))?)
}

/// `POST /v1/rigs/{rig}/runs`
pub async fn upload(
    State(http): State<Shared>,
    caller: Caller,
    OfRig(id): OfRig,
    params: Params,
    key: RequestKey,
    headers: HeaderMap,
    request: Body,
) -> Answer {
    let rig = http.store.rig(&id).await?.ok_or_else(|| no_rig(id.as_str()))?;
    let Received { description, format, upload } = Received::take(&http, params, &headers, request).await?;
    let Description { meta, query, is_dry } = description;
    let class = Class::of_bytes(upload.size());
    let scratch = http.store.scratch_dir();
    let read =
        http.off_thread(class, move || file::prepare(query, &rig, meta, format, upload, &scratch)).await??;
    if is_dry {
        let outlook = http.store.outlook(&id, &read.run).await?.ok_or_else(|| no_rig(id.as_str()))?;
        return json::answer(&DryRun { understood: read.understood, outlook });
    }
    let run = read.run;
    match http.store.insert_run(&id, run, caller.token_id(), key.stored(), http.now()).await? {
        RunInsert::Inserted(inserted) => {
            if !inserted.jobs.is_empty() {
                http.jobs.wake();
            }
            http.drift.wake();
            created(Created::run(&inserted))
        }
        RunInsert::MissingRig => Err(no_rig(id.as_str())),
        RunInsert::RigChanged => {
            let detail = "The rig's channels or sample rate changed during the upload; upload the run again.";
            Err(Problem::new(codes::RIG_CHANGED, detail))
        }
    }
}

/// `GET /v1/rigs/{rig}/runs/{run}`
pub async fn show(State(http): State<Shared>, OfRun(rig, id): OfRun, _: NoParams) -> Answer {
    json::answer(&http.store.run(&rig, id).await?.ok_or_else(|| no_run(&id.to_string()))?)
}

/// `PATCH /v1/rigs/{rig}/runs/{run}`
pub async fn change(
    State(http): State<Shared>,
    OfRun(rig, id): OfRun,
    _: NoParams,
    headers: HeaderMap,
    body: Body,
) -> Answer {
    let patch: RunPatch = json::take(&headers, body, &http, rigs::PATCH_TYPES).await?;
    match http.store.patch_run(&rig, id, patch).await? {
        RunUpdate::Updated(run) => json::answer(&*run),
        RunUpdate::Missing => Err(no_run(&id.to_string())),
        RunUpdate::FittedOn(versions) => {
            let versions: Vec<_> = versions.iter().map(u32::to_string).collect();
            let detail = format!(
                "Model versions {} were fitted on this run: it cannot become a test run.",
                versions.join(", ")
            );
            Err(Problem::new(codes::RUN_FITTED_ON, detail)
                .with(FieldError::new("/split", "training or validation")))
        }
        RunUpdate::Invalid(found) => {
            Err(Problem::new(codes::RUN_INVALID, errors::summary("The run does not make sense", &found))
                .with_all(found))
        }
    }
}

/// `DELETE /v1/rigs/{rig}/runs/{run}`
pub async fn remove(State(http): State<Shared>, OfRun(rig, id): OfRun, _: NoParams) -> Answer {
    if http.store.delete_run(&rig, id).await? {
        Ok(StatusCode::NO_CONTENT.into_response())
    } else {
        Err(no_run(&id.to_string()))
    }
}
