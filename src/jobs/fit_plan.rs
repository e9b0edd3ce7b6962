//! What a fit will do, resolved without loading a sample: channels by name, runs by row.

use std::collections::{HashMap, HashSet};

use crate::domain::fits::{Activate, FitRequest, RunFilter, RunSelection};
use crate::domain::{
    FieldError, FitChannels, Lineage, Problem, Rig, Run, RunId, RunKind, Span, Split, model,
};
use crate::engine::model::{ModelKind, hold_out_from};
use crate::storage::{Store, StoreError};

use super::problem::{codes, sentence};
use super::selection::{by_id, matching};

/// A fit with everything resolved: channels by name, runs by row, in the order of their ids.
#[derive(Debug, Clone, PartialEq)]
pub struct FitPlan {
    /// The request with channels and runs filled in; what the model stores.
    pub request: FitRequest,
    /// Input channels.
    pub inputs: Vec<String>,
    /// Output channels.
    pub outputs: Vec<String>,
    /// Training runs.
    pub training: Vec<Run>,
    /// Runs of the FRF part, where they are others.
    pub frf: Option<Vec<Run>>,
    /// Validation runs; empty: the last 10 % of each training run.
    pub validation: Vec<Run>,
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
    /// The rig was deleted meanwhile (404 `rig.not_found`).
    #[error("the rig is gone")]
    RigGone,
    /// The store.
    #[error(transparent)]
    Store(#[from] StoreError),
}

impl FitProblem {
    /// As a problem document; of the store's failure only that it happened.
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
                named(codes::MODEL_NOT_FORWARD, "The model is no forward model of the rig", &[place])
            }
            Self::NoRuns { pointer } => {
                let title = "No run matches the selection";
                Problem::new(409, codes::FIT_NO_RUNS, title, format!("{self}."))
                    .with(vec![FieldError::new(*pointer, "at least one run of the rig")])
            }
            Self::RigGone => Problem::new(404, codes::RIG_NOT_FOUND, "No such rig", format!("{self}.")),
            Self::Store(_) => Problem::new(
                503,
                codes::STORE_UNAVAILABLE,
                "The store is out of reach",
                "The store failed while the fit was checked.",
            ),
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
    plan(&store.all_runs(&rig.id).await?, request, channels)
}

fn plan(all: &[Run], request: &FitRequest, channels: FitChannels) -> Result<FitPlan, FitProblem> {
    let noise = Some(RunKind::Noise);
    let select = |selection: Option<&RunSelection>, pointer| {
        let found = selected(all, selection, noise, Split::Training, pointer)?;
        if found.is_empty() { Err(FitProblem::NoRuns { pointer }) } else { Ok(found) }
    };
    let frf_runs = request.frf.runs.as_ref();
    // A model that is an FRF and nothing else is fitted on the runs of its FRF part.
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
    let FitChannels { inputs, outputs } = channels;
    let plan = FitPlan { request, inputs, outputs, training, frf, validation };
    plan.long_enough()?;
    Ok(plan)
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

/// Validation runs. What nobody asked for by name gives way to training; without any, the caller
/// holds out a part of each training run.
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
    // The contract's default may be spelled out.
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

/// Refuses channels that are constant in every run: nothing can be fitted from or to them.
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

    /// Refuses runs that leave no window, no segment or nothing to validate on.
    fn long_enough(&self) -> Result<(), FitProblem> {
        let refuse =
            |pointer: &str, limit: String| Err(FitProblem::TooShort(vec![FieldError::new(pointer, limit)]));
        let lineage = self.lineage();
        if lineage.validation.is_empty() {
            return refuse("/runs", "a run of at least 10 samples, a tenth of which is held out".into());
        }
        let request = &self.request;
        if request.kind != ModelKind::Lstm
            && let Some(segment_len) = request.frf.segment_len
        {
            let used = if self.frf.is_some() { &lineage.frf } else { &lineage.training };
            let longest = used.iter().map(|span| span.to_sample).max().unwrap_or(0);
            if longest < segment_len as u64 {
                return refuse(
                    "/frf/segment_len",
                    format!("at most {longest}, the samples of the longest run"),
                );
            }
        }
        if request.kind != ModelKind::Frf
            && let Ok(lstm) = request.lstm.resolve(request.preset, request.kind, &[])
            && let Some(shortest) = lineage.training.iter().min_by_key(|span| span.to_sample)
            && shortest.to_sample < lstm.window_len as u64
        {
            let Span { run, to_sample, .. } = shortest;
            let limit = format!("at most {to_sample}, the samples that run {run} gives to training");
            return refuse("/lstm/window_len", limit);
        }
        Ok(())
    }

    /// Sample of a training run from which on it is held out for validation; its length when there
    /// are validation runs.
    pub(super) fn training_until(&self, run: &Run) -> u64 {
        if self.validation.is_empty() {
            // A run that was accepted fits into memory, and so does its length into a usize.
            usize::try_from(run.samples).map_or(run.samples, |samples| hold_out_from(samples) as u64)
        } else {
            run.samples
        }
    }

    /// Sample at which an FRF run ends: where it is held out, if it is trained on too.
    pub(super) fn frf_until(&self, run: &Run) -> u64 {
        let trained = self.training.iter().any(|trained| trained.sha256 == run.sha256);
        if trained { self.training_until(run) } else { run.samples }
    }

    /// The spans of data that will shape the model.
    pub fn lineage(&self) -> Lineage {
        let span = |run: &Run, from_sample, to_sample| Span {
            run: run.id,
            sha256: run.sha256.clone(),
            from_sample,
            to_sample,
        };
        let held_out = self.training.iter().map(|run| span(run, self.training_until(run), run.samples));
        let validation = self.validation.iter().map(|run| span(run, 0, run.samples));
        Lineage {
            training: self.training.iter().map(|run| span(run, 0, self.training_until(run))).collect(),
            frf: self.frf.iter().flatten().map(|run| span(run, 0, self.frf_until(run))).collect(),
            validation: validation.chain(held_out).filter(|span| span.from_sample < span.to_sample).collect(),
            diagnoses: Vec::new(),
        }
    }
}

#[cfg(test)]
pub(super) mod testing;
#[cfg(test)]
mod tests;
