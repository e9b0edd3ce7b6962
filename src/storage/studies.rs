//! Studies in the store: a job of kind `study`, and what it has found.

use jiff::Timestamp;
use serde::{Deserialize, Serialize};

use super::database::{Session, either, sql};
use super::jobs::succeed;
use super::models::insert_published;
use super::objects::ObjectWrite;
use super::rows::{StudyRow, json, us};
use super::{Activation, Digest, Lease, NewModel, Store, StoreError};
use crate::domain::study::{StoredStudy, StudyReport, StudySummary};
use crate::domain::{JobResult, Page, PageRequest, RigId, StudyId};

/// Part of a study's checkpoints that holds its report so far, as JSON.
pub const STUDY_PART: &str = "study";

/// What a study has found, on its way into the store.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct NewStudy {
    /// The result.
    pub report: StudyReport,
    /// The model that it publishes, and whether that becomes the active one.
    pub model: Option<(NewModel, Activation)>,
}

/// Every column of a study: its job, what it has found, and while it is under way its report so far.
macro_rules! select_studies {
    ($rest:literal) => {
        either(
            select_studies!("CAST(checkpoints.state AS TEXT)", $rest),
            select_studies!("convert_from(checkpoints.state, 'UTF8')", $rest),
        )
    };
    ($state:literal, $rest:literal) => {
        concat!(
            "SELECT jobs.id, jobs.rig, jobs.state, jobs.request, jobs.created_us, studies.version,
                    coalesce(studies.report,
                             (SELECT ",
            $state,
            " FROM checkpoints
                              WHERE checkpoints.job = jobs.id AND checkpoints.part = 'study')) AS report
             FROM jobs LEFT JOIN studies ON studies.job = jobs.id
             WHERE jobs.kind = 'study' AND jobs.rig = $1 AND ",
            $rest
        )
    };
}

impl Store {
    /// Stores what a study has found, publishes its model, and ends its job, in one transaction, if the lease still
    /// holds. `None`: the lease is lost, and nothing was changed. `stage` makes the job's last stage text from the
    /// model's version and whether it became active.
    ///
    /// # Errors
    /// The store's failures.
    pub async fn publish_study(
        &self,
        lease: &Lease,
        rig: &RigId,
        study: NewStudy,
        stage: impl FnOnce(Option<(u32, bool)>) -> String + Send,
        now: Timestamp,
    ) -> Result<Option<StudyId>, StoreError> {
        let Some((model, activation)) = study.model else {
            let mut tx = self.write().await?;
            let ended = end(&mut tx, lease, rig, &study.report, None, &stage(None), now).await?;
            if ended {
                tx.commit().await?;
            }
            return Ok(ended.then_some(lease.job));
        };
        let digest = Digest::of(&model.weights);
        let published = async {
            let ObjectWrite { kept: _kept, mut tx } = self.write_object(&digest, &model.weights).await?;
            let made = insert_published(&mut tx, rig, &digest, &model, &activation, now).await?;
            let Some((version, active)) = made else { return Ok(None) };
            let stage = stage(Some((version, active)));
            if !end(&mut tx, lease, rig, &study.report, Some(version), &stage, now).await? {
                return Ok(None);
            }
            tx.commit().await?;
            Ok(Some(lease.job))
        };
        self.discard_unless(Option::is_some, &digest, published).await
    }

    /// Studies of a rig, newest first; `None` when there is no such rig.
    ///
    /// # Errors
    /// The store's failures.
    pub async fn studies(
        &self,
        rig: &RigId,
        page: &PageRequest,
    ) -> Result<Option<Page<StudySummary>>, StoreError> {
        let sql = select_studies!("($2 IS NULL OR jobs.id < $2) ORDER BY jobs.id DESC LIMIT $3");
        let found = self.newest::<StudyRow, StoredStudy>(sql, rig, page, |one| one.summary.id.to_string());
        Ok(found.await?.map(|page| page.map(|one| one.summary)))
    }

    /// One study of a rig, with what it has found so far.
    ///
    /// # Errors
    /// The store's failures.
    pub async fn study(&self, rig: &RigId, id: StudyId) -> Result<Option<StoredStudy>, StoreError> {
        let row: Option<StudyRow> = sql(select_studies!("jobs.id = $2"))
            .bind(rig.as_str())
            .bind(id.to_string())
            .fetch_optional(self.reader())
            .await?;
        row.map(StoredStudy::try_from).transpose()
    }
}

/// Stores a report and ends the job; `false` when the lease is lost.
async fn end(
    connection: &mut Session,
    lease: &Lease,
    rig: &RigId,
    report: &StudyReport,
    version: Option<u32>,
    stage: &str,
    now: Timestamp,
) -> Result<bool, StoreError> {
    let job = lease.job;
    let result = JobResult {
        kind: "study".into(),
        id: job.to_string(),
        href: format!("/v1/rigs/{rig}/studies/{job}"),
    };
    if !succeed(connection, lease, &result, stage, now).await? {
        return Ok(false);
    }
    sql("INSERT INTO studies (job, version, report, created_us) VALUES ($1, $2, $3, $4)")
        .bind(job.to_string())
        .bind(version)
        .bind(json(report))
        .bind(us(now))
        .execute(connection)
        .await?;
    Ok(true)
}

#[cfg(test)]
mod tests {
    use jiff::ToSpan;
    use serde_json::json;

    use super::super::testing::{TestStore, draft, now};
    use super::super::{Asker, Checkpoint, JobInsert, Outcome};
    use super::*;
    use crate::domain::study::StudyRequest;
    use crate::domain::{JobKind, JobState, Rig};

    fn request() -> StudyRequest {
        serde_json::from_value(json!({"kind": "search", "fit": {"kind": "lstm"}})).unwrap()
    }

    fn report(planned: usize) -> StudyReport {
        serde_json::from_value(json!({"search": {"planned": planned, "trials": [], "best": null}})).unwrap()
    }

    async fn claimed(store: &TestStore, rig: &Rig) -> Lease {
        let asker = Asker { token: None, max_waiting: 9 };
        let JobInsert::Queued(job) = store.insert_job(&rig.id, &request(), asker, None, now()).await.unwrap()
        else {
            panic!("not queued")
        };
        assert_eq!(job.kind, JobKind::Study);
        store.claim_job("w", now() + 30.seconds(), now()).await.unwrap().unwrap().lease
    }

    async fn keep(store: &TestStore, lease: &Lease, report: &StudyReport) {
        let state = serde_json::to_vec(report).unwrap().into();
        let one = Checkpoint { part: STUDY_PART.into(), fits: "x".into(), state };
        assert!(store.keep_checkpoint(lease, &one, now()).await.unwrap());
    }

    #[tokio::test]
    async fn a_study_shows_what_it_has_found_while_it_runs_and_at_its_end() {
        let store = TestStore::open().await;
        let rig = store.insert_rig(&draft("bench"), None, now()).await.unwrap().unwrap();
        let lease = claimed(&store, &rig).await;
        let seen = async || store.study(&rig.id, lease.job).await.unwrap().unwrap();
        assert_eq!((seen().await.report, seen().await.summary.state), (None, JobState::Running));
        keep(&store, &lease, &report(3)).await;
        assert_eq!(seen().await.report, Some(report(3)));
        let study = NewStudy { report: report(4), model: None };
        let lost = Lease { token: lease.token + 1, ..lease.clone() };
        let stage = |_| "done".to_owned();
        let late = store.publish_study(&lost, &rig.id, study.clone(), stage, now()).await.unwrap();
        assert_eq!(late, None);
        let id = store.publish_study(&lease, &rig.id, study, stage, now()).await.unwrap();
        assert_eq!(id, Some(lease.job));
        let found = seen().await;
        assert_eq!((found.report, found.summary.state), (Some(report(4)), JobState::Succeeded));
        let job = store.job(lease.job).await.unwrap().unwrap();
        assert_eq!(job.result.unwrap().href, format!("/v1/rigs/bench/studies/{}", lease.job));
        let page = PageRequest { limit: 5, cursor: None };
        let listed = store.studies(&rig.id, &page).await.unwrap().unwrap();
        assert_eq!(listed.items, [found.summary]);
        assert_eq!(store.studies(&"nobody".parse().unwrap(), &page).await.unwrap(), None);
        assert_eq!(store.study(&"other".parse().unwrap(), lease.job).await.unwrap(), None);
        store.delete_rig(&rig.id).await.unwrap();
        assert_eq!(store.study(&rig.id, lease.job).await.unwrap(), None);
    }

    #[tokio::test]
    async fn a_cancelled_study_keeps_what_it_had_found_even_while_it_waits() {
        let store = TestStore::open().await;
        let rig = store.insert_rig(&draft("bench"), None, now()).await.unwrap().unwrap();
        for waits in [false, true] {
            let lease = claimed(&store, &rig).await;
            keep(&store, &lease, &report(7)).await;
            if waits {
                store.finish_job(&lease, Outcome::Yielded, now()).await.unwrap();
                let job = store.job(lease.job).await.unwrap().unwrap();
                assert_eq!((job.state, job.attempt), (JobState::Queued, 0));
                store.request_cancel(lease.job, now()).await.unwrap();
            } else {
                store.finish_job(&lease, Outcome::Cancelled, now()).await.unwrap();
            }
            let found = store.study(&rig.id, lease.job).await.unwrap().unwrap();
            assert_eq!((found.summary.state, found.report), (JobState::Cancelled, Some(report(7))));
        }
    }
}
