//! Errors of trainings by epoch, as jobs go on.

use super::database::sql;
use super::rows::int;
use super::{Lease, Store, StoreError};
use crate::domain::JobId;
use crate::engine::Loss;

impl Store {
    /// Adds errors of epochs to those of a job, where `anew` in place of them; `false` if the lease is lost and nothing
    /// was changed.
    ///
    /// # Errors
    /// The store's failures.
    pub async fn add_losses(&self, lease: &Lease, anew: bool, new: &[Loss]) -> Result<bool, StoreError> {
        let job = lease.job.to_string();
        let mut tx = self.write_with_reserve().await?;
        let held: Option<i64> =
            sql("SELECT 1 FROM jobs WHERE id = $1 AND lease_token = $2 AND state = 'running'")
                .bind(&job)
                .bind(int(lease.token))
                .fetch_optional(&mut *tx)
                .await?;
        if held.is_none() {
            return Ok(false);
        }
        if anew {
            sql("DELETE FROM job_losses WHERE job = $1").bind(&job).execute(&mut *tx).await?;
        }
        for loss in new {
            // An epoch that is done again after an interruption has the same errors.
            sql("INSERT INTO job_losses (job, stopped, seed, epoch, training, stopping)
                 VALUES ($1, $2, $3, $4, $5, $6)
                 ON CONFLICT (job, stopped, seed, epoch) DO UPDATE
                 SET training = excluded.training, stopping = excluded.stopping")
            .bind(&job)
            .bind(loss.stopping.is_some())
            .bind(loss.seed.cast_signed())
            .bind(int(loss.epoch as u64))
            .bind(loss.training)
            .bind(loss.stopping)
            .execute(&mut *tx)
            .await?;
        }
        tx.commit_progress().await?;
        Ok(true)
    }

    /// The errors of a job's training, by seed and epoch; those of a training that nothing stops come last.
    ///
    /// # Errors
    /// The store's failures.
    pub async fn losses(&self, job: JobId) -> Result<Vec<Loss>, StoreError> {
        let rows: Vec<(i64, i64, f64, Option<f64>)> =
            sql("SELECT seed, epoch, training, stopping FROM job_losses
             WHERE job = $1 ORDER BY stopped DESC, seed, epoch")
            .bind(job.to_string())
            .fetch_all(self.reader())
            .await?;
        let loss = |(seed, epoch, training, stopping): (i64, i64, f64, Option<f64>)| Loss {
            seed: seed.cast_unsigned(),
            epoch: usize::try_from(epoch).unwrap_or_default(),
            training,
            stopping,
        };
        Ok(rows.into_iter().map(loss).collect())
    }
}

#[cfg(test)]
mod tests {
    use jiff::ToSpan;

    use super::super::Outcome;
    use super::super::testing::{TestStore, draft, now};
    use super::*;

    fn loss(seed: u64, epoch: usize, stopping: Option<f64>) -> Loss {
        Loss { seed, epoch, training: 0.5, stopping }
    }

    #[tokio::test]
    async fn losses_stay_with_their_job_until_its_training_begins_anew() {
        let store = TestStore::open().await;
        let rig = store.insert_rig(&draft("bench"), None, now()).await.unwrap().unwrap();
        let id = store.queue_fit(&rig).await.id;
        let lease = store.claim_job("w", now() + 30.seconds(), now()).await.unwrap().unwrap().lease;
        let (first, second, last) = (loss(7, 1, Some(0.4)), loss(7, 2, Some(0.3)), loss(u64::MAX, 1, None));
        assert!(store.add_losses(&lease, true, &[last, first]).await.unwrap());
        assert!(store.add_losses(&lease, false, &[second, first]).await.unwrap());
        assert_eq!(store.losses(id).await.unwrap(), [first, second, last]);
        assert!(store.add_losses(&lease, true, &[second]).await.unwrap());
        assert_eq!(store.losses(id).await.unwrap(), [second]);
        store.finish_job(&lease, Outcome::Cancelled, now()).await.unwrap();
        assert!(!store.add_losses(&lease, true, &[]).await.unwrap(), "its lease is gone");
        assert_eq!(store.losses(id).await.unwrap(), [second], "a job that has ended keeps them");
        store.delete_rig(&rig.id).await.unwrap();
        assert_eq!(store.losses(id).await.unwrap(), []);
    }
}
