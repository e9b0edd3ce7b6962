//! The plan of a diagnosis, resolved without loading a sample: model, channels, runs and their roles.

use std::collections::{BTreeSet, HashSet};

use crate::domain::diagnosis::DiagnosisRuns;
use crate::domain::fits::RunSelection;
use crate::domain::rig::Role as ChannelRole;
use crate::domain::{Channel, DiagnosisRequest, FieldError, FitChannels, Model, ModelRef, Rig, Run, RunId};
use crate::engine::diagnosis::{Effect, Role};
use crate::storage::Store;

use super::problem::DiagnosisProblem;
use super::runs::{Baseline, baseline, runs, simulated};

/// A diagnosis with everything resolved.
#[derive(Debug, Clone, PartialEq)]
pub(in crate::jobs) struct DiagnosisPlan {
    /// The request with model and runs filled in, as the diagnosis stores it.
    pub request: DiagnosisRequest,
    /// Effects that may be named.
    pub effects: Vec<Effect>,
    /// The model that is the sim; `None` for simulated runs.
    pub model: Option<Model>,
    /// Drives, in order; with a model, those of its inputs that are drives.
    pub drives: Vec<Channel>,
    /// Responses, in order.
    pub responses: Vec<Channel>,
    /// Runs that the core is fitted to.
    pub baseline: Vec<Baseline>,
    /// Runs to explain, in the request's order.
    pub runs: Vec<Run>,
    /// Role of each run, if the request gives roles.
    pub roles: Option<Vec<Role>>,
    /// For each run the run with its simulated responses; empty if a model is the sim.
    pub simulated: Vec<Run>,
    /// Indices into the runs.
    pub repeats: Vec<Vec<usize>>,
    /// Largest magnitude allowed of each drive.
    pub drive_limit: Vec<f64>,
}

impl DiagnosisPlan {
    /// Names of drives and responses.
    pub fn channels(&self) -> FitChannels {
        let names = |channels: &[Channel]| channels.iter().map(|c| c.name.clone()).collect();
        FitChannels { inputs: names(&self.drives), outputs: names(&self.responses) }
    }
}

/// Resolves a request against the rig, its models and runs, without loading a sample.
///
/// # Errors
/// See [`DiagnosisProblem`].
pub(in crate::jobs) async fn check(
    store: &Store,
    rig: &Rig,
    request: &DiagnosisRequest,
) -> Result<DiagnosisPlan, DiagnosisProblem> {
    settings(request)?;
    let model = match (&request.simulated, request.model) {
        (Some(_), None) => None,
        (Some(_), Some(_)) => {
            return invalid("/model", "left out: simulated stands in its place");
        }
        (None, name) => Some(find_model(store, rig, name.unwrap_or_default()).await?),
    };
    plan(rig, &store.all_runs(&rig.id).await?, request, model)
}

async fn find_model(store: &Store, rig: &Rig, name: ModelRef) -> Result<Model, DiagnosisProblem> {
    let version = match name {
        ModelRef::Version(version) => version,
        ModelRef::Active => {
            let active = store.active_model(&rig.id).await?.ok_or(DiagnosisProblem::RigGone)?;
            active.version.ok_or(DiagnosisProblem::NoneActive)?
        }
    };
    store.model(&rig.id, version).await?.ok_or(DiagnosisProblem::NoModel(version))
}

/// The refusal of one field.
pub(super) fn invalid<T>(
    pointer: impl Into<String>,
    limit: impl Into<String>,
) -> Result<T, DiagnosisProblem> {
    Err(DiagnosisProblem::Invalid(vec![FieldError::new(pointer, limit)]))
}

/// Refuses numbers that make no sense on any rig.
fn settings(request: &DiagnosisRequest) -> Result<(), DiagnosisProblem> {
    let mut errors = Vec::new();
    if !(request.material_gap > 0.0 && request.material_gap < 1.0) {
        errors.push(FieldError::new("/material_gap", "above 0 and below 1"));
    }
    for (drive, peak) in &request.envelope.drive_peak {
        if !(peak.is_finite() && *peak > 0.0) {
            let pointer = format!("/envelope/drive_peak/{}", drive.replace('~', "~0").replace('/', "~1"));
            errors.push(FieldError::new(pointer, "a positive number").on_channel(drive));
        }
    }
    errors.extend(request.effects().err().into_iter().flatten());
    if errors.is_empty() { Ok(()) } else { Err(DiagnosisProblem::Invalid(errors)) }
}

fn plan(
    rig: &Rig,
    all: &[Run],
    request: &DiagnosisRequest,
    model: Option<Model>,
) -> Result<DiagnosisPlan, DiagnosisProblem> {
    let effects = request.effects().map_err(DiagnosisProblem::Invalid)?;
    let (runs, roles) = runs(all, &request.runs)?;
    let baseline = baseline(all, request.baseline_runs.as_ref(), model.as_ref())?;
    let simulated = simulated(all, request, &runs)?;
    let (drives, responses) = channels(rig, model.as_ref(), &runs, &baseline, &simulated)?;
    let repeats = repeats(&request.repeats, &runs, roles.as_deref())?;
    let drive_limit = drive_limit(request, &drives, &runs)?;
    let ids = |runs: &[Run]| runs.iter().map(|run| run.id).collect::<Vec<_>>();
    let mut request = request.clone();
    request.model = model.as_ref().map(|model| ModelRef::Version(model.version));
    if let DiagnosisRuns::Match(_) = request.runs {
        request.runs = DiagnosisRuns::Ids(ids(&runs));
    }
    if let Some(RunSelection::Match(_)) = request.baseline_runs {
        request.baseline_runs = Some(RunSelection::Ids(baseline.iter().map(|b| b.run.id).collect()));
    }
    let plan = DiagnosisPlan {
        request,
        effects,
        model,
        drives,
        responses,
        baseline,
        runs,
        roles,
        simulated,
        repeats,
        drive_limit,
    };
    plan.suits_runs()?;
    Ok(plan)
}

/// Drives and responses: the model's, or those of the rig that the runs hold.
fn channels(
    rig: &Rig,
    model: Option<&Model>,
    runs: &[Run],
    baseline: &[Baseline],
    simulated: &[Run],
) -> Result<(Vec<Channel>, Vec<Channel>), DiagnosisProblem> {
    let Some(model) = model else {
        let held: BTreeSet<&String> =
            runs.iter().chain(baseline.iter().map(|b| &b.run)).flat_map(|run| &run.channels).collect();
        let simulated: BTreeSet<&String> = simulated.iter().flat_map(|run| &run.channels).collect();
        let of = |role: ChannelRole, held: &BTreeSet<&String>| -> Vec<Channel> {
            rig.channels.iter().filter(|c| c.role == role && held.contains(&c.name)).cloned().collect()
        };
        let (drives, responses) = (of(ChannelRole::Drive, &held), of(ChannelRole::Response, &simulated));
        if drives.is_empty() {
            return invalid("/runs", "runs that hold a drive of the rig");
        }
        if responses.is_empty() {
            return invalid("/simulated", "runs that hold a response of the rig");
        }
        return Ok((drives, responses));
    };
    let row = |name: &String| rig.channel(name).cloned();
    let drives: Vec<Channel> =
        model.inputs.iter().filter_map(row).filter(|c| c.role == ChannelRole::Drive).collect();
    let responses: Vec<Channel> = model.outputs.iter().filter_map(row).collect();
    if drives.is_empty() || responses.is_empty() {
        return invalid("/model", "a model from at least one drive of the rig to its channels");
    }
    Ok((drives, responses))
}

fn repeats(
    asked: &[Vec<RunId>],
    runs: &[Run],
    roles: Option<&[Role]>,
) -> Result<Vec<Vec<usize>>, DiagnosisProblem> {
    let mut errors = Vec::new();
    let mut seen = HashSet::new();
    let mut groups = Vec::with_capacity(asked.len());
    for (g, ids) in asked.iter().enumerate() {
        let mut group = Vec::with_capacity(ids.len());
        for (i, id) in ids.iter().enumerate() {
            let pointer = format!("/repeats/{g}/{i}");
            match runs.iter().position(|run| run.id == *id) {
                None => errors.push(FieldError::new(pointer, "one of the runs of this diagnosis")),
                Some(_) if !seen.insert(*id) => {
                    errors.push(FieldError::new(pointer, "each run in one group, once"));
                }
                Some(run) => group.push(run),
            }
        }
        if ids.len() < 2 {
            errors.push(FieldError::new(format!("/repeats/{g}"), "at least two runs"));
        }
        if let (Some(roles), Some(&first)) = (roles, group.first())
            && group.iter().any(|&run| roles[run] != roles[first])
        {
            let limit = "runs of one role: a drive that is tested on is never fitted to";
            errors.push(FieldError::new(format!("/repeats/{g}"), limit));
        }
        groups.push(group);
    }
    if errors.is_empty() { Ok(groups) } else { Err(DiagnosisProblem::Invalid(errors)) }
}

/// Limit of each drive: the envelope's, else the peak of the runs.
fn drive_limit(
    request: &DiagnosisRequest,
    drives: &[Channel],
    runs: &[Run],
) -> Result<Vec<f64>, DiagnosisProblem> {
    let envelope = &request.envelope.drive_peak;
    let unknown = envelope.keys().filter(|name| !drives.iter().any(|drive| drive.name == **name));
    let errors: Vec<FieldError> = unknown
        .map(|name| FieldError::new("/envelope/drive_peak", "drives of this diagnosis").on_channel(name))
        .collect();
    if !errors.is_empty() {
        return Err(DiagnosisProblem::Invalid(errors));
    }
    let reached = |name: &str| {
        let quality = runs.iter().flat_map(|run| &run.quality.channels).filter(|q| q.channel == name);
        quality.map(|q| q.min.abs().max(q.max.abs())).fold(f64::MIN_POSITIVE, f64::max)
    };
    Ok(drives.iter().map(|d| envelope.get(&d.name).copied().unwrap_or_else(|| reached(&d.name))).collect())
}
