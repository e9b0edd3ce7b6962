//! Jobs whose worker or service was lost on the way.
//!
//! An attempt counts only where the job is suspect, which is where its worker was lost while the service
//! lived. After the death of the service nobody knows the cause; see
//! [`MAX_SERVICE_DEATHS`](crate::domain::job::MAX_SERVICE_DEATHS).

use jiff::Timestamp;

use super::database::sql;
use super::jobs::leave_running;
use super::rows::{JobRow, all, json, us};
use super::{Outcome, Store, StoreError};
use crate::domain::job::MAX_SERVICE_DEATHS;
use crate::domain::{Job, JobId, Problem};

impl Store {
    /// Puts the jobs that were running when the service died back into the queue, no attempt counted, or
    /// fails those under which it died too often without progress. Returns their ids. For the start of
    /// the service, when no other process can have the data directory.
    ///
    /// # Errors
    /// The store's failures.
    pub async fn requeue_interrupted(&self, now: Timestamp) -> Result<Vec<JobId>, StoreError> {
        self.requeue_of_dead(Timestamp::MAX, &[], now).await
    }

    /// As [`Store::requeue_interrupted`], of the jobs whose lease ended before `expired_at`, without those `held`.
    async fn requeue_of_dead(
        &self,
        expired_at: Timestamp,
        held: &[JobId],
        now: Timestamp,
    ) -> Result<Vec<JobId>, StoreError> {
        let mut tx = self.write_with_reserve().await?;
        let held: Vec<String> = held.iter().map(JobId::to_string).collect();
        let rows: Vec<JobRow> = sql("UPDATE jobs SET service_deaths = service_deaths + 1
             WHERE state = 'running' AND coalesce(lease_until_us, 0) <= $1
               AND id NOT IN (SELECT value FROM json_each($2))
             RETURNING *")
        .bind(us(expired_at))
        .bind(json(&held))
        .fetch_all(&mut *tx)
        .await?;
        let mut ids = Vec::with_capacity(rows.len());
        for row in rows {
            let deaths = row.service_deaths;
            let job: Job = row.try_into()?;
            let outcome = if deaths > i64::from(MAX_SERVICE_DEATHS) && !job.cancel_requested {
                let detail = format!(
                    "The service died {deaths} times in a row while it had the job, which made no progress in between."
                );
                Outcome::Failed(interrupted(detail))
            } else {
                Outcome::Released
            };
            leave_running(&mut tx, &job, outcome, now).await?;
            ids.push(job.id);
        }
        tx.commit().await?;
        Ok(ids)
    }

    /// Puts jobs whose lease ended before `expired_at` back into the queue, or fails them if their
    /// attempts are used up. Returns their ids. Jobs in `held` stay as they are.
    ///
    /// Where processes share the registry, each tells of the end of its own workers: who lets a lease end is a service
    /// that has died, or stood still.
    ///
    /// # Errors
    /// The store's failures.
    pub async fn requeue_expired(
        &self,
        expired_at: Timestamp,
        held: &[JobId],
        now: Timestamp,
    ) -> Result<Vec<JobId>, StoreError> {
        if self.is_shared() {
            return self.requeue_of_dead(expired_at, held, now).await;
        }
        let mut tx = self.write_with_reserve().await?;
        let rows: Vec<JobRow> =
            sql("SELECT * FROM jobs WHERE state = 'running' AND lease_until_us <= $1 ORDER BY id")
                .bind(us(expired_at))
                .fetch_all(&mut *tx)
                .await?;
        let mut jobs: Vec<Job> = all(rows)?;
        jobs.retain(|job| !held.contains(&job.id));
        for job in &jobs {
            let detail =
                format!("The worker died or was stopped {} times while it had the job.", job.attempt);
            leave_running(&mut tx, job, Outcome::Retry(interrupted(detail)), now).await?;
        }
        tx.commit().await?;
        Ok(jobs.into_iter().map(|job| job.id).collect())
    }
}

fn interrupted(detail: String) -> Problem {
    Problem::new(500, "job.interrupted", "The job was interrupted too often", detail)
}

#[cfg(test)]
mod tests {
    use bytes::Bytes;
    use jiff::ToSpan;

    use super::super::testing::{TestStore, draft, now};
    use super::super::{Checkpoint, Claim, Lease};
    use super::*;
    use crate::domain::JobState;
    use crate::domain::job::{MAX_ATTEMPTS, SUSPECT_AFTER};

    async fn queued() -> (TestStore, JobId) {
        queued_in(TestStore::open().await).await
    }

    async fn queued_in(store: TestStore) -> (TestStore, JobId) {
        let rig = store.insert_rig(&draft("bench"), None, now()).await.unwrap().unwrap();
        let id = store.queue_fit(&rig).await.id;
        (store, id)
    }

    async fn claim(store: &Store) -> Option<Claim> {
        store.claim_job("w", now() + 30.seconds(), now()).await.unwrap()
    }

    async fn beat(store: &Store, lease: &Lease, progress: f64) {
        store.heartbeat(lease, "LSTM", progress, now() + 30.seconds(), now()).await.unwrap();
    }

    #[tokio::test]
    async fn a_job_whose_worker_is_lost_is_tried_three_times() {
        let (store, id) = queued_in(TestStore::open_sqlite().await).await;
        for attempt in 1..=MAX_ATTEMPTS {
            let claimed = claim(&store).await.unwrap();
            assert_eq!((claimed.job.attempt, claimed.lease.token), (attempt, u64::from(attempt)));
            assert_eq!(store.requeue_expired(now(), &[], now()).await.unwrap().len(), 0, "its lease lasts");
            assert_eq!(store.requeue_expired(Timestamp::MAX, &[], now()).await.unwrap(), [id]);
        }
        assert_eq!(claim(&store).await, None);
        let job = store.job(id).await.unwrap().unwrap();
        assert_eq!((job.state, job.problem.unwrap().code.as_str()), (JobState::Failed, "job.interrupted"));
    }

    #[tokio::test]
    async fn a_job_that_makes_progress_outlives_any_number_of_deaths_of_the_service() {
        let (store, id) = queued().await;
        for death in 0..10 * MAX_SERVICE_DEATHS {
            let claimed = claim(&store).await.expect("it goes on");
            assert_eq!(claimed.job.attempt, 1, "the job is not suspect");
            // A checkpoint now and then is enough, and so is work that comes further than ever.
            match death % MAX_SERVICE_DEATHS {
                0 if death % (2 * MAX_SERVICE_DEATHS) == 0 => {
                    let state = Bytes::from_static(b"state");
                    let checkpoint = Checkpoint { part: "a".into(), fits: String::new(), state };
                    assert!(store.keep_checkpoint(&claimed.lease, &checkpoint, now()).await.unwrap());
                }
                0 => beat(&store, &claimed.lease, f64::from(death) * 1e-3).await,
                _ => beat(&store, &claimed.lease, 1e-3).await,
            }
            assert_eq!(store.requeue_interrupted(now()).await.unwrap(), [id]);
        }
        let lease = claim(&store).await.unwrap().lease;
        let job = store.job(id).await.unwrap().unwrap();
        assert_eq!((lease.job, job.state, job.attempt), (id, JobState::Running, 1));
    }

    #[tokio::test]
    async fn a_job_under_which_the_service_always_dies_at_the_same_place_fails_in_the_end() {
        let (store, id) = queued().await;
        for _ in 0..=MAX_SERVICE_DEATHS {
            assert_eq!(store.job(id).await.unwrap().unwrap().state, JobState::Queued);
            beat(&store, &claim(&store).await.expect("it is tried again").lease, 0.25).await;
            store.requeue_interrupted(now()).await.unwrap();
        }
        assert_eq!(store.job(id).await.unwrap().unwrap().state, JobState::Failed);
        let problem = store.job(id).await.unwrap().unwrap().problem.unwrap();
        assert_eq!(problem.code, "job.interrupted");
        assert!(problem.detail.contains("21 times"), "{}", problem.detail);
    }

    #[tokio::test]
    async fn an_interrupted_job_goes_on_before_others_start_until_it_is_suspect() {
        let (store, _) = queued().await;
        let rig = store.rig(&"bench".parse().unwrap()).await.unwrap().unwrap();
        let first = claim(&store).await.unwrap();
        let later = store.queue_fit(&rig).await.id;
        let started = claim(&store).await.unwrap();
        assert_eq!(started.job.id, later);
        // The older one goes back without its turn, the younger one keeps its own.
        let problem = interrupted(String::new());
        store.finish_job(&first.lease, Outcome::Retry(problem), now()).await.unwrap();
        for _ in 1..SUSPECT_AFTER {
            store.requeue_interrupted(now()).await.unwrap();
            assert_eq!(claim(&store).await.unwrap().job.id, later, "its turn is not over");
        }
        store.requeue_interrupted(now()).await.unwrap();
        assert_eq!(claim(&store).await.unwrap().job.id, first.job.id, "it waits like the others");
    }

    #[tokio::test]
    async fn a_wish_to_cancel_outlives_the_service() {
        let (store, id) = queued().await;
        claim(&store).await.unwrap();
        store.request_cancel(id, now()).await.unwrap();
        store.requeue_interrupted(now()).await.unwrap();
        assert_eq!(store.job(id).await.unwrap().unwrap().state, JobState::Cancelled);
    }
}
