//! The errors of active models on the runs of their rigs.

use jiff::Timestamp;

use super::database::{Pool, Session, postgres, sql};
use super::rows::{DriftEntry, all, json, parsed, us};
use super::{Store, StoreError};
use crate::domain::RigId;
use crate::domain::drift::{DriftRow, DueRun, Outcome};

/// The right to judge runs.
pub struct DriftTurn {
    _held: Option<Session>,
}

/// Runs without an outcome under the active version of their rig.
macro_rules! due_runs {
    ($select:literal, $rest:literal) => {
        concat!(
            $select,
            " FROM rigs JOIN runs ON runs.rig = rigs.id
              WHERE rigs.active_version IS NOT NULL
                AND NOT EXISTS (SELECT 1 FROM drift WHERE drift.rig = rigs.id
                                AND drift.version = rigs.active_version AND drift.run = runs.id) ",
            $rest
        )
    };
}

impl Store {
    /// Of each rig with an active model the newest run that waits to be predicted by it.
    ///
    /// # Errors
    /// The store's failures.
    pub async fn due_runs(&self) -> Result<Vec<DueRun>, StoreError> {
        let rows: Vec<(String, u32, String)> = sql(due_runs!(
            "SELECT rigs.id, rigs.active_version, max(runs.id)",
            "GROUP BY rigs.id ORDER BY rigs.id"
        ))
        .fetch_all(self.reader())
        .await?;
        let due = |(rig, version, run): (String, u32, String)| {
            Ok(DueRun { rig: parsed("rigs", &rig, &rig)?, version, run: parsed("runs", &run, &run)? })
        };
        rows.into_iter().map(due).collect()
    }

    /// The right to judge runs, which one process has at a time; `None` while another has it. It ends when it is dropped.
    ///
    /// # Errors
    /// The store's failures.
    pub async fn drift_turn(&self) -> Result<Option<DriftTurn>, StoreError> {
        let Pool::Postgres(_) = self.reader() else { return Ok(Some(DriftTurn { _held: None })) };
        let mut held = self.snapshot().await?;
        let is_ours = postgres::take_turn(&mut held).await?;
        Ok(is_ours.then_some(DriftTurn { _held: Some(held) }))
    }

    /// Number of runs of a rig that wait to be predicted by its active model.
    ///
    /// # Errors
    /// The store's failures.
    pub async fn count_due_runs(&self, rig: &RigId) -> Result<u64, StoreError> {
        let count: i64 = sql(due_runs!("SELECT count(*)", "AND rigs.id = $1"))
            .bind(rig.as_str())
            .fetch_one(self.reader())
            .await?;
        Ok(count.unsigned_abs())
    }

    /// Stores the outcome of a run under a version, unless there is one, or the run or the version is gone.
    ///
    /// # Errors
    /// The store's failures.
    pub async fn insert_drift(
        &self,
        due: &DueRun,
        outcome: &Outcome,
        now: Timestamp,
    ) -> Result<(), StoreError> {
        let ratio = match outcome {
            Outcome::Judged(judgement) => judgement.ratio,
            Outcome::Omitted(_) => None,
        };
        let mut tx = self.write().await?;
        sql(
            "INSERT INTO drift (rig, version, run, outcome, ratio, created_us)
             SELECT models.rig, models.version, runs.id, $4, $5, $6 FROM models JOIN runs ON runs.rig = models.rig
             WHERE models.rig = $1 AND models.version = $2 AND runs.id = $3
             ON CONFLICT (rig, version, run) DO NOTHING",
        )
        .bind(due.rig.as_str())
        .bind(due.version)
        .bind(due.run.to_string())
        .bind(json(outcome))
        .bind(ratio)
        .bind(us(now))
        .execute(&mut *tx)
        .await?;
        tx.commit().await?;
        Ok(())
    }

    /// The runs of a rig under a version, by time.
    ///
    /// # Errors
    /// The store's failures.
    pub async fn drift(&self, rig: &RigId, version: u32) -> Result<Vec<DriftRow>, StoreError> {
        let rows: Vec<DriftEntry> = sql(
            "SELECT runs.id, runs.name, runs.kind, coalesce(runs.started_us, runs.created_us) AS at_us, drift.outcome
             FROM drift JOIN runs ON runs.id = drift.run
             WHERE drift.rig = $1 AND drift.version = $2 ORDER BY at_us, runs.id",
        )
        .bind(rig.as_str())
        .bind(version)
        .fetch_all(self.reader())
        .await?;
        all(rows)
    }

    /// Of each rig the largest ratio of error to limit of the newest run that its active model was held against; at
    /// most `limit` rigs, by id.
    ///
    /// # Errors
    /// The store's failures.
    pub async fn error_ratios(&self, limit: u32) -> Result<Vec<(String, f64)>, StoreError> {
        let rows = sql(
            "SELECT rig, ratio FROM (
                SELECT drift.rig, drift.ratio,
                       row_number() OVER (PARTITION BY drift.rig
                                          ORDER BY coalesce(runs.started_us, runs.created_us) DESC, runs.id DESC) AS age
                FROM drift JOIN rigs ON rigs.id = drift.rig AND rigs.active_version = drift.version
                JOIN runs ON runs.id = drift.run
                WHERE drift.ratio IS NOT NULL
             ) AS judged WHERE age = 1 ORDER BY rig LIMIT $1",
        )
        .bind(limit)
        .fetch_all(self.reader())
        .await?;
        Ok(rows)
    }
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;

    use super::super::testing::{TestStore, draft, now};
    use super::*;
    use crate::domain::drift::{Judgement, NotPredicted};
    use crate::domain::{RunId, RunKind};

    fn judged(ratio: Option<f64>) -> Outcome {
        let judgement = Judgement::new(BTreeMap::from([("y".into(), Some(0.5))]), 1.0, 1.0, None);
        Outcome::Judged(Judgement { ratio, ..judgement })
    }

    #[tokio::test]
    async fn each_run_has_one_outcome_under_the_active_version_and_waits_until_then() {
        let store = TestStore::open().await;
        let rig = store.insert_rig(&draft("bench"), None, now()).await.unwrap().unwrap();
        let first = store.upload(&rig, &[1.0, 2.0]).await.run;
        assert_eq!(store.due_runs().await.unwrap(), [], "no model is active");
        let version = store.import(&rig, b"weights").await.version;
        store.set_active_model(&rig.id, Some(version), "*", now()).await.unwrap();
        let second = store.upload(&rig, &[3.0, 4.0]).await.run;
        let due = |run: RunId| DueRun { rig: rig.id.clone(), version, run };
        assert_eq!(store.due_runs().await.unwrap(), [due(second.id)], "the newest first");
        assert_eq!(store.count_due_runs(&rig.id).await.unwrap(), 2);
        store.insert_drift(&due(second.id), &judged(Some(2.0)), now()).await.unwrap();
        store.insert_drift(&due(second.id), &judged(Some(9.0)), now()).await.unwrap();
        assert_eq!(store.due_runs().await.unwrap(), [due(first.id)]);
        store.insert_drift(&due(first.id), &Outcome::Omitted(NotPredicted::Training), now()).await.unwrap();
        assert_eq!(store.due_runs().await.unwrap(), []);
        let found = store.drift(&rig.id, version).await.unwrap();
        assert_eq!(found.iter().map(|row| row.run).collect::<Vec<_>>(), [first.id, second.id]);
        assert_eq!((&found[1].outcome, found[1].kind), (&judged(Some(2.0)), RunKind::Noise));
        assert_eq!(store.error_ratios(9).await.unwrap(), [("bench".to_owned(), 2.0)]);

        let other = store.import(&rig, b"other").await.version;
        store.set_active_model(&rig.id, Some(other), "*", now()).await.unwrap();
        assert_eq!(store.error_ratios(9).await.unwrap(), [], "the other version has judged nothing yet");
        assert_eq!(store.count_due_runs(&rig.id).await.unwrap(), 2);
        store.delete_model(&rig.id, version).await.unwrap();
        store.insert_drift(&due(second.id), &judged(None), now()).await.unwrap();
        assert_eq!(store.drift(&rig.id, version).await.unwrap(), [], "what is gone has no outcome");
    }

    #[tokio::test]
    async fn a_run_of_another_kind_is_judged_again() {
        let store = TestStore::open().await;
        let rig = store.insert_rig(&draft("bench"), None, now()).await.unwrap().unwrap();
        let version = store.import(&rig, b"weights").await.version;
        store.set_active_model(&rig.id, Some(version), "*", now()).await.unwrap();
        let run = store.upload(&rig, &[1.0, 2.0]).await.run.id;
        let due = DueRun { rig: rig.id.clone(), version, run };
        store.insert_drift(&due, &judged(Some(0.5)), now()).await.unwrap();
        let patch = |json: &str| serde_json::from_str(json).unwrap();
        store.patch_run(&rig.id, run, patch(r#"{"name": "n1"}"#)).await.unwrap();
        assert_eq!(store.due_runs().await.unwrap(), []);
        store.patch_run(&rig.id, run, patch(r#"{"kind": "service"}"#)).await.unwrap();
        assert_eq!(store.due_runs().await.unwrap(), [due]);
        store.delete_run(&rig.id, run).await.unwrap();
        assert_eq!(store.due_runs().await.unwrap(), []);
    }
}
