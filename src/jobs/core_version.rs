//! The version that takes the place of a hybrid's FRF: checked against the request, then read.

use crate::domain::fits::{CoreFrom, FitRequest};
use crate::domain::{FieldError, FitChannels, Model, Rig, UsedCore};
use crate::engine::model::{ModelKind, Preprocess, RigModel};
use crate::storage::Store;

use super::fit_plan::{FitPlan, FitProblem};
use super::problem::JobError;
use super::warm_start::other_channels;
use super::work_context::WorkContext;

const AT: &str = "/core/version";

/// The version that a request names as core, if it names one: an FRF with adopted effects, with the channels and the
/// rate of the fit, and with its filter where the version's base is there to tell it.
///
/// # Errors
/// [`FitProblem`]: no such version, or one that does not suit the fit.
pub(super) async fn check(
    store: &Store,
    rig: &Rig,
    request: &FitRequest,
    channels: &FitChannels,
) -> Result<Option<Model>, FitProblem> {
    let Some(CoreFrom { version }) = request.core else { return Ok(None) };
    let found = store.model(&rig.id, version).await?;
    let model = found.ok_or(FitProblem::NoVersion { version, pointer: AT })?;
    let mut errors: Vec<FieldError> = not_adopted(&model).into_iter().collect();
    errors.extend(other_channels(AT, rig, channels, &model));
    let base = model.adoption.as_ref().and_then(|adoption| adoption.base.version);
    if let Some(base) = base
        && let Some(report) = store.model(&rig.id, base).await?.and_then(|base| base.report)
    {
        errors.extend(other_filter(version, &request.preprocess, &report.preprocess));
    }
    if errors.is_empty() { Ok(Some(model)) } else { Err(FitProblem::Invalid(errors)) }
}

/// Refuses versions that are no FRF with effects.
fn not_adopted(model: &Model) -> Option<FieldError> {
    let version = model.version;
    let found = match &model.adoption {
        Some(adoption) if adoption.base.kind == ModelKind::Frf => return None,
        Some(adoption) => format!("has effects on a {}", adoption.base.kind.as_str()),
        None => format!("is of kind {}, without an effect", model.kind.as_str()),
    };
    let limit = format!("a version with adopted effects on an FRF; version {version} {found}");
    Some(FieldError::new(AT, limit))
}

/// Refuses a core with another filter: its effects were found behind that one.
fn other_filter(version: u32, asked: &Preprocess, core: &Preprocess) -> Option<FieldError> {
    let filter = serde_json::to_string(core).unwrap_or_default();
    let limit = format!("{filter}, the filter of version {version}, as which the core is used");
    (asked != core).then(|| FieldError::new("/preprocess", limit))
}

/// What the lineage keeps of the version.
pub(super) fn lineage(model: &Model) -> UsedCore {
    UsedCore {
        version: Some(model.version),
        sha256: Some(model.sha256.clone()),
        effects: model.adoption.as_ref().map(|adoption| adoption.effects.clone()).unwrap_or_default(),
        seen: model.lineage.seen().cloned().collect(),
    }
}

/// The core of the plan.
pub(super) async fn load(context: &WorkContext, plan: &FitPlan) -> Result<Option<RigModel>, JobError> {
    let Some(model) = &plan.core else { return Ok(None) };
    let core = context.read_model(model, Ok).await?;
    match other_filter(model.version, &plan.request.preprocess, &core.preprocess) {
        Some(error) => Err(FitProblem::Invalid(vec![error]).into()),
        None => Ok(Some(core)),
    }
}
