//! The page of a model version, its figures, and the page of its report.

use axum::extract::State;

use super::figure::FigureQuery;
use super::rigs::find;
use super::{Visitor, html};
use crate::compute::Class;
use crate::http::Shared;
use crate::http::frf::frf_of;
use crate::http::model_report::Sources;
use crate::http::params::{Params, invalid};
use crate::http::paths::{OfModel, no_model, no_rig};
use crate::http::problem::{Answer, Problem};
use crate::ui;
use crate::ui::figures::Drawing;
use crate::ui::model::ModelView;

/// `GET /rigs/{rig}/models/{version}`, and its figures.
pub async fn show(
    State(http): State<Shared>,
    OfModel(rig_id, version): OfModel,
    visitor: Visitor,
    mut params: Params,
) -> Answer {
    let query = FigureQuery::take(&mut params)?;
    let output = params.parse::<usize>("output", "the place of an output")?.unwrap_or_default();
    params.finish()?;
    let model = http.store.model(&rig_id, version).await?.ok_or_else(|| no_model(&version.to_string()))?;
    if output >= model.outputs.len() {
        return Err(invalid("output", format!("is {output}"), &format!("below {}", model.outputs.len())));
    }
    let rig = find(&http, &rig_id).await?;
    let file = format!("{rig_id}-v{version}");
    match query.name.as_deref() {
        None => {}
        Some("loss") => {
            let drawing = match &model.report {
                Some(report) => ui::model::loss(report, query.width),
                None => Drawing::Nothing("This version was not fitted here.".into()),
            };
            return query.answer(&drawing, &file);
        }
        Some(name @ ("magnitude" | "phase" | "coherence")) => {
            let loaded =
                http.models.version(&rig_id, version).await?.ok_or_else(|| no_model(&version.to_string()))?;
            let (name, width) = (name.to_owned(), query.width);
            let draw = move || {
                let model = loaded.model();
                let frf = frf_of(model)?;
                Ok::<_, Problem>(ui::model::response(&name, &rig, model, frf, output, width))
            };
            let drawing = http.off_thread(Class::Predict, draw).await??;
            return query.answer(&drawing, &file);
        }
        Some(_) => return Err(query.unknown("loss, magnitude, phase or coherence")),
    }
    let active = http.store.active_model(&rig_id).await?.ok_or_else(|| no_rig(rig_id.as_str()))?;
    let active_tag = active.etag();
    let view =
        ModelView { rig: &rig, model: &model, active_tag: &active_tag, active: active.version, output };
    html(ui::model::page(&visitor.shown, &view))
}

/// `GET /rigs/{rig}/models/{version}/report`, and its figures.
pub async fn report(
    State(http): State<Shared>,
    OfModel(rig, version): OfModel,
    visitor: Visitor,
    mut params: Params,
) -> Answer {
    let query = FigureQuery::take(&mut params)?;
    params.finish()?;
    let sources = Sources::read(&http, &rig, version).await?;
    if let Some(name) = query.name.clone() {
        let draw = move || sources.draw(|of| ui::model_report::drawing(of, &name));
        let drawing = http.off_thread(Class::Predict, draw).await?;
        let drawing = drawing.map_err(|known| query.unknown(&known))?;
        return query.answer(&drawing, &format!("{rig}-v{version}-report"));
    }
    let draw = move || sources.draw(|of| ui::model_report::framed(&visitor.shown, of));
    html(http.off_thread(Class::Predict, draw).await?)
}
