//! Diagnoses, evaluations, iterations and studies: the forms that start them, and the pages of their results.

use axum::extract::State;

use super::figure::FigureQuery;
use super::rigs::{find, items, whole};
use super::{Visitor, html};
use crate::compute::Class;
use crate::http::params::{NoParams, Params};
use crate::http::paths::{
    OfDiagnosis, OfEvaluation, OfIteration, OfRig, OfStudy, no_evaluation, no_iteration, no_study,
};
use crate::http::problem::Answer;
use crate::http::{Shared, diagnoses};
use crate::storage::RunQuery;
use crate::ui;

/// `GET /rigs/{rig}/diagnose`
pub async fn diagnose(
    State(http): State<Shared>,
    OfRig(id): OfRig,
    visitor: Visitor,
    mut params: Params,
) -> Answer {
    let run = params.one("run")?;
    let model = params.parse::<u32>("model", "a version")?;
    params.finish()?;
    let rig = find(&http, &id).await?;
    let runs = items(http.store.runs(&id, &RunQuery::default(), &whole()).await?);
    let models = items(http.store.models(&id, &whole()).await?);
    html(ui::diagnosis::form(&visitor.shown, &rig, &runs, &models, (run.as_deref(), model)))
}

/// `GET /rigs/{rig}/diagnoses/{diagnosis}`, and its figures.
pub async fn diagnosis(
    State(http): State<Shared>,
    OfDiagnosis(rig, id): OfDiagnosis,
    visitor: Visitor,
    mut params: Params,
) -> Answer {
    let query = FigureQuery::take(&mut params)?;
    params.finish()?;
    let diagnosis = diagnoses::find(&http, &rig, id).await?;
    let mut findings = http.store.findings(&diagnosis).await?;
    let names = diagnoses::run_names(&http, &rig, &findings.report).await?;
    ui::diagnosis::name_runs(&mut findings.report, &mut findings.views, &names);
    if let Some(name) = &query.name {
        let found = ui::diagnosis::drawing(&findings.report, &findings.views, name);
        return query.answer(&found.map_err(|known| query.unknown(&known))?, &format!("{rig}-diagnosis"));
    }
    let heading = diagnoses::heading(&http, &diagnosis, &findings.report).await?;
    let draw = move || ui::diagnosis::framed(&visitor.shown, &heading, &findings.report, &findings.views);
    html(http.off_thread(Class::Predict, draw).await?)
}

/// `GET /rigs/{rig}/evaluations/{evaluation}`, and its figures.
pub async fn evaluation(
    State(http): State<Shared>,
    OfEvaluation(rig, id): OfEvaluation,
    visitor: Visitor,
    mut params: Params,
) -> Answer {
    let query = FigureQuery::take(&mut params)?;
    params.finish()?;
    let found = http.store.evaluation(&rig, id).await?.ok_or_else(|| no_evaluation(&id.to_string()))?;
    let report = http.store.evaluation_report(&found).await?;
    if let Some(name) = &query.name {
        let drawing = ui::evaluation::drawing(&report, name).map_err(|known| query.unknown(&known))?;
        return query.answer(&drawing, &format!("{rig}-evaluation"));
    }
    let name = find(&http, &rig).await?.name;
    let draw = move || ui::evaluation::framed(&visitor.shown, &name, &found, &report);
    html(http.off_thread(Class::Predict, draw).await?)
}

/// `GET /rigs/{rig}/evaluate`
pub async fn evaluate(
    State(http): State<Shared>,
    OfRig(id): OfRig,
    visitor: Visitor,
    mut params: Params,
) -> Answer {
    let model = params.parse::<u32>("model", "a version")?;
    params.finish()?;
    let rig = find(&http, &id).await?;
    let runs = items(http.store.runs(&id, &RunQuery::default(), &whole()).await?);
    let models = items(http.store.models(&id, &whole()).await?);
    html(ui::evaluation::form(&visitor.shown, &rig, &runs, &models, model))
}

/// `GET /rigs/{rig}/study`
pub async fn start_study(
    State(http): State<Shared>,
    OfRig(id): OfRig,
    visitor: Visitor,
    _: NoParams,
) -> Answer {
    let rig = find(&http, &id).await?;
    let models = items(http.store.models(&id, &whole()).await?);
    html(ui::study::form(&visitor.shown, &rig, &models))
}

/// `GET /rigs/{rig}/studies/{study}`, and its figure.
pub async fn study(
    State(http): State<Shared>,
    OfStudy(rig_id, id): OfStudy,
    visitor: Visitor,
    mut params: Params,
) -> Answer {
    let query = FigureQuery::take(&mut params)?;
    params.finish()?;
    let found = http.store.study(&rig_id, id).await?.ok_or_else(|| no_study(&id.to_string()))?;
    match query.name.as_deref() {
        None => {}
        Some("errors") => {
            return query.answer(&ui::study::errors(&found, query.width), &format!("{rig_id}-study"));
        }
        Some(_) => return Err(query.unknown("errors")),
    }
    let rig = find(&http, &rig_id).await?;
    html(ui::study::page(&visitor.shown, &rig, &found))
}

/// `GET /rigs/{rig}/iterate`
pub async fn iterate(
    State(http): State<Shared>,
    OfRig(id): OfRig,
    visitor: Visitor,
    mut params: Params,
) -> Answer {
    let run = params.one("run")?;
    params.finish()?;
    let rig = find(&http, &id).await?;
    let runs = items(http.store.runs(&id, &RunQuery::default(), &whole()).await?);
    let models = items(http.store.models(&id, &whole()).await?);
    html(ui::iteration::form(&visitor.shown, &rig, &runs, &models, run.as_deref()))
}

/// `GET /rigs/{rig}/iterations/{iteration}`, and its figure.
pub async fn iteration(
    State(http): State<Shared>,
    OfIteration(rig_id, id): OfIteration,
    visitor: Visitor,
    mut params: Params,
) -> Answer {
    let query = FigureQuery::take(&mut params)?;
    params.finish()?;
    let found = http.store.iteration(&rig_id, id).await?.ok_or_else(|| no_iteration(&id.to_string()))?;
    match query.name.as_deref() {
        None => {}
        Some("steps") => {
            return query.answer(&ui::iteration::steps(&found, query.width), &format!("{rig_id}-iteration"));
        }
        Some(_) => return Err(query.unknown("steps")),
    }
    let rig = find(&http, &rig_id).await?;
    html(ui::iteration::page(&visitor.shown, &rig, &found))
}
