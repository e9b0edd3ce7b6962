//! Why a diagnosis cannot be done, as problem documents.

use crate::domain::{FieldError, FitChannels, Problem};
use crate::engine::EngineError;
use crate::storage::StoreError;

use crate::jobs::problem::{
    JobError, codes, no_model, none_active, of_engine, rig_gone, sentence, store_failed, too_many_waiting,
};

/// Why a diagnosis cannot be done.
#[derive(Debug, thiserror::Error)]
pub enum DiagnosisProblem {
    /// Fields of the request that do not fit the rig or each other (422 `diagnosis.invalid`).
    #[error("the diagnosis does not suit the rig")]
    Invalid(Vec<FieldError>),
    /// Runs that lack a channel of the diagnosis (422 `diagnosis.missing_channel`).
    #[error("a run lacks a channel of the diagnosis")]
    MissingChannel(Vec<FieldError>),
    /// Runs that are too short for anything (422 `diagnosis.too_short`).
    #[error("a run is too short for a diagnosis")]
    TooShort(Vec<FieldError>),
    /// Channels that are constant where power is needed (422 `signal.dead_channel`).
    #[error("a channel is constant where the diagnosis needs power")]
    DeadChannel(Vec<FieldError>),
    /// Simulated responses of another length than the run's (422 `signal.unequal_lengths`).
    #[error("a simulated run is not as long as its run")]
    UnequalLengths(Vec<FieldError>),
    /// Runs of another rate than the model's (422 `signal.sample_rate`).
    #[error("a run has another sample rate than the model")]
    SampleRate(Vec<FieldError>),
    /// No run matches a selection (409 `diagnosis.no_runs`).
    #[error("no run matches {pointer}")]
    NoRuns {
        /// The selection.
        pointer: &'static str,
    },
    /// The rig has no active model (409 `model.none_active`).
    #[error("the rig has no active model; fit one, name a version, or send simulated runs")]
    NoneActive,
    /// The rig has no such version (404 `model.not_found`).
    #[error("the rig has no model version {0}")]
    NoModel(u32),
    /// The rig was deleted meanwhile (404 `rig.not_found`).
    #[error("the rig is gone")]
    RigGone,
    /// This many jobs of the token wait, as many as it may have (429 `job.too_many_waiting`).
    #[error("{0} jobs of the token wait already")]
    TooManyWaiting(u64),
    /// The store.
    #[error(transparent)]
    Store(#[from] StoreError),
}

impl DiagnosisProblem {
    /// As a problem document, which does not repeat a message of the store.
    pub fn problem(&self) -> Problem {
        let named = |code, title: &str, errors: &[FieldError]| {
            let detail = errors.iter().map(sentence).collect::<Vec<_>>().join("; ");
            Problem::new(422, code, title, format!("{self}: {detail}.")).with(errors.to_vec())
        };
        let at = |pointer: &str, limit: &str| vec![FieldError::new(pointer, limit)];
        match self {
            Self::Invalid(errors) => {
                named(codes::DIAGNOSIS_INVALID, "The diagnosis does not suit the rig", errors)
            }
            Self::MissingChannel(errors) => {
                named(codes::DIAGNOSIS_MISSING_CHANNEL, "A run lacks a channel of the diagnosis", errors)
            }
            Self::TooShort(errors) => {
                named(codes::DIAGNOSIS_TOO_SHORT, "Runs are too short for a diagnosis", errors)
            }
            Self::DeadChannel(errors) => {
                named("signal.dead_channel", "A constant channel where power is needed", errors)
            }
            Self::UnequalLengths(errors) => {
                named("signal.unequal_lengths", "Channels differ in length", errors)
            }
            Self::SampleRate(errors) => named("signal.sample_rate", "Another sample rate", errors),
            Self::NoRuns { pointer } => {
                let title = "No run matches the selection of the diagnosis";
                Problem::new(409, codes::DIAGNOSIS_NO_RUNS, title, format!("{self}."))
                    .with(at(pointer, "at least one run of the rig"))
            }
            Self::NoneActive => none_active(format!("{self}.")),
            Self::NoModel(_) => no_model(format!("{self}.")),
            Self::RigGone => rig_gone(format!("{self}.")),
            Self::TooManyWaiting(most) => too_many_waiting(*most),
            Self::Store(_) => store_failed("the diagnosis"),
        }
    }
}

impl From<DiagnosisProblem> for JobError {
    fn from(problem: DiagnosisProblem) -> Self {
        match problem {
            DiagnosisProblem::Store(error) => error.into(),
            problem => Self::failed(problem.problem()),
        }
    }
}

/// An engine error about a diagnosis, with channel names in place of numbers.
pub(super) fn of_diagnosis(error: &EngineError, channels: &FitChannels) -> JobError {
    let pointer = |what: &str| if what.contains("baseline") { "/baseline_runs" } else { "/runs" };
    match error {
        EngineError::TooShort { what, needed, .. } => {
            let limit = format!("runs of which at least {needed} samples are left ({error})");
            DiagnosisProblem::TooShort(vec![FieldError::new(pointer(what), limit)]).into()
        }
        EngineError::DeadChannel { what, channel } => {
            let names = if what.contains("response") { &channels.outputs } else { &channels.inputs };
            let place = FieldError::new(pointer(what), "runs in which the channel moves");
            let name = names.get(*channel).cloned().unwrap_or_else(|| channel.to_string());
            DiagnosisProblem::DeadChannel(vec![place.on_channel(name)]).into()
        }
        EngineError::Setting { setting, limit, .. } => {
            let place = FieldError::new(format!("/{}", setting.replace('.', "/")), limit);
            DiagnosisProblem::Invalid(vec![place]).into()
        }
        other => of_engine(other, channels),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn channels() -> FitChannels {
        FitChannels { inputs: vec!["u".into()], outputs: vec!["y".into(), "z".into()] }
    }

    #[test]
    fn the_engines_words_become_codes_and_places_of_the_request() {
        let case = |error: EngineError, code: &str, pointer: &str| {
            let JobError::Failed(problem) = of_diagnosis(&error, &channels()) else {
                panic!("trying again would not help")
            };
            assert_eq!((problem.code.as_str(), problem.errors[0].pointer.as_str()), (code, pointer));
            problem
        };
        let what = "baseline runs, for the linear core";
        let short = EngineError::TooShort { what, needed: 640, found: 10 };
        case(short, "diagnosis.too_short", "/baseline_runs");
        let what = "run of the diagnosis";
        case(EngineError::TooShort { what, needed: 64, found: 3 }, "diagnosis.too_short", "/runs");
        let what = "response of the baseline runs";
        let problem =
            case(EngineError::DeadChannel { what, channel: 1 }, "signal.dead_channel", "/baseline_runs");
        assert_eq!(problem.errors[0].channel.as_deref(), Some("z"));
        let setting = "envelope.drive_peak";
        let limit = "a positive number a drive".into();
        let error = EngineError::Setting { setting, found: "[]".into(), limit };
        case(error, "diagnosis.invalid", "/envelope/drive_peak");
        assert!(matches!(of_diagnosis(&EngineError::Cancelled, &channels()), JobError::Stopped));
    }
}
