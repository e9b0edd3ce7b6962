//! Jobs: durable pieces of long work, their states and the transitions between them.

use jiff::Timestamp;
use serde::{Deserialize, Serialize};

use super::ids::{JobId, RigId};
use super::problem::Problem;

/// Most attempts of a job. An attempt counts if its worker failed while the service lived.
pub const MAX_ATTEMPTS: u32 = 3;

/// Most deaths of the service in a row under a job that made no progress in between; at the next one the
/// job has failed.
///
/// A service that dies takes its workers with it, so its death says little about the jobs at hand and costs
/// them no attempt. A job can still be the cause: a control group may end the whole service for the memory
/// of one worker, and a machine may hang. Such a job meets its end at the same place each time and makes no
/// progress, so only deaths without progress are counted. There may be many of them, because a machine that
/// crashes for a reason of its own can also do so several times before a job comes to its first checkpoint.
pub const MAX_SERVICE_DEATHS: u32 = 20;

/// Deaths of the service in a row and without progress after which a job is suspect: it then no longer
/// resumes before other jobs, so that they are done even if this one ends the service each time.
pub const SUSPECT_AFTER: u32 = 3;

/// Kinds of jobs.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum JobKind {
    /// Fits a model from runs.
    Fit,
    /// Compares models with runs.
    Evaluation,
    /// Finds where model and rig disagree, and the effect behind it.
    Diagnosis,
    /// Finds the drive that reproduces a target.
    Iteration,
    /// Searches hyper-parameters.
    Study,
}

impl JobKind {
    /// All kinds.
    pub const ALL: [Self; 5] = [Self::Fit, Self::Evaluation, Self::Diagnosis, Self::Iteration, Self::Study];

    /// The word of the contract.
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Fit => "fit",
            Self::Evaluation => "evaluation",
            Self::Diagnosis => "diagnosis",
            Self::Iteration => "iteration",
            Self::Study => "study",
        }
    }
}

/// A request that a job answers.
pub trait JobRequest: Serialize + Sync {
    /// The kind of the job.
    const KIND: JobKind;
}

/// The state of a job.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum JobState {
    /// Waits for a worker.
    Queued,
    /// Claimed by a worker.
    Running,
    /// Ended with a result.
    Succeeded,
    /// Ended with a problem.
    Failed,
    /// Ended on request.
    Cancelled,
}

impl JobState {
    /// All states.
    pub const ALL: [Self; 5] = [Self::Queued, Self::Running, Self::Succeeded, Self::Failed, Self::Cancelled];

    /// The word of the contract.
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Queued => "queued",
            Self::Running => "running",
            Self::Succeeded => "succeeded",
            Self::Failed => "failed",
            Self::Cancelled => "cancelled",
        }
    }

    /// Whether a job in this state never changes again.
    pub fn is_terminal(self) -> bool {
        matches!(self, Self::Succeeded | Self::Failed | Self::Cancelled)
    }

    /// Whether a job may go from this state to `next`.
    ///
    /// A running job goes back to queued when its worker stops or dies; a queued one fails when its attempts
    /// are used up.
    pub fn may_become(self, next: Self) -> bool {
        match self {
            Self::Queued => matches!(next, Self::Running | Self::Cancelled | Self::Failed),
            Self::Running => next != Self::Running,
            Self::Succeeded | Self::Failed | Self::Cancelled => false,
        }
    }
}

/// The result of a job.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct JobResult {
    /// Kind of resource (`model`).
    pub kind: String,
    /// Its id; for a model the version.
    pub id: String,
    /// Its path.
    pub href: String,
}

/// A job as the contract shows it.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Job {
    /// Id.
    pub id: JobId,
    /// Kind.
    pub kind: JobKind,
    /// Rig that it works for.
    pub rig: RigId,
    /// State.
    pub state: JobState,
    /// The present stage in an engineer's words; for a finished job, the outcome.
    pub stage: Option<String>,
    /// Share that is done, 0..=1.
    pub progress: f64,
    /// Estimated seconds until it is done, from the speed so far; only while it runs.
    pub eta_s: Option<f64>,
    /// Number of attempts; those that a stop or the death of the service ended do not count.
    pub attempt: u32,
    /// When it was queued.
    pub created_at: Timestamp,
    /// When its last attempt started.
    pub started_at: Option<Timestamp>,
    /// When it reached a terminal state.
    pub finished_at: Option<Timestamp>,
    /// The result, if it succeeded.
    pub result: Option<JobResult>,
    /// The problem, if it failed.
    pub problem: Option<Problem>,
    /// Rises with every change: the id of its server-sent event.
    #[serde(skip)]
    pub event: u64,
    /// Whether a cancellation was requested.
    #[serde(skip)]
    pub cancel_requested: bool,
}

/// Estimated seconds until work is done of which `fraction` took `elapsed_s`; `None` while the fraction is
/// too small for an estimate.
pub fn eta_s(fraction: f64, elapsed_s: f64) -> Option<f64> {
    // Below one percent the quotient is dominated by the start-up.
    let known = fraction.is_finite() && (0.01..=1.0).contains(&fraction) && elapsed_s > 0.0;
    known.then(|| elapsed_s * (1.0 - fraction) / fraction)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_legal_moves_are_exactly_these() {
        use JobState::{Cancelled, Failed, Queued, Running, Succeeded};
        let legal = [
            (Queued, Running),
            (Queued, Cancelled),
            (Queued, Failed),
            (Running, Queued),
            (Running, Succeeded),
            (Running, Failed),
            (Running, Cancelled),
        ];
        for from in JobState::ALL {
            for to in JobState::ALL {
                assert_eq!(from.may_become(to), legal.contains(&(from, to)), "{from:?} -> {to:?}");
            }
            assert_eq!(from.is_terminal(), !legal.iter().any(|(f, _)| *f == from));
        }
    }

    #[test]
    fn the_eta_follows_the_speed_so_far() {
        assert_eq!(eta_s(0.25, 10.0), Some(30.0));
        assert_eq!(eta_s(1.0, 10.0), Some(0.0));
        assert_eq!(eta_s(0.0, 10.0), None);
        assert_eq!(eta_s(f64::NAN, 10.0), None);
    }
}
