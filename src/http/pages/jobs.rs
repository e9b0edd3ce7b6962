//! Jobs: the list, and the page of one.

use axum::extract::State;

use super::figure::FigureQuery;
use super::{Visitor, html};
use crate::http::Shared;
use crate::http::jobs;
use crate::http::params::{Params, page};
use crate::http::paths::OfJob;
use crate::http::problem::Answer;
use crate::storage::JobQuery;
use crate::ui;

/// `GET /jobs`
pub async fn list(State(http): State<Shared>, visitor: Visitor, mut params: Params) -> Answer {
    let query = JobQuery {
        among: visitor.caller.scope().cloned(),
        rig: params.parse("rig", "the id of a rig")?,
        ..JobQuery::default()
    };
    let request = page(&mut params)?;
    params.finish()?;
    let found = http.store.jobs(&query, &request).await?;
    let rig = query.rig.as_ref().map(|rig| rig.as_str());
    let next = found.next.as_ref().map(|next| {
        let of = rig.map(|rig| format!("&rig={rig}")).unwrap_or_default();
        format!("/jobs?cursor={}{of}", next.as_str())
    });
    html(ui::job::list(&visitor.shown, &found.items, rig, next.as_deref()))
}

/// `GET /jobs/{job}`, and its figure.
pub async fn show(
    State(http): State<Shared>,
    visitor: Visitor,
    OfJob(id): OfJob,
    mut params: Params,
) -> Answer {
    let query = FigureQuery::take(&mut params)?;
    params.finish()?;
    let job = jobs::find(&http, &visitor.caller, id).await?;
    let losses = jobs::losses_of(&http, id).await?;
    match query.name.as_deref() {
        None => html(ui::job::page(&visitor.shown, &job, !losses.curves.is_empty())),
        Some("losses") => query.answer(&ui::job::losses(&losses, query.width), &format!("{}-fit", job.rig)),
        Some(_) => Err(query.unknown("losses")),
    }
}
