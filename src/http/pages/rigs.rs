//! The list of rigs, and the page of one with its forms.

use axum::extract::State;
use axum::http::HeaderMap;
use serde_json::json;

use super::{Visitor, html};
use crate::domain::{Cursor, JobState, Page, PageRequest, Rig, RigId};
use crate::http::params::{NoParams, Params, page};
use crate::http::paths::{OfRig, no_rig};
use crate::http::problem::{Answer, Problem};
use crate::http::{Shared, json as body_json, negotiate};
use crate::storage::{JobQuery, RunQuery};
use crate::ui;
use crate::ui::rigs::{Active, Row};

const HTML: &str = "text/html";

/// Rigs on a page.
const RIGS: u32 = 50;

/// Runs, models and reports on a rig's page, the newest.
const ITEMS: usize = 100;

/// Jobs on a rig's page.
const JOBS: usize = 5;

/// `GET /`: the rigs for a browser, links for a program.
pub async fn list(
    State(http): State<Shared>,
    visitor: Answer<Visitor>,
    mut params: Params,
    headers: HeaderMap,
) -> Answer {
    if negotiate::choose(&headers, &[body_json::MEDIA_TYPE, HTML])? == body_json::MEDIA_TYPE {
        params.finish()?;
        return body_json::answer(&json!({
            "service": "rigcast",
            "links": {
                "contract": "/openapi.yaml", "docs": "/docs", "rigs": "/v1/rigs", "jobs": "/v1/jobs",
                "live": "/livez", "ready": "/readyz", "metrics": "/metrics",
            },
        }));
    }
    let visitor = visitor?;
    let cursor = page(&mut params)?.cursor;
    params.finish()?;
    let found = http.store.rigs(visitor.caller.scope(), &PageRequest { limit: RIGS, cursor }).await?;
    let next = found.next.as_ref().map(|next| format!("/?cursor={}", next.as_str()));
    let mut rows = Vec::with_capacity(found.items.len());
    for rig in found.items {
        rows.push(row(&http, rig).await?);
    }
    html(ui::rigs::page(&visitor.shown, &rows, next.as_deref(), crate::VERSION))
}

async fn row(http: &Shared, rig: Rig) -> Answer<Row> {
    let version = http.store.active_model(&rig.id).await?.and_then(|active| active.version);
    let active = match version {
        Some(version) => http.store.model(&rig.id, version).await?,
        None => None,
    };
    let active = active.map(|model| {
        let found: Vec<f64> =
            model.report.iter().flat_map(|report| &report.validation_rms).flatten().copied().collect();
        Active {
            version: model.version,
            kind: model.kind_in_words(),
            rms: (!found.is_empty()).then(|| found.iter().sum::<f64>() / found.len() as f64),
            when: model.created_at.strftime("%Y-%m-%d").to_string(),
        }
    });
    let mut jobs = 0;
    for state in [JobState::Queued, JobState::Running] {
        let query = JobQuery { rig: Some(rig.id.clone()), state: Some(state), ..JobQuery::default() };
        jobs += http.store.jobs(&query, &PageRequest { limit: 100, cursor: None }).await?.items.len();
    }
    Ok(Row { rig, active, jobs })
}

/// `GET /rigs/{rig}`
pub async fn show(State(http): State<Shared>, OfRig(id): OfRig, visitor: Visitor, _: NoParams) -> Answer {
    let rig = find(&http, &id).await?;
    let mut runs = Vec::new();
    let mut request = whole();
    while let Some(found) = http.store.runs(&id, &RunQuery::default(), &request).await? {
        runs.extend(found.items);
        let Some(next) = found.next else { break };
        request.cursor = Some(Cursor::parse(&next).map_err(Problem::internal)?);
    }
    runs.reverse();
    let more_runs = runs.len() > ITEMS;
    runs.truncate(ITEMS);
    let mut models = items(http.store.models(&id, &whole()).await?);
    models.sort_by_key(|model| std::cmp::Reverse(model.version));
    let mut diagnoses = items(http.store.diagnoses(&id, &whole()).await?);
    diagnoses.sort_by_key(|diagnosis| std::cmp::Reverse(diagnosis.id));
    let mut evaluations = items(http.store.evaluations(&id, &whole()).await?);
    evaluations.sort_by_key(|evaluation| std::cmp::Reverse(evaluation.id));
    let mut iterations = items(http.store.iterations(&id, &whole()).await?);
    iterations.sort_by_key(|iteration| std::cmp::Reverse(iteration.id));
    let mut studies = items(http.store.studies(&id, &whole()).await?);
    studies.sort_by_key(|study| std::cmp::Reverse(study.id));
    let mut jobs =
        http.store.jobs(&JobQuery { rig: Some(id.clone()), ..JobQuery::default() }, &whole()).await?.items;
    jobs.sort_by_key(|job| std::cmp::Reverse(job.id));
    jobs.truncate(JOBS);
    let active_tag = http.store.active_model(&id).await?.ok_or_else(|| no_rig(id.as_str()))?.etag();
    let view = ui::rig::RigView {
        rig,
        runs,
        more_runs,
        models,
        jobs,
        diagnoses,
        evaluations,
        iterations,
        studies,
        active_tag,
    };
    html(ui::rig::page(&visitor.shown, &view))
}

/// `GET /rigs/{rig}/upload`
pub async fn upload(State(http): State<Shared>, OfRig(id): OfRig, visitor: Visitor, _: NoParams) -> Answer {
    let rig = find(&http, &id).await?;
    html(ui::upload::page(&visitor.shown, &rig))
}

/// `GET /rigs/{rig}/fit`
pub async fn fit(State(http): State<Shared>, OfRig(id): OfRig, visitor: Visitor, _: NoParams) -> Answer {
    let rig = find(&http, &id).await?;
    let runs = items(http.store.runs(&id, &RunQuery::default(), &whole()).await?);
    html(ui::fit::page(&visitor.shown, &rig, &runs))
}

/// `GET /rigs/{rig}/drift`
pub async fn drift(State(http): State<Shared>, OfRig(id): OfRig, visitor: Visitor, _: NoParams) -> Answer {
    let rig = find(&http, &id).await?;
    let drift = crate::http::drift::read(&http, &id, ITEMS).await?;
    html(ui::drift::page(&visitor.shown, &rig, &drift))
}

/// The rig of this id.
///
/// # Errors
/// `rig.not_found`
pub async fn find(http: &Shared, id: &RigId) -> Answer<Rig> {
    http.store.rig(id).await?.ok_or_else(|| no_rig(id.as_str()))
}

/// As many items as a list may have.
pub fn whole() -> PageRequest {
    PageRequest { limit: crate::domain::page::MAX_LIMIT, cursor: None }
}

/// The items of a list; none of a rig that is gone.
pub fn items<T>(page: Option<Page<T>>) -> Vec<T> {
    page.map(|page| page.items).unwrap_or_default()
}
