//! Diagnoses in the store.

use bytes::Bytes;
use jiff::Timestamp;
use serde::{Deserialize, Serialize};

use super::database::sql;
use super::jobs::succeed;
use super::objects::ObjectWrite;
use super::rows::{DiagnosisRow, int, json, us, word};
use super::{Digest, Lease, Store, StoreError};
use crate::domain::diagnosis::VerdictSummary;
use crate::domain::{
    DiagnosisId, DiagnosisRequest, DiagnosisSummary, JobResult, Page, PageRequest, RigId, StoredDiagnosis,
    UsedModel, new_id,
};

/// A diagnosis on its way into the store.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct NewDiagnosis {
    /// The model that was diagnosed, if it was one of the rig's.
    pub model: Option<UsedModel>,
    /// The request, resolved.
    pub request: DiagnosisRequest,
    /// The answer in short.
    pub verdict: VerdictSummary,
    /// JSON of the findings; travels beside other JSON, not in it.
    #[serde(skip)]
    pub findings: Bytes,
    /// Seconds that it took.
    pub elapsed_s: f64,
}

impl Store {
    /// Stores a diagnosis and ends its job, whose last words are `stage`, in one transaction, if the
    /// lease still holds. `None`: the lease is lost, and nothing was changed.
    ///
    /// # Errors
    /// The store's failures.
    pub async fn publish_diagnosis(
        &self,
        lease: &Lease,
        diagnosis: NewDiagnosis,
        stage: &str,
        now: Timestamp,
    ) -> Result<Option<DiagnosisId>, StoreError> {
        let digest = Digest::of(&diagnosis.findings);
        let published = self.publish_diagnosis_gated(lease, &digest, diagnosis, stage, now);
        self.discard_unless(Option::is_some, &digest, published).await
    }

    async fn publish_diagnosis_gated(
        &self,
        lease: &Lease,
        digest: &Digest,
        diagnosis: NewDiagnosis,
        stage: &str,
        now: Timestamp,
    ) -> Result<Option<DiagnosisId>, StoreError> {
        let ObjectWrite { kept: _kept, mut tx } = self.write_object(digest, &diagnosis.findings).await?;
        let id = new_id(now);
        let rig: Option<String> = sql(
            "INSERT INTO diagnoses (id, rig, job, version, model_sha256, mode, request, verdict, findings,
                                    elapsed_s, created_us)
             SELECT $1, rig, id, $2, $3, $4, $5, $6, $7, $8, $9 FROM jobs
             WHERE id = $10 AND state = 'running' AND lease_token = $11
             RETURNING rig",
        )
        .bind(id.to_string())
        .bind(diagnosis.model.as_ref().map(|model| model.version))
        .bind(diagnosis.model.as_ref().map(|model| model.sha256.as_str()))
        .bind(word(&diagnosis.request.mode))
        .bind(json(&diagnosis.request))
        .bind(json(&diagnosis.verdict))
        .bind(digest.as_str())
        .bind(diagnosis.elapsed_s)
        .bind(us(now))
        .bind(lease.job.to_string())
        .bind(int(lease.token))
        .fetch_optional(&mut *tx)
        .await?;
        let Some(rig) = rig else { return Ok(None) };
        let result = JobResult {
            kind: "diagnosis".into(),
            id: id.to_string(),
            href: format!("/v1/rigs/{rig}/diagnoses/{id}"),
        };
        if !succeed(&mut tx, lease, &result, stage, now).await? {
            return Ok(None);
        }
        tx.commit().await?;
        Ok(Some(id))
    }

    /// Diagnoses of a rig, newest first; `None` when there is no such rig.
    ///
    /// # Errors
    /// The store's failures.
    pub async fn diagnoses(
        &self,
        rig: &RigId,
        page: &PageRequest,
    ) -> Result<Option<Page<DiagnosisSummary>>, StoreError> {
        let sql =
            "SELECT * FROM diagnoses WHERE rig = $1 AND ($2 IS NULL OR id < $2) ORDER BY id DESC LIMIT $3";
        self.newest::<DiagnosisRow, DiagnosisSummary>(sql, rig, page, |one| one.id.to_string()).await
    }

    /// One diagnosis of a rig.
    ///
    /// # Errors
    /// The store's failures.
    pub async fn diagnosis(
        &self,
        rig: &RigId,
        id: DiagnosisId,
    ) -> Result<Option<StoredDiagnosis>, StoreError> {
        let row: Option<DiagnosisRow> = sql("SELECT * FROM diagnoses WHERE rig = $1 AND id = $2")
            .bind(rig.as_str())
            .bind(id.to_string())
            .fetch_optional(self.reader())
            .await?;
        row.map(StoredDiagnosis::try_from).transpose()
    }

    /// The findings of a diagnosis, verified.
    ///
    /// # Errors
    /// The store's failures, a damaged or missing object among them.
    pub async fn findings(
        &self,
        diagnosis: &StoredDiagnosis,
    ) -> Result<crate::domain::diagnosis::Findings, StoreError> {
        let key = diagnosis.summary.id.to_string();
        self.objects().get_json(&diagnosis.findings, "diagnoses", key).await
    }
}

#[cfg(test)]
mod tests {
    use jiff::ToSpan;

    use super::super::testing::{TestStore, draft, now};
    use super::super::{Asker, JobInsert};
    use super::*;
    use crate::domain::{Job, JobKind, JobState, Rig};

    fn request() -> DiagnosisRequest {
        serde_json::from_value(serde_json::json!({"runs": []})).unwrap()
    }

    fn new(findings: &'static [u8]) -> NewDiagnosis {
        let verdict = serde_json::json!({
            "kind": "identified", "effect": "cubic_stiffness", "family": "stiffness", "axis": "x",
            "channel": "y", "probability": 0.9,
        });
        NewDiagnosis {
            model: Some(UsedModel { version: 3, sha256: "ab".into() }),
            request: request(),
            verdict: serde_json::from_value(verdict).unwrap(),
            findings: Bytes::from_static(findings),
            elapsed_s: 1.5,
        }
    }

    async fn queued(store: &TestStore, rig: &Rig) -> Job {
        let asker = Asker { token: None, max_waiting: 1 };
        match store.insert_job(&rig.id, &request(), asker, None, now()).await.unwrap() {
            JobInsert::Queued(job) => *job,
            other => panic!("{other:?}"),
        }
    }

    async fn published(store: &TestStore, rig: &Rig, findings: &'static [u8]) -> DiagnosisId {
        queued(store, rig).await;
        let lease = store.claim_job("w", now() + 30.seconds(), now()).await.unwrap().unwrap().lease;
        store.publish_diagnosis(&lease, new(findings), "found", now()).await.unwrap().unwrap()
    }

    #[tokio::test]
    async fn a_diagnosis_is_stored_once_with_the_end_of_its_job_and_goes_with_its_rig() {
        let store = TestStore::open().await;
        let rig = store.insert_rig(&draft("bench"), None, now()).await.unwrap().unwrap();
        let job = queued(&store, &rig).await;
        assert_eq!(job.kind, JobKind::Diagnosis);
        let lease = store.claim_job("w", now() + 30.seconds(), now()).await.unwrap().unwrap().lease;
        let lost = Lease { token: lease.token + 1, ..lease.clone() };
        assert_eq!(store.publish_diagnosis(&lost, new(b"late"), "", now()).await.unwrap(), None);
        let id = store.publish_diagnosis(&lease, new(b"good"), "found", now()).await.unwrap().unwrap();
        assert_eq!(store.publish_diagnosis(&lease, new(b"again"), "", now()).await.unwrap(), None);
        let job = store.job(job.id).await.unwrap().unwrap();
        assert_eq!((job.state, job.stage.as_deref()), (JobState::Succeeded, Some("found")));
        assert_eq!(job.result.unwrap().href, format!("/v1/rigs/bench/diagnoses/{id}"));
        let stored = store.diagnosis(&rig.id, id).await.unwrap().unwrap();
        assert_eq!((stored.summary.verdict.clone(), stored.elapsed_s), (new(b"").verdict, 1.5));
        assert_eq!(store.diagnosis(&"other".parse().unwrap(), id).await.unwrap(), None);
        for gone in [&b"late"[..], b"again"] {
            let read = store.objects().get(Digest::of(gone).as_str()).await;
            assert!(matches!(read, Err(StoreError::ObjectMissing { .. })));
        }
        assert!(matches!(store.findings(&stored).await, Err(StoreError::Row { .. })), "no findings");
        store.sweep_objects().await.unwrap();
        assert_eq!(store.objects().get(&stored.findings).await.unwrap(), b"good"[..]);
        store.delete_rig(&rig.id).await.unwrap();
        let read = store.objects().get(&stored.findings).await;
        assert!(matches!(read, Err(StoreError::ObjectMissing { .. })));
    }

    #[tokio::test]
    async fn diagnoses_are_listed_in_pages_newest_first() {
        let store = TestStore::open().await;
        let rig = store.insert_rig(&draft("bench"), None, now()).await.unwrap().unwrap();
        let (first, second) = (published(&store, &rig, b"1").await, published(&store, &rig, b"1").await);
        let mut page = PageRequest { limit: 1, cursor: None };
        let listed = store.diagnoses(&rig.id, &page).await.unwrap().unwrap();
        assert_eq!((listed.items[0].id, listed.next.as_deref()), (second, Some(&*second.to_string())));
        page.cursor = Some(crate::domain::Cursor::parse(&second.to_string()).unwrap());
        let listed = store.diagnoses(&rig.id, &page).await.unwrap().unwrap();
        assert_eq!((listed.items[0].id, listed.next), (first, None));
        assert_eq!(store.diagnoses(&"nobody".parse().unwrap(), &page).await.unwrap(), None);
    }
}
