//! Durations of the stages of a prediction, for the metrics.

use std::time::Instant;

use crate::telemetry::names;

/// The present stage of a prediction and its start.
#[derive(Debug)]
pub struct Stages {
    since: Instant,
}

impl Stages {
    /// Starts the first stage.
    pub fn begin() -> Self {
        Self { since: Instant::now() }
    }

    /// Ends a stage and starts the next.
    pub fn end(&mut self, stage: &'static str) {
        debug_assert!(names::STAGES.contains(&stage), "{stage} is not in the table");
        let now = Instant::now();
        let took = now.duration_since(self.since);
        metrics::histogram!(names::STAGE_SECONDS, "stage" => stage).record(took.as_secs_f64());
        self.since = now;
    }
}
