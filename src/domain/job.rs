//! Jobs: durable pieces of long work, their states and the moves between them.

use jiff::Timestamp;
use serde::{Deserialize, Serialize};

use super::ids::{JobId, RigId};
use super::problem::Problem;

/// How often a job may be started; a job that was interrupted this often has failed.
pub const MAX_ATTEMPTS: u32 = 3;

/// What a job does.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum JobKind {
    /// Fits a model from runs.
    Fit,
    /// Compares models with runs.
    Evaluation,
    /// Finds where model and rig disagree, and why.
    Diagnosis,
    /// Finds the drive that reproduces a target.
    Iteration,
    /// Searches hyper-parameters.
    Study,
}

impl JobKind {
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

/// Where a job stands.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum JobState {
    /// Waits for a worker.
    Queued,
    /// A worker has it.
    Running,
    /// Done, with a result.
    Succeeded,
    /// Done, with a problem.
    Failed,
    /// Done, by wish.
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
    /// Running goes back to queued when its worker stops or dies; queued fails when its attempts
    /// are used up.
    pub fn may_become(self, next: Self) -> bool {
        match self {
            Self::Queued => matches!(next, Self::Running | Self::Cancelled | Self::Failed),
            Self::Running => next != Self::Running,
            Self::Succeeded | Self::Failed | Self::Cancelled => false,
        }
    }
}

/// What a job made.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct JobResult {
    /// Kind of thing (`model`).
    pub kind: String,
    /// Its id; of a model the version.
    pub id: String,
    /// Where it is.
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
    /// What is being done, in an engineer's words; of a finished job, what came of it.
    pub stage: Option<String>,
    /// Share that is done, 0..=1.
    pub progress: f64,
    /// Seconds until it is done, by the speed so far; only while it runs.
    pub eta_s: Option<f64>,
    /// How often it was started.
    pub attempt: u32,
    /// When it was queued.
    pub created_at: Timestamp,
    /// When its last attempt started.
    pub started_at: Option<Timestamp>,
    /// When it reached a terminal state.
    pub finished_at: Option<Timestamp>,
    /// Of a job that succeeded.
    pub result: Option<JobResult>,
    /// Of a job that failed.
    pub problem: Option<Problem>,
    /// Rises with every change: the id of its server-sent event.
    #[serde(skip)]
    pub event: u64,
    /// Whether somebody asked for an end.
    #[serde(skip)]
    pub cancel_requested: bool,
}

/// Seconds until work is done that came to `fraction` in `elapsed_s`; `None` before anything can
/// be said.
pub fn eta_s(fraction: f64, elapsed_s: f64) -> Option<f64> {
    // Below one percent the quotient says more about the start-up than about the work.
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
