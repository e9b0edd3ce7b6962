//! What clients ask about the service: its name, whether it is up, and the models that it has.

use axum::body::Body;
use axum::extract::State;
use axum::http::HeaderMap;
use serde::{Deserialize, Serialize};
use serde_json::json;

use crate::domain::page::MAX_LIMIT;
use crate::domain::{Cursor, PageRequest};
use crate::http::auth::Caller;
use crate::http::body::Limited;
use crate::http::problem::Answer;
use crate::http::{Shared, health, json};

/// Longest request for the index, bytes.
const MAX_INDEX_BYTES: u64 = 64 << 10;

/// A model of the index.
#[derive(Debug, Serialize)]
struct IndexEntry {
    name: String,
    #[serde(skip_serializing_if = "Option::is_none")]
    version: Option<String>,
    state: &'static str,
    reason: &'static str,
}

/// The body of a request for the index.
#[derive(Debug, Default, Deserialize)]
struct IndexRequest {
    /// Only models that are ready.
    #[serde(default)]
    ready: Option<bool>,
}

/// `GET /v2`
pub async fn server() -> Answer {
    json::answer(&json!({
        "name": "rigcast",
        "version": env!("CARGO_PKG_VERSION"),
        "extensions": ["binary_tensor_data", "model_configuration"],
    }))
}

/// `GET /v2/health/live`
pub async fn live() -> Answer {
    json::answer(&json!({"live": true}))
}

/// `GET /v2/health/ready`: as `/readyz`, without what that says about rigs.
pub async fn ready(State(http): State<Shared>) -> Answer {
    health::accepting(&http).await?;
    json::answer(&json!({"ready": true}))
}

/// `POST /v2/repository/index`: the rigs that the caller may see, each with its active version. Clients send
/// an empty body.
pub async fn index(State(http): State<Shared>, caller: Caller, headers: HeaderMap, body: Body) -> Answer {
    let bytes = Limited::new(&headers, body, MAX_INDEX_BYTES, http.limits.pace)?.collect().await?;
    let request: IndexRequest =
        if bytes.trim_ascii().is_empty() { IndexRequest::default() } else { json::parse(&bytes)? };
    let mut found = Vec::new();
    let mut page = PageRequest { limit: MAX_LIMIT, cursor: None };
    loop {
        let rigs = http.store.rigs_at_a_glance(caller.scope(), &page).await?;
        found.extend(rigs.items.into_iter().map(|rig| match rig.active {
            Some((version, _)) => {
                IndexEntry { name: rig.id, version: Some(version.to_string()), state: "READY", reason: "" }
            }
            None => IndexEntry {
                name: rig.id,
                version: None,
                state: "UNAVAILABLE",
                reason: "the rig has no active model",
            },
        }));
        match rigs.next.and_then(|next| Cursor::parse(&next).ok()) {
            None => break,
            cursor => page.cursor = cursor,
        }
    }
    if request.ready == Some(true) {
        found.retain(|entry| entry.state == "READY");
    }
    json::answer(&found)
}
