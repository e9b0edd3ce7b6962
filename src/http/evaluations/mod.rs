//! Evaluations: checked while the client waits, done as jobs, shown as JSON, as a table, or as a page.

mod table;

use axum::extract::State;
use axum::http::header::{CONTENT_SECURITY_POLICY, CONTENT_TYPE};
use axum::http::{HeaderMap, HeaderValue};
use axum::response::IntoResponse;
use serde::Serialize;

use super::Shared;
use super::auth::Caller;
use super::headers::page_with_style;
use super::idempotency::{RequestKey, created};
use super::json::{self, Json};
use super::negotiate::{self, CSV, HTML};
use super::params::{NoParams, Params, page};
use super::paths::{OfEvaluation, OfRig, no_evaluation, no_rig};
use super::problem::{Answer, Problem};
use crate::compute::Class;
use crate::domain::evaluation::EvaluationReport;
use crate::domain::{Created, EvaluationRequest, EvaluationSummary};
use crate::ui::assets::STYLE;
use crate::ui::evaluation as ui;

/// A report with the fields of the registry.
#[derive(Debug, Serialize)]
struct Shown<'a> {
    id: crate::domain::EvaluationId,
    rig: &'a crate::domain::RigId,
    created_at: jiff::Timestamp,
    job: crate::domain::JobId,
    elapsed_s: f64,
    request: &'a EvaluationRequest,
    #[serde(flatten)]
    report: &'a EvaluationReport,
}

/// `POST /v1/rigs/{rig}/evaluations`
pub async fn start(
    State(http): State<Shared>,
    caller: Caller,
    OfRig(id): OfRig,
    _: NoParams,
    key: RequestKey,
    Json(request): Json<EvaluationRequest>,
) -> Answer {
    let rig = http.store.rig(&id).await?.ok_or_else(|| no_rig(id.as_str()))?;
    let (token, key) = (caller.token_id(), key.stored());
    let job = http.jobs.submit_evaluation(&rig, &request, token, key.as_ref()).await?;
    created(Created::job(&job))
}

/// `GET /v1/rigs/{rig}/evaluations`
pub async fn list(State(http): State<Shared>, OfRig(rig): OfRig, mut params: Params) -> Answer {
    let page = page(&mut params)?;
    params.finish()?;
    json::answer(&http.store.evaluations(&rig, &page).await?.ok_or_else(|| no_rig(rig.as_str()))?)
}

/// `GET /v1/rigs/{rig}/evaluations/{evaluation}`
pub async fn show(
    State(http): State<Shared>,
    OfEvaluation(rig, id): OfEvaluation,
    _: NoParams,
    headers: HeaderMap,
) -> Answer {
    let found = http.store.evaluation(&rig, id).await?.ok_or_else(|| no_evaluation(&id.to_string()))?;
    let media_type = negotiate::choose(&headers, &[json::MEDIA_TYPE, CSV, HTML])?;
    let report = http.store.evaluation_report(&found).await?;
    match media_type {
        HTML => {
            let name = http.store.rig(&rig).await?.ok_or_else(|| no_rig(rig.as_str()))?.name;
            let draw = move || ui::page(&name, &found, &report);
            let html = http.off_thread(Class::Predict, draw).await?;
            let kind = HeaderValue::from_static("text/html; charset=utf-8");
            let policy = HeaderValue::try_from(page_with_style(STYLE)).map_err(Problem::internal)?;
            Ok(([(CONTENT_TYPE, kind), (CONTENT_SECURITY_POLICY, policy)], html).into_response())
        }
        CSV => {
            let table = http.off_thread(Class::Predict, move || table::write(&report)).await?;
            let table = table.map_err(Problem::internal)?;
            Ok(([(CONTENT_TYPE, "text/csv; charset=utf-8")], table).into_response())
        }
        _ => {
            let bytes = http
                .off_thread(Class::Predict, move || {
                    let EvaluationSummary { id, rig, created_at, job, .. } = &found.summary;
                    serde_json::to_vec(&Shown {
                        id: *id,
                        rig,
                        created_at: *created_at,
                        job: *job,
                        elapsed_s: found.elapsed_s,
                        request: &found.request,
                        report: &report,
                    })
                })
                .await?;
            Ok(json::respond(bytes.map_err(Problem::internal)?))
        }
    }
}
