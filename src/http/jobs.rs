//! Jobs: lists, states, events, cancellation.

use std::convert::Infallible;

use axum::extract::State;
use axum::http::header::LOCATION;
use axum::http::{HeaderMap, StatusCode};
use axum::response::IntoResponse;
use axum::response::sse::{Event, KeepAlive, Sse};
use futures::StreamExt;
use serde::de::DeserializeOwned;

use super::doors::Caller;
use super::lists::page;
use super::params::{NoParams, Params, invalid};
use super::paths::{OfJob, no_job};
use super::problem::Answer;
use super::{Shared, json, negotiate};
use crate::domain::{Job, JobId};
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

/// The job of this id, if the caller may see its rig; else there is none.
async fn find(http: &Shared, caller: &Caller, id: JobId) -> Answer<Job> {
    let job = http.store.job(id).await?.filter(|job| caller.reaches(&job.rig));
    job.ok_or_else(|| no_job(&id.to_string()))
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
    // A Last-Event-ID that we did not give is as good as none: the stream starts with the present.
    let seen = headers.get("last-event-id").and_then(|v| v.to_str().ok()?.parse().ok());
    let jobs = http.jobs.subscribe(id, seen).await?.ok_or_else(|| no_job(&id.to_string()))?;
    // The stream ends when the door shuts through which its reader came.
    let jobs = jobs.take_until(async move { http.doors.shut(&caller, http.clock).await });
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

/// Takes a parameter that is one of an enumeration's words.
pub fn word<T: DeserializeOwned>(params: &mut Params, name: &str, limit: &str) -> Answer<Option<T>> {
    let Some(text) = params.one(name)? else { return Ok(None) };
    let word = serde_json::from_value(serde_json::Value::String(text.clone()));
    word.map(Some).map_err(|_| invalid(name, format!("is {text:?}"), limit))
}
