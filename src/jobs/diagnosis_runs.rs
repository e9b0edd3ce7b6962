//! Which runs a diagnosis means: by id, or all that match.

use std::collections::HashMap;

use crate::domain::fits::RunFilter;
use crate::domain::{FieldError, Run, RunId, RunKind, Split};

use super::diagnosis_problem::DiagnosisProblem;

/// Most runs that a list may name.
const MAX_RUNS: usize = 10_000;

/// Runs by id, in the order of the ids.
///
/// # Errors
/// An empty list, ids of no run of the rig.
pub(super) fn by_id(all: &[Run], ids: &[RunId], pointer: &str) -> Result<Vec<Run>, DiagnosisProblem> {
    if ids.is_empty() || ids.len() > MAX_RUNS {
        let limit = format!("1 to {MAX_RUNS} runs");
        return Err(DiagnosisProblem::Invalid(vec![FieldError::new(pointer, limit)]));
    }
    let rows: HashMap<RunId, &Run> = all.iter().map(|run| (run.id, run)).collect();
    let mut errors = Vec::new();
    let mut runs = Vec::with_capacity(ids.len());
    for (i, id) in ids.iter().enumerate() {
        match rows.get(id) {
            Some(run) => runs.push((*run).clone()),
            None => {
                errors.push(FieldError::new(format!("{pointer}/{i}"), format!("a run of the rig, not {id}")));
            }
        }
    }
    if errors.is_empty() { Ok(runs) } else { Err(DiagnosisProblem::Invalid(errors)) }
}

/// Runs that match, each measurement once, by id; what is left open is as in a fit: noise of the
/// training split.
///
/// # Errors
/// Kinds and splits that do not exist.
pub(super) fn matching(all: &[Run], filter: &RunFilter, pointer: &str) -> Result<Vec<Run>, DiagnosisProblem> {
    let mut errors = Vec::new();
    for (i, kind) in filter.kinds.iter().flatten().enumerate() {
        if !RunKind::ALL.iter().any(|known| known.as_str() == kind) {
            let limit = "noise, service, sine, sweep or other";
            errors.push(FieldError::new(format!("{pointer}/kinds/{i}"), limit));
        }
    }
    let split = filter.split.as_deref().unwrap_or(Split::Training.as_str());
    if !Split::ALL.iter().any(|known| known.as_str() == split) {
        errors.push(FieldError::new(format!("{pointer}/split"), "training, validation or test"));
    }
    if !errors.is_empty() {
        return Err(DiagnosisProblem::Invalid(errors));
    }
    let kind_fits = |run: &Run| match &filter.kinds {
        Some(kinds) => kinds.is_empty() || kinds.iter().any(|kind| kind == run.kind.as_str()),
        None => run.kind == RunKind::Noise,
    };
    Ok(all
        .iter()
        .filter(|run| run.duplicate_of.is_none() && run.split.as_str() == split && kind_fits(run))
        .filter(|run| filter.tags.iter().all(|tag| run.tags.contains(tag)))
        .cloned()
        .collect())
}
