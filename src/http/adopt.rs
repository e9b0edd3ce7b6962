//! Adopting an effect: a new version of the diagnosed model, with a hypothesis of the report added to
//! it.

use axum::extract::State;
use bytes::Bytes;
use serde::Deserialize;

use super::diagnoses::find;
use super::idempotency::{RequestKey, created};
use super::json::Json;
use super::params::NoParams;
use super::paths::{OfDiagnosis, no_model, no_rig};
use super::problem::{Answer, FieldError, Problem};
use super::{Shared, codes, errors};
use crate::compute::Class;
use crate::domain::diagnosis::Findings;
use crate::domain::fits::Activate;
use crate::domain::{Adopted, Adoption, Created, Model, Origin, Rig, RigId, Role, StoredDiagnosis};
use crate::engine::diagnosis::{HeldOut, VerdictKind};
use crate::engine::model::{AddedEffect, from_safetensors, to_safetensors};
use crate::engine::simd::Isa;
use crate::storage::{Activation, NewModel};

/// An adopted model is better if it leaves at most this share of the diagnosed model's held-out error.
const BETTER: f64 = 0.99;

/// The body.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct AdoptRequest {
    /// Index in the report's hypotheses, best first.
    #[serde(default)]
    hypothesis: usize,
    /// When the new version becomes the active one.
    #[serde(default = "never")]
    activate: Activate,
}

fn never() -> Activate {
    Activate::Never
}

/// `POST /v1/rigs/{rig}/diagnoses/{diagnosis}/adopt`
pub async fn adopt(
    State(http): State<Shared>,
    OfDiagnosis(rig_id, id): OfDiagnosis,
    _: NoParams,
    key: RequestKey,
    Json(request): Json<AdoptRequest>,
) -> Answer {
    let rig = http.store.rig(&rig_id).await?.ok_or_else(|| no_rig(rig_id.as_str()))?;
    let diagnosis = find(&http, &rig_id, id).await?;
    let base = diagnosed(&http, &rig_id, &diagnosis).await?;
    allowed(diagnosis.summary.verdict.kind)?;
    if request.activate == Activate::Always && !base.is_forward(&rig) {
        let limit = "never: the model does not map all drives of the rig to all its responses";
        return Err(Problem::new(codes::MODEL_NOT_FORWARD, format!("activate must be {limit}."))
            .with(FieldError::new("/activate", limit)));
    }
    let findings = http.store.findings(&diagnosis).await?;
    let held_out = hypothesis(&findings, request.hypothesis)?.clone();
    let activation = activation(&http, &rig, &base, request.activate, &held_out).await?;
    let model = make(&http, &rig, &diagnosis, findings, base, request.hypothesis).await?;
    let key = key.stored().map(|key| (key, Created::adopted as fn(&Model) -> Created));
    let inserted = http.store.insert_model(&rig_id, model, activation, key, http.now()).await?;
    created(Created::adopted(&inserted.ok_or_else(|| no_rig(rig_id.as_str()))?))
}

/// The model that was diagnosed, if it is still there.
async fn diagnosed(http: &Shared, rig: &RigId, diagnosis: &StoredDiagnosis) -> Answer<Model> {
    let Some(named) = &diagnosis.summary.model else {
        let detail =
            "The diagnosis compared simulated runs that were uploaded; it has no model to add an effect to.";
        return Err(Problem::new(codes::DIAGNOSIS_NO_MODEL, detail));
    };
    let found = http.store.model(rig, named.version).await?;
    found.filter(|model| model.sha256 == named.sha256).ok_or_else(|| no_model(&named.version.to_string()))
}

/// Refuses verdicts that name no effect to add.
fn allowed(kind: VerdictKind) -> Answer<()> {
    if kind.blames() {
        return Ok(());
    }
    let detail = "The verdict names no effect that could be added to a model.";
    Err(Problem::new(codes::DIAGNOSIS_NO_EFFECT, detail))
}

/// The held-out figures of a hypothesis, if it may be adopted.
fn hypothesis(findings: &Findings, index: usize) -> Answer<&HeldOut> {
    let found = findings.report.hypotheses.get(index).filter(|_| index < findings.augmented.len());
    let Some(found) = found else {
        let n = findings.report.hypotheses.len();
        let limit = format!("a place in the report's list of {n} hypotheses, from 0");
        return Err(Problem::new(codes::DIAGNOSIS_NO_HYPOTHESIS, format!("hypothesis must be {limit}."))
            .with(FieldError::new("/hypothesis", limit)));
    };
    if !found.stable_over_envelope {
        let detail = format!(
            "With {} the free run does not stay bounded over the allowed drives; diagnose with a smaller \
             envelope.drive_peak, or adopt another hypothesis.",
            found.effect.name()
        );
        return Err(Problem::new(codes::DIAGNOSIS_UNSTABLE, detail)
            .with(FieldError::new("/hypothesis", "a hypothesis with stable_over_envelope")));
    }
    Ok(&found.held_out)
}

/// The change of the rig's active model. With `if_better` the adopted model becomes active if none was,
/// or if the diagnosed model is active and the report's held-out error is at least 1 % lower. A third
/// model stays active, because the two were never compared.
async fn activation(
    http: &Shared,
    rig: &Rig,
    base: &Model,
    wanted: Activate,
    held_out: &HeldOut,
) -> Answer<Activation> {
    match wanted {
        Activate::Never => Ok(Activation::Leave),
        Activate::Always => Ok(Activation::Always),
        Activate::IfBetter if !base.is_forward(rig) => Ok(Activation::Leave),
        Activate::IfBetter => {
            let active = http.store.active_model(&rig.id).await?.and_then(|active| active.version);
            let better = held_out.rms_after <= BETTER * held_out.rms_before;
            Ok(match active {
                None => Activation::IfStill(None),
                Some(version) if version == base.version && better => Activation::IfStill(Some(version)),
                Some(_) => Activation::Leave,
            })
        }
    }
}

/// The diagnosed model with one more effect.
async fn make(
    http: &Shared,
    rig: &Rig,
    diagnosis: &StoredDiagnosis,
    mut findings: Findings,
    base: Model,
    hypothesis: usize,
) -> Answer<NewModel> {
    let weights = http.store.weights(&base).await?;
    let is_drive = |name: &String| rig.channel(name).is_some_and(|channel| channel.role == Role::Drive);
    let drives = (0..base.inputs.len()).filter(|&i| is_drive(&base.inputs[i])).collect();
    let effect = AddedEffect { drives, augmented: findings.augmented.swap_remove(hypothesis) };
    let add = move || {
        let mut model = from_safetensors(&weights).map_err(|error| {
            Problem::new(codes::MODEL_DAMAGED, "The stored weights cannot be read as a model.").because(error)
        })?;
        model.effects.push(effect);
        // The band was calibrated without the effect.
        model.band = None;
        let weights = to_safetensors(&model);
        // Stored weights can be read; the error left is too many effects in one model.
        let model = from_safetensors(&weights).map_err(|error| errors::engine(&error, &[], "/hypothesis"))?;
        Ok::<_, Problem>((weights, model))
    };
    let (weights, model) = http.off_thread(Class::Predict, add).await??;
    // Beneath a version with effects lies the one that they were first added to.
    let (version, sha256) = match base.adoption {
        Some(Adoption { base, .. }) => (base.version, base.sha256),
        None => (Some(base.version), Some(base.sha256)),
    };
    let mut lineage = base.lineage;
    lineage.diagnoses.push(Adopted {
        id: diagnosis.summary.id,
        hypothesis,
        version: base.version,
        fit: findings.fit,
        select: findings.select,
    });
    Ok(NewModel {
        kind: model.kind,
        adoption: Adoption::of(&model, version, sha256),
        inputs: base.inputs,
        outputs: base.outputs,
        sample_rate_hz: base.sample_rate_hz,
        weights: Bytes::from(weights),
        origin: Origin::Diagnosis,
        job: Some(diagnosis.summary.job),
        request: None,
        report: None,
        record: None,
        frf: model.frf_summary(),
        lineage,
        instruction_set: Isa::of_process().map_err(Problem::internal)?.name().into(),
    })
}
