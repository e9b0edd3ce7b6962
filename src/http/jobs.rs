//! Jobs: lists, states, errors of trainings, events, cancellation.

use std::convert::Infallible;

use axum::extract::State;
use axum::http::header::LOCATION;
use axum::http::{HeaderMap, StatusCode};
use axum::response::IntoResponse;
use axum::response::sse::{Event, KeepAlive, Sse};
use futures::StreamExt;
use serde::de::DeserializeOwned;

use super::auth::Caller;
use super::observe::note_rig;
use super::params::{NoParams, Params, invalid, page};
use super::paths::{OfJob, no_job};
use super::problem::Answer;
use super::{Shared, json, negotiate};
use crate::domain::{Job, JobId, JobLosses};
use crate::storage::{CancelOutcome, JobQuery};

/// `GET /v1/jobs`
pub async fn list(State(http): State<Shared>, caller: Caller, mut params: Params) -> Answer {
    let query = JobQuery {
        among: caller.scope().cloned(),
        rig: params.parse("rig", "the id of a rig")?,
        state: word(&mut params, "state", "queued, running, succeeded, failed or cancelled")?,
        kind: word(&mut params, "kind", "fit, evaluation, diagnosis, iteration or study")?,
    };
    let page = page(&mut params)?;
    params.finish()?;
    json::answer(&http.store.jobs(&query, &page).await?)
}

/// `GET /v1/jobs/{job}`
pub async fn show(State(http): State<Shared>, caller: Caller, OfJob(id): OfJob, _: NoParams) -> Answer {
    json::answer(&find(&http, &caller, id).await?)
}

/// `GET /v1/jobs/{job}/losses`
pub async fn losses(State(http): State<Shared>, caller: Caller, OfJob(id): OfJob, _: NoParams) -> Answer {
    find(&http, &caller, id).await?;
    json::answer(&losses_of(&http, id).await?)
}

/// The errors of a job's training so far.
pub(super) async fn losses_of(http: &Shared, id: JobId) -> Answer<JobLosses> {
    Ok(JobLosses::of(id, &http.store.losses(id).await?))
}

/// The job of this id; to a caller that may not see its rig, there is none.
pub(super) async fn find(http: &Shared, caller: &Caller, id: JobId) -> Answer<Job> {
    let job = http.store.job(id).await?.filter(|job| caller.reaches(&job.rig));
    let job = job.ok_or_else(|| no_job(&id.to_string()))?;
    note_rig(&tracing::Span::current(), &job.rig);
    Ok(job)
}

/// `GET /v1/jobs/{job}/events`
pub async fn events(
    State(http): State<Shared>,
    caller: Caller,
    OfJob(id): OfJob,
    _: NoParams,
    headers: HeaderMap,
) -> Answer {
    find(&http, &caller, id).await?;
    negotiate::choose(&headers, &["text/event-stream"])?;
    // An unknown Last-Event-ID is ignored: the stream starts with the present state.
    let seen = headers.get("last-event-id").and_then(|v| v.to_str().ok()?.parse().ok());
    let jobs = http.jobs.subscribe(id, seen).await?.ok_or_else(|| no_job(&id.to_string()))?;
    // The stream ends when its reader's token is revoked or expires.
    let jobs = jobs.take_until(async move { http.auth.until_revoked(&caller, http.clock).await });
    Ok(Sse::new(jobs.map(|job| Ok::<_, Infallible>(event(&job))))
        .keep_alive(KeepAlive::default())
        .into_response())
}

fn event(job: &Job) -> Event {
    let data = serde_json::to_string(job).expect("a job of strings and finite numbers always serialises");
    Event::default().event("job").id(job.event.to_string()).data(data)
}

/// `POST /v1/jobs/{job}/cancel`
pub async fn cancel(State(http): State<Shared>, caller: Caller, OfJob(id): OfJob, _: NoParams) -> Answer {
    find(&http, &caller, id).await?;
    match http.jobs.cancel(id).await? {
        CancelOutcome::Missing => Err(no_job(&id.to_string())),
        CancelOutcome::Noted(job) => {
            let location = [(LOCATION, format!("/v1/jobs/{id}"))];
            Ok((StatusCode::ACCEPTED, location, json::answer(&job)?).into_response())
        }
    }
}

/// Takes a parameter whose value is a word of an enumeration.
pub fn word<T: DeserializeOwned>(params: &mut Params, name: &str, limit: &str) -> Answer<Option<T>> {
    let Some(text) = params.one(name)? else { return Ok(None) };
    let word = serde_json::from_value(serde_json::Value::String(text.clone()));
    word.map(Some).map_err(|_| invalid(name, format!("is {text:?}"), limit))
}
