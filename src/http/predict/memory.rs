//! Memory of large predictions: one budget for all of them, so that many at once do not take more than the
//! machine has. Short ones take none of it.

use std::sync::Arc;
use std::time::Duration;

use tokio::sync::{OwnedSemaphorePermit, Semaphore};

use crate::compute::fair_queue::{ClientId, FairQueue, QueueSettings, Refused};

/// The budget is counted in KiB.
const UNIT: usize = 1 << 10;

/// Memory of a short prediction, which needs no share: a minute of a large rig.
const SHORT_BYTES: usize = 16 << 20;

/// Memory of an answer besides its samples: its beginning, a piece, and what waits to be sent.
const ANSWER_BYTES: usize = 3 << 19;

/// Predictions that may wait for memory; each holds the drive that it came with.
const MAX_WAITING: usize = 32;

/// Longest wait for the first place in the queue, and there for memory.
const MAX_WAIT: Duration = Duration::from_secs(30);

/// The budget.
#[derive(Debug)]
pub struct PredictionMemory {
    free: Arc<Semaphore>,
    units: u32,
    /// Its one permit is the right to take the next memory that comes free, so that the queue is fair between
    /// tokens whatever their predictions need.
    first: Arc<FairQueue>,
    max_wait: Duration,
}

/// A part of the budget, until it is dropped.
#[derive(Debug, Default)]
pub struct Share(Option<OwnedSemaphorePermit>);

impl PredictionMemory {
    /// A budget of so many bytes.
    pub fn new(bytes: usize) -> Self {
        Self::with(bytes, MAX_WAIT)
    }

    fn with(bytes: usize, max_wait: Duration) -> Self {
        let units = u32::try_from(bytes / UNIT).unwrap_or(u32::MAX).min(Semaphore::MAX_PERMITS as u32);
        let free = Arc::new(Semaphore::new(units as usize));
        let first = FairQueue::new("memory", QueueSettings::new(1, MAX_WAITING, max_wait));
        Self { free, units, first, max_wait }
    }

    /// The queue for the next memory that comes free.
    pub fn queue(&self) -> &Arc<FairQueue> {
        &self.first
    }

    /// Waits for the memory of a client's prediction. One that needs more than the whole budget gets all of
    /// it, and has it alone.
    ///
    /// # Errors
    /// [`Refused`]: at once when too many wait, later when the longest wait is over.
    pub async fn take(&self, client: ClientId, bytes: usize) -> Result<Share, Refused> {
        if bytes <= SHORT_BYTES {
            return Ok(Share(None));
        }
        let units = u32::try_from(of_answer(bytes)).unwrap_or(u32::MAX).min(self.units);
        let _first = self.first.acquire(client).await?;
        match tokio::time::timeout(self.max_wait, Arc::clone(&self.free).acquire_many_owned(units)).await {
            Ok(Ok(permit)) => Ok(Share(Some(permit))),
            _ => Err(Refused::Late),
        }
    }
}

/// Units of so many bytes of samples and of their answer.
fn of_answer(bytes: usize) -> usize {
    bytes.saturating_add(ANSWER_BYTES) / UNIT
}

impl Share {
    /// Gives back what is beyond these bytes of samples.
    pub fn keep(&mut self, bytes: usize) {
        if let Some(permit) = &mut self.0 {
            let beyond = permit.num_permits().saturating_sub(of_answer(bytes));
            drop(permit.split(beyond));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const MIB: usize = 1 << 20;

    #[tokio::test]
    async fn large_predictions_share_the_budget_and_short_ones_take_none() {
        let memory = PredictionMemory::new(256 * MIB);
        let free = || memory.free.available_permits() * UNIT / MIB;
        let first = memory.take(None, 100 * MIB).await.expect("room");
        let mut second = memory.take(None, 100 * MIB).await.expect("room");
        let _short = memory.take(None, SHORT_BYTES).await.expect("no share");
        assert_eq!(free(), 53);
        second.keep(60 * MIB);
        assert_eq!(free(), 93);
        second.keep(80 * MIB);
        assert_eq!(free(), 93, "nothing is taken back");
        drop((first, second));
        assert_eq!(free(), 256);
        let _all = memory.take(None, 5000 * MIB).await.expect("alone");
        assert_eq!(free(), 0);
    }

    #[tokio::test]
    async fn a_prediction_waits_for_memory_but_not_for_ever_and_not_in_any_number() {
        let hasty = PredictionMemory::with(256 * MIB, Duration::from_millis(20));
        let all = hasty.take(None, 256 * MIB).await.expect("room");
        assert_eq!(hasty.take(None, 20 * MIB).await.err(), Some(Refused::Late));
        drop(all);
        let memory = Arc::new(PredictionMemory::new(256 * MIB));
        let all = memory.take(None, 256 * MIB).await.expect("room");
        // One of them is the first, and the others wait behind it.
        let waiting: Vec<_> = (0..=MAX_WAITING)
            .map(|_| {
                let memory = Arc::clone(&memory);
                tokio::spawn(async move { memory.take(None, 256 * MIB).await.is_ok() })
            })
            .collect();
        while memory.queue().depth() != ("memory", 1, MAX_WAITING) {
            tokio::task::yield_now().await;
        }
        assert_eq!(memory.take(None, 20 * MIB).await.err(), Some(Refused::Full));
        drop(all);
        for took in waiting {
            assert!(took.await.expect("no panic"));
        }
    }
}
