//! Runs in the store.

use jiff::Timestamp;

use super::database::{On, Session, sql};
use super::objects::{ObjectWrite, to_the_end};
use super::policy::PolicyRun;
use super::prepare::NewRun;
use super::reserve::with_reserve;
use super::rigs::rig_in;
use super::rows::{RunRow, all, int, json, us};
use super::{IdempotencyKey, PreparedRun, Store, StoreError, idempotency, npy, policy};
use crate::domain::{
    Created, FieldError, InsertedRun, Lineage, Page, PageRequest, RigId, Run, RunId, RunKind, RunMeta,
    RunOutlook, RunPatch, Split, TokenId, new_id,
};
use crate::engine::Signal;

/// A filter of runs; the default is all runs.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct RunQuery {
    /// Of this kind.
    pub kind: Option<RunKind>,
    /// Of this split.
    pub split: Option<Split>,
    /// With this tag.
    pub tag: Option<String>,
}

/// Outcome of an upload.
#[derive(Debug, Clone, PartialEq)]
pub enum RunInsert {
    /// Accepted.
    Inserted(Box<InsertedRun>),
    /// No such rig.
    MissingRig,
    /// The rig's channels or sample rate changed during the upload.
    RigChanged,
}

/// Outcome of a patch.
#[derive(Debug, Clone, PartialEq)]
pub enum RunUpdate {
    /// The run as it is now.
    Updated(Box<Run>),
    /// No such run.
    Missing,
    /// The run cannot become a test run, because these model versions were fitted on it.
    FittedOn(Vec<u32>),
    /// Fields that do not fit.
    Invalid(Vec<FieldError>),
}

impl Store {
    /// Accepts a run of a token: stores its object first, then its row, the fit policy's jobs and the
    /// answer under a key in one transaction. Completes even if the caller goes away.
    ///
    /// # Errors
    /// The store's failures.
    pub async fn insert_run(
        &self,
        rig: &RigId,
        run: PreparedRun,
        token: Option<TokenId>,
        key: Option<IdempotencyKey>,
        now: Timestamp,
    ) -> Result<RunInsert, StoreError> {
        let (store, rig) = (self.clone(), rig.clone());
        to_the_end(async move {
            let object = run.object.digest().clone();
            let inserted = store.insert_run_gated(&rig, run, token, key.as_ref(), now);
            let made = |inserted: &RunInsert| matches!(inserted, RunInsert::Inserted(_));
            store.discard_unless(made, &object, inserted).await
        })
        .await
    }

    async fn insert_run_gated(
        &self,
        rig: &RigId,
        run: PreparedRun,
        token: Option<TokenId>,
        key: Option<&IdempotencyKey>,
        now: Timestamp,
    ) -> Result<RunInsert, StoreError> {
        let PreparedRun { row: run, object } = run;
        let ObjectWrite { kept: _kept, mut tx } = self.write_object_file(object).await?;
        idempotency::check_unused(&mut tx, key).await?;
        let Some(rig) = rig_in(&mut tx, rig).await? else { return Ok(RunInsert::MissingRig) };
        let unit = |name| rig.channel(name).map(|channel| &channel.unit);
        let suits = run.channels.iter().zip(&run.units).all(|(name, found)| unit(name) == Some(found));
        if !suits || rig.sample_rate_hz != run.sample_rate_hz {
            return Ok(RunInsert::RigChanged);
        }
        let run = insert_row(&mut tx, &rig.id, &run, now).await?;
        let (jobs, policy) = policy::after_run(&mut tx, &rig, &run, token, now).await?;
        let inserted = InsertedRun { run, jobs, policy };
        idempotency::record(&mut tx, key, || Created::run(&inserted), now).await?;
        tx.commit().await?;
        Ok(RunInsert::Inserted(Box::new(inserted)))
    }

    /// What [`Store::insert_run`] would do with a run; changes nothing. `None` when there is no such rig.
    ///
    /// # Errors
    /// The store's failures.
    pub async fn outlook(&self, rig: &RigId, run: &PreparedRun) -> Result<Option<RunOutlook>, StoreError> {
        let mut tx = self.snapshot().await?;
        let Some(rig) = rig_in(&mut tx, rig).await? else { return Ok(None) };
        let original: Option<String> = sql(
            "SELECT id FROM runs WHERE rig = $1 AND sha256 = $2 AND duplicate_of IS NULL ORDER BY id LIMIT 1",
        )
        .bind(rig.id.as_str())
        .bind(&run.row.sha256)
        .fetch_optional(&mut tx)
        .await?;
        let parse = |id: String| {
            let bad = |error: uuid::Error| StoreError::Row {
                table: "runs",
                key: id.clone(),
                what: error.to_string(),
            };
            id.parse().map_err(bad)
        };
        let duplicate_of = original.map(parse).transpose()?;
        let RunMeta { kind, split, .. } = run.row.meta;
        let seen = PolicyRun { kind, split, duplicate_of, unstored_s: run.row.duration_s };
        let decision = policy::decide(&mut tx, &rig, &seen).await?;
        let new = decision.fits.iter().filter(|(_, job)| job.is_none());
        let fits = new.map(|(fit, _)| (*fit).clone()).collect();
        let jobs = decision.fits.iter().filter_map(|(_, job)| *job).collect();
        Ok(Some(RunOutlook { duplicate_of, fits, jobs, policy: decision.words("to be queued") }))
    }

    /// One run of a rig.
    ///
    /// # Errors
    /// The store's failures.
    pub async fn run(&self, rig: &RigId, id: RunId) -> Result<Option<Run>, StoreError> {
        run_in(self.reader(), rig, id).await
    }

    /// Runs of a rig, oldest first; `None` when there is no such rig.
    ///
    /// # Errors
    /// The store's failures.
    pub async fn runs(
        &self,
        rig: &RigId,
        query: &RunQuery,
        page: &PageRequest,
    ) -> Result<Option<Page<Run>>, StoreError> {
        let mut tx = self.snapshot().await?;
        if rig_in(&mut tx, rig).await?.is_none() {
            return Ok(None);
        }
        let rows: Vec<RunRow> = sql("SELECT * FROM runs
             WHERE rig = $1 AND id > $2
               AND ($3 IS NULL OR kind = $3) AND ($4 IS NULL OR split = $4)
               AND ($5 IS NULL OR EXISTS (SELECT 1 FROM json_each(tags) WHERE value = $5))
             ORDER BY id LIMIT $6")
        .bind(rig.as_str())
        .bind(page.cursor.as_ref().map_or("", |cursor| cursor.as_str()))
        .bind(query.kind.map(RunKind::as_str))
        .bind(query.split.map(Split::as_str))
        .bind(query.tag.as_deref())
        .bind(i64::from(page.limit) + 1)
        .fetch_all(&mut tx)
        .await?;
        Ok(Some(Page::cut(all(rows)?, page.limit, |run: &Run| run.id.to_string())))
    }

    /// All runs of a rig, oldest first, for selections.
    pub(crate) async fn all_runs(&self, rig: &RigId) -> Result<Vec<Run>, StoreError> {
        let rows: Vec<RunRow> = sql("SELECT * FROM runs WHERE rig = $1 ORDER BY id")
            .bind(rig.as_str())
            .fetch_all(self.reader())
            .await?;
        all(rows)
    }

    /// Changes the description of a run; its samples never change.
    ///
    /// # Errors
    /// The store's failures.
    pub async fn patch_run(&self, rig: &RigId, id: RunId, patch: RunPatch) -> Result<RunUpdate, StoreError> {
        let mut tx = self.write().await?;
        let Some(run) = run_in(&mut tx, rig, id).await? else { return Ok(RunUpdate::Missing) };
        let meta = match patch.apply(&run) {
            Ok(meta) => meta,
            Err(errors) => return Ok(RunUpdate::Invalid(errors)),
        };
        if meta.split == Split::Test && run.split != Split::Test {
            // A test run is of use only if no fit has seen it.
            let versions = fitted_on(&mut tx, rig, &run).await?;
            if !versions.is_empty() {
                return Ok(RunUpdate::FittedOn(versions));
            }
        }
        let row: RunRow = sql("UPDATE runs SET name = $2, kind = $3, split = $4, tags = $5, started_us = $6
             WHERE id = $1 RETURNING *")
        .bind(id.to_string())
        .bind(&meta.name)
        .bind(meta.kind.as_str())
        .bind(meta.split.as_str())
        .bind(json(&meta.tags))
        .bind(meta.started_at.map(us))
        .fetch_one(&mut *tx)
        .await?;
        tx.commit().await?;
        Ok(RunUpdate::Updated(Box::new(row.try_into()?)))
    }

    /// Removes a run; tells whether it was there. Models that were fitted on it stay and keep its id.
    ///
    /// # Errors
    /// The store's failures.
    pub async fn delete_run(&self, rig: &RigId, id: RunId) -> Result<bool, StoreError> {
        with_reserve!(self, self.delete_run_row(rig, id))
    }

    async fn delete_run_row(&self, rig: &RigId, id: RunId) -> Result<bool, StoreError> {
        let mut tx = self.write_with_reserve().await?;
        let Some(run) = run_in(&mut tx, rig, id).await? else { return Ok(false) };
        promote_duplicate(&mut tx, id).await?;
        sql("DELETE FROM runs WHERE id = $1").bind(id.to_string()).execute(&mut *tx).await?;
        tx.commit().await?;
        self.discard_unreferenced(vec![run.object]).await;
        Ok(true)
    }

    /// The samples of a run, verified, in the order of its channels.
    ///
    /// # Errors
    /// The store's failures, a damaged or missing object among them.
    pub async fn load_signal(&self, run: &Run) -> Result<Signal, StoreError> {
        let bad = |id: RunId, what: String| StoreError::Row { table: "runs", key: id.to_string(), what };
        let (id, rate, channels) = (run.id, run.sample_rate_hz, run.channels.len());
        let samples = usize::try_from(run.samples).map_err(|error| bad(id, error.to_string()))?;
        self.objects()
            .get_with(&run.object, move |bytes| {
                let channels = npy::decode(&bytes, samples, channels)
                    .ok_or_else(|| bad(id, "its object has another shape".into()))?;
                Signal::new(rate, channels).map_err(|error| bad(id, error.to_string()))
            })
            .await
    }
}

async fn run_in<'a>(on: impl Into<On<'a>>, rig: &RigId, id: RunId) -> Result<Option<Run>, StoreError> {
    let row: Option<RunRow> = sql("SELECT * FROM runs WHERE rig = $1 AND id = $2")
        .bind(rig.as_str())
        .bind(id.to_string())
        .fetch_optional(on)
        .await?;
    row.map(Run::try_from).transpose()
}

pub(super) async fn insert_row(
    connection: &mut Session,
    rig: &RigId,
    run: &NewRun,
    now: Timestamp,
) -> Result<Run, StoreError> {
    let RunMeta { name, kind, split, tags, started_at } = &run.meta;
    let row: RunRow =
        sql("INSERT INTO runs (id, rig, name, kind, split, tags, started_us, created_us, channels, units,
                           samples, duration_s, sample_rate_hz, sha256, object, quality, duplicate_of)
         VALUES ($1, $2, $3, $4, $5, $6, $7, $8, $9, $10, $11, $12, $13, $14, $15, $16,
                 (SELECT id FROM runs WHERE rig = $2 AND sha256 = $14 AND duplicate_of IS NULL
                  ORDER BY id LIMIT 1))
         RETURNING *")
        .bind(new_id(now).to_string())
        .bind(rig.as_str())
        .bind(name)
        .bind(kind.as_str())
        .bind(split.as_str())
        .bind(json(tags))
        .bind(started_at.map(us))
        .bind(us(now))
        .bind(json(&run.channels))
        .bind(json(&run.units))
        .bind(int(run.samples))
        .bind(run.duration_s)
        .bind(run.sample_rate_hz)
        .bind(&run.sha256)
        .bind(run.object.as_str())
        .bind(json(&run.quality))
        .fetch_one(connection)
        .await?;
    row.try_into()
}

/// When an original is deleted, its earliest duplicate takes its place, so that the measurement still
/// counts once.
async fn promote_duplicate(connection: &mut Session, original: RunId) -> Result<(), StoreError> {
    let heir: Option<String> = sql("SELECT id FROM runs WHERE duplicate_of = $1 ORDER BY id LIMIT 1")
        .bind(original.to_string())
        .fetch_optional(&mut *connection)
        .await?;
    let Some(heir) = heir else { return Ok(()) };
    sql("UPDATE runs SET duplicate_of = nullif($2, id) WHERE duplicate_of = $1")
        .bind(original.to_string())
        .bind(heir)
        .execute(connection)
        .await?;
    Ok(())
}

/// Model versions of the rig whose fit used the run's bytes, for training or validation.
async fn fitted_on(connection: &mut Session, rig: &RigId, run: &Run) -> Result<Vec<u32>, StoreError> {
    let rows: Vec<(u32, String)> = sql("SELECT version, lineage FROM models WHERE rig = $1 ORDER BY version")
        .bind(rig.as_str())
        .fetch_all(connection)
        .await?;
    let mut versions = Vec::new();
    for (version, lineage) in rows {
        let lineage: Lineage = serde_json::from_str(&lineage).map_err(|error| StoreError::Row {
            table: "models",
            key: format!("{rig}/{version}"),
            what: error.to_string(),
        })?;
        if lineage.spans().any(|span| span.run == run.id || span.sha256 == run.sha256) {
            versions.push(version);
        }
    }
    Ok(versions)
}

#[cfg(test)]
mod tests {
    use super::super::testing::{TestStore, draft, meta, now};
    use super::*;

    #[tokio::test]
    async fn a_run_comes_back_sample_by_sample() {
        let store = TestStore::open().await;
        let rig = store.insert_rig(&draft("bench"), None, now()).await.unwrap().unwrap();
        let sent = store.upload(&rig, &[0.1, -2.5, 1e300]).await.run;
        let run = store.run(&rig.id, sent.id).await.unwrap().unwrap();
        assert_eq!(run, sent);
        let signal = store.load_signal(&run).await.unwrap();
        assert_eq!(signal.channel(0), [0.1, -2.5, 1e300]);
        assert_eq!((signal.sample_rate_hz(), signal.n_channels()), (100.0, 2));
        let other = "other".parse().unwrap();
        assert_eq!(store.run(&other, sent.id).await.unwrap(), None, "a run of another rig is none");
    }

    #[tokio::test]
    async fn the_same_bytes_again_are_a_duplicate_on_the_same_object() {
        let store = TestStore::open().await;
        let rig = store.insert_rig(&draft("bench"), None, now()).await.unwrap().unwrap();
        let runs = [
            store.upload(&rig, &[1.0]).await.run,
            store.upload(&rig, &[1.0]).await.run,
            store.upload(&rig, &[1.0]).await.run,
        ];
        assert_eq!(runs[0].duplicate_of, None);
        assert_eq!(runs[1].duplicate_of, Some(runs[0].id));
        assert_eq!(runs[2].duplicate_of, Some(runs[0].id));
        assert_eq!(runs[0].object, runs[2].object);
        // After the original is deleted, the second run takes its place and the third refers to the
        // second.
        assert!(store.delete_run(&rig.id, runs[0].id).await.unwrap());
        let second = store.run(&rig.id, runs[1].id).await.unwrap().unwrap();
        let third = store.run(&rig.id, runs[2].id).await.unwrap().unwrap();
        assert_eq!((second.duplicate_of, third.duplicate_of), (None, Some(runs[1].id)));
        assert_eq!(store.load_signal(&third).await.unwrap().channel(0), [1.0]);
        for run in [second, third] {
            assert!(store.delete_run(&rig.id, run.id).await.unwrap());
        }
        assert!(!store.delete_run(&rig.id, runs[1].id).await.unwrap());
        let read = store.objects().get(&runs[0].object).await;
        assert!(matches!(read, Err(StoreError::ObjectMissing { .. })), "the last run took the object along");
    }

    #[tokio::test]
    async fn runs_are_listed_by_kind_split_and_tag() {
        let store = TestStore::open().await;
        let rig = store.insert_rig(&draft("bench"), None, now()).await.unwrap().unwrap();
        let mut tagged = meta();
        tagged.tags = vec!["linear".into(), "quote\"d".into()];
        let tagged = store.upload_with(&rig, tagged, &[1.0]).await.run;
        let mut service = meta();
        (service.kind, service.split) = (RunKind::Service, Split::Test);
        let service = store.upload_with(&rig, service, &[2.0]).await.run;
        let list = async |query: RunQuery| {
            let page = store.runs(&rig.id, &query, &PageRequest::default()).await.unwrap().unwrap();
            page.items.into_iter().map(|run| run.id).collect::<Vec<_>>()
        };
        assert_eq!(list(RunQuery::default()).await, [tagged.id, service.id]);
        let tag = |tag: &str| RunQuery { tag: Some(tag.into()), ..RunQuery::default() };
        assert_eq!(list(tag("quote\"d")).await, [tagged.id]);
        assert_eq!(list(tag("line")).await, [] as [RunId; 0]);
        assert_eq!(list(RunQuery { kind: Some(RunKind::Service), ..Default::default() }).await, [service.id]);
        assert_eq!(list(RunQuery { split: Some(Split::Training), ..Default::default() }).await, [tagged.id]);
        let page = PageRequest { limit: 1, cursor: None };
        let first = store.runs(&rig.id, &RunQuery::default(), &page).await.unwrap().unwrap();
        assert_eq!(first.next, Some(tagged.id.to_string()));
        let nobody = "nobody".parse().unwrap();
        assert_eq!(store.runs(&nobody, &RunQuery::default(), &page).await.unwrap(), None);
    }

    #[tokio::test]
    async fn a_run_that_a_model_was_fitted_on_cannot_become_a_test_run() {
        let store = TestStore::open().await;
        let rig = store.insert_rig(&draft("bench"), None, now()).await.unwrap().unwrap();
        let run = store.upload(&rig, &[1.0]).await.run;
        let free = store.upload(&rig, &[2.0]).await.run;
        let model = store.import_fitted_on(&rig, b"weights", &run).await;
        let to_test = || RunPatch { split: Some(Split::Test), ..RunPatch::default() };
        let refused = store.patch_run(&rig.id, run.id, to_test()).await.unwrap();
        assert_eq!(refused, RunUpdate::FittedOn(vec![model.version]));
        let RunUpdate::Updated(changed) = store.patch_run(&rig.id, free.id, to_test()).await.unwrap() else {
            panic!("no model saw this one")
        };
        assert_eq!(*changed, Run { split: Split::Test, ..free });
        let too_long = RunPatch { name: Some(Some("x".repeat(1001))), ..RunPatch::default() };
        assert!(matches!(store.patch_run(&rig.id, run.id, too_long).await, Ok(RunUpdate::Invalid(_))));
        let missing = store.patch_run(&rig.id, new_id(now()), RunPatch::default()).await.unwrap();
        assert_eq!(missing, RunUpdate::Missing);
        // Deleting it is allowed: the model keeps the id.
        assert!(store.delete_run(&rig.id, run.id).await.unwrap());
        let kept = store.model(&rig.id, model.version).await.unwrap().unwrap();
        assert_eq!(kept.lineage.training[0].run, run.id);
    }

    #[tokio::test]
    async fn a_run_for_a_rig_that_is_gone_leaves_nothing() {
        let store = TestStore::open().await;
        let rig = store.insert_rig(&draft("bench"), None, now()).await.unwrap().unwrap();
        let [prepared, again] = [store.prepare(&rig, meta(), &[1.0]), store.prepare(&rig, meta(), &[1.0])];
        let object = prepared.row.object.as_str().to_owned();
        store.delete_rig(&rig.id).await.unwrap();
        let inserted = store.insert_run(&rig.id, prepared, None, None, now()).await.unwrap();
        assert_eq!(inserted, RunInsert::MissingRig);
        assert!(matches!(store.objects().get(&object).await, Err(StoreError::ObjectMissing { .. })));
        let mut other = draft("bench");
        other.sample_rate_hz = 200.0;
        store.insert_rig(&other, None, now()).await.unwrap();
        let inserted = store.insert_run(&rig.id, again, None, None, now()).await.unwrap();
        assert_eq!(inserted, RunInsert::RigChanged);
        assert_eq!(std::fs::read_dir(store.scratch_dir()).unwrap().count(), 0);
    }
}
