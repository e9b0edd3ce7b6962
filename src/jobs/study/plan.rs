//! The plan of a study, resolved without loading a sample: its fit, and the data that may choose.

use crate::domain::fits::{FitRequest, RunSelection};
use crate::domain::study::{LearningCurve, LinearStudy, Search, StudyKind};
use crate::domain::{FieldError, Model, ModelRef, Rig, StudyRequest};
use crate::engine::model::{FitSplit, ModelKind};
use crate::engine::study::TrialSettings;
use crate::storage::Store;

use super::StudyProblem;
use crate::jobs::fit::{self, FitPlan};

/// A study with everything resolved.
#[derive(Debug, Clone)]
pub(in crate::jobs) struct StudyPlan {
    /// The request with the fit's channels and runs filled in, as the study stores it.
    pub request: StudyRequest,
    pub task: Task,
}

/// What a study does.
#[derive(Debug, Clone)]
pub(in crate::jobs) enum Task {
    Search(Box<SearchTask>),
    /// With its fit.
    LearningCurve(LearningCurve, Box<FitPlan>),
    /// With the model whose FRF makes the files.
    Linear(Box<LinearStudy>, Box<Model>),
}

/// A search, and its fits.
#[derive(Debug, Clone)]
pub(in crate::jobs) struct SearchTask {
    pub search: Search,
    /// The fit of the best trial.
    pub fit: FitPlan,
    /// The fit of each trial: without whole runs that compare models.
    pub trial: FitPlan,
}

/// Resolves a request against the rig and its runs, without loading a sample.
///
/// # Errors
/// See [`StudyProblem`].
pub(in crate::jobs) async fn check(
    store: &Store,
    rig: &Rig,
    request: &StudyRequest,
) -> Result<StudyPlan, StudyProblem> {
    let (task, fit) = match request.kind {
        StudyKind::LinearStudy => return linear_study(store, rig, request).await,
        StudyKind::Search => {
            let search = request.search().map_err(StudyProblem::Invalid)?;
            let task = search_task(store, rig, request, search).await?;
            let fit = task.fit.request.clone();
            (Task::Search(Box::new(task)), fit)
        }
        StudyKind::LearningCurve => {
            let curve = request.learning_curve().map_err(StudyProblem::Invalid)?;
            let fit = fit::check(store, rig, &request.fit()).await?;
            let resolved = fit.request.clone();
            (Task::LearningCurve(curve, Box::new(fit)), resolved)
        }
    };
    Ok(StudyPlan { request: StudyRequest { fit: Some(fit), ..request.clone() }, task })
}

async fn linear_study(store: &Store, rig: &Rig, request: &StudyRequest) -> Result<StudyPlan, StudyProblem> {
    let version = match request.model.unwrap_or_default() {
        ModelRef::Version(version) => version,
        ModelRef::Active => {
            let active = store.active_model(&rig.id).await?.ok_or(StudyProblem::RigGone)?;
            active.version.ok_or(StudyProblem::NoneActive)?
        }
    };
    let model = store.model(&rig.id, version).await?.ok_or(StudyProblem::NoModel(version))?;
    if model.parts == ModelKind::Lstm {
        return Err(StudyProblem::NoFrf(version));
    }
    let channels = model.inputs.len() + model.outputs.len();
    let study = request.linear_study(channels, model.sample_rate_hz).map_err(StudyProblem::Invalid)?;
    let request = StudyRequest { model: Some(ModelRef::Version(version)), ..request.clone() };
    Ok(StudyPlan { request, task: Task::Linear(Box::new(study), Box::new(model)) })
}

async fn search_task(
    store: &Store,
    rig: &Rig,
    request: &StudyRequest,
    search: Search,
) -> Result<SearchTask, StudyProblem> {
    let kinds = search.space.kinds_or(request.fit().kind);
    if kinds.iter().all(|kind| *kind == ModelKind::Frf) {
        let limit = "a kind with a network: the settings that vary are those of one";
        let pointer = if search.space.kinds.is_some() { "/space/kinds" } else { "/fit/kind" };
        return Err(StudyProblem::Invalid(vec![FieldError::new(pointer, limit)]));
    }
    let fit = fit::check(store, rig, &request.fit()).await?;
    let trial = fit::check(store, rig, &without_comparison(&fit)).await?;
    // Every kind with every window, so that no trial of them is refused later.
    let windows: Vec<Option<usize>> = match &search.space.window_len {
        Some(windows) => windows.iter().copied().map(Some).collect(),
        None => vec![None],
    };
    for kind in kinds {
        for window_len in &windows {
            let mut one = TrialSettings { kind, ..base(&trial.request) };
            one.lstm.window_len = window_len.or(one.lstm.window_len);
            if search.space.hop.is_some() {
                one.lstm.hop = None;
            }
            fit::check(store, rig, &with(&trial.request, &one)).await?;
        }
    }
    Ok(SearchTask { search, fit, trial })
}

/// The fit's request on the runs that do not compare models as a whole.
fn without_comparison(plan: &FitPlan) -> FitRequest {
    let mut request = plan.request.clone();
    if let FitSplit::LeftOut { comparison, .. } = &plan.split {
        let kept = plan.training.iter().enumerate().filter(|(place, _)| !comparison.contains(place));
        request.runs = Some(RunSelection::Ids(kept.map(|(_, run)| run.id).collect()));
    }
    request
}

/// What a trial varies, as the fit has it.
pub(super) fn base(request: &FitRequest) -> TrialSettings {
    TrialSettings { kind: request.kind, lstm: request.lstm.clone() }
}

/// The request with the settings of a trial.
pub(super) fn with(request: &FitRequest, settings: &TrialSettings) -> FitRequest {
    FitRequest { kind: settings.kind, lstm: settings.lstm.clone(), ..request.clone() }
}
