//! Names of the metrics, in one table for the code, the exporter and docs/operations.md.
//!
//! Labels are fixed words, apart from rig ids, whose number is bounded. The number of series is therefore
//! bounded too.

/// Type of a metric.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Kind {
    /// Only rises.
    Counter,
    /// Rises and falls.
    Gauge,
    /// Times in buckets.
    Histogram,
}

/// Defines the constants and the table of all of them at once, so that both are complete.
macro_rules! metrics {
    ($($constant:ident = $kind:ident $name:literal, $help:literal;)*) => {
        $(
            #[doc = $help]
            pub const $constant: &str = $name;
        )*

        /// All metrics: type, name, description.
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
    ABANDONED = Counter "rigcast_predict_abandoned_total",
        "Work for an answer that was given up, or not begun, because its client had gone.";
    JOBS = Gauge "rigcast_jobs", "Jobs in the store, by state.";
    ATTEMPTS = Counter "rigcast_job_attempts_total",
        "Attempts of jobs that ended, by kind and outcome: succeeded, failed, retry, cancelled, released, lost.";
    LEASES_LOST = Counter "rigcast_job_leases_lost_total",
        "Leases that ended without a heartbeat, or were found to be another worker's.";
    FIT_SECONDS = Histogram "rigcast_fit_duration_seconds", "Time that a fit ran, by how it ended.";
    PARSE_ERRORS = Counter "rigcast_parse_errors_total", "Files that could not be read, by format and reason.";
    STORE_ERRORS = Counter "rigcast_store_errors_total",
        "Failures of the store, by kind: full, unavailable, damaged or defect.";
    ROWS_MENDED = Counter "rigcast_rows_mended_total",
        "Rows of the registry that were not as they were written, and were mended from the journal.";
    CLOCK_OFFSET = Gauge "rigcast_clock_offset_seconds",
        "Clock of this machine minus that of the registry's database; 0 where the registry is not shared.";
    MODEL_LOADS = Counter "rigcast_model_loads_total", "Models read from the store into memory.";
    LOADED_MODELS = Gauge "rigcast_loaded_models", "Models in memory.";
    DEGRADED = Gauge "rigcast_degraded", "Models, runs and diagnoses that could not be read when last wanted.";
    VALIDATION_ERROR = Gauge "rigcast_validation_error",
        "Mean over outputs of the relative RMS error of the active model on its validation data, by rig.";
    MODEL_ERROR_RATIO = Gauge "rigcast_model_error_ratio",
        "Largest error over its control limit of the newest run that the active model was held against, by rig.";
    DATA_BYTES = Gauge "rigcast_data_bytes",
        "Size of the data directory, by part: database, objects or scratch.";
    DATA_FREE_BYTES = Gauge "rigcast_data_free_bytes",
        "Free space for this user on the file system of the data directory.";
    PANICS = Counter "rigcast_panics_total", "Panics in this process, those that became an answer included.";
    BUILD_INFO = Gauge "rigcast_build_info", "1, with the version of the program as label.";
    PROCESS_CPU = Counter "process_cpu_seconds_total", "Processor time of this process, its threads together.";
    PROCESS_RESIDENT = Gauge "process_resident_memory_bytes", "Memory of this process that is in RAM.";
    PROCESS_VIRTUAL = Gauge "process_virtual_memory_bytes", "Address space of this process.";
    PROCESS_OPEN_FDS = Gauge "process_open_fds", "File handles that are open.";
    PROCESS_MAX_FDS = Gauge "process_max_fds", "Limit of open file handles.";
    PROCESS_START = Gauge "process_start_time_seconds", "Start of this process, seconds since 1970.";
}

/// Whether a metric is written into the answer each time instead of being kept: its series come and go, or the
/// system keeps it.
pub fn by_hand(name: &str) -> bool {
    [VALIDATION_ERROR, MODEL_ERROR_RATIO].contains(&name) || name.starts_with("process_")
}

/// Values of the label `limit` of [`CONNECTIONS_REFUSED`].
pub const LIMITS: [&str; 2] = ["all", "address"];
/// Values of the label `slow_in` of [`CONNECTIONS_ENDED`].
pub const SLOW_IN: [&str; 4] = ["head", "body", "answer", "idle"];
/// Values of the label `reason` of [`SHED`].
pub const SHED_REASONS: [&str; 3] = ["share", "full", "late"];
/// Values of the label `stage` of [`STAGE_SECONDS`].
pub const STAGES: [&str; 6] = ["receive", "load", "wait", "parse", "simulate", "report"];
/// Values of the label `outcome` of [`ATTEMPTS`] and [`FIT_SECONDS`].
pub const OUTCOMES: [&str; 6] = ["succeeded", "failed", "retry", "cancelled", "released", "lost"];
/// Values of the label `kind` of [`STORE_ERRORS`].
pub const STORE_FAILURES: [&str; 4] = ["full", "unavailable", "damaged", "defect"];
