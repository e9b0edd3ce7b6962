//! The report of a model version, as JSON, CSV or a page.

mod table;

use axum::extract::State;
use axum::http::header::{CONTENT_SECURITY_POLICY, CONTENT_TYPE};
use axum::http::{HeaderMap, HeaderValue};
use axum::response::IntoResponse;

use super::Shared;
use super::headers::page_with_style;
use super::json;
use super::negotiate::{self, CSV, HTML};
use super::params::NoParams;
use super::paths::{OfModel, no_model, no_rig};
use super::problem::{Answer, Problem};
use crate::compute::Class;
use crate::domain::{Model, ModelReport, Rig, RigId, Run};
use crate::engine::model::FitRecord;
use crate::ui::assets::STYLE;
use crate::ui::model_report as ui;

/// Everything that a report is made of.
pub(super) struct Sources {
    pub rig: Rig,
    pub model: Model,
    record: Option<FitRecord>,
    runs: Vec<Run>,
}

impl Sources {
    /// Reads them.
    ///
    /// # Errors
    /// `rig.not_found`, `model.not_found`, the store's failures.
    pub(super) async fn read(http: &Shared, id: &RigId, version: u32) -> Answer<Self> {
        let rig = http.store.rig(id).await?.ok_or_else(|| no_rig(id.as_str()))?;
        let model = http.store.model(id, version).await?.ok_or_else(|| no_model(&version.to_string()))?;
        let record = http.store.fit_record(id, version).await?;
        let runs = http.store.all_runs(id).await?;
        Ok(Self { rig, model, record, runs })
    }

    /// The report.
    pub(super) fn report(&self) -> ModelReport<'_> {
        ModelReport::of(&self.model, self.record.as_ref(), &self.runs)
    }

    /// Draws something of it.
    pub(super) fn draw<T>(&self, draw: impl FnOnce(ui::Reported<'_>) -> T) -> T {
        draw(ui::Reported { rig: &self.rig, model: &self.model, report: &self.report() })
    }
}

/// `GET /v1/rigs/{rig}/models/{version}/report`
pub async fn show(
    State(http): State<Shared>,
    OfModel(rig, version): OfModel,
    _: NoParams,
    headers: HeaderMap,
) -> Answer {
    let sources = Sources::read(&http, &rig, version).await?;
    match negotiate::choose(&headers, &[json::MEDIA_TYPE, CSV, HTML])? {
        HTML => {
            let html = http.off_thread(Class::Predict, move || sources.draw(ui::page)).await?;
            let kind = HeaderValue::from_static("text/html; charset=utf-8");
            let policy = HeaderValue::try_from(page_with_style(STYLE)).map_err(Problem::internal)?;
            Ok(([(CONTENT_TYPE, kind), (CONTENT_SECURITY_POLICY, policy)], html).into_response())
        }
        CSV => {
            let table = http.off_thread(Class::Predict, move || table::write(&sources.report())).await?;
            let table = table.map_err(Problem::internal)?;
            Ok(([(CONTENT_TYPE, "text/csv; charset=utf-8")], table).into_response())
        }
        _ => {
            let write = move || serde_json::to_vec(&sources.report());
            let bytes = http.off_thread(Class::Predict, write).await?;
            Ok(json::respond(bytes.map_err(Problem::internal)?))
        }
    }
}
