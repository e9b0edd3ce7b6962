//! The runs of a diagnosis: those to explain, those of the core, simulated ones; by id or by a
//! selection.

use std::collections::HashMap;

use crate::domain::diagnosis::{DiagnosisRuns, RunRoles};
use crate::domain::fits::{RunFilter, RunSelection};
use crate::domain::{DiagnosisRequest, FieldError, Lineage, Model, Run, RunId, RunKind, Split};
use crate::engine::diagnosis::Role;

use super::super::selection;
use super::plan::invalid;
use super::problem::DiagnosisProblem;

/// Largest number of runs in a list.
const MAX_RUNS: usize = 10_000;

/// A segment of a run that the linear core is fitted to.
#[derive(Debug, Clone, PartialEq)]
pub(in crate::jobs) struct Baseline {
    pub run: Run,
    pub from_sample: u64,
    pub to_sample: u64,
}

/// Runs to explain with their roles, each measurement once.
pub(super) fn runs(
    all: &[Run],
    asked: &DiagnosisRuns,
) -> Result<(Vec<Run>, Option<Vec<Role>>), DiagnosisProblem> {
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

/// Refuses a measurement that comes twice, by its id or as a copy of its bytes: data that were fitted to
/// must not test the fit, and a copy tells nothing about noise.
fn once(runs: &[Run], places: &[&str], lens: &[usize]) -> Result<(), DiagnosisProblem> {
    let pointers =
        places.iter().zip(lens).flat_map(|(place, n)| (0..*n).map(move |i| format!("{place}/{i}")));
    let errors = selection::repeated(runs, pointers);
    if errors.is_empty() { Ok(()) } else { Err(DiagnosisProblem::Invalid(errors)) }
}

/// Runs of the linear core: those of the request, else those of the model's FRF, else those of the
/// model's fit.
pub(super) fn baseline(
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

/// For each run the run with its simulated responses.
pub(super) fn simulated(
    all: &[Run],
    request: &DiagnosisRequest,
    runs: &[Run],
) -> Result<Vec<Run>, DiagnosisProblem> {
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

/// Runs by id, in the order of the ids.
///
/// # Errors
/// An empty list, ids of no run of the rig.
fn by_id(all: &[Run], ids: &[RunId], pointer: &str) -> Result<Vec<Run>, DiagnosisProblem> {
    if ids.is_empty() || ids.len() > MAX_RUNS {
        let limit = format!("1 to {MAX_RUNS} runs");
        return Err(DiagnosisProblem::Invalid(vec![FieldError::new(pointer, limit)]));
    }
    selection::by_id(all, ids, pointer).map_err(DiagnosisProblem::Invalid)
}

/// Runs that match, each measurement once, by id; defaults as in a fit: noise of the training split.
///
/// # Errors
/// Kinds and splits that do not exist.
fn matching(all: &[Run], filter: &RunFilter, pointer: &str) -> Result<Vec<Run>, DiagnosisProblem> {
    let errors = selection::unknown_words(filter, pointer);
    if !errors.is_empty() {
        return Err(DiagnosisProblem::Invalid(errors));
    }
    Ok(selection::matching(all, filter, Some(RunKind::Noise), Split::Training))
}
