//! Jobs in the store: queue, leases, states.

use jiff::Timestamp;

use super::{Store, StoreError};
use crate::domain::fits::FitRequest;
use crate::domain::{Job, JobId, JobKind, JobState, Page, PageRequest, Problem, RigId};

/// Which jobs are wanted; empty: all.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct JobQuery {
    /// Of this rig.
    pub rig: Option<RigId>,
    /// In this state.
    pub state: Option<JobState>,
    /// Of this kind.
    pub kind: Option<JobKind>,
}

/// The right to work on a job. Every claim has a token of its own, so that a worker that lost its
/// lease can no longer write.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Lease {
    /// The job.
    pub job: JobId,
    /// Fencing token.
    pub token: u64,
}

/// A job that was claimed.
#[derive(Debug, Clone, PartialEq)]
pub struct Claim {
    /// The right to it.
    pub lease: Lease,
    /// The job.
    pub job: Job,
    /// What it is asked to do.
    pub request: serde_json::Value,
}

/// Answer to a heartbeat.
#[derive(Debug, Clone, PartialEq)]
pub enum Beat {
    /// Go on.
    Held,
    /// Somebody asked for an end.
    CancelRequested,
    /// The lease, or the job, is gone: stop and write nothing.
    Lost,
}

/// How a job ended without a result.
#[derive(Debug, Clone, PartialEq)]
pub enum Outcome {
    /// It failed.
    Failed(Problem),
    /// It was cancelled.
    Cancelled,
    /// It goes back into the queue, its attempt not counted: the service stops.
    Released,
}

/// What came of a wish to cancel.
#[derive(Debug, Clone, PartialEq)]
pub enum CancelOutcome {
    /// No such job.
    Missing,
    /// The job as it is now: cancelled, about to be, or long finished.
    Noted(Job),
}

impl Store {
    /// Queues a fit that was asked for; `None` when there is no such rig.
    ///
    /// # Errors
    /// The store's failures.
    pub async fn insert_fit_job(
        &self,
        _rig: &RigId,
        _request: &FitRequest,
        _now: Timestamp,
    ) -> Result<Option<Job>, StoreError> {
        todo!()
    }

    /// One job.
    ///
    /// # Errors
    /// The store's failures.
    pub async fn job(&self, _id: JobId) -> Result<Option<Job>, StoreError> {
        todo!()
    }

    /// Jobs, newest first.
    ///
    /// # Errors
    /// The store's failures.
    pub async fn jobs(&self, _query: &JobQuery, _page: &PageRequest) -> Result<Page<Job>, StoreError> {
        todo!()
    }

    /// How many jobs there are in each state.
    ///
    /// # Errors
    /// The store's failures.
    pub async fn count_jobs(&self) -> Result<Vec<(JobState, u64)>, StoreError> {
        todo!()
    }

    /// Notes the wish to cancel: a queued job ends at once, a running one when its worker sees it.
    ///
    /// # Errors
    /// The store's failures.
    pub async fn request_cancel(&self, _id: JobId, _now: Timestamp) -> Result<CancelOutcome, StoreError> {
        todo!()
    }

    /// Claims the oldest queued job for `worker`, until `lease_until` unless a heartbeat extends it.
    ///
    /// # Errors
    /// The store's failures.
    pub async fn claim_job(
        &self,
        _worker: &str,
        _lease_until: Timestamp,
        _now: Timestamp,
    ) -> Result<Option<Claim>, StoreError> {
        todo!()
    }

    /// Extends a lease and notes how far the job is.
    ///
    /// # Errors
    /// The store's failures.
    pub async fn heartbeat(
        &self,
        _lease: &Lease,
        _stage: &str,
        _progress: f64,
        _lease_until: Timestamp,
        _now: Timestamp,
    ) -> Result<Beat, StoreError> {
        todo!()
    }

    /// Ends a job without a result; `false` when the lease is lost, and nothing was changed.
    ///
    /// # Errors
    /// The store's failures.
    pub async fn finish_job(
        &self,
        _lease: &Lease,
        _outcome: Outcome,
        _now: Timestamp,
    ) -> Result<bool, StoreError> {
        todo!()
    }

    /// Puts jobs whose lease ended before `expired_at` back into the queue, or fails them when
    /// their attempts are used up; which ones. At a start, when no other process can have the data
    /// directory, every lease is over: [`Timestamp::MAX`].
    ///
    /// # Errors
    /// The store's failures.
    pub async fn requeue_expired(
        &self,
        _expired_at: Timestamp,
        _now: Timestamp,
    ) -> Result<Vec<JobId>, StoreError> {
        todo!()
    }
}
