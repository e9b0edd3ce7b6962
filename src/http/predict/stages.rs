//! How long the stages of a prediction take, for the metrics.

use std::time::Instant;

use crate::telemetry::names;

/// Where a prediction stands.
#[derive(Debug)]
pub struct Stages {
    since: Instant,
}

impl Stages {
    /// The first stage begins.
    pub fn begin() -> Self {
        Self { since: Instant::now() }
    }

    /// A stage has ended, and the next begins.
    pub fn end(&mut self, stage: &'static str) {
        let now = Instant::now();
        let took = now.duration_since(self.since);
        metrics::histogram!(names::STAGE_SECONDS, "stage" => stage).record(took.as_secs_f64());
        self.since = now;
    }
}
