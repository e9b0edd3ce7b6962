//! Runs that are in no store, and plans over them.

use crate::domain::{FitChannels, Quality, Run, RunId, RunKind, Split};
use crate::engine::model::Task;
use crate::storage::testing::now;

use super::{FitPlan, FitProblem, plan};

/// A run of the channels `u` and `y` at 100 Hz.
pub(in crate::jobs) fn run(id: u128, kind: RunKind, split: Split, samples: u64) -> Run {
    Run {
        id: RunId::from_u128(id),
        rig: "bench".parse().unwrap(),
        name: String::new(),
        kind,
        split,
        tags: Vec::new(),
        started_at: None,
        created_at: now(),
        channels: vec!["u".into(), "y".into()],
        units: vec!["kN".into(), "mm".into()],
        samples,
        duration_s: samples as f64 / 100.0,
        sample_rate_hz: 100.0,
        sha256: format!("{id:064x}"),
        quality: Quality::default(),
        duplicate_of: None,
        object: format!("{id:064x}"),
    }
}

/// A plan from `u` to `y`.
pub(in crate::jobs) fn plan_of(runs: &[Run], request: &str) -> Result<FitPlan, FitProblem> {
    let request = serde_json::from_str(request).unwrap();
    let channels = FitChannels { inputs: vec!["u".into()], outputs: vec!["y".into()] };
    plan(runs, &request, (channels, Task::Forward), None)
}
