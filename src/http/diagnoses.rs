//! Diagnoses: checked while the client waits, done as jobs, shown as reports.

use std::collections::{BTreeMap, BTreeSet};

use axum::extract::State;
use axum::http::header::{CONTENT_SECURITY_POLICY, CONTENT_TYPE};
use axum::http::{HeaderMap, HeaderValue};
use axum::response::IntoResponse;
use jiff::Timestamp;
use serde::Serialize;

use super::auth::Caller;
use super::headers::page_with_style;
use super::idempotency::{RequestKey, created};
use super::json::{self, Json};
use super::negotiate::HTML;
use super::params::{NoParams, Params, page};
use super::paths::{OfDiagnosis, OfRig, no_diagnosis, no_rig};
use super::problem::{Answer, Problem};
use super::{Shared, negotiate};
use crate::compute::Class;
use crate::domain::{
    Created, DiagnosisId, DiagnosisRequest, DiagnosisSummary, JobId, RigId, RunId, StoredDiagnosis, UsedModel,
};
use crate::engine::diagnosis::Report;
use crate::ui::assets::STYLE;
use crate::ui::diagnosis::{self as ui, Heading, Simulation};

/// A report with the fields that the engine does not know: ids, times, names.
#[derive(Debug, Serialize)]
struct Shown<'a> {
    id: DiagnosisId,
    rig: &'a RigId,
    created_at: Timestamp,
    job: JobId,
    model: &'a Option<UsedModel>,
    elapsed_s: f64,
    request: &'a DiagnosisRequest,
    #[serde(flatten)]
    report: &'a Report,
}

/// `POST /v1/rigs/{rig}/diagnoses`
pub async fn start(
    State(http): State<Shared>,
    caller: Caller,
    OfRig(id): OfRig,
    _: NoParams,
    key: RequestKey,
    Json(request): Json<DiagnosisRequest>,
) -> Answer {
    let rig = http.store.rig(&id).await?.ok_or_else(|| no_rig(id.as_str()))?;
    let (token, key) = (caller.token_id(), key.stored());
    let job = http.jobs.submit_diagnosis(&rig, &request, token, key.as_ref()).await?;
    created(Created::job(&job))
}

/// `GET /v1/rigs/{rig}/diagnoses`
pub async fn list(State(http): State<Shared>, OfRig(rig): OfRig, mut params: Params) -> Answer {
    let page = page(&mut params)?;
    params.finish()?;
    json::answer(&http.store.diagnoses(&rig, &page).await?.ok_or_else(|| no_rig(rig.as_str()))?)
}

/// `GET /v1/rigs/{rig}/diagnoses/{diagnosis}`
pub async fn show(
    State(http): State<Shared>,
    OfDiagnosis(rig, id): OfDiagnosis,
    _: NoParams,
    headers: HeaderMap,
) -> Answer {
    let diagnosis = find(&http, &rig, id).await?;
    let media_type = negotiate::choose(&headers, &[json::MEDIA_TYPE, HTML])?;
    let mut findings = http.store.findings(&diagnosis).await?;
    if media_type == HTML {
        let heading = heading(&http, &diagnosis, &findings.report).await?;
        let names = run_names(&http, &rig, &findings.report).await?;
        ui::name_runs(&mut findings.report, &mut findings.views, &names);
        let draw = move || ui::page(&heading, &findings.report, &findings.views);
        let html = http.off_thread(Class::Predict, draw).await?;
        let kind = HeaderValue::from_static("text/html; charset=utf-8");
        let policy = HeaderValue::try_from(page_with_style(STYLE)).map_err(Problem::internal)?;
        return Ok(([(CONTENT_TYPE, kind), (CONTENT_SECURITY_POLICY, policy)], html).into_response());
    }
    let bytes = http
        .off_thread(Class::Predict, move || {
            let StoredDiagnosis { summary, request, elapsed_s, .. } = &diagnosis;
            serde_json::to_vec(&Shown {
                id: summary.id,
                rig: &summary.rig,
                created_at: summary.created_at,
                job: summary.job,
                model: &summary.model,
                elapsed_s: *elapsed_s,
                request,
                report: &findings.report,
            })
        })
        .await?;
    Ok(json::respond(bytes.map_err(Problem::internal)?))
}

/// Names of the report's runs by their ids; a run without a name, or one that is gone, keeps its id.
pub(super) async fn run_names(
    http: &Shared,
    rig: &RigId,
    report: &Report,
) -> Answer<BTreeMap<String, String>> {
    let split = &report.data_split;
    let parts = split.fit.iter().chain(&split.select).chain(&split.test).map(|part| &part.run);
    // Runs of the model's own data stand in the transfer table only.
    let transfer = report.hypotheses.iter().flat_map(|hypothesis| &hypothesis.transfer);
    let all: BTreeSet<&String> = parts.chain(transfer.flat_map(|row| &row.runs)).collect();
    let mut names = BTreeMap::new();
    for text in all {
        let Ok(id) = text.parse::<RunId>() else { continue };
        if let Some(run) = http.store.run(rig, id).await?.filter(|run| !run.name.is_empty()) {
            names.insert(text.clone(), run.name);
        }
    }
    Ok(names)
}

/// The heading of the page.
pub(super) async fn heading(http: &Shared, diagnosis: &StoredDiagnosis, report: &Report) -> Answer<Heading> {
    let DiagnosisSummary { id, rig, created_at, model, verdict, .. } = &diagnosis.summary;
    let row = http.store.rig(rig).await?.ok_or_else(|| no_rig(rig.as_str()))?;
    let model = match model {
        None => Simulation::Outside,
        Some(model) => {
            let kept = http.store.model(rig, model.version).await?;
            let kind = kept.map_or_else(|| "deleted".to_owned(), |model| model.kind_in_words());
            Simulation::Version { version: model.version.into(), kind }
        }
    };
    let best = report.hypotheses.first().is_some_and(|best| best.stable_over_envelope);
    let adoptable = best && model != Simulation::Outside && verdict.kind.blames();
    Ok(Heading {
        rig: rig.to_string(),
        rig_name: row.name,
        diagnosis: id.to_string(),
        when: created_at.strftime("%Y-%m-%d %H:%M UTC").to_string(),
        model,
        elapsed_s: diagnosis.elapsed_s,
        adopt: adoptable.then(|| format!("POST /v1/rigs/{rig}/diagnoses/{id}/adopt")),
    })
}

/// The diagnosis of this id.
///
/// # Errors
/// `diagnosis.not_found`.
pub(super) async fn find(http: &Shared, rig: &RigId, id: DiagnosisId) -> Answer<StoredDiagnosis> {
    http.store.diagnosis(rig, id).await?.ok_or_else(|| no_diagnosis(&id.to_string()))
}
