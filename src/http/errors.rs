//! Turns errors of the layers below into problems. Only this file knows both.

use super::codes;
use super::problem::{FieldError, Problem};
use crate::compute::ComputeError;
use crate::compute::fair_queue::Refused;
use crate::engine::{EngineError, rounded};
use crate::formats::FormatError;
use crate::jobs::{DiagnosisProblem, EvaluationProblem, FitProblem, IterationProblem, StudyProblem};
use crate::models::ModelError;
use crate::storage::StoreError;
use crate::telemetry::names;

/// Seconds after which a token with too many waiting jobs may ask again: about the time of a short job.
const WAITING_JOBS_S: u32 = 30;

impl From<StoreError> for Problem {
    fn from(error: StoreError) -> Self {
        error.count();
        if error.is_disk_full() {
            return Self::new(codes::STORE_FULL, "The disk is full; nothing was stored.").because(error);
        }
        match error {
            StoreError::ObjectMissing { .. } | StoreError::ObjectDamaged { .. } => {
                Self::new(codes::STORE_DAMAGED, "Stored data are damaged; they are not served.")
                    .because(error)
            }
            error if error.is_damaged_row() => {
                let detail =
                    "A row of the registry is damaged; it is not served. It is being mended: ask again.";
                Self::new(codes::STORE_ROW, detail).because(error).retry_after(1)
            }
            StoreError::Repeated => {
                let detail = "A request under the same Idempotency-Key is under way; ask again later.";
                Self::new(codes::IDEMPOTENCY_KEY_IN_USE, detail).retry_after(1)
            }
            error if error.is_unavailable() => {
                Self::new(codes::STORE_UNAVAILABLE, "The store cannot be reached; nothing was stored.")
                    .because(error)
                    .retry_after(5)
            }
            error => Self::internal(error),
        }
    }
}

impl From<ComputeError> for Problem {
    fn from(error: ComputeError) -> Self {
        match error {
            ComputeError::Busy(why) => why.into(),
            error => Self::internal(error),
        }
    }
}

impl From<Refused> for Problem {
    fn from(why: Refused) -> Self {
        match why {
            Refused::Share => Self::new(
                codes::TOKEN_BUSY,
                "The service is overloaded, and this token has or waits for more than its share; try again.",
            ),
            Refused::Full => Self::new(codes::BUSY, "Too much work is waiting already; try again."),
            Refused::Late => Self::new(codes::BUSY, "The request waited too long in the queue; try again."),
        }
        .retry_after(1)
    }
}

impl From<ModelError> for Problem {
    fn from(error: ModelError) -> Self {
        match error {
            ModelError::Store(error) => error.into(),
            ModelError::Compute(error) => error.into(),
            error @ ModelError::Weights { .. } => {
                Self::new(codes::MODEL_DAMAGED, "The stored weights cannot be read as a model.")
                    .because(error)
            }
        }
    }
}

/// Problems of the requests that a job answers.
macro_rules! of_jobs {
    ($($error:ident),*) => {
        $(impl From<$error> for Problem {
            fn from(error: $error) -> Self {
                match error {
                    $error::Store(error) => error.into(),
                    $error::TooManyWaiting(_) => Self::from(error.problem()).retry_after(WAITING_JOBS_S),
                    error => error.problem().into(),
                }
            }
        })*
    };
}

of_jobs!(FitProblem, DiagnosisProblem, StudyProblem, IterationProblem, EvaluationProblem);

/// The problem of an engine error about signals with channels `names`, sent at `pointer`.
pub fn engine(error: &EngineError, names: &[String], pointer: &str) -> Problem {
    let name = |index: usize| names.get(index).cloned().unwrap_or_else(|| index.to_string());
    let on = |index: usize| {
        FieldError { pointer: pointer.into(), ..FieldError::default() }.on_channel(name(index))
    };
    let limit = |text: String| FieldError::new(pointer, text);
    let (code, place) = match error {
        EngineError::UnequalLength { channel, expected, .. } => {
            let place = FieldError { limit: Some(format!("{expected} samples")), ..on(*channel) };
            (codes::SIGNAL_UNEQUAL_LENGTHS, place)
        }
        EngineError::ChannelCount { expected, .. } => {
            (codes::SIGNAL_CHANNEL_COUNT, limit(format!("{expected} channels")))
        }
        EngineError::NonFinite { channel, sample, .. } => {
            (codes::SIGNAL_NON_FINITE, FieldError { sample: Some(*sample as u64), ..on(*channel) })
        }
        EngineError::SampleRate { expected_hz, .. } => {
            (codes::SIGNAL_SAMPLE_RATE, limit(format!("{} Hz", rounded(*expected_hz, 10))))
        }
        EngineError::TooShort { needed, .. } => {
            (codes::SIGNAL_TOO_SHORT, limit(format!("at least {needed} samples")))
        }
        EngineError::DeadChannel { channel, .. } => (codes::SIGNAL_DEAD_CHANNEL, on(*channel)),
        EngineError::Setting { setting, limit, .. } => {
            (codes::SETTING_OUT_OF_RANGE, FieldError::new(format!("/{}", setting.replace('.', "/")), limit))
        }
        EngineError::TooFewAverages { drives, .. } => (
            codes::FRF_TOO_FEW_AVERAGES,
            FieldError::new("/frf/segment_len", format!("more than {drives} averages")),
        ),
        EngineError::TensorShape { expected, .. } => {
            (codes::WEIGHTS_SHAPE, limit(format!("shape {expected:?}")))
        }
        EngineError::Weights(_) => (codes::WEIGHTS_MALFORMED, limit("a safetensors file of a model".into())),
        EngineError::Diverged { .. } => {
            (codes::TRAINING_DIVERGED, FieldError::new("/lstm/learning_rate", "lower it"))
        }
        EngineError::NonFiniteResult { channel, sample, .. } => {
            (codes::RESULT_NON_FINITE, FieldError { sample: Some(*sample as u64), ..on(*channel) })
        }
        EngineError::DamageOverflow { channel, .. } => (codes::RESULT_NON_FINITE, on(*channel)),
        EngineError::DependentInputs { channel } => (
            codes::FRF_DEPENDENT_INPUTS,
            FieldError { limit: Some("independent inputs".into()), ..on(*channel) },
        ),
        // `OutOfRange` comes only from the virtual rig, which no request reaches.
        EngineError::Cancelled | EngineError::OutOfRange { .. } => return Problem::internal(error),
    };
    Problem::new(code, named(error, &place)).with(place)
}

/// The problem of a file that a reader refused. `names` are its columns if the file does not name them
/// itself.
pub fn format(error: &FormatError, names: &[String]) -> Problem {
    let code = codes::find(error.code()).unwrap_or(codes::RUN_INVALID);
    let named = error.channel().map(str::to_owned);
    let place = FieldError {
        pointer: error.pointer(),
        channel: named.or_else(|| names.get(error.channel_index()?).cloned()),
        sample: error.sample().map(|s| s as u64),
        row: error.row(),
        column: error.column().map(|c| c as u64),
        limit: error.limit(),
    };
    Problem::new(code, format!("{error}.")).with(place)
}

/// Counts a file that could not be read.
pub fn count_unreadable(format: &'static str, problem: &Problem) {
    let reason = problem.code().to_owned();
    metrics::counter!(names::PARSE_ERRORS, "format" => format, "reason" => reason).increment(1);
}

/// The engine's message, with the channel's name added.
fn named(error: &EngineError, place: &FieldError) -> String {
    match &place.channel {
        Some(channel) => format!("{error} (channel {channel:?})."),
        None => format!("{error}."),
    }
}

/// A sentence that names the first of several places.
pub fn summary(what: &str, errors: &[FieldError]) -> String {
    let Some(first) = errors.first() else { return format!("{what}.") };
    let place = match (&first.channel, first.pointer.as_str()) {
        (Some(channel), _) => format!("channel {channel:?}"),
        (None, "") => "the whole".to_owned(),
        (None, pointer) => pointer.to_owned(),
    };
    let more = if errors.len() > 1 { format!(" (and {} more)", errors.len() - 1) } else { String::new() };
    format!("{what}: {place}: {}{more}.", first.limit.as_deref().unwrap_or("not valid"))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::formats::ChannelAt;

    fn document(problem: &Problem) -> serde_json::Value {
        serde_json::from_slice(&problem.document("")).expect("JSON")
    }

    #[test]
    fn a_channel_index_becomes_its_name() {
        let error = EngineError::NonFinite { what: "drive", channel: 1, sample: 7 };
        let problem = document(&engine(&error, &["a".into(), "b".into()], "/drive"));
        assert_eq!(problem["code"], "signal.non_finite");
        assert_eq!(
            problem["errors"][0],
            serde_json::json!({"pointer": "/drive", "channel": "b", "sample": 7})
        );
        assert!(problem["detail"].as_str().is_some_and(|d| d.contains("\"b\"")), "{problem}");
    }

    #[test]
    fn a_setting_becomes_a_pointer_and_its_limit() {
        let error = EngineError::Setting {
            setting: "damage.slope",
            found: "-1".into(),
            limit: "above 0, at most 50".into(),
        };
        let problem = document(&engine(&error, &[], ""));
        assert_eq!(
            problem["errors"][0],
            serde_json::json!({"pointer": "/damage/slope", "limit": "above 0, at most 50"})
        );
    }

    #[test]
    fn every_code_of_the_readers_is_one_of_the_contract() {
        let source = include_str!("../formats/error.rs");
        let codes: Vec<&str> = source
            .lines()
            .filter_map(|line| line.trim().split_once("=> \"")?.1.strip_suffix("\","))
            .filter(|code| code.contains('.'))
            .collect();
        assert!(codes.len() > 20, "the readers' codes are found in their source: {codes:?}");
        for code in codes {
            assert!(codes::find(code).is_some(), "{code} is missing");
        }
    }

    #[test]
    fn every_code_of_jobs_is_one_of_the_contract() {
        let sources = [
            include_str!("../jobs/problem.rs"),
            include_str!("../jobs/fit_plan.rs"),
            include_str!("../jobs/diagnosis/mod.rs"),
            include_str!("../jobs/diagnosis/problem.rs"),
            include_str!("../jobs/iteration/mod.rs"),
            include_str!("../jobs/evaluation/mod.rs"),
            include_str!("../jobs/evaluation/problem.rs"),
            include_str!("../jobs/iteration/problem.rs"),
            include_str!("../jobs/study/problem.rs"),
            include_str!("../storage/jobs.rs"),
        ];
        let is_code = |word: &&str| {
            word.split_once('.').is_some_and(|(a, b)| {
                [a, b]
                    .iter()
                    .all(|part| part.len() > 1 && part.bytes().all(|c| c.is_ascii_lowercase() || c == b'_'))
            })
        };
        let code = sources.iter().filter_map(|text| text.split("#[cfg(test)]").next());
        let found: Vec<&str> = code.flat_map(|text| text.split('"')).filter(is_code).collect();
        assert!(found.len() > 15, "the jobs' codes are found in their source: {found:?}");
        for name in found {
            assert!(codes::find(name).is_some(), "{name} is missing");
        }
    }

    #[test]
    fn a_files_channel_without_a_name_gets_that_of_its_column() {
        let channel = ChannelAt { index: 1, name: None };
        let error = FormatError::NonFinite { channel, sample: 4, row: None, column: None };
        let problem = document(&format(&error, &["u".into(), "y".into()]));
        assert_eq!(problem["code"], "run.non_finite");
        assert_eq!(problem["errors"][0], serde_json::json!({"pointer": "", "channel": "y", "sample": 4}));
    }

    #[test]
    fn a_full_disk_and_one_that_fails_are_told_apart_from_defects() {
        use std::io::ErrorKind::{Other, StorageFull};
        let failed = |kind: std::io::ErrorKind| {
            Problem::from(StoreError::DataDir { path: "secret".into(), source: kind.into() })
        };
        assert_eq!(failed(StorageFull).code(), "store.full");
        assert_eq!(failed(Other).code(), "store.unavailable");
        assert!(!document(&failed(Other)).to_string().contains("secret"));
    }

    #[test]
    fn a_failure_of_ours_tells_the_client_nothing() {
        let error = StoreError::Row { table: "rigs", key: "secret".into(), what: "broken".into() };
        let problem = Problem::from(error);
        assert!(problem.cause().is_some_and(|c| c.contains("secret")));
        assert!(!document(&problem).to_string().contains("secret"));
    }
}
