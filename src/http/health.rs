//! Liveness, and readiness for requests.

use axum::extract::State;
use serde::Serialize;
use serde_json::json;

use super::auth::Caller;
use super::params::{NoParams, Params};
use super::problem::{Answer, Problem};
use super::{Shared, codes, json};
use crate::compute::Class;
use crate::models::Degraded;

#[derive(Debug, Serialize)]
struct Ready {
    status: &'static str,
    /// `ok`, or `full`: reads and predictions go on, and only deletions and changes of the active model are taken.
    store: &'static str,
    /// `ok`, or why the bucket of the objects cannot be used: models that are loaded and what the data directory has
    /// copies of are still there, and uploads are refused. Absent where the objects are in the data directory.
    #[serde(skip_serializing_if = "Option::is_none")]
    bucket: Option<String>,
    /// Objects that were put aside because no row names them.
    quarantined: Vec<String>,
    degraded: Vec<Degraded>,
    degraded_models: usize,
    #[serde(skip_serializing_if = "Option::is_none")]
    checks: Option<serde_json::Value>,
}

/// `GET /livez`: says only that the process answers.
pub async fn live(_: NoParams) -> Answer {
    json::answer(&json!({"status": "ok"}))
}

/// `GET /readyz`. It names only rigs that the caller may see.
pub async fn ready(State(http): State<Shared>, caller: Option<Caller>, mut params: Params) -> Answer {
    let verbose = params.flag("verbose")?;
    params.finish()?;
    let room = accepting(&http).await?;
    let store = if room { "ok" } else { "full" };
    let checks = if verbose { Some(checks(&http, store).await?) } else { None };
    let mut degraded = http.models.degraded().await?;
    let degraded_models = degraded.len();
    degraded.retain(|model| caller.as_ref().is_some_and(|caller| caller.reaches(&model.rig)));
    let quarantined = http.store.quarantined().await?;
    let bucket = match &http.store.settings().bucket {
        None => None,
        Some(_) => {
            Some(http.store.ping_bucket().await.map_or_else(|away| away.to_string(), |()| "ok".into()))
        }
    };
    json::answer(&Ready { status: "ready", store, bucket, quarantined, degraded, degraded_models, checks })
}

/// Checks that requests should be sent here; returns whether the store has room for more.
///
/// # Errors
/// `draining`, `store.unavailable`.
pub(super) async fn accepting(http: &Shared) -> Answer<bool> {
    if *http.draining.borrow() {
        return Err(Problem::new(codes::DRAINING, "The service is shutting down.").retry_after(5));
    }
    http.store.ping().await.map_err(|error| {
        Problem::new(codes::STORE_UNAVAILABLE, "The store does not answer.").because(error).retry_after(5)
    })
}

async fn checks(http: &Shared, store: &str) -> Answer<serde_json::Value> {
    let jobs: serde_json::Map<_, _> = http
        .store
        .count_jobs()
        .await?
        .into_iter()
        .map(|(state, n)| (state.as_str().to_owned(), n.into()))
        .collect();
    let compute = [Class::Predict, Class::Long].map(|class| http.compute.queue(class));
    let queues: serde_json::Map<_, _> = http
        .admission
        .all()
        .into_iter()
        .chain(compute)
        .map(|turns| {
            let (class, in_use, waiting) = turns.depth();
            (class.to_owned(), json!({"in_use": in_use, "waiting": waiting}))
        })
        .collect();
    let loaded_models = http.models.loaded();
    Ok(json!({
        "store": store, "draining": false, "jobs": jobs, "queues": queues, "loaded_models": loaded_models
    }))
}
