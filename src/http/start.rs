//! The root: a page for browsers, links for programs. It shows rigs only to callers that may read them.

use axum::extract::State;
use axum::http::header::{CONTENT_SECURITY_POLICY, CONTENT_TYPE};
use axum::http::{HeaderMap, HeaderValue};
use axum::response::IntoResponse;
use serde_json::json;

use super::auth::Caller;
use super::headers::page_with_style;
use super::params::NoParams;
use super::problem::{Answer, Problem};
use super::{Shared, json, negotiate};
use crate::domain::PageRequest;
use crate::ui::start::{self, Rig, Rigs, Start};

const HTML: &str = "text/html";

/// Largest number of rigs on the page.
const ROOM: u32 = 200;

/// `GET /`
pub async fn show(
    State(http): State<Shared>,
    caller: Option<Caller>,
    _: NoParams,
    headers: HeaderMap,
) -> Answer {
    if negotiate::choose(&headers, &[json::MEDIA_TYPE, HTML])? == json::MEDIA_TYPE {
        return json::answer(&json!({
            "service": "rigcast",
            "links": {
                "contract": "/openapi.yaml", "docs": "/docs", "rigs": "/v1/rigs", "jobs": "/v1/jobs",
                "live": "/livez", "ready": "/readyz", "metrics": "/metrics",
            },
        }));
    }
    let rigs = match caller {
        Some(caller) => Some(rigs(&http, &caller).await?),
        None => None,
    };
    let html = start::page(&Start { version: crate::VERSION.into(), rigs });
    let policy = HeaderValue::try_from(page_with_style(start::STYLE)).map_err(Problem::internal)?;
    let kind = HeaderValue::from_static("text/html; charset=utf-8");
    Ok(([(CONTENT_TYPE, kind), (CONTENT_SECURITY_POLICY, policy)], html).into_response())
}

async fn rigs(http: &Shared, caller: &Caller) -> Answer<Rigs> {
    let page =
        http.store.rigs_at_a_glance(caller.scope(), &PageRequest { limit: ROOM, cursor: None }).await?;
    let items = page.items.into_iter().map(|rig| Rig { id: rig.id, name: rig.name, active: rig.active });
    Ok(Rigs { items: items.collect(), more: page.next.is_some() })
}
