//! Runs by the names that their lab gave them instead of their ids.

use std::collections::BTreeMap;

use crate::engine::diagnosis::{Report, Views};

/// Replaces ids of runs by `names`; an id without a name stays.
pub fn name_runs(report: &mut Report, views: &mut Views, names: &BTreeMap<String, String>) {
    let rename = |run: &mut String| {
        if let Some(name) = names.get(run) {
            run.clone_from(name);
        }
    };
    report.location.segments.iter_mut().for_each(|s| rename(&mut s.run));
    for hypothesis in &mut report.hypotheses {
        hypothesis.held_out.runs.iter_mut().for_each(rename);
        hypothesis.responses.iter_mut().flat_map(|r| &mut r.held_out.runs).for_each(rename);
        hypothesis.transfer.iter_mut().flat_map(|row| &mut row.runs).for_each(rename);
    }
    let split = &mut report.data_split;
    let parts = split.fit.iter_mut().chain(&mut split.select).chain(&mut split.test);
    parts.for_each(|part| rename(&mut part.run));
    if let Some(unseen) = &mut views.unseen {
        rename(&mut unseen.run);
    }
}
