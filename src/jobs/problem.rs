//! Why a job did not succeed: the problem that its row stores, and whether to try again.

use serde::{Deserialize, Serialize};

use super::fit::FitProblem;
use super::{DiagnosisProblem, EvaluationProblem, IterationProblem, StudyProblem};
use crate::compute::ComputeError;
use crate::domain::{FieldError, FitChannels, Problem};
use crate::engine::{EngineError, rounded};
use crate::storage::StoreError;

/// Codes of jobs. Those of engine errors are the same as for requests.
pub mod codes {
    /// The fit's channels, runs or settings do not suit the rig (422).
    pub const FIT_INVALID: &str = "fit.invalid";
    /// A selected run lacks a channel (422).
    pub const FIT_MISSING_CHANNEL: &str = "fit.missing_channel";
    /// A run of the test split was named (422).
    pub const FIT_TEST_RUN: &str = "fit.test_run";
    /// The fit takes more memory than there is (422).
    pub const FIT_MEMORY: &str = "fit.memory";
    /// No run matches a selection (409).
    pub const FIT_NO_RUNS: &str = "fit.no_runs";
    /// The iteration's model, channels, runs or settings do not suit the rig or each other (422).
    pub const ITERATION_INVALID: &str = "iteration.invalid";
    /// The evaluation's models, runs or settings do not suit the rig or each other (422).
    pub const EVALUATION_INVALID: &str = "evaluation.invalid";
    /// No run of an evaluation has the channels of a model (422).
    pub const EVALUATION_NO_COMMON_CHANNELS: &str = "evaluation.no_common_channels";
    /// No run of an evaluation is in a class (422).
    pub const EVALUATION_EMPTY_CLASS: &str = "evaluation.empty_class";
    /// No run matches a selection of an evaluation (409).
    pub const EVALUATION_NO_RUNS: &str = "evaluation.no_runs";
    /// Fields of a study leave their limits or do not go together (422).
    pub const STUDY_INVALID: &str = "study.invalid";
    /// No trial of a study came to an end (422).
    pub const STUDY_NO_TRIAL: &str = "study.no_trial";
    /// The diagnosis' channels, runs or settings do not suit the rig or each other (422).
    pub const DIAGNOSIS_INVALID: &str = "diagnosis.invalid";
    /// A run lacks a channel of the diagnosis (422).
    pub const DIAGNOSIS_MISSING_CHANNEL: &str = "diagnosis.missing_channel";
    /// Runs too short for the linear core or for scores (422).
    pub const DIAGNOSIS_TOO_SHORT: &str = "diagnosis.too_short";
    /// No run matches a selection of a diagnosis (409).
    pub const DIAGNOSIS_NO_RUNS: &str = "diagnosis.no_runs";
    /// The rig has no active model (409).
    pub const MODEL_NONE_ACTIVE: &str = "model.none_active";
    /// The rig has no such model version (404).
    pub const MODEL_NOT_FOUND: &str = "model.not_found";
    /// The model has no FRF (409).
    pub const MODEL_NO_FRF: &str = "model.no_frf";
    /// The weights of a model cannot be read (500).
    pub const MODEL_DAMAGED: &str = "model.damaged";
    /// The rig was deleted (404).
    pub const RIG_NOT_FOUND: &str = "rig.not_found";
    /// The fit's model cannot be activated (422).
    pub const MODEL_NOT_FORWARD: &str = "model.not_forward";
    /// So many jobs of the token wait that it may have no more (429).
    pub const JOB_TOO_MANY_WAITING: &str = "job.too_many_waiting";
    /// A panic ended the job (500).
    pub const JOB_PANICKED: &str = "job.panicked";
    /// The job's worker died too often (500).
    pub const JOB_INTERRUPTED: &str = "job.interrupted";
    /// The worker process died under the job (500).
    pub const JOB_CRASHED: &str = "job.crashed";
    /// The job took more memory than it may (500).
    pub const JOB_MEMORY: &str = "job.memory";
    /// An attempt took longer than it may (500).
    pub const JOB_TIME_LIMIT: &str = "job.time_limit";
    /// This version of the program does not know the job's kind or request (500).
    pub const JOB_UNKNOWN: &str = "job.unknown";
    /// Stored data are damaged (500).
    pub const STORE_DAMAGED: &str = "store.damaged";
    /// The store is out of reach (503).
    pub const STORE_UNAVAILABLE: &str = "store.unavailable";
    /// The system gave no threads or processes for the job (503).
    pub const BUSY: &str = "busy";
    /// The disk is full (507).
    pub const STORE_FULL: &str = "store.full";
}

/// Why a job that was asked for does not wait for its turn.
pub(super) enum NotQueued {
    /// The rig was deleted.
    RigGone,
    /// So many jobs of the token wait that it may have no more.
    TooManyWaiting(u64),
}

macro_rules! of_not_queued {
    ($($problem:ty),*) => {
        $(impl From<NotQueued> for $problem {
            fn from(why: NotQueued) -> Self {
                match why {
                    NotQueued::RigGone => Self::RigGone,
                    NotQueued::TooManyWaiting(most) => Self::TooManyWaiting(most),
                }
            }
        })*
    };
}

of_not_queued!(FitProblem, DiagnosisProblem, StudyProblem, IterationProblem, EvaluationProblem);

/// How a job's work ended without a result.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub(super) enum JobError {
    /// It was asked to stop.
    Stopped,
    /// Trying again would end the same way.
    Failed(Box<Problem>),
    /// Another attempt may succeed.
    Retry(Box<Problem>),
}

impl JobError {
    pub(super) fn failed(problem: Problem) -> Self {
        Self::Failed(Box::new(problem))
    }

    pub(super) fn retry(problem: Problem) -> Self {
        Self::Retry(Box::new(problem))
    }
}

impl From<StoreError> for JobError {
    fn from(error: StoreError) -> Self {
        tracing::error!(%error, "the store failed a job");
        // Messages of the store name paths and rows, so they go to the log only.
        match error {
            StoreError::ObjectMissing { .. } | StoreError::ObjectDamaged { .. } | StoreError::Row { .. } => {
                let detail = "Data that the job needs are damaged and were not used.";
                Self::failed(Problem::new(500, codes::STORE_DAMAGED, "Stored data are damaged", detail))
            }
            error if error.is_disk_full() => {
                let detail = "The disk is full; the job's result could not be stored.";
                Self::retry(Problem::new(507, codes::STORE_FULL, "The disk is full", detail))
            }
            _ => {
                let detail = "The store failed while the job was running.";
                Self::retry(Problem::new(503, codes::STORE_UNAVAILABLE, "The store is out of reach", detail))
            }
        }
    }
}

impl From<ComputeError> for JobError {
    fn from(error: ComputeError) -> Self {
        match error {
            ComputeError::Panicked(message) => panicked(&message),
            ComputeError::Busy(_) | ComputeError::Threads(_) => {
                tracing::error!(%error, "a job got no threads");
                Self::retry(Problem::new(503, codes::BUSY, "Busy", "There were no threads for the job."))
            }
        }
    }
}

/// A panic: the log has its message, the row only its code.
pub(super) fn panicked(message: &str) -> JobError {
    tracing::error!(panic = message, "a job panicked: this is a bug");
    let detail = "A defect of the program ended the job; the log has the details.";
    JobError::failed(Problem::new(500, codes::JOB_PANICKED, "A defect ended the job", detail))
}

/// The refusal of a job because `most` jobs of its token wait already.
pub(super) fn too_many_waiting(most: u64) -> Problem {
    let detail = format!("{most} jobs of this token wait already; ask again when some of them have started.");
    Problem::new(429, codes::JOB_TOO_MANY_WAITING, "Too many jobs of the token wait", detail)
        .with(vec![FieldError::new("", format!("at most {most} waiting jobs of one token"))])
}

/// The refusal of a job because the rig has no active model.
pub(super) fn none_active(detail: String) -> Problem {
    Problem::new(409, codes::MODEL_NONE_ACTIVE, "The rig has no active model", detail).with(a_version())
}

/// The refusal of a job because the rig has no such model version.
pub(super) fn no_model(detail: String) -> Problem {
    Problem::new(404, codes::MODEL_NOT_FOUND, "No such model version", detail).with(a_version())
}

fn a_version() -> Vec<FieldError> {
    vec![FieldError::new("/model", "a version of the rig")]
}

/// The refusal of a job whose rig is gone.
pub(super) fn rig_gone(detail: String) -> Problem {
    Problem::new(404, codes::RIG_NOT_FOUND, "No such rig", detail)
}

/// The refusal of a job (`what`, as `the fit`) because the store failed.
pub(super) fn store_failed(what: &str) -> Problem {
    let detail = format!("The store failed while {what} was checked.");
    Problem::new(503, codes::STORE_UNAVAILABLE, "The store is out of reach", detail)
}

/// The problem of a version whose weights are damaged or lack a part.
pub(super) fn unreadable(version: u32, why: &dyn std::fmt::Display) -> JobError {
    tracing::error!(model.version = version, error = %why, "a stored model cannot be read");
    let detail = format!("The stored weights of version {version} cannot be used: {why}.");
    JobError::failed(Problem::new(500, codes::MODEL_DAMAGED, "The stored model cannot be read", detail))
}

/// A place and its limit, in words.
pub(super) fn sentence(error: &FieldError) -> String {
    let place = match &error.channel {
        Some(channel) => format!("{} (channel {channel:?})", error.pointer),
        None => error.pointer.clone(),
    };
    format!("{place}: {}", error.limit.as_deref().unwrap_or("not valid"))
}

/// The field of a setting outside its limits.
pub(super) fn of_setting(error: &EngineError) -> FieldError {
    match error {
        EngineError::Setting { setting, found, limit } => {
            FieldError::new(format!("/{}", setting.replace('.', "/")), format!("{limit}; found {found}"))
        }
        other => FieldError::new("", other.to_string()),
    }
}

/// An engine error about a fit, with channel names in place of numbers.
pub(super) fn of_engine(error: &EngineError, channels: &FitChannels) -> JobError {
    if *error == EngineError::Cancelled {
        return JobError::Stopped;
    }
    let (code, title, place) = describe(error, channels);
    let detail = match &place.channel {
        Some(channel) => format!("{error} (channel {channel:?})."),
        None => format!("{error}."),
    };
    JobError::failed(Problem::new(422, code, title, detail).with(vec![place]))
}

/// Code, title and place, as for a request with the same error.
fn describe(error: &EngineError, channels: &FitChannels) -> (&'static str, &'static str, FieldError) {
    let on = |what: &str, index: usize| {
        let outputs = what.contains("output") || what.contains("response");
        let names = if outputs { &channels.outputs } else { &channels.inputs };
        let pointer = if outputs { "/outputs" } else { "/inputs" };
        let place = FieldError { pointer: pointer.into(), ..FieldError::default() };
        place.on_channel(names.get(index).cloned().unwrap_or_else(|| index.to_string()))
    };
    let runs = |limit: String| FieldError::new("/runs", limit);
    match error {
        EngineError::UnequalLength { what, channel, expected, .. } => (
            "signal.unequal_lengths",
            "Channels differ in length",
            FieldError { limit: Some(format!("{expected} samples")), ..on(what, *channel) },
        ),
        EngineError::ChannelCount { expected, .. } => {
            ("signal.channel_count", "Another number of channels", runs(format!("{expected} channels")))
        }
        EngineError::NonFinite { what, channel, sample } => (
            "signal.non_finite",
            "NaN or infinity",
            FieldError { sample: Some(*sample as u64), ..on(what, *channel) },
        ),
        EngineError::SampleRate { expected_hz, .. } => {
            ("signal.sample_rate", "Another sample rate", runs(format!("{} Hz", rounded(*expected_hz, 10))))
        }
        EngineError::TooShort { needed, .. } => {
            ("signal.too_short", "Too few samples", runs(format!("at least {needed} samples")))
        }
        EngineError::DeadChannel { what, channel } => {
            ("signal.dead_channel", "A constant channel where power is needed", on(what, *channel))
        }
        EngineError::Setting { setting, limit, .. } => (
            "setting.out_of_range",
            "A setting outside its limits",
            FieldError::new(format!("/{}", setting.replace('.', "/")), limit),
        ),
        EngineError::TooFewAverages { drives, .. } => (
            "frf.too_few_averages",
            "Too few averages",
            FieldError::new("/frf/segment_len", format!("more than {drives} averages")),
        ),
        EngineError::Diverged { .. } => (
            "training.diverged",
            "Training diverged",
            FieldError::new("/lstm/learning_rate", "a lower learning rate"),
        ),
        EngineError::NonFiniteResult { channel, sample, .. } => (
            "result.non_finite",
            "The result is not finite",
            FieldError { sample: Some(*sample as u64), ..on("output", *channel) },
        ),
        // The other errors of a fit; the message names them.
        other => ("fit.invalid", "The fit does not suit the rig", runs(other.to_string())),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn channels() -> FitChannels {
        FitChannels { inputs: vec!["u".into()], outputs: vec!["y".into(), "z".into()] }
    }

    #[test]
    fn a_channel_number_becomes_the_name_of_an_input_or_output() {
        for (what, channel, name) in [("frf inputs", 0, "u"), ("training outputs", 1, "z")] {
            let JobError::Failed(problem) =
                of_engine(&EngineError::DeadChannel { what, channel }, &channels())
            else {
                panic!("trying again would not help")
            };
            assert_eq!((problem.code.as_str(), problem.status), ("signal.dead_channel", 422));
            assert_eq!(problem.errors[0].channel.as_deref(), Some(name));
            assert!(problem.detail.contains(name), "{}", problem.detail);
        }
    }

    #[test]
    fn cancelled_work_is_no_failure() {
        assert!(matches!(of_engine(&EngineError::Cancelled, &channels()), JobError::Stopped));
    }

    #[test]
    fn the_store_is_tried_again_unless_its_data_are_damaged() {
        let damaged = StoreError::ObjectMissing { digest: "ab".into() };
        assert!(matches!(JobError::from(damaged), JobError::Failed(p) if p.code == codes::STORE_DAMAGED));
        let busy = StoreError::Database(sqlx::Error::PoolTimedOut);
        assert!(matches!(JobError::from(busy), JobError::Retry(p) if p.code == codes::STORE_UNAVAILABLE));
    }
}
