//! Drive-file iterations in the store. The drive that one found is a run.

use std::path::Path;

use bytes::Bytes;
use jiff::Timestamp;
use serde::{Deserialize, Serialize};

use super::database::sql;
use super::jobs::{insert_requested, refusal, succeed};
use super::objects::{ObjectWrite, off_thread, to_the_end};
use super::prepare::NewRun;
use super::rigs::rig_in;
use super::rows::{IterationRow, int, json, us};
use super::runs::insert_row;
use super::{Asker, Digest, IdempotencyKey, JobInsert, Lease, PrepareError, PreparedRun, Store, StoreError};
use crate::domain::iteration::{IterationReport, IterationTarget};
use crate::domain::text::MAX_NAME_CHARS;
use crate::domain::{
    IterationId, IterationRequest, IterationSummary, JobResult, Page, PageRequest, Rig, RigId, RunKind,
    RunMeta, Split, StoredIteration, UsedModel, new_id,
};
use crate::engine::Signal;

/// Tag of the runs that hold iterated drives.
const TAG: &str = "iterated";

/// Tag of the runs that hold targets which came with their request.
const TARGET_TAG: &str = "target";

/// An iteration on its way into the store.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct NewIteration {
    /// The model that was iterated on.
    pub model: UsedModel,
    /// The request, resolved.
    pub request: IterationRequest,
    /// The result.
    pub report: IterationReport,
    /// Seconds that it took.
    pub elapsed_s: f64,
    /// Name of the run that will hold the drive.
    pub name: String,
    /// Drives, in the order of their samples.
    pub drives: Vec<String>,
    /// Samples of the drives one after the other, `f64` little endian; travels beside other JSON, not in it.
    #[serde(skip)]
    pub samples: Bytes,
}

impl NewIteration {
    /// The bytes of a drive.
    pub fn bytes_of(drive: &Signal) -> Bytes {
        drive.channels().iter().flatten().flat_map(|v| v.to_le_bytes()).collect()
    }

    /// The run that holds the drive.
    fn prepare(&self, scratch: &Path, rig: &Rig) -> Result<PreparedRun, StoreError> {
        let bad = |what: String| StoreError::Row { table: "iterations", key: rig.id.to_string(), what };
        let (numbers, _) = self.samples.as_chunks::<8>();
        let values: Vec<f64> = numbers.iter().map(|bytes| f64::from_le_bytes(*bytes)).collect();
        let per_drive = (values.len() / self.drives.len().max(1)).max(1);
        let channels = values.chunks(per_drive).map(<[f64]>::to_vec).collect();
        let drive = Signal::new(rig.sample_rate_hz, channels).map_err(|error| bad(error.to_string()))?;
        let run = unmeasured(scratch, rig, self.name.clone(), TAG, self.drives.clone(), drive, &self.samples);
        run.map_err(|error| match error {
            PrepareError::Store(error) => error,
            PrepareError::Unsuitable(errors) => bad(format!("{errors:?}")),
        })
    }
}

/// A run of signals that nothing has measured, which are also `bytes`: as a test run it never enters a fit.
fn unmeasured(
    scratch: &Path,
    rig: &Rig,
    name: String,
    tag: &str,
    channels: Vec<String>,
    signal: Signal,
    bytes: &Bytes,
) -> Result<PreparedRun, PrepareError> {
    let (kind, split, tags) = (RunKind::Other, Split::Test, vec![tag.to_owned()]);
    let meta = RunMeta { name, kind, split, tags, started_at: None };
    let sha256 = Digest::of(bytes).as_str().to_owned();
    PreparedRun::new(scratch, rig, meta, channels, Vec::new(), signal, sha256)
}

impl Store {
    /// Makes a target that came with a request a run: its channels in order, and the name of the iteration, if it has one.
    ///
    /// # Errors
    /// A target that does not suit the rig, its fields below `/target`; the store's failures.
    pub async fn prepare_target(
        &self,
        rig: &Rig,
        name: Option<&str>,
        channels: Vec<String>,
        target: Signal,
    ) -> Result<PreparedRun, PrepareError> {
        let name = name.map_or_else(|| "target".to_owned(), |name| format!("target for {name}"));
        let name = name.chars().take(MAX_NAME_CHARS).collect();
        let (scratch, rig) = (self.scratch_dir(), rig.clone());
        let prepared = off_thread(move || {
            let bytes = NewIteration::bytes_of(&target);
            Ok(unmeasured(&scratch, &rig, name, TARGET_TAG, channels, target, &bytes))
        })
        .await?;
        prepared.map_err(|error| match error {
            PrepareError::Unsuitable(mut errors) => {
                for error in &mut errors {
                    error.pointer.insert_str(0, "/target");
                }
                PrepareError::Unsuitable(errors)
            }
            error => error,
        })
    }

    /// Stores the target of an iteration as a run and queues the iteration, whose request names that run, in one
    /// transaction. Completes even if the caller goes away.
    ///
    /// # Errors
    /// The store's failures.
    pub async fn insert_iteration_job_for(
        &self,
        rig: &RigId,
        request: IterationRequest<()>,
        target: PreparedRun,
        asker: Asker,
        key: Option<IdempotencyKey>,
        now: Timestamp,
    ) -> Result<JobInsert, StoreError> {
        let (store, rig) = (self.clone(), rig.clone());
        to_the_end(async move {
            let object = target.object.digest().clone();
            let inserted = store.insert_iteration_job_gated(&rig, request, target, asker, key.as_ref(), now);
            let made = |inserted: &JobInsert| matches!(inserted, JobInsert::Queued(_));
            store.discard_unless(made, &object, inserted).await
        })
        .await
    }

    async fn insert_iteration_job_gated(
        &self,
        rig: &RigId,
        request: IterationRequest<()>,
        target: PreparedRun,
        asker: Asker,
        key: Option<&IdempotencyKey>,
        now: Timestamp,
    ) -> Result<JobInsert, StoreError> {
        let PreparedRun { row, object } = target;
        let ObjectWrite { kept: _kept, mut tx } = self.write_object_file(object).await?;
        if let Some(refused) = refusal(&mut tx, rig, asker, key).await? {
            return Ok(refused);
        }
        let run = insert_row(&mut tx, rig, &row, now).await?.id;
        let (request, ()) = request.with_target(IterationTarget { run, channels: None });
        let job = insert_requested(&mut tx, rig, &request, asker, key, now).await?;
        tx.commit().await?;
        Ok(JobInsert::Queued(Box::new(job)))
    }

    /// Stores an iteration and its drive as a run, and ends its job, whose last words are `stage`, in one
    /// transaction, if the lease still holds. `None`: the lease is lost, or the rig gone, and nothing was changed.
    ///
    /// # Errors
    /// The store's failures.
    pub async fn publish_iteration(
        &self,
        lease: &Lease,
        rig: &RigId,
        iteration: NewIteration,
        stage: &str,
        now: Timestamp,
    ) -> Result<Option<IterationId>, StoreError> {
        let Some(described) = self.rig(rig).await? else { return Ok(None) };
        let scratch = self.scratch_dir();
        let (iteration, run) = off_thread(move || {
            let run = iteration.prepare(&scratch, &described)?;
            Ok((iteration, run))
        })
        .await?;
        let digest = run.object.digest().clone();
        let published = self.publish_iteration_gated(lease, rig, run, iteration, stage, now);
        self.discard_unless(Option::is_some, &digest, published).await
    }

    async fn publish_iteration_gated(
        &self,
        lease: &Lease,
        rig: &RigId,
        run: PreparedRun,
        iteration: NewIteration,
        stage: &str,
        now: Timestamp,
    ) -> Result<Option<IterationId>, StoreError> {
        let PreparedRun { row, object } = run;
        let row: NewRun = row;
        let ObjectWrite { kept: _kept, mut tx } = self.write_object_file(object).await?;
        if rig_in(&mut tx, rig).await?.is_none() {
            return Ok(None);
        }
        let run = insert_row(&mut tx, rig, &row, now).await?;
        let id = new_id(now);
        let inserted = sql(
            "INSERT INTO iterations (id, rig, job, version, model_sha256, run, request, report, elapsed_s,
                                     created_us)
             SELECT $1, rig, id, $2, $3, $4, $5, $6, $7, $8 FROM jobs
             WHERE id = $9 AND rig = $10 AND state = 'running' AND lease_token = $11",
        )
        .bind(id.to_string())
        .bind(iteration.model.version)
        .bind(&iteration.model.sha256)
        .bind(run.id.to_string())
        .bind(json(&iteration.request))
        .bind(json(&iteration.report))
        .bind(iteration.elapsed_s)
        .bind(us(now))
        .bind(lease.job.to_string())
        .bind(rig.as_str())
        .bind(int(lease.token))
        .execute(&mut *tx)
        .await?;
        if inserted == 0 {
            return Ok(None);
        }
        let result = JobResult {
            kind: "iteration".into(),
            id: id.to_string(),
            href: format!("/v1/rigs/{rig}/iterations/{id}"),
        };
        if !succeed(&mut tx, lease, &result, stage, now).await? {
            return Ok(None);
        }
        tx.commit().await?;
        Ok(Some(id))
    }

    /// Iterations of a rig, newest first; `None` when there is no such rig.
    ///
    /// # Errors
    /// The store's failures.
    pub async fn iterations(
        &self,
        rig: &RigId,
        page: &PageRequest,
    ) -> Result<Option<Page<IterationSummary>>, StoreError> {
        let sql = "SELECT iterations.*, (SELECT runs.id FROM runs WHERE runs.id = iterations.run) AS drive
                   FROM iterations WHERE rig = $1 AND ($2 IS NULL OR id < $2) ORDER BY id DESC LIMIT $3";
        let found =
            self.newest::<IterationRow, StoredIteration>(sql, rig, page, |one| one.summary.id.to_string());
        Ok(found.await?.map(|page| page.map(|one| one.summary)))
    }

    /// One iteration of a rig.
    ///
    /// # Errors
    /// The store's failures.
    pub async fn iteration(
        &self,
        rig: &RigId,
        id: IterationId,
    ) -> Result<Option<StoredIteration>, StoreError> {
        let row: Option<IterationRow> =
            sql("SELECT iterations.*, (SELECT runs.id FROM runs WHERE runs.id = iterations.run) AS drive
             FROM iterations WHERE rig = $1 AND id = $2")
            .bind(rig.as_str())
            .bind(id.to_string())
            .fetch_optional(self.reader())
            .await?;
        row.map(StoredIteration::try_from).transpose()
    }
}

#[cfg(test)]
mod tests {
    use jiff::ToSpan;
    use serde_json::json;

    use super::super::testing::{TestStore, draft, now};
    use super::*;
    use crate::domain::{Job, JobKind, JobState};

    fn request() -> IterationRequest {
        serde_json::from_value(json!({"target": {"run": new_id(now())}})).unwrap()
    }

    fn found(drive: &[f64]) -> NewIteration {
        let report = json!({
            "stopped": "settled", "best": 0, "errors": {}, "band_hz": [0.0, 50.0], "out_of_reach": {"y": 0.1},
            "linear_part": "model", "warnings": [],
            "steps": [{"iteration": 0, "errors": {"y": 0.25}, "total_error": 0.25, "damage": {"y": {"ratio": 0.9}},
                       "inside": 1.0, "drive_peak": {"u": 2.0}, "limited": {"u": 0.0}, "gain": 1.0, "better": true}],
        });
        NewIteration {
            model: UsedModel { version: 2, sha256: "ab".into() },
            request: request(),
            report: serde_json::from_value(report).unwrap(),
            elapsed_s: 0.5,
            name: "drive 1".into(),
            drives: vec!["u".into()],
            samples: NewIteration::bytes_of(&Signal::new(100.0, vec![drive.to_vec()]).unwrap()),
        }
    }

    async fn queued(store: &TestStore, rig: &Rig) -> Job {
        let asker = Asker { token: None, max_waiting: 9 };
        match store.insert_job(&rig.id, &request(), asker, None, now()).await.unwrap() {
            JobInsert::Queued(job) => *job,
            other => panic!("{other:?}"),
        }
    }

    #[tokio::test]
    async fn an_iteration_is_stored_once_with_its_drive_and_the_end_of_its_job() {
        let store = TestStore::open().await;
        let rig = store.insert_rig(&draft("bench"), None, now()).await.unwrap().unwrap();
        let job = queued(&store, &rig).await;
        assert_eq!(job.kind, JobKind::Iteration);
        let lease = store.claim_job("w", now() + 30.seconds(), now()).await.unwrap().unwrap().lease;
        let lost = Lease { token: lease.token + 1, ..lease.clone() };
        let late = store.publish_iteration(&lost, &rig.id, found(&[9.0, 9.0]), "", now()).await.unwrap();
        assert_eq!(late, None);
        let query = super::super::RunQuery::default();
        let page = PageRequest { limit: 5, cursor: None };
        assert!(
            store.runs(&rig.id, &query, &page).await.unwrap().unwrap().items.is_empty(),
            "no run of a lost lease"
        );
        let drive = [0.5, -2.0, 1.0];
        let id =
            store.publish_iteration(&lease, &rig.id, found(&drive), "done", now()).await.unwrap().unwrap();
        let job = store.job(job.id).await.unwrap().unwrap();
        assert_eq!((job.state, job.stage.as_deref()), (JobState::Succeeded, Some("done")));
        assert_eq!(job.result.unwrap().href, format!("/v1/rigs/bench/iterations/{id}"));
        let stored = store.iteration(&rig.id, id).await.unwrap().unwrap();
        assert_eq!((stored.summary.total_error, stored.elapsed_s), (0.25, 0.5));
        assert_eq!(stored.report, found(&drive).report);
        let run = store.run(&rig.id, stored.summary.drive.unwrap()).await.unwrap().unwrap();
        assert_eq!(
            (run.channels.as_slice(), run.samples, run.split),
            (&["u".to_owned()][..], 3, Split::Test)
        );
        assert_eq!((run.name.as_str(), run.tags.as_slice()), ("drive 1", &[TAG.to_owned()][..]));
        assert_eq!(store.load_signal(&run).await.unwrap().channel(0), drive);
        let listed = store.iterations(&rig.id, &page).await.unwrap().unwrap();
        assert_eq!(listed.items, [stored.summary]);
        assert_eq!(store.iterations(&"nobody".parse().unwrap(), &page).await.unwrap(), None);
        assert_eq!(store.iteration(&"other".parse().unwrap(), id).await.unwrap(), None);
        // The drive may go; what is known of the search stays.
        assert!(store.delete_run(&rig.id, run.id).await.unwrap());
        assert_eq!(store.iteration(&rig.id, id).await.unwrap().unwrap().summary.drive, None);
        store.delete_rig(&rig.id).await.unwrap();
        assert_eq!(store.iteration(&rig.id, id).await.unwrap(), None);
    }
}
