//! Checkpoints of running jobs in the store.

use bytes::Bytes;
use jiff::Timestamp;
use serde::{Deserialize, Serialize};

use super::database::sql;
use super::rows::{int, us};
use super::{Digest, Lease, Store, StoreError};
use crate::domain::JobId;

/// The state of a part of some work.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Checkpoint {
    /// Part of the work.
    pub part: String,
    /// Digest of the data, settings and program that it was computed from.
    pub fits: String,
    /// Its state; sent beside JSON, not in it.
    #[serde(skip)]
    pub state: Bytes,
}

impl Store {
    /// Stores a checkpoint in place of the part's previous one; `false` if the lease is lost and nothing
    /// was changed. It is progress, so the deaths of the service under the job count from here on. The end
    /// of a job deletes its checkpoints.
    ///
    /// # Errors
    /// The store's failures; the previous one is then still there.
    pub async fn keep_checkpoint(
        &self,
        lease: &Lease,
        checkpoint: &Checkpoint,
        now: Timestamp,
    ) -> Result<bool, StoreError> {
        let mut tx = self.write_with_reserve().await?;
        let done = sql("INSERT INTO checkpoints (job, part, fits, sha256, state, written_us)
             SELECT id, $3, $4, $5, $6, $7 FROM jobs
             WHERE id = $1 AND lease_token = $2 AND state = 'running'
             ON CONFLICT (job, part) DO UPDATE
             SET fits = excluded.fits, sha256 = excluded.sha256, state = excluded.state,
                 written_us = excluded.written_us")
        .bind(lease.job.to_string())
        .bind(int(lease.token))
        .bind(&checkpoint.part)
        .bind(&checkpoint.fits)
        .bind(Digest::of(&checkpoint.state).as_str())
        .bind(&checkpoint.state[..])
        .bind(us(now))
        .execute(&mut *tx)
        .await?;
        if done == 0 {
            return Ok(false);
        }
        sql("UPDATE jobs SET service_deaths = 0 WHERE id = $1")
            .bind(lease.job.to_string())
            .execute(&mut *tx)
            .await?;
        tx.commit_progress().await?;
        Ok(true)
    }

    /// The checkpoints of a job with this digest; damaged ones are skipped.
    ///
    /// # Errors
    /// The store's failures.
    pub async fn checkpoints(&self, job: JobId, fits: &str) -> Result<Vec<Checkpoint>, StoreError> {
        let rows: Vec<(String, String, Vec<u8>)> =
            sql("SELECT part, sha256, state FROM checkpoints WHERE job = $1 AND fits = $2")
                .bind(job.to_string())
                .bind(fits)
                .fetch_all(self.reader())
                .await?;
        let whole = |(part, sha256, state): (String, String, Vec<u8>)| {
            if Digest::of(&state).as_str() != sha256 {
                tracing::warn!(job.id = %job, part, "a damaged checkpoint is not used");
                return None;
            }
            Some(Checkpoint { part, fits: fits.to_owned(), state: state.into() })
        };
        Ok(rows.into_iter().filter_map(whole).collect())
    }
}

#[cfg(test)]
mod tests {
    use jiff::ToSpan;

    use super::super::Outcome;
    use super::super::testing::{TestStore, draft, now};
    use super::*;

    fn checkpoint(part: &str, state: &'static [u8]) -> Checkpoint {
        Checkpoint { part: part.into(), fits: "settings".into(), state: Bytes::from_static(state) }
    }

    /// A store with a running job.
    async fn running() -> (TestStore, Lease) {
        let store = TestStore::open().await;
        let rig = store.insert_rig(&draft("bench"), None, now()).await.unwrap().unwrap();
        store.queue_fit(&rig).await;
        let lease = store.claim_job("w", now() + 30.seconds(), now()).await.unwrap().unwrap().lease;
        (store, lease)
    }

    #[tokio::test]
    async fn the_last_checkpoint_of_each_part_is_kept_until_the_job_ends() {
        let (store, lease) = running().await;
        for one in [checkpoint("a", b"1"), checkpoint("b", b"2"), checkpoint("a", b"3")] {
            assert!(store.keep_checkpoint(&lease, &one, now()).await.unwrap());
        }
        let mut found = store.checkpoints(lease.job, "settings").await.unwrap();
        found.sort_by(|a, b| a.part.cmp(&b.part));
        assert_eq!(found, [checkpoint("a", b"3"), checkpoint("b", b"2")]);
        assert_eq!(store.checkpoints(lease.job, "other settings").await.unwrap(), []);
        // A job that goes back into the queue keeps them, one that ends does not.
        store.finish_job(&lease, Outcome::Released, now()).await.unwrap();
        assert_eq!(store.checkpoints(lease.job, "settings").await.unwrap().len(), 2);
        let late = store.keep_checkpoint(&lease, &checkpoint("a", b"late"), now()).await.unwrap();
        assert!(!late, "its lease is gone");
        let lease = store.claim_job("w", now() + 30.seconds(), now()).await.unwrap().unwrap().lease;
        store.finish_job(&lease, Outcome::Cancelled, now()).await.unwrap();
        assert_eq!(store.checkpoints(lease.job, "settings").await.unwrap(), []);
    }

    #[tokio::test]
    async fn a_damaged_checkpoint_is_passed_over_and_all_go_with_their_rig() {
        let (store, lease) = running().await;
        store.keep_checkpoint(&lease, &checkpoint("a", b"good"), now()).await.unwrap();
        store.keep_checkpoint(&lease, &checkpoint("b", b"good"), now()).await.unwrap();
        store.raw("UPDATE checkpoints SET sha256 = 'other' WHERE part = 'a'").await.unwrap();
        assert_eq!(store.checkpoints(lease.job, "settings").await.unwrap(), [checkpoint("b", b"good")]);
        assert!(store.delete_rig(&"bench".parse().unwrap()).await.unwrap());
        assert_eq!(store.checkpoints(lease.job, "settings").await.unwrap(), []);
    }
}
