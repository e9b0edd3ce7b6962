//! The fit policy: which fits an accepted run sets off.
//!
//! Each fit of the list is queued at most once at a time. A run that comes while it is queued
//! joins it, because a job selects its runs when it starts; a run that comes while it is running
//! queues it once more. So the last round always sees all runs, and a burst of uploads costs two
//! rounds at most.

use jiff::Timestamp;
use sqlx::SqliteConnection;

use super::StoreError;
use super::jobs::{JobOrigin, insert};
use super::rows::json;
use crate::domain::{FitPolicy, JobId, JobKind, Rig, RigId, Run, RunKind, Split};

/// Applies the rig's policy to a run that was just added; the jobs that it queued or joined.
pub(super) async fn after_run(
    connection: &mut SqliteConnection,
    rig: &Rig,
    run: &Run,
    now: Timestamp,
) -> Result<Vec<JobId>, StoreError> {
    let Some(policy) = &rig.fit_policy else { return Ok(Vec::new()) };
    // A duplicate brings nothing new.
    let counts =
        run.split == Split::Training && policy.kinds.contains(&run.kind) && run.duplicate_of.is_none();
    if !counts || !enough(connection, &rig.id, policy).await? {
        return Ok(Vec::new());
    }
    let mut jobs = Vec::with_capacity(policy.fits.len());
    for fit in &policy.fits {
        let queued: Option<String> = sqlx::query_scalar(
            "SELECT id FROM jobs
             WHERE rig = ? AND state = 'queued' AND origin = 'policy' AND request = ?
             ORDER BY id LIMIT 1",
        )
        .bind(rig.id.as_str())
        .bind(json(fit))
        .fetch_optional(&mut *connection)
        .await?;
        let id = match queued {
            Some(id) => id.parse().map_err(|error: uuid::Error| StoreError::Row {
                table: "jobs",
                key: id.clone(),
                what: error.to_string(),
            })?,
            None => insert(connection, &rig.id, JobKind::Fit, fit, JobOrigin::Policy, now).await?.id,
        };
        if !jobs.contains(&id) {
            jobs.push(id);
        }
    }
    Ok(jobs)
}

/// Whether the rig's training runs of these kinds, each measurement once, are long enough.
async fn enough(
    connection: &mut SqliteConnection,
    rig: &RigId,
    policy: &FitPolicy,
) -> Result<bool, StoreError> {
    let kinds: Vec<&str> = policy.kinds.iter().copied().map(RunKind::as_str).collect();
    let total_s: f64 = sqlx::query_scalar(
        "SELECT total(duration_s) FROM runs
         WHERE rig = ? AND split = 'training' AND duplicate_of IS NULL
           AND kind IN (SELECT value FROM json_each(?))",
    )
    .bind(rig.as_str())
    .bind(json(&kinds))
    .fetch_one(connection)
    .await?;
    // Sixty runs of a second each are a minute, whatever the rounding of their sum.
    Ok(total_s >= policy.min_total_s * (1.0 - 1e-9))
}

#[cfg(test)]
mod tests {
    use jiff::ToSpan;
    use serde_json::json;

    use super::super::testing::{TestStore, draft, meta, now};
    use super::*;

    /// A rig that fits FRF and hybrid 2 from two seconds of noise (100 Hz).
    async fn rig_with_policy(store: &TestStore) -> Rig {
        let mut draft = draft("bench");
        draft.fit_policy = serde_json::from_value(json!({
            "kinds": ["noise"], "min_total_s": 2.0, "fits": [{"kind": "frf"}, {"kind": "hybrid2"}]
        }))
        .unwrap();
        store.insert_rig(&draft, None, now()).await.unwrap().unwrap()
    }

    /// No job, as opposed to no item of any other type.
    const NONE: [JobId; 0] = [];

    fn second(seed: f64) -> Vec<f64> {
        (0..100).map(|i| seed + f64::from(i)).collect()
    }

    #[tokio::test]
    async fn nothing_is_queued_before_the_runs_are_long_enough() {
        let store = TestStore::open().await;
        let rig = rig_with_policy(&store).await;
        assert_eq!(store.upload(&rig, &second(1.0)).await.jobs, NONE);
        let mut service = meta();
        service.kind = RunKind::Service;
        assert_eq!(store.upload_with(&rig, service, &second(2.0)).await.jobs, NONE);
        let mut test = meta();
        test.split = Split::Test;
        assert_eq!(store.upload_with(&rig, test, &second(3.0)).await.jobs, NONE);
        assert_eq!(store.upload(&rig, &second(1.0)).await.jobs, NONE, "a duplicate does not count");
        assert_eq!(store.upload(&rig, &second(4.0)).await.jobs.len(), 2);
    }

    #[tokio::test]
    async fn a_run_joins_what_is_queued_and_asks_for_one_more_round_of_what_is_running() {
        let store = TestStore::open().await;
        let rig = rig_with_policy(&store).await;
        store.upload(&rig, &second(1.0)).await;
        let first = store.upload(&rig, &second(2.0)).await.jobs;
        assert_eq!(first.len(), 2);
        assert_eq!(store.upload(&rig, &second(3.0)).await.jobs, first, "joined");
        assert_eq!(store.upload(&rig, &second(3.0)).await.jobs, NONE, "a duplicate sets nothing off");
        // The FRF starts: it is queued once more, the hybrid is joined.
        let claim = store.claim_job("w", now() + 30.seconds(), now()).await.unwrap().unwrap();
        assert_eq!(claim.job.id, first[0]);
        let second_round = store.upload(&rig, &second(4.0)).await.jobs;
        assert_eq!((second_round.len(), second_round[1]), (2, first[1]));
        assert!(!first.contains(&second_round[0]));
        assert_eq!(store.upload(&rig, &second(5.0)).await.jobs, second_round, "no third round");
        // Jobs start in the order in which they were queued.
        let next = store.claim_job("w", now() + 30.seconds(), now()).await.unwrap().unwrap();
        assert_eq!(next.job.id, first[1]);
    }

    #[tokio::test]
    async fn fits_that_a_person_asked_for_are_not_the_policys() {
        let store = TestStore::open().await;
        let rig = rig_with_policy(&store).await;
        let asked = store.queue_fit(&rig).await;
        store.upload(&rig, &second(1.0)).await;
        let jobs = store.upload(&rig, &second(2.0)).await.jobs;
        assert_eq!(jobs.len(), 2);
        assert!(!jobs.contains(&asked.id));
    }

    #[tokio::test]
    async fn many_short_runs_make_up_the_length_in_spite_of_rounding() {
        let store = TestStore::open().await;
        let rig = rig_with_policy(&store).await;
        for i in 0..19 {
            let run: Vec<f64> = (0..10).map(|k| f64::from(100 * i + k)).collect();
            assert_eq!(store.upload(&rig, &run).await.jobs, NONE);
        }
        assert_eq!(store.upload(&rig, &second(-1e3)[..10]).await.jobs.len(), 2);
    }
}
