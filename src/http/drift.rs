//! The error of a rig's active model on each run that has come.

use axum::extract::State;

use super::Shared;
use super::json;
use super::params::{Params, limit};
use super::paths::{OfRig, no_rig};
use super::problem::Answer;
use crate::domain::RigId;
use crate::domain::drift::Drift;

/// `GET /v1/rigs/{rig}/drift`
pub async fn show(State(http): State<Shared>, OfRig(rig): OfRig, mut params: Params) -> Answer {
    let most = limit(&mut params)?;
    params.finish()?;
    json::answer(&read(&http, &rig, most as usize).await?)
}

/// The drift of a rig's active model, with its last `most` judged runs.
///
/// # Errors
/// `rig.not_found`, the store's failures.
pub(super) async fn read(http: &Shared, rig: &RigId, most: usize) -> Answer<Drift> {
    let active = http.store.active_model(rig).await?.ok_or_else(|| no_rig(rig.as_str()))?;
    let model = match active.version {
        Some(version) => http.store.model(rig, version).await?,
        None => None,
    };
    let Some(model) = model else { return Ok(Drift::without_model(rig.clone())) };
    // Counted first: when nothing waits, the rows are all there.
    let pending = http.store.count_due_runs(rig).await?;
    let rows = http.store.drift(rig, model.version).await?;
    if pending > 0 {
        http.drift.wake();
    }
    let runs = http.store.all_runs(rig).await?;
    Ok(Drift::of(&model, rows, &runs, pending, most))
}
