//! What a diagnosis will do, resolved without loading a sample: model, channels, runs and their roles.

use std::collections::{BTreeSet, HashMap, HashSet};

use crate::domain::diagnosis::{DiagnosisRuns, RunRoles};
use crate::domain::fits::RunSelection;
use crate::domain::rig::Role as ChannelRole;
use crate::domain::{
    Channel, DiagnosisRequest, FieldError, FitChannels, Lineage, Model, ModelName, Rig, Run, RunId,
};
use crate::engine::Signal;
use crate::engine::diagnosis::{Effect, Role};
use crate::storage::Store;

use super::diagnosis_problem::DiagnosisProblem;
use super::diagnosis_runs::{by_id, matching};

/// Fewest samples of a run: below, nothing can be scored.
const MIN_SAMPLES: u64 = 64;

/// A stretch of a run that the linear core is fitted to.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Baseline {
    pub run: Run,
    pub from_sample: u64,
    pub to_sample: u64,
}

/// A diagnosis with everything resolved.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct DiagnosisPlan {
    /// The request with model and runs filled in; what the diagnosis keeps.
    pub request: DiagnosisRequest,
    /// Effects that may be named.
    pub effects: Vec<Effect>,
    /// The sim, unless its responses were sent.
    pub model: Option<Model>,
    /// Drives, in order: of a model those of its inputs that are drives.
    pub drives: Vec<Channel>,
    /// Responses, in order.
    pub responses: Vec<Channel>,
    /// What the core is fitted to.
    pub baseline: Vec<Baseline>,
    /// Runs to explain, in the request's order.
    pub runs: Vec<Run>,
    /// What each run is used for, if the request says so.
    pub roles: Option<Vec<Role>>,
    /// Of each run, the one with its simulated responses; empty where a model is the sim.
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
pub(super) async fn check(
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

async fn find_model(store: &Store, rig: &Rig, name: ModelName) -> Result<Model, DiagnosisProblem> {
    let version = match name {
        ModelName::Version(version) => version,
        ModelName::Active => {
            let active = store.active_model(&rig.id).await?.ok_or(DiagnosisProblem::RigGone)?;
            active.version.ok_or(DiagnosisProblem::NoneActive)?
        }
    };
    store.model(&rig.id, version).await?.ok_or(DiagnosisProblem::NoModel(version))
}

fn invalid<T>(pointer: impl Into<String>, limit: impl Into<String>) -> Result<T, DiagnosisProblem> {
    Err(DiagnosisProblem::Invalid(vec![FieldError::new(pointer, limit)]))
}

/// Numbers that make no sense on any rig.
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
    request.model = model.as_ref().map(|model| ModelName::Version(model.version));
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
    plan.holds_channels()?;
    plan.suits_lengths()?;
    plan.moves()?;
    Ok(plan)
}

/// Runs to explain with their roles, each measurement once.
fn runs(all: &[Run], asked: &DiagnosisRuns) -> Result<(Vec<Run>, Option<Vec<Role>>), DiagnosisProblem> {
    match asked {
        DiagnosisRuns::Match(filter) => {
            let runs = matching(all, filter, "/runs")?;
            if runs.is_empty() {
                Err(DiagnosisProblem::NoRuns { pointer: "/runs" })
            } else {
                Ok((runs, None))
            }
        }
        DiagnosisRuns::Ids(ids) => {
            let runs = by_id(all, ids, "/runs")?;
            once(&runs, &["/runs"], &[runs.len()])?;
            Ok((runs, None))
        }
        DiagnosisRuns::Roles(RunRoles { fit, select, test }) => {
            let places = ["/runs/fit", "/runs/select", "/runs/test"];
            let lists = [fit, select, test];
            let mut runs = Vec::new();
            let mut roles = Vec::new();
            for ((ids, pointer), role) in lists.iter().zip(places).zip([Role::Fit, Role::Select, Role::Test])
            {
                runs.extend(by_id(all, ids, pointer)?);
                roles.resize(runs.len(), role);
            }
            once(&runs, &places, &lists.map(Vec::len))?;
            Ok((runs, Some(roles)))
        }
    }
}

/// Refuses a measurement that is named twice, by its id or by the bytes it came in: what is fitted
/// must not be tested on, and a copy says nothing about noise.
fn once(runs: &[Run], places: &[&str], lens: &[usize]) -> Result<(), DiagnosisProblem> {
    let pointers =
        places.iter().zip(lens).flat_map(|(place, n)| (0..*n).map(move |i| format!("{place}/{i}")));
    let mut seen: HashMap<&str, RunId> = HashMap::new();
    let mut errors = Vec::new();
    for (run, pointer) in runs.iter().zip(pointers) {
        if let Some(first) = seen.insert(&run.sha256, run.id) {
            errors.push(FieldError::new(
                pointer,
                format!("each measurement once: its bytes are those of run {first}"),
            ));
        }
    }
    if errors.is_empty() { Ok(()) } else { Err(DiagnosisProblem::Invalid(errors)) }
}

/// Runs of the linear core: those that were asked for, else what the model's linear part, or
/// without one the model, was fitted to.
fn baseline(
    all: &[Run],
    asked: Option<&RunSelection>,
    model: Option<&Model>,
) -> Result<Vec<Baseline>, DiagnosisProblem> {
    let pointer = "/baseline_runs";
    let whole = |run: Run| Baseline { from_sample: 0, to_sample: run.samples, run };
    match asked {
        Some(RunSelection::Ids(ids)) => Ok(by_id(all, ids, pointer)?.into_iter().map(whole).collect()),
        Some(RunSelection::Match(filter)) => {
            let runs = matching(all, filter, pointer)?;
            if runs.is_empty() {
                Err(DiagnosisProblem::NoRuns { pointer })
            } else {
                Ok(runs.into_iter().map(whole).collect())
            }
        }
        None => {
            let Some(model) = model else {
                return invalid(pointer, "required with simulated: low-level runs for the linear core");
            };
            let Lineage { training, frf, .. } = &model.lineage;
            let spans = if frf.is_empty() { training } else { frf };
            let rows: HashMap<RunId, &Run> = all.iter().map(|run| (run.id, run)).collect();
            let found = spans.iter().filter_map(|span| {
                let run = (*rows.get(&span.run)?).clone();
                Some(Baseline { run, from_sample: span.from_sample, to_sample: span.to_sample })
            });
            let found: Vec<Baseline> = found.collect();
            if found.is_empty() {
                let limit = format!(
                    "required: the rig has none of the runs that model {} was fitted on",
                    model.version
                );
                return invalid(pointer, limit);
            }
            Ok(found)
        }
    }
}

/// Of each run the one with its simulated responses.
fn simulated(all: &[Run], request: &DiagnosisRequest, runs: &[Run]) -> Result<Vec<Run>, DiagnosisProblem> {
    let Some(map) = &request.simulated else { return Ok(Vec::new()) };
    let rows: HashMap<RunId, &Run> = all.iter().map(|run| (run.id, run)).collect();
    let mut errors = Vec::new();
    for id in map.keys().filter(|id| !runs.iter().any(|run| run.id == **id)) {
        errors.push(FieldError::new(format!("/simulated/{id}"), "one of the runs of this diagnosis"));
    }
    let mut found = Vec::new();
    for run in runs {
        let pointer = format!("/simulated/{}", run.id);
        match map.get(&run.id).map(|id| (id, rows.get(id))) {
            None => errors.push(FieldError::new(pointer, "required: a simulated run for each of the runs")),
            Some((id, None)) => errors.push(FieldError::new(pointer, format!("a run of the rig, not {id}"))),
            Some((id, Some(_))) if *id == run.id => {
                errors.push(FieldError::new(pointer, "another run than the measured one"));
            }
            Some((_, Some(row))) => found.push((*row).clone()),
        }
    }
    if errors.is_empty() { Ok(found) } else { Err(DiagnosisProblem::Invalid(errors)) }
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

/// Limit of each drive: the envelope's, else what the runs reach.
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

impl DiagnosisPlan {
    /// Every list of runs with its place in the request.
    fn lists(&self) -> [(&'static str, Vec<&Run>); 3] {
        [
            ("/runs", self.runs.iter().collect()),
            ("/baseline_runs", self.baseline.iter().map(|b| &b.run).collect()),
            ("/simulated", self.simulated.iter().collect()),
        ]
    }

    fn holds_channels(&self) -> Result<(), DiagnosisProblem> {
        let FitChannels { inputs, outputs } = self.channels();
        // A model may take measured channels beside the drives.
        let inputs = self.model.as_ref().map_or(&inputs, |model| &model.inputs);
        let mut errors = Vec::new();
        for (pointer, runs) in self.lists() {
            let needed: Vec<&String> = if pointer == "/simulated" {
                outputs.iter().collect()
            } else {
                inputs.iter().chain(&outputs).collect()
            };
            for run in runs {
                for name in needed.iter().filter(|name| !run.channels.contains(name)) {
                    let limit = format!("runs that hold every channel of the diagnosis: {} does not", run.id);
                    errors.push(FieldError::new(pointer, limit).on_channel(name.as_str()));
                }
            }
        }
        if errors.is_empty() { Ok(()) } else { Err(DiagnosisProblem::MissingChannel(errors)) }
    }

    fn suits_lengths(&self) -> Result<(), DiagnosisProblem> {
        let rate = self.model.as_ref().map_or(self.runs[0].sample_rate_hz, |model| model.sample_rate_hz);
        let mut other_rate = Vec::new();
        let mut short = Vec::new();
        for (pointer, runs) in self.lists() {
            for run in runs {
                if !Signal::same_rate(run.sample_rate_hz, rate) {
                    let limit = format!("{rate} Hz: run {} has {} Hz", run.id, run.sample_rate_hz);
                    other_rate.push(FieldError::new(pointer, limit));
                }
                if run.samples < MIN_SAMPLES {
                    let limit = format!("at least {MIN_SAMPLES} samples: run {} has {}", run.id, run.samples);
                    short.push(FieldError::new(pointer, limit));
                }
            }
        }
        let unequal: Vec<FieldError> = self
            .runs
            .iter()
            .zip(&self.simulated)
            .filter(|(run, simulated)| run.samples != simulated.samples)
            .map(|(run, simulated)| {
                let limit = format!(
                    "{} samples, as many as the run: {} has {}",
                    run.samples, simulated.id, simulated.samples
                );
                FieldError::new(format!("/simulated/{}", run.id), limit)
            })
            .collect();
        match (other_rate.is_empty(), short.is_empty(), unequal.is_empty()) {
            (false, _, _) => Err(DiagnosisProblem::SampleRate(other_rate)),
            (_, false, _) => Err(DiagnosisProblem::TooShort(short)),
            (_, _, false) => Err(DiagnosisProblem::UnequalLengths(unequal)),
            _ => Ok(()),
        }
    }

    /// Refuses responses that are constant in every run, and runs without any drive that moves.
    fn moves(&self) -> Result<(), DiagnosisProblem> {
        let mut errors = Vec::new();
        let [runs, baseline, _] = self.lists();
        for (pointer, runs) in [runs, baseline] {
            let dead =
                |channel: &Channel| runs.iter().all(|r| r.quality.dead_channels.contains(&channel.name));
            let place =
                |c: &Channel| FieldError::new(pointer, "runs in which the channel moves").on_channel(&c.name);
            if self.drives.iter().all(dead) {
                errors.extend(self.drives.iter().map(place));
            }
            errors.extend(self.responses.iter().filter(|c| dead(c)).map(place));
        }
        if errors.is_empty() { Ok(()) } else { Err(DiagnosisProblem::DeadChannel(errors)) }
    }
}
