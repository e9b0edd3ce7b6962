//! Runs that a request names, by id or by a selection.

use std::collections::HashMap;

use crate::domain::fits::RunFilter;
use crate::domain::{FieldError, Run, RunId, RunKind, Split};

/// Runs by id, in the order of the ids.
///
/// # Errors
/// The ids that are no run of the rig, under `pointer`.
pub(super) fn by_id(all: &[Run], ids: &[RunId], pointer: &str) -> Result<Vec<Run>, Vec<FieldError>> {
    let rows: HashMap<RunId, &Run> = all.iter().map(|run| (run.id, run)).collect();
    let mut errors = Vec::new();
    let mut runs = Vec::with_capacity(ids.len());
    for (i, id) in ids.iter().enumerate() {
        match rows.get(id) {
            Some(run) => runs.push((*run).clone()),
            None => {
                errors.push(FieldError::new(format!("{pointer}/{i}"), format!("a run of the rig, not {id}")))
            }
        }
    }
    if errors.is_empty() { Ok(runs) } else { Err(errors) }
}

/// Kinds and splits of a filter that do not exist.
pub(super) fn unknown_words(filter: &RunFilter, pointer: &str) -> Vec<FieldError> {
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
    errors
}

/// The measurements that come twice, by their ids or as copies of their bytes, at `pointers`.
pub(super) fn repeated(runs: &[Run], pointers: impl Iterator<Item = String>) -> Vec<FieldError> {
    let mut seen: HashMap<&str, RunId> = HashMap::new();
    let mut errors = Vec::new();
    for (run, pointer) in runs.iter().zip(pointers) {
        if let Some(first) = seen.insert(&run.sha256, run.id) {
            let limit = format!("each measurement once: its bytes are those of run {first}");
            errors.push(FieldError::new(pointer, limit));
        }
    }
    errors
}

/// Runs that match, each measurement once; `kind` and `split` are the defaults of the filter.
pub(super) fn matching(all: &[Run], filter: &RunFilter, kind: Option<RunKind>, split: Split) -> Vec<Run> {
    let split = filter.split.as_deref().unwrap_or(split.as_str());
    let kind_fits = |run: &Run| match &filter.kinds {
        Some(kinds) => kinds.is_empty() || kinds.iter().any(|kind| kind == run.kind.as_str()),
        None => kind.is_none_or(|kind| kind == run.kind),
    };
    all.iter()
        .filter(|run| run.duplicate_of.is_none() && run.split.as_str() == split && kind_fits(run))
        .filter(|run| filter.tags.iter().all(|tag| run.tags.contains(tag)))
        .cloned()
        .collect()
}
