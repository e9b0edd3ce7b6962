//! The model that a training goes on from: checked against the request, then read.

use crate::domain::fits::{FitRequest, StartFrom};
use crate::domain::{FieldError, FitChannels, Model, Rig, StartedFrom};
use crate::engine::Signal;
use crate::engine::model::LstmPart;
use crate::storage::Store;

use super::fit_plan::{FitPlan, FitProblem};
use super::problem::{JobError, unreadable};
use super::work_context::WorkContext;

const AT: &str = "/start/version";

/// The version that a request starts from, if it names one; kind, channels and rate are those of the fit, and so
/// are the blocks where the version's report has them.
///
/// # Errors
/// [`FitProblem`]: no such version, or one that does not suit the fit.
pub(super) async fn check(
    store: &Store,
    rig: &Rig,
    request: &FitRequest,
    channels: &FitChannels,
) -> Result<Option<Model>, FitProblem> {
    let Some(StartFrom { version }) = request.start else { return Ok(None) };
    let model = store.model(&rig.id, version).await?.ok_or(FitProblem::NoVersion { version, pointer: AT })?;
    let errors = mismatches(rig, request, channels, &model);
    if errors.is_empty() { Ok(Some(model)) } else { Err(FitProblem::Invalid(errors)) }
}

fn mismatches(rig: &Rig, request: &FitRequest, channels: &FitChannels, model: &Model) -> Vec<FieldError> {
    let version = model.version;
    let mut errors = Vec::new();
    if model.kind != request.kind.into() {
        let (wanted, found) = (request.kind.as_str(), model.kind.as_str());
        let limit = format!("a version of kind {wanted}, as the fit; version {version} is of kind {found}");
        errors.push(FieldError::new(AT, limit));
    }
    errors.extend(other_channels(AT, rig, channels, model));
    if let (Some(wanted), Some(found)) = (&request.lstm.blocks, reported_blocks(model))
        && wanted != found
    {
        errors.push(other_blocks(version, found));
    }
    errors
}

/// Where the version at `at` has other channels or another sample rate than the fit.
pub(super) fn other_channels(at: &str, rig: &Rig, channels: &FitChannels, model: &Model) -> Vec<FieldError> {
    let version = model.version;
    let mut errors = Vec::new();
    for (what, wanted, found) in
        [("inputs", &channels.inputs, &model.inputs), ("outputs", &channels.outputs, &model.outputs)]
    {
        if wanted != found {
            let limit = format!(
                "a version with the fit's {what}, {}; version {version} has {}",
                wanted.join(", "),
                found.join(", ")
            );
            errors.push(FieldError::new(at, limit));
        }
    }
    if !Signal::same_rate(model.sample_rate_hz, rig.sample_rate_hz) {
        let [wanted, found] =
            [rig.sample_rate_hz, model.sample_rate_hz].map(|hz| crate::engine::rounded(hz, 10));
        let limit = format!("a version at {wanted} Hz, the rig's rate; version {version} is at {found} Hz");
        errors.push(FieldError::new(at, limit));
    }
    errors
}

/// Blocks of a version by its report; an imported one has none.
pub(super) fn reported_blocks(model: &Model) -> Option<&Vec<usize>> {
    model.report.as_ref()?.lstm.as_ref().map(|lstm| &lstm.blocks)
}

fn other_blocks(version: u32, found: &[usize]) -> FieldError {
    FieldError::new("/lstm/blocks", format!("{found:?}, the blocks of version {version}, or left out"))
}

/// What the lineage keeps of the version.
pub(super) fn lineage(model: &Model) -> StartedFrom {
    let seen = model.lineage.seen().cloned().collect();
    StartedFrom { version: model.version, sha256: model.sha256.clone(), seen }
}

/// The network of the version that the plan starts from. Blocks that are still open become its.
pub(super) async fn load(context: &WorkContext, plan: &mut FitPlan) -> Result<Option<LstmPart>, JobError> {
    let Some(model) = &plan.start else { return Ok(None) };
    let version = model.version;
    let part = context.read_model(model, |model| Ok(model.lstm)).await?;
    let part = part.ok_or_else(|| unreadable(version, &"it has no network"))?;
    let found = part.net.cells();
    if *plan.request.lstm.blocks.get_or_insert_with(|| found.clone()) != found {
        return Err(FitProblem::Invalid(vec![other_blocks(version, &found)]).into());
    }
    Ok(Some(part))
}
