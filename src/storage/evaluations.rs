//! Evaluations in the store. Their reports are objects.

use bytes::Bytes;
use jiff::Timestamp;
use serde::{Deserialize, Serialize};

use super::database::sql;
use super::jobs::succeed;
use super::objects::ObjectWrite;
use super::rows::{EvaluationRow, int, json, us};
use super::{Digest, Lease, Store, StoreError};
use crate::domain::evaluation::{EvaluationOutline, EvaluationReport};
use crate::domain::{
    EvaluationId, EvaluationRequest, EvaluationSummary, JobResult, Page, PageRequest, RigId,
    StoredEvaluation, new_id,
};

/// An evaluation on its way into the store.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct NewEvaluation {
    /// The request, resolved.
    pub request: EvaluationRequest,
    /// The report in a few words.
    pub outline: EvaluationOutline,
    /// JSON of the report; travels beside other JSON, not in it.
    #[serde(skip)]
    pub report: Bytes,
    /// Seconds that it took.
    pub elapsed_s: f64,
}

impl Store {
    /// Stores an evaluation and ends its job, whose last words are `stage`, in one transaction, if the lease still
    /// holds. `None`: the lease is lost, and nothing was changed.
    ///
    /// # Errors
    /// The store's failures.
    pub async fn publish_evaluation(
        &self,
        lease: &Lease,
        evaluation: NewEvaluation,
        stage: &str,
        now: Timestamp,
    ) -> Result<Option<EvaluationId>, StoreError> {
        let digest = Digest::of(&evaluation.report);
        let published = self.publish_evaluation_gated(lease, &digest, evaluation, stage, now);
        self.discard_unless(Option::is_some, &digest, published).await
    }

    async fn publish_evaluation_gated(
        &self,
        lease: &Lease,
        digest: &Digest,
        evaluation: NewEvaluation,
        stage: &str,
        now: Timestamp,
    ) -> Result<Option<EvaluationId>, StoreError> {
        let ObjectWrite { kept: _kept, mut tx } = self.write_object(digest, &evaluation.report).await?;
        let id = new_id(now);
        let rig: Option<String> =
            sql("INSERT INTO evaluations (id, rig, job, request, outline, report, elapsed_s, created_us)
             SELECT $1, rig, id, $2, $3, $4, $5, $6 FROM jobs
             WHERE id = $7 AND state = 'running' AND lease_token = $8
             RETURNING rig")
            .bind(id.to_string())
            .bind(json(&evaluation.request))
            .bind(json(&evaluation.outline))
            .bind(digest.as_str())
            .bind(evaluation.elapsed_s)
            .bind(us(now))
            .bind(lease.job.to_string())
            .bind(int(lease.token))
            .fetch_optional(&mut *tx)
            .await?;
        let Some(rig) = rig else { return Ok(None) };
        let result = JobResult {
            kind: "evaluation".into(),
            id: id.to_string(),
            href: format!("/v1/rigs/{rig}/evaluations/{id}"),
        };
        if !succeed(&mut tx, lease, &result, stage, now).await? {
            return Ok(None);
        }
        tx.commit().await?;
        Ok(Some(id))
    }

    /// Evaluations of a rig, newest first; `None` when there is no such rig.
    ///
    /// # Errors
    /// The store's failures.
    pub async fn evaluations(
        &self,
        rig: &RigId,
        page: &PageRequest,
    ) -> Result<Option<Page<EvaluationSummary>>, StoreError> {
        let sql =
            "SELECT * FROM evaluations WHERE rig = $1 AND ($2 IS NULL OR id < $2) ORDER BY id DESC LIMIT $3";
        self.newest::<EvaluationRow, EvaluationSummary>(sql, rig, page, |one| one.id.to_string()).await
    }

    /// One evaluation of a rig.
    ///
    /// # Errors
    /// The store's failures.
    pub async fn evaluation(
        &self,
        rig: &RigId,
        id: EvaluationId,
    ) -> Result<Option<StoredEvaluation>, StoreError> {
        let row: Option<EvaluationRow> = sql("SELECT * FROM evaluations WHERE rig = $1 AND id = $2")
            .bind(rig.as_str())
            .bind(id.to_string())
            .fetch_optional(self.reader())
            .await?;
        row.map(StoredEvaluation::try_from).transpose()
    }

    /// The report of an evaluation, verified.
    ///
    /// # Errors
    /// The store's failures, a damaged or missing object among them.
    pub async fn evaluation_report(
        &self,
        evaluation: &StoredEvaluation,
    ) -> Result<EvaluationReport, StoreError> {
        let key = evaluation.summary.id.to_string();
        self.objects().get_json(&evaluation.report, "evaluations", key).await
    }
}

#[cfg(test)]
mod tests {
    use jiff::ToSpan;
    use serde_json::json;

    use super::super::testing::{TestStore, draft, now};
    use super::super::{Asker, JobInsert};
    use super::*;
    use crate::domain::{JobKind, JobState, Rig};

    fn new(report: &'static [u8]) -> NewEvaluation {
        let outline = json!({"models": [2], "baseline": null, "classes": ["service"], "runs": 4});
        NewEvaluation {
            request: EvaluationRequest::default(),
            outline: serde_json::from_value(outline).unwrap(),
            report: Bytes::from_static(report),
            elapsed_s: 2.5,
        }
    }

    async fn leased(store: &TestStore, rig: &Rig) -> Lease {
        let asker = Asker { token: None, max_waiting: 1 };
        let request = EvaluationRequest::default();
        let queued = store.insert_job(&rig.id, &request, asker, None, now()).await.unwrap();
        assert!(matches!(queued, JobInsert::Queued(job) if job.kind == JobKind::Evaluation));
        store.claim_job("w", now() + 30.seconds(), now()).await.unwrap().unwrap().lease
    }

    #[tokio::test]
    async fn an_evaluation_is_stored_once_with_the_end_of_its_job_and_goes_with_its_rig() {
        let store = TestStore::open().await;
        let rig = store.insert_rig(&draft("bench"), None, now()).await.unwrap().unwrap();
        let lease = leased(&store, &rig).await;
        let lost = Lease { token: lease.token + 1, ..lease.clone() };
        assert_eq!(store.publish_evaluation(&lost, new(b"late"), "", now()).await.unwrap(), None);
        let id = store.publish_evaluation(&lease, new(b"good"), "done", now()).await.unwrap().unwrap();
        assert_eq!(store.publish_evaluation(&lease, new(b"again"), "", now()).await.unwrap(), None);
        let job = store.job(lease.job).await.unwrap().unwrap();
        assert_eq!((job.state, job.stage.as_deref()), (JobState::Succeeded, Some("done")));
        assert_eq!(job.result.unwrap().href, format!("/v1/rigs/bench/evaluations/{id}"));
        let stored = store.evaluation(&rig.id, id).await.unwrap().unwrap();
        assert_eq!((stored.summary.outline.clone(), stored.elapsed_s), (new(b"").outline, 2.5));
        assert_eq!(store.evaluation(&"other".parse().unwrap(), id).await.unwrap(), None);
        for gone in [&b"late"[..], b"again"] {
            let read = store.objects().get(Digest::of(gone).as_str()).await;
            assert!(matches!(read, Err(StoreError::ObjectMissing { .. })));
        }
        assert!(matches!(store.evaluation_report(&stored).await, Err(StoreError::Row { .. })), "no report");
        store.sweep_objects().await.unwrap();
        assert_eq!(store.objects().get(&stored.report).await.unwrap(), b"good"[..]);
        store.delete_rig(&rig.id).await.unwrap();
        let read = store.objects().get(&stored.report).await;
        assert!(matches!(read, Err(StoreError::ObjectMissing { .. })));
    }

    #[tokio::test]
    async fn evaluations_are_listed_newest_first_and_a_damaged_report_is_named() {
        let store = TestStore::open_sqlite().await;
        let rig = store.insert_rig(&draft("bench"), None, now()).await.unwrap().unwrap();
        let mut ids = Vec::new();
        for report in [&b"1"[..], b"2"] {
            let lease = leased(&store, &rig).await;
            ids.push(store.publish_evaluation(&lease, new(report), "", now()).await.unwrap().unwrap());
        }
        let page = PageRequest { limit: 1, cursor: None };
        let listed = store.evaluations(&rig.id, &page).await.unwrap().unwrap();
        assert_eq!((listed.items[0].id, listed.next.as_deref()), (ids[1], Some(&*ids[1].to_string())));
        assert_eq!(store.evaluations(&"nobody".parse().unwrap(), &page).await.unwrap(), None);
        let stored = store.evaluation(&rig.id, ids[0]).await.unwrap().unwrap();
        std::fs::write(store.objects().path_of(&stored.report), b"other").unwrap();
        assert!(matches!(store.evaluation_report(&stored).await, Err(StoreError::ObjectDamaged { .. })));
        let corrupt = store.corrupt_objects().await.unwrap();
        assert_eq!(corrupt, [(rig.id, super::super::CorruptObject::Evaluation(ids[0]))]);
    }
}
