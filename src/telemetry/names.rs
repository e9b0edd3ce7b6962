//! Names of the metrics, in one table for those who write them, those who read them and the README.
//!
//! Labels are words of ours, never a client's, but for rig ids, of which there is a bounded number:
//! so the number of series is bounded too.

/// What a metric is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Kind {
    /// Rises.
    Counter,
    /// Rises and falls.
    Gauge,
    /// Times, in buckets.
    Histogram,
}

/// Defines the constants and the table of all of them in one go, so that neither lacks one.
macro_rules! metrics {
    ($($constant:ident = $kind:ident $name:literal, $help:literal;)*) => {
        $(
            #[doc = $help]
            pub const $constant: &str = $name;
        )*

        /// All metrics: kind, name, what it tells.
        pub const ALL: &[(Kind, &str, &str)] = &[$((Kind::$kind, $name, $help)),*];
    };
}

metrics! {
    REQUESTS = Counter "rigcast_http_requests_total", "Answers, by route, method and status.";
    REQUEST_SECONDS = Histogram "rigcast_http_request_duration_seconds",
        "Time until the head of the answer, by route and method.";
    CONNECTIONS = Gauge "rigcast_connections", "Connections that are open.";
    CONNECTIONS_REFUSED = Counter "rigcast_connections_refused_total",
        "Connections beyond the limits, by limit: all or address.";
    CONNECTIONS_ENDED = Counter "rigcast_connections_timed_out_total",
        "Connections of clients that were too slow, by what they were slow in: head, body, answer or idle.";
    QUEUE_DEPTH = Gauge "rigcast_queue_depth", "Tasks that wait for a turn, by class.";
    QUEUE_SECONDS = Histogram "rigcast_queue_wait_seconds", "Time that tasks waited for a turn, by class.";
    TURNS = Gauge "rigcast_turns_in_use", "Turns under way, by class.";
    SHED = Counter "rigcast_shed_total",
        "Tasks that got no turn, by class and reason: share, full or late.";
    PREDICTIONS = Counter "rigcast_predictions_total", "Predictions answered, by kind of model.";
    PREDICTED_SAMPLES = Counter "rigcast_predicted_samples_total", "Samples predicted, all outputs together.";
    PREDICTION_SECONDS = Histogram "rigcast_prediction_duration_seconds",
        "Time that a prediction took to compute, by kind of model.";
    STAGE_SECONDS = Histogram "rigcast_prediction_stage_seconds",
        "Time of a prediction's stages: receive, load, wait, parse, simulate, report.";
    DEADLINES = Counter "rigcast_predict_deadlines_total", "Work for an answer that was given up at its deadline.";
    JOBS = Gauge "rigcast_jobs", "Jobs in the store, by state.";
    ATTEMPTS = Counter "rigcast_job_attempts_total",
        "Attempts of jobs that ended, by kind and outcome: succeeded, failed, retry, cancelled, released, lost.";
    LEASES_LOST = Counter "rigcast_job_leases_lost_total",
        "Leases that ended without a heartbeat, or were found to be another worker's.";
    FIT_SECONDS = Histogram "rigcast_fit_duration_seconds", "Time that a fit ran, by how it ended.";
    PARSE_ERRORS = Counter "rigcast_parse_errors_total", "Files that could not be read, by format and reason.";
    STORE_ERRORS = Counter "rigcast_store_errors_total",
        "Failures of the store, by kind: full, unavailable, damaged or defect.";
    MODEL_LOADS = Counter "rigcast_model_loads_total", "Models read from the store into memory.";
    LOADED_MODELS = Gauge "rigcast_loaded_models", "Models in memory.";
    DEGRADED = Gauge "rigcast_degraded", "Models, runs and diagnoses that could not be read when last wanted.";
    VALIDATION_ERROR = Gauge "rigcast_validation_error",
        "Mean over outputs of the relative RMS error of the newest fitted model on validation data, by rig.";
    PANICS = Counter "rigcast_panics_total", "Panics in this process, those that became an answer included.";
    BUILD_INFO = Gauge "rigcast_build_info", "1, with the version of the program as label.";
}
