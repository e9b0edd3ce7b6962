//! Snapshots of jobs as they change.
//!
//! Changes are announced by id, and subscribers read the job from the store: a slow subscriber sees the
//! latest state, never a queue of old ones. A periodic look finds changes by other processes.

use std::time::Duration;

use futures::Stream;
use tokio::sync::{broadcast, watch};

use crate::domain::{Job, JobId};
use crate::storage::{Store, StoreError};

/// How often a subscriber reads the job without an announcement.
const LOOK_EVERY: Duration = Duration::from_secs(2);

/// Announcements kept for slow subscribers; a subscriber that misses some reads the store once.
const BACKLOG: usize = 256;

/// Announces changes of jobs.
#[derive(Debug)]
pub(super) struct Hub {
    changes: broadcast::Sender<JobId>,
    stopping: watch::Sender<bool>,
}

impl Hub {
    pub(super) fn new(stopping: watch::Sender<bool>) -> Self {
        Self { changes: broadcast::Sender::new(BACKLOG), stopping }
    }

    /// Announces that a job has changed.
    pub(super) fn changed(&self, id: JobId) {
        // An error means that nobody listens.
        let _ = self.changes.send(id);
    }

    /// See [`super::Jobs::subscribe`].
    pub(super) async fn subscribe(
        &self,
        store: Store,
        id: JobId,
        last_event: Option<u64>,
    ) -> Result<Option<impl Stream<Item = Job> + Send + 'static + use<>>, StoreError> {
        // Listening begins before the first read, so that no change is missed.
        let changes = self.changes.subscribe();
        let stopping = self.stopping.subscribe();
        let Some(job) = store.job(id).await? else { return Ok(None) };
        // An event number that does not exist yet is not from this service.
        let seen = last_event.filter(|seen| *seen <= job.event).unwrap_or(0);
        let follower = Follower { store, id, seen, changes, stopping, ended: false };
        Ok(Some(futures::stream::unfold(follower, Follower::next)))
    }
}

struct Follower {
    store: Store,
    id: JobId,
    seen: u64,
    changes: broadcast::Receiver<JobId>,
    stopping: watch::Receiver<bool>,
    ended: bool,
}

impl Follower {
    async fn next(mut self) -> Option<(Job, Self)> {
        while !self.ended && !*self.stopping.borrow() {
            let job = match self.store.job(self.id).await {
                Ok(job) => job?,
                Err(error) => {
                    tracing::warn!(job.id = %self.id, %error, "a stream of job events ends early");
                    return None;
                }
            };
            self.ended = job.state.is_terminal();
            if job.event > self.seen {
                self.seen = job.event;
                return Some((job, self));
            }
            if !self.ended {
                self.wait().await;
            }
        }
        None
    }

    /// Returns when the job may have changed, or the service stops.
    async fn wait(&mut self) {
        let told = async {
            loop {
                match self.changes.recv().await {
                    Ok(id) if id != self.id => {}
                    // A change of this job, or so many changes that some were missed.
                    Ok(_) | Err(broadcast::error::RecvError::Lagged(_)) => return,
                    Err(broadcast::error::RecvError::Closed) => std::future::pending().await,
                }
            }
        };
        tokio::select! {
            () = told => {}
            _ = self.stopping.wait_for(|stopping| *stopping) => {}
            () = tokio::time::sleep(LOOK_EVERY) => {}
        }
    }
}
