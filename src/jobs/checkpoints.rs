//! The checkpoints of a fit: saves them, and loads those of an interrupted attempt.

use std::collections::HashMap;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use bytes::Bytes;

use crate::domain::JobId;
use crate::engine::checkpoint::CheckpointStore;
use crate::storage::{Checkpoint, Store, StoreError};

use super::control::{Control, NewLosses};

/// Time from the start of an attempt to its first checkpoint, unless the setting is shorter.
const FIRST: Duration = Duration::from_millis(500);

/// The checkpoints of one attempt.
#[derive(Debug)]
pub(super) struct JobCheckpoints {
    control: Arc<Control>,
    fits: String,
    found: HashMap<String, Bytes>,
    /// Longest time between two checkpoints.
    every: Duration,
    opened: Instant,
    /// When each part was last saved.
    put: Mutex<HashMap<String, Instant>>,
}

impl JobCheckpoints {
    /// Loads the job's checkpoints that belong to `fits`, a digest of the data, settings and code that
    /// they were computed from.
    pub(super) async fn open(
        store: &Store,
        job: JobId,
        fits: String,
        every: Duration,
        control: &Arc<Control>,
    ) -> Result<Self, StoreError> {
        let found: HashMap<String, Bytes> =
            store.checkpoints(job, &fits).await?.into_iter().map(|one| (one.part, one.state)).collect();
        if found.is_empty() {
            control.add_losses(NewLosses { anew: true, losses: Vec::new() });
        } else {
            tracing::info!(job.id = %job, parts = found.len(), "work goes on from its checkpoints");
        }
        Ok(Self { found, ..Self::none(fits, every, control) })
    }

    /// Those of work of which none are of use.
    pub(super) fn none(fits: String, every: Duration, control: &Arc<Control>) -> Self {
        let (control, opened) = (Arc::clone(control), Instant::now());
        Self { control, fits, found: HashMap::new(), every, opened, put: Mutex::default() }
    }

    /// Longest time between two checkpoints so far. The first ones come early, so that work goes forward
    /// even on a machine that crashes every few seconds; as an attempt lives on they come less often, up to
    /// the setting.
    fn interval(&self) -> Duration {
        self.every.min(FIRST.max(self.opened.elapsed() / 2))
    }

    fn put(&self) -> std::sync::MutexGuard<'_, HashMap<String, Instant>> {
        self.put.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl CheckpointStore for JobCheckpoints {
    fn load(&self, part: &str) -> Option<Vec<u8>> {
        self.found.get(part).map(|state| state.to_vec())
    }

    fn is_due(&self, part: &str, done: bool) -> bool {
        let last = self.put().get(part).copied().unwrap_or(self.opened);
        // A part that ended within a moment is not worth a write.
        last.elapsed() >= if done { self.interval() / 4 } else { self.interval() }
    }

    fn save(&self, part: &str, state: Vec<u8>) {
        self.put().insert(part.to_owned(), Instant::now());
        let (part, fits, state) = (part.to_owned(), self.fits.clone(), state.into());
        self.control.keep(Checkpoint { part, fits, state });
    }
}
