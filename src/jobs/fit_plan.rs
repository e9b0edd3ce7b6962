//! The plan of a fit, resolved without loading a sample: channels by name, runs by row.

mod left_out;

use std::collections::{HashMap, HashSet};

use crate::domain::fits::{Activate, FitRequest, RunFilter, RunSelection};
use crate::domain::{
    FieldError, FitChannels, Lineage, Model, Problem, Rig, Run, RunId, RunKind, Span, Split, model, task,
};
use crate::engine::model::{
    FitSplit, ModelKind, Preset, RunLengths, Section, Sections, Task, own_frf_sections,
};
use crate::storage::{Store, StoreError};

use super::problem::{codes, rig_gone, sentence, store_failed, too_many_waiting};
use super::selection::{by_id, matching};
use super::{core_version, warm_start};

/// A fit with everything resolved: channels by name, runs by row, in the order of their ids.
#[derive(Debug, Clone, PartialEq)]
pub struct FitPlan {
    /// The request with channels and runs filled in, as the model stores it.
    pub request: FitRequest,
    /// Input channels.
    pub inputs: Vec<String>,
    /// Output channels.
    pub outputs: Vec<String>,
    /// What the model is for.
    pub task: Task,
    /// The version that the training begins at.
    pub start: Option<Model>,
    /// The version in place of the FRF.
    pub core: Option<Model>,
    /// Training runs.
    pub training: Vec<Run>,
    /// Runs of the FRF part, if they differ.
    pub frf: Option<Vec<Run>>,
    /// Validation runs.
    pub validation: Vec<Run>,
    /// How the samples are divided.
    pub split: FitSplit,
    /// Why they are divided so, where whole runs are usually left out.
    pub split_reason: Option<String>,
}

/// Why a fit cannot be done.
#[derive(Debug, thiserror::Error)]
pub enum FitProblem {
    /// Fields of the request that do not fit the rig (422 `fit.invalid`).
    #[error("the fit does not suit the rig")]
    Invalid(Vec<FieldError>),
    /// Runs that lack a channel of the fit (422 `fit.missing_channel`).
    #[error("a run lacks a channel of the fit")]
    MissingChannel(Vec<FieldError>),
    /// A channel that is constant in every run (422 `signal.dead_channel`).
    #[error("a channel is constant in every run of the fit")]
    DeadChannel(Vec<FieldError>),
    /// Runs that are too short for the settings (422 `signal.too_short`).
    #[error("a run is too short for the settings")]
    TooShort(Vec<FieldError>),
    /// Runs of the test split, which never enters a fit (422 `fit.test_run`).
    #[error("a test run never enters a fit")]
    TestRun(Vec<FieldError>),
    /// The model is to become active but does not map drives to responses (422
    /// `model.not_forward`).
    #[error("only a model from the rig's drives to its responses can be active")]
    NotForward,
    /// No run matches a selection (409 `fit.no_runs`).
    #[error("no run matches {pointer}")]
    NoRuns {
        /// The selection.
        pointer: &'static str,
    },
    /// The rig has no such version to start from or to use as core (404 `model.not_found`).
    #[error("the rig has no model version {version}")]
    NoVersion {
        /// The version.
        version: u32,
        /// The field that names it.
        pointer: &'static str,
    },
    /// The fit takes more memory than a job may, or than there is (422 `fit.memory`). Bytes.
    #[error("the fit needs about {} MiB of memory", .needed >> 20)]
    Memory {
        /// The estimate.
        needed: u64,
        /// The most that a job may take.
        limit: u64,
        /// What the machine has left, where that was asked.
        available: Option<u64>,
    },
    /// The rig was deleted meanwhile (404 `rig.not_found`).
    #[error("the rig is gone")]
    RigGone,
    /// This many jobs of the token wait, as many as it may have (429 `job.too_many_waiting`).
    #[error("{0} jobs of the token wait already")]
    TooManyWaiting(u64),
    /// The store.
    #[error(transparent)]
    Store(#[from] StoreError),
}

impl FitProblem {
    /// As a problem document, which does not repeat a message of the store.
    pub fn problem(&self) -> Problem {
        let named = |code, title: &str, errors: &[FieldError]| {
            let detail = errors.iter().map(sentence).collect::<Vec<_>>().join("; ");
            Problem::new(422, code, title, format!("{self}: {detail}.")).with(errors.to_vec())
        };
        match self {
            Self::Invalid(errors) => named(codes::FIT_INVALID, "The fit does not suit the rig", errors),
            Self::MissingChannel(errors) => {
                named(codes::FIT_MISSING_CHANNEL, "A run lacks a channel of the fit", errors)
            }
            Self::DeadChannel(errors) => {
                named("signal.dead_channel", "A constant channel where power is needed", errors)
            }
            Self::TooShort(errors) => named("signal.too_short", "Too few samples", errors),
            Self::TestRun(errors) => named(codes::FIT_TEST_RUN, "A test run never enters a fit", errors),
            Self::NotForward => {
                let place = FieldError::new("/activate", "if_better or never for such a model");
                named(codes::MODEL_NOT_FORWARD, "The model does not map drives to responses", &[place])
            }
            Self::NoRuns { pointer } => {
                let title = "No run matches the selection";
                Problem::new(409, codes::FIT_NO_RUNS, title, format!("{self}."))
                    .with(vec![FieldError::new(*pointer, "at least one run of the rig")])
            }
            Self::NoVersion { pointer, .. } => {
                let title = "No such model version";
                Problem::new(404, codes::MODEL_NOT_FOUND, title, format!("{self}."))
                    .with(vec![FieldError::new(*pointer, "a version of the rig")])
            }
            Self::Memory { needed, limit, available } => {
                let mib = |bytes: u64| bytes >> 20;
                let free = available.map(|bytes| format!("; {} MiB are free", mib(bytes)));
                let detail = format!(
                    "The fit needs about {} MiB of memory. A job may take {} MiB (--job-memory-mib){}. Name fewer \
                     channels, or fewer or shorter runs.",
                    mib(*needed),
                    mib(*limit),
                    free.unwrap_or_default()
                );
                let most = available.map_or(*limit, |available| available.min(*limit));
                let limit = format!("runs and channels that take at most {} MiB in a fit", mib(most));
                Problem::new(422, codes::FIT_MEMORY, "The fit needs more memory than there is", detail)
                    .with(vec![FieldError::new("/runs", limit)])
            }
            Self::RigGone => rig_gone(format!("{self}.")),
            Self::TooManyWaiting(most) => too_many_waiting(*most),
            Self::Store(_) => store_failed("the fit"),
        }
    }
}

/// Resolves a request against the rig and its runs, without loading a sample.
///
/// # Errors
/// See [`FitProblem`].
pub async fn check(store: &Store, rig: &Rig, request: &FitRequest) -> Result<FitPlan, FitProblem> {
    let channels = request.check(&rig.channels, rig.sample_rate_hz).map_err(FitProblem::Invalid)?;
    if request.activate == Activate::Always && !model::is_forward(rig, &channels.inputs, &channels.outputs) {
        return Err(FitProblem::NotForward);
    }
    let task = task(&rig.channels, &channels.inputs, &channels.outputs);
    let start = warm_start::check(store, rig, request, &channels).await?;
    let core = core_version::check(store, rig, request, &channels).await?;
    let mut request = request.clone();
    if let Some(blocks) = start.as_ref().and_then(warm_start::reported_blocks) {
        request.lstm.blocks.get_or_insert_with(|| blocks.clone());
    }
    let plan = plan(&store.all_runs(&rig.id).await?, &request, (channels, task), core)?;
    Ok(FitPlan { start, ..plan })
}

fn plan(
    all: &[Run],
    request: &FitRequest,
    (channels, task): (FitChannels, Task),
    core: Option<Model>,
) -> Result<FitPlan, FitProblem> {
    let noise = Some(RunKind::Noise);
    let select = |selection: Option<&RunSelection>, pointer| {
        let found = selected(all, selection, noise, Split::Training, pointer)?;
        if found.is_empty() { Err(FitProblem::NoRuns { pointer }) } else { Ok(found) }
    };
    let frf_runs = request.frf.runs.as_ref();
    // A plain FRF is fitted on the runs of its FRF part.
    let (training, training_at) = match frf_runs {
        Some(own) if request.kind == ModelKind::Frf => (select(Some(own), "/frf/runs")?, "/frf/runs"),
        _ => (select(request.runs.as_ref(), "/runs")?, "/runs"),
    };
    let hybrid = matches!(request.kind, ModelKind::Hybrid1 | ModelKind::Hybrid2);
    let frf = match frf_runs {
        Some(own) if hybrid => Some(select(Some(own), "/frf/runs")?).filter(|own| *own != training),
        _ => None,
    };
    let validation = validation(all, request, &training, frf.as_deref())?;

    holds_channels(training_at, &training, &channels)?;
    holds_channels("/frf/runs", frf.as_deref().unwrap_or_default(), &channels)?;
    holds_channels("/validation_runs", &validation, &channels)?;
    moves(training_at, &training, &channels)?;
    moves("/frf/runs", frf.as_deref().unwrap_or_default(), &channels)?;

    let ids = |runs: &[Run]| RunSelection::Ids(runs.iter().map(|run| run.id).collect());
    let mut request = request.clone();
    request.inputs = Some(channels.inputs.clone());
    request.outputs = Some(channels.outputs.clone());
    request.runs = Some(ids(&training));
    request.frf.runs = frf.as_deref().map(ids);
    request.validation_runs = if validation.is_empty() { None } else { Some(ids(&validation)) };
    let fixed = (frf.as_deref(), core.as_ref());
    let (split, split_reason) = divide((&request, task), &channels, &training, fixed, &validation);
    let FitChannels { inputs, outputs } = channels;
    let start = None;
    let plan = FitPlan {
        request,
        inputs,
        outputs,
        task,
        start,
        core,
        training,
        frf,
        validation,
        split,
        split_reason,
    };
    plan.long_enough()?;
    Ok(plan)
}

/// How a fit's samples are divided (design, section 3, "What stops a training"). Runs that the core has seen compare
/// nothing while there are others.
fn divide(
    (request, task): (&FitRequest, Task),
    channels: &FitChannels,
    training: &[Run],
    (frf, core): (Option<&[Run]>, Option<&Model>),
    validation: &[Run],
) -> (FitSplit, Option<String>) {
    if !validation.is_empty() {
        let split = match request.preset {
            Preset::Default => FitSplit::ValidationHalves,
            Preset::Paper => FitSplit::ValidationStops,
        };
        return (split, None);
    }
    if training.len() < 2 {
        return (FitSplit::LastTenths, None);
    }
    let names: Vec<&str> = channels.inputs.iter().chain(&channels.outputs).map(String::as_str).collect();
    let of_frf = |run: &Run| frf.unwrap_or_default().iter().any(|other| other.sha256 == run.sha256);
    let shortest = 2 * window_len(request, task) as u64;
    let of_core = |run: &Run| core.is_some_and(|core| core.lineage.has_seen(&span(run, 0, run.samples)));
    let unseen = left_out::choose(training, &names, |run| of_frf(run) || of_core(run), shortest);
    match unseen.or_else(|_| left_out::choose(training, &names, of_frf, shortest)) {
        Ok(split) => (split, None),
        Err(why) => (FitSplit::LastTenths, Some(why)),
    }
}

/// Window of the fit's network; settings outside their limits are refused elsewhere.
fn window_len(request: &FitRequest, task: Task) -> usize {
    request.lstm.resolve(request.preset, request.kind, task, &[]).map_or(0, |lstm| lstm.window_len)
}

/// Runs of a selection, each measurement once, by id. `kind` and `split` stand for what the
/// selection leaves open.
fn selected(
    all: &[Run],
    selection: Option<&RunSelection>,
    kind: Option<RunKind>,
    split: Split,
    pointer: &'static str,
) -> Result<Vec<Run>, FitProblem> {
    let default = RunFilter::default();
    let mut runs: Vec<Run> = match selection {
        Some(RunSelection::Ids(ids)) => by_id(all, ids, pointer).map_err(FitProblem::Invalid)?,
        Some(RunSelection::Match(filter)) => matching(all, filter, kind, split),
        None => matching(all, &default, kind, split),
    };
    runs.sort_by_key(|run| run.id);
    let mut seen = HashSet::new();
    runs.retain(|run| seen.insert(run.sha256.clone()));
    no_test_data(all, &runs, pointer)?;
    Ok(runs)
}

/// Refuses test runs, and uploads of the same bytes under another split.
fn no_test_data(all: &[Run], runs: &[Run], pointer: &str) -> Result<(), FitProblem> {
    let test: HashMap<&str, RunId> =
        all.iter().filter(|run| run.split == Split::Test).map(|run| (run.sha256.as_str(), run.id)).collect();
    let errors: Vec<FieldError> = runs
        .iter()
        .filter_map(|run| {
            let of_test = test.get(run.sha256.as_str())?;
            let limit = if run.split == Split::Test {
                format!("no run of the test split: {}", run.id)
            } else {
                format!("no data of the test split: run {} holds the bytes of test run {of_test}", run.id)
            };
            Some(FieldError::new(pointer, limit))
        })
        .collect();
    if errors.is_empty() { Ok(()) } else { Err(FitProblem::TestRun(errors)) }
}

/// Validation runs. A run that was not named by id is used for training if both lists have it. Without
/// validation runs the caller holds out a part of each training run.
fn validation(
    all: &[Run],
    request: &FitRequest,
    training: &[Run],
    frf: Option<&[Run]>,
) -> Result<Vec<Run>, FitProblem> {
    let pointer = "/validation_runs";
    let asked = request.validation_runs.as_ref();
    let mut runs = selected(all, asked, None, Split::Validation, pointer)?;
    let trained: HashSet<&str> =
        training.iter().chain(frf.unwrap_or_default()).map(|run| run.sha256.as_str()).collect();
    // The request may spell out the contract's default.
    let is_default = asked.is_none_or(|asked| match asked {
        RunSelection::Ids(_) => false,
        RunSelection::Match(filter) => {
            filter.kinds.is_none()
                && filter.tags.is_empty()
                && filter.split.as_deref().is_none_or(|split| split == Split::Validation.as_str())
        }
    });
    if is_default {
        runs.retain(|run| !trained.contains(run.sha256.as_str()));
        return Ok(runs);
    }
    if runs.is_empty() {
        return Err(FitProblem::NoRuns { pointer });
    }
    let both: Vec<FieldError> = runs
        .iter()
        .filter(|run| trained.contains(run.sha256.as_str()))
        .map(|run| FieldError::new(pointer, format!("no run that is trained on: {}", run.id)))
        .collect();
    if both.is_empty() { Ok(runs) } else { Err(FitProblem::Invalid(both)) }
}

fn holds_channels(pointer: &str, runs: &[Run], channels: &FitChannels) -> Result<(), FitProblem> {
    let mut errors = Vec::new();
    for run in runs {
        for name in channels.inputs.iter().chain(&channels.outputs) {
            if !run.channels.contains(name) {
                let limit = format!("runs that hold every channel of the fit: {} does not", run.id);
                errors.push(FieldError::new(pointer, limit).on_channel(name));
            }
        }
    }
    if errors.is_empty() { Ok(()) } else { Err(FitProblem::MissingChannel(errors)) }
}

/// Refuses channels that are constant in every run, because nothing can be fitted with them.
fn moves(pointer: &str, runs: &[Run], channels: &FitChannels) -> Result<(), FitProblem> {
    if runs.is_empty() {
        return Ok(());
    }
    let errors: Vec<FieldError> = channels
        .inputs
        .iter()
        .chain(&channels.outputs)
        .filter(|name| runs.iter().all(|run| run.quality.dead_channels.contains(name)))
        .map(|name| FieldError::new(pointer, "a run in which the channel moves").on_channel(name))
        .collect();
    if errors.is_empty() { Ok(()) } else { Err(FitProblem::DeadChannel(errors)) }
}

impl FitPlan {
    /// Channels of the fit.
    pub fn channels(&self) -> FitChannels {
        FitChannels { inputs: self.inputs.clone(), outputs: self.outputs.clone() }
    }

    /// Window of the fit's network.
    pub(super) fn window_len(&self) -> usize {
        window_len(&self.request, self.task)
    }

    /// Refuses runs that leave no window, no segment or nothing to compare on.
    fn long_enough(&self) -> Result<(), FitProblem> {
        let refuse =
            |pointer: &str, limit: String| Err(FitProblem::TooShort(vec![FieldError::new(pointer, limit)]));
        let request = &self.request;
        let sections = self.sections();
        if sections.comparison.is_empty() && sections.stopping.is_empty() {
            return refuse("/runs", "a run of at least 10 samples, a tenth of which is held out".into());
        }
        let stops = request.kind != ModelKind::Frf;
        if stops && sections.stopping.is_empty() {
            return refuse(
                "/runs",
                "a run of at least 10 samples, a tenth of which stops the training".into(),
            );
        }
        if stops
            && let lstm = window_len(request, self.task)
            && let Some(shortest) = sections.training.iter().min_by_key(|section| section.samples.len())
            && shortest.samples.len() < lstm
        {
            let (run, samples) = (self.training[shortest.run].id, shortest.samples.len());
            let limit = format!("at most {samples}, the samples that run {run} gives to training");
            return refuse("/lstm/window_len", limit);
        }
        if request.kind != ModelKind::Lstm
            && let Some(segment_len) = request.frf.segment_len
        {
            let sections = self.frf_sections(&sections.training);
            let longest = sections.iter().map(|section| section.samples.end).max().unwrap_or(0);
            if longest < segment_len {
                return refuse(
                    "/frf/segment_len",
                    format!("at most {longest}, the samples of the longest run that the FRF is estimated on"),
                );
            }
        }
        Ok(())
    }

    /// The split carried out; runs by their place among the training runs, then the validation runs.
    fn sections(&self) -> Sections {
        // A run that was accepted fits into memory, and so does its length into a usize.
        let lengths = |runs: &[Run]| -> Vec<usize> {
            runs.iter().map(|run| usize::try_from(run.samples).unwrap_or(usize::MAX)).collect()
        };
        let (training, validation) = (lengths(&self.training), lengths(&self.validation));
        let lengths = RunLengths { training: &training, validation: &validation };
        Sections::of(&self.split, self.request.kind, lengths, window_len(&self.request, self.task))
    }

    /// Place of each run of the FRF part, where it has its own: among the training runs, the validation runs
    /// and `frf_only`.
    pub(super) fn frf_places(&self) -> Option<Vec<usize>> {
        let place = |run: &Run| {
            let known =
                self.training.iter().chain(&self.validation).position(|other| other.sha256 == run.sha256);
            let only = || self.frf_only().position(|other| other.id == run.id);
            known.or_else(|| Some(self.training.len() + self.validation.len() + only()?))
        };
        self.frf.as_ref().map(|runs| runs.iter().filter_map(place).collect())
    }

    /// Runs of the FRF part that are neither training nor validation runs.
    pub(super) fn frf_only(&self) -> impl Iterator<Item = &Run> {
        let known = |run: &&Run| self.training.iter().chain(&self.validation).any(|o| o.sha256 == run.sha256);
        self.frf.iter().flatten().filter(move |run| !known(run))
    }

    /// A run by its place: training runs, validation runs, then those of the FRF part alone.
    fn run(&self, place: usize) -> &Run {
        let run = self.training.iter().chain(&self.validation).chain(self.frf_only()).nth(place);
        run.expect("a section names a run of the plan")
    }

    fn spans(&self, sections: &[Section]) -> Vec<Span> {
        let of = |section: &Section| {
            span(self.run(section.run), section.samples.start as u64, section.samples.end as u64)
        };
        sections.iter().map(of).collect()
    }

    fn length(&self, place: usize) -> usize {
        usize::try_from(self.run(place).samples).unwrap_or(usize::MAX)
    }

    /// Data of the FRF part when `training` is trained on.
    fn frf_sections(&self, training: &[Section]) -> Vec<Section> {
        match self.frf_places() {
            Some(own) => own_frf_sections(&own, training, self.training.len(), |place| self.length(place)),
            None => training.to_vec(),
        }
    }

    /// The spans of data behind the model. `refitted`: the model was fitted again on all training runs after
    /// the comparison.
    pub fn lineage(&self, refitted: bool) -> Lineage {
        let Sections { training, stopping, comparison, .. } = self.sections();
        let whole =
            || (0..self.training.len()).map(|run| Section { run, samples: 0..self.length(run) }).collect();
        let (training, stopping) = if refitted { (whole(), Vec::new()) } else { (training, stopping) };
        let frf = if self.frf.is_some() { self.frf_sections(&training) } else { Vec::new() };
        Lineage {
            frf: self.spans(&frf),
            training: self.spans(&training),
            stopping: Some(self.spans(&stopping)),
            validation: self.spans(&comparison),
            start: self.start.as_ref().map(warm_start::lineage),
            core: self.core.as_ref().map(core_version::lineage),
            diagnoses: Vec::new(),
        }
    }
}

fn span(run: &Run, from_sample: u64, to_sample: u64) -> Span {
    Span { run: run.id, sha256: run.sha256.clone(), from_sample, to_sample }
}

#[cfg(test)]
pub(super) mod testing;
#[cfg(test)]
mod tests;
