//! Long work: claim, heartbeat, finish; one file a kind of job.
//!
//! A job is claimed in one short transaction, done outside of any, and published in one more that
//! holds only while the lease does.

mod events;
pub mod fit;
mod runner;

use std::time::Duration;

use futures::Stream;

use crate::compute::Compute;
use crate::domain::fits::FitRequest;
use crate::domain::{Clock, Job, JobId, Rig};
use crate::storage::{CancelOutcome, Store, StoreError};

pub use fit::{FitPlan, FitProblem};

/// How the runner behaves.
#[derive(Debug, Clone)]
pub struct JobSettings {
    /// Jobs at once in this process.
    pub workers: usize,
    /// How long a lease lasts without a heartbeat.
    pub lease: Duration,
    /// How often an idle worker looks for jobs that it was not told of.
    pub poll: Duration,
    /// Least time between two progress writes of a job.
    pub progress_every: Duration,
}

impl Default for JobSettings {
    fn default() -> Self {
        Self {
            workers: 1,
            lease: Duration::from_secs(30),
            poll: Duration::from_secs(2),
            progress_every: Duration::from_millis(500),
        }
    }
}

/// The runner of jobs, and the way to them. Clones share it.
#[derive(Debug, Clone)]
pub struct Jobs {
    store: Store,
}

impl Jobs {
    /// Puts jobs that a former process left running back into the queue, and starts the workers.
    ///
    /// # Errors
    /// The store's failures.
    pub async fn start(
        store: Store,
        _compute: Compute,
        _clock: Clock,
        _settings: JobSettings,
    ) -> Result<Self, StoreError> {
        Ok(Self { store })
    }

    /// Checks a fit and queues it.
    ///
    /// # Errors
    /// [`FitProblem`]: what is wrong with it, or the store's failure.
    pub async fn submit_fit(&self, _rig: &Rig, _request: &FitRequest) -> Result<Job, FitProblem> {
        todo!()
    }

    /// Notes the wish to cancel and stops the work if it is done here. Idempotent.
    ///
    /// # Errors
    /// The store's failures.
    pub async fn cancel(&self, _id: JobId) -> Result<CancelOutcome, StoreError> {
        todo!()
    }

    /// Tells idle workers that jobs were queued (by an accepted run).
    pub fn wake(&self) {
        todo!()
    }

    /// The job's snapshots from now on, each with a greater [`Job::event`], ending after a
    /// terminal state; `None` when there is no such job. The first is the job as it is now,
    /// unless `last_event` (the client's `Last-Event-ID`) says that it was seen. The stream also
    /// ends when the job is deleted, the store fails or the service stops.
    ///
    /// # Errors
    /// The store's failures.
    pub async fn subscribe(
        &self,
        _id: JobId,
        _last_event: Option<u64>,
    ) -> Result<Option<impl Stream<Item = Job> + Send + 'static + use<>>, StoreError> {
        Ok(Some(futures::stream::empty()))
    }

    /// Stops claiming, cancels the work at hand, puts its jobs back into the queue, and returns
    /// when that is done.
    pub async fn shutdown(&self) {
        todo!()
    }
}
