//! Model versions and the active model in the store.

use bytes::Bytes;
use jiff::Timestamp;
use serde::{Deserialize, Serialize};

use super::database::{On, Session, sql};
use super::fit_records::insert_record;
use super::jobs::succeed;
use super::objects::{ObjectWrite, to_the_end};
use super::reserve::with_reserve;
use super::rigs::{if_match, rig_in};
use super::rows::{ModelRow, all, int, json, us, word};
use super::{Digest, IdempotencyKey, Lease, Store, StoreError, idempotency};
use crate::domain::fits::FitRequest;
use crate::domain::{
    ActiveModel, Adoption, Created, JobId, JobResult, Lineage, Model, Origin, Page, PageRequest, RigId,
};
use crate::engine::frf::FrfSummary;
use crate::engine::model::{FitRecord, FitReport, ModelKind};

/// A model on its way into the store.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct NewModel {
    /// Its parts and how they combine; of a model with adopted effects those of the one beneath.
    pub kind: ModelKind,
    /// What it consists of, if it has adopted effects.
    pub adoption: Option<Adoption>,
    /// Input channels, in order.
    pub inputs: Vec<String>,
    /// Output channels, in order.
    pub outputs: Vec<String>,
    /// Sample rate.
    pub sample_rate_hz: f64,
    /// The safetensors file; sent beside JSON, not in it.
    #[serde(skip)]
    pub weights: Bytes,
    /// Fitted, imported or adopted.
    pub origin: Origin,
    /// The job that fitted it, or found its effect.
    pub job: Option<JobId>,
    /// The request, resolved.
    pub request: Option<FitRequest>,
    /// The report of the fit.
    pub report: Option<FitReport>,
    /// What the fit keeps about its data.
    pub record: Option<FitRecord>,
    /// Figures of its FRF, if it has one.
    pub frf: Option<FrfSummary>,
    /// The data that it was fitted to.
    pub lineage: Lineage,
    /// Instruction set that it was computed with.
    pub instruction_set: String,
}

/// The key of a request that creates a model, and the form of its answer.
pub type KeyedImport = (IdempotencyKey, fn(&Model) -> Created);

/// The change of the active model that a new model brings. It was decided against the version that was
/// active then.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub enum Activation {
    /// Nothing.
    Leave,
    /// Make the new one active, whichever is now.
    Always,
    /// Make the new one active if this version still is.
    IfStill(Option<u32>),
}

/// Outcome of a change of the active model.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum ActiveUpdate {
    /// The active model as it is now.
    Updated(ActiveModel),
    /// No such rig.
    MissingRig,
    /// No such model version.
    MissingModel,
    /// The model does not map the rig's drives to its responses.
    NotForward,
    /// The active model has changed since the client read it; the present one.
    Stale(ActiveModel),
}

/// Outcome of a deletion.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ModelDelete {
    /// It is gone.
    Deleted,
    /// No such model version.
    Missing,
    /// It is the active model, which cannot be deleted.
    Active,
}

/// Every column of a model, and whether it is active.
macro_rules! select_models {
    ($rest:literal) => {
        concat!(
            "SELECT models.*, CASE WHEN rigs.active_version = models.version THEN 1 ELSE 0 END AS active
             FROM models JOIN rigs ON rigs.id = models.rig ",
            $rest
        )
    };
}

impl Store {
    /// Adds a model that no job publishes; `None` when there is no such rig. With an idempotency key the
    /// answer is stored too. Completes even if the caller goes away.
    ///
    /// # Errors
    /// The store's failures.
    pub async fn insert_model(
        &self,
        rig: &RigId,
        model: NewModel,
        activation: Activation,
        key: Option<KeyedImport>,
        now: Timestamp,
    ) -> Result<Option<Model>, StoreError> {
        let (store, rig) = (self.clone(), rig.clone());
        to_the_end(async move {
            let digest = Digest::of(&model.weights);
            let inserted = store.insert_model_gated(&rig, &digest, model, activation, key, now);
            store.discard_unless(Option::is_some, &digest, inserted).await
        })
        .await
    }

    async fn insert_model_gated(
        &self,
        rig: &RigId,
        digest: &Digest,
        model: NewModel,
        activation: Activation,
        key: Option<KeyedImport>,
        now: Timestamp,
    ) -> Result<Option<Model>, StoreError> {
        let ObjectWrite { kept: _kept, mut tx } = self.write_object(digest, &model.weights).await?;
        idempotency::check_unused(&mut tx, key.as_ref().map(|(once, _)| once)).await?;
        let Some(version) = insert_row(&mut tx, rig, digest, &model, now).await? else { return Ok(None) };
        activate(&mut tx, rig, version, &activation, now).await?;
        let inserted = model_in(&mut tx, rig, version).await?;
        if let (Some((key, answer)), Some(model)) = (&key, &inserted) {
            idempotency::record(&mut tx, Some(key), || answer(model), now).await?;
        }
        tx.commit().await?;
        Ok(inserted)
    }

    /// Publishes a fitted model and ends its job, in one transaction, if the lease still holds.
    /// `None`: the lease is lost, and nothing was changed.
    ///
    /// `stage` makes the job's last stage text from the version number and whether it became active.
    ///
    /// # Errors
    /// The store's failures.
    pub async fn publish_model(
        &self,
        lease: &Lease,
        model: NewModel,
        activation: Activation,
        stage: impl FnOnce(u32, bool) -> String + Send,
        now: Timestamp,
    ) -> Result<Option<Model>, StoreError> {
        let digest = Digest::of(&model.weights);
        let published = self.publish_gated(lease, &digest, model, activation, stage, now);
        self.discard_unless(Option::is_some, &digest, published).await
    }

    async fn publish_gated(
        &self,
        lease: &Lease,
        digest: &Digest,
        model: NewModel,
        activation: Activation,
        stage: impl FnOnce(u32, bool) -> String + Send,
        now: Timestamp,
    ) -> Result<Option<Model>, StoreError> {
        let ObjectWrite { kept: _kept, mut tx } = self.write_object(digest, &model.weights).await?;
        let rig: Option<String> =
            sql("SELECT rig FROM jobs WHERE id = $1 AND state = 'running' AND lease_token = $2")
                .bind(lease.job.to_string())
                .bind(int(lease.token))
                .fetch_optional(&mut *tx)
                .await?;
        let Some(rig) = rig.and_then(|rig| rig.parse::<RigId>().ok()) else { return Ok(None) };
        let published = insert_published(&mut tx, &rig, digest, &model, &activation, now).await?;
        let Some((version, active)) = published else { return Ok(None) };
        let result = JobResult {
            kind: "model".into(),
            id: version.to_string(),
            href: format!("/v1/rigs/{rig}/models/{version}"),
        };
        if !succeed(&mut tx, lease, &result, &stage(version, active), now).await? {
            return Ok(None);
        }
        let published = model_in(&mut tx, &rig, version).await?;
        tx.commit().await?;
        Ok(published)
    }

    /// One model version of a rig.
    ///
    /// # Errors
    /// The store's failures.
    pub async fn model(&self, rig: &RigId, version: u32) -> Result<Option<Model>, StoreError> {
        model_in(self.reader(), rig, version).await
    }

    /// Model versions of a rig, oldest first; `None` when there is no such rig.
    ///
    /// # Errors
    /// The store's failures.
    pub async fn models(&self, rig: &RigId, page: &PageRequest) -> Result<Option<Page<Model>>, StoreError> {
        let mut tx = self.snapshot().await?;
        if rig_in(&mut tx, rig).await?.is_none() {
            return Ok(None);
        }
        // A cursor that is no number belongs to another list: nothing comes after it.
        let after = page.cursor.as_ref().map_or(0, |c| c.as_str().parse().unwrap_or(i64::MAX));
        let rows: Vec<ModelRow> =
            sql(select_models!("WHERE rig = $1 AND version > $2 ORDER BY version LIMIT $3"))
                .bind(rig.as_str())
                .bind(after)
                .bind(i64::from(page.limit) + 1)
                .fetch_all(&mut tx)
                .await?;
        Ok(Some(Page::cut(all(rows)?, page.limit, |model: &Model| model.version.to_string())))
    }

    /// A few model versions before `version`, newest first.
    ///
    /// # Errors
    /// The store's failures.
    pub async fn models_before(&self, rig: &RigId, version: u32) -> Result<Vec<Model>, StoreError> {
        let rows: Vec<ModelRow> =
            sql(select_models!("WHERE rig = $1 AND version < $2 ORDER BY version DESC LIMIT 8"))
                .bind(rig.as_str())
                .bind(version)
                .fetch_all(self.reader())
                .await?;
        all(rows)
    }

    /// Errors on validation data of each rig's active model, one an output; at most `limit` rigs, by id. A model that
    /// was imported has none.
    ///
    /// # Errors
    /// The store's failures.
    pub async fn validation_errors(&self, limit: u32) -> Result<Vec<(String, Vec<Option<f64>>)>, StoreError> {
        let rows: Vec<(String, String)> =
            sql("SELECT rigs.id, json_extract(report, '$.validation_rms') FROM rigs
             JOIN models ON models.rig = rigs.id AND models.version = rigs.active_version
             WHERE json_extract(report, '$.validation_rms') IS NOT NULL ORDER BY rigs.id LIMIT $1")
            .bind(limit)
            .fetch_all(self.reader())
            .await?;
        let errors = |(rig, errors): (String, String)| match serde_json::from_str(&errors) {
            Ok(errors) => Ok((rig, errors)),
            Err(error) => Err(StoreError::Row { table: "models", key: rig, what: error.to_string() }),
        };
        rows.into_iter().map(errors).collect()
    }

    /// The weight file of a model, verified.
    ///
    /// # Errors
    /// The store's failures, a damaged or missing object among them.
    pub async fn weights(&self, model: &Model) -> Result<Bytes, StoreError> {
        self.objects().get(&model.sha256).await
    }

    /// Removes a model version that is not active. Its number is not used again.
    ///
    /// # Errors
    /// The store's failures.
    pub async fn delete_model(&self, rig: &RigId, version: u32) -> Result<ModelDelete, StoreError> {
        with_reserve!(self, self.delete_model_row(rig, version))
    }

    async fn delete_model_row(&self, rig: &RigId, version: u32) -> Result<ModelDelete, StoreError> {
        let mut tx = self.write_with_reserve().await?;
        let Some(model) = model_in(&mut tx, rig, version).await? else { return Ok(ModelDelete::Missing) };
        if model.active {
            return Ok(ModelDelete::Active);
        }
        sql("DELETE FROM models WHERE rig = $1 AND version = $2")
            .bind(rig.as_str())
            .bind(version)
            .execute(&mut *tx)
            .await?;
        tx.commit().await?;
        self.discard_unreferenced(vec![model.sha256]).await;
        Ok(ModelDelete::Deleted)
    }

    /// The active model; `None` when there is no such rig.
    ///
    /// # Errors
    /// The store's failures.
    pub async fn active_model(&self, rig: &RigId) -> Result<Option<ActiveModel>, StoreError> {
        active_in(self.reader(), rig).await
    }

    /// Makes `version` (or none) the active model if the pointer still has the `ETag` that the
    /// client names (`*` names any).
    ///
    /// # Errors
    /// The store's failures.
    pub async fn set_active_model(
        &self,
        rig_id: &RigId,
        version: Option<u32>,
        if_match_header: &str,
        now: Timestamp,
    ) -> Result<ActiveUpdate, StoreError> {
        with_reserve!(self, self.point_active(rig_id, version, if_match_header, now))
    }

    async fn point_active(
        &self,
        rig_id: &RigId,
        version: Option<u32>,
        if_match_header: &str,
        now: Timestamp,
    ) -> Result<ActiveUpdate, StoreError> {
        let mut tx = self.write_with_reserve().await?;
        let (Some(rig), Some(current)) = (rig_in(&mut tx, rig_id).await?, active_in(&mut tx, rig_id).await?)
        else {
            return Ok(ActiveUpdate::MissingRig);
        };
        if !if_match(if_match_header, &current.etag()) {
            return Ok(ActiveUpdate::Stale(current));
        }
        if let Some(version) = version {
            match model_in(&mut tx, rig_id, version).await? {
                None => return Ok(ActiveUpdate::MissingModel),
                Some(model) if !model.is_forward(&rig) => return Ok(ActiveUpdate::NotForward),
                Some(_) => {}
            }
        }
        let Some(updated) = point(&mut tx, rig_id, version, now).await? else {
            return Ok(ActiveUpdate::MissingRig);
        };
        tx.commit().await?;
        Ok(ActiveUpdate::Updated(updated))
    }
}

async fn model_in<'a>(on: impl Into<On<'a>>, rig: &RigId, version: u32) -> Result<Option<Model>, StoreError> {
    let row: Option<ModelRow> = sql(select_models!("WHERE rig = $1 AND version = $2"))
        .bind(rig.as_str())
        .bind(version)
        .fetch_optional(on)
        .await?;
    row.map(Model::try_from).transpose()
}

async fn active_in<'a>(on: impl Into<On<'a>>, rig: &RigId) -> Result<Option<ActiveModel>, StoreError> {
    let row: Option<(Option<u32>, i64)> =
        sql("SELECT active_version, active_revision FROM rigs WHERE id = $1")
            .bind(rig.as_str())
            .fetch_optional(on)
            .await?;
    Ok(row.map(|(version, revision)| ActiveModel { version, revision: revision.unsigned_abs() }))
}

/// Applies a decision about the active model; tells whether the version is the active one now.
async fn activate(
    connection: &mut Session,
    rig: &RigId,
    version: u32,
    activation: &Activation,
    now: Timestamp,
) -> Result<bool, StoreError> {
    let wanted = match activation {
        Activation::Leave => false,
        Activation::Always => true,
        Activation::IfStill(expected) => {
            active_in(&mut *connection, rig).await?.is_some_and(|current| current.version == *expected)
        }
    };
    Ok(wanted && point(connection, rig, Some(version), now).await?.is_some())
}

/// Points the rig at a version; `None` when the rig is gone.
async fn point(
    connection: &mut Session,
    rig: &RigId,
    version: Option<u32>,
    now: Timestamp,
) -> Result<Option<ActiveModel>, StoreError> {
    sql("UPDATE rigs SET active_version = $2, active_us = $3, active_revision = active_revision + 1
         WHERE id = $1")
    .bind(rig.as_str())
    .bind(version)
    .bind(us(now))
    .execute(&mut *connection)
    .await?;
    active_in(connection, rig).await
}

/// Adds a model of a job under the rig's next number, and applies the decision about the active model: the version,
/// and whether it is active. `None` when there is no such rig.
pub(super) async fn insert_published(
    connection: &mut Session,
    rig: &RigId,
    digest: &Digest,
    model: &NewModel,
    activation: &Activation,
    now: Timestamp,
) -> Result<Option<(u32, bool)>, StoreError> {
    let Some(version) = insert_row(connection, rig, digest, model, now).await? else { return Ok(None) };
    let active = activate(connection, rig, version, activation, now).await?;
    Ok(Some((version, active)))
}

/// Adds a row under the rig's next number; `None` when there is no such rig.
async fn insert_row(
    connection: &mut Session,
    rig: &RigId,
    digest: &Digest,
    model: &NewModel,
    now: Timestamp,
) -> Result<Option<u32>, StoreError> {
    let version: Option<u32> =
        sql("UPDATE rigs SET next_version = next_version + 1 WHERE id = $1 RETURNING next_version - 1")
            .bind(rig.as_str())
            .fetch_optional(&mut *connection)
            .await?;
    let Some(version) = version else { return Ok(None) };
    sql("INSERT INTO models (rig, version, kind, inputs, outputs, sample_rate_hz, sha256, size_bytes,
                             origin, job, request, report, lineage, code_version, instruction_set,
                             created_us, adoption, frf)
         VALUES ($1, $2, $3, $4, $5, $6, $7, $8, $9, $10, $11, $12, $13, $14, $15, $16, $17, $18)")
    .bind(rig.as_str())
    .bind(version)
    .bind(word(&model.kind))
    .bind(json(&model.inputs))
    .bind(json(&model.outputs))
    .bind(model.sample_rate_hz)
    .bind(digest.as_str())
    .bind(int(model.weights.len() as u64))
    .bind(model.origin.as_str())
    .bind(model.job.map(|job| job.to_string()))
    .bind(model.request.as_ref().map(json))
    .bind(model.report.as_ref().map(json))
    .bind(json(&model.lineage))
    .bind(crate::VERSION)
    .bind(&model.instruction_set)
    .bind(us(now))
    .bind(model.adoption.as_ref().map(json))
    .bind(model.frf.as_ref().map(json))
    .execute(&mut *connection)
    .await?;
    if let Some(record) = &model.record {
        insert_record(connection, rig, version, record).await?;
    }
    Ok(Some(version))
}

#[cfg(test)]
mod tests {
    use jiff::ToSpan;

    use super::super::testing::{TestStore, draft, imported, now};
    use super::super::{JobQuery, Outcome};
    use super::*;
    use crate::domain::{JobState, Rig};

    async fn rig(store: &TestStore) -> Rig {
        store.insert_rig(&draft("bench"), None, now()).await.unwrap().unwrap()
    }

    #[tokio::test]
    async fn versions_count_up_from_one_and_are_not_given_twice() {
        let store = TestStore::open().await;
        let rig = rig(&store).await;
        let first = store.import(&rig, b"1").await;
        let second = store.import(&rig, b"2").await;
        assert_eq!((first.version, second.version, first.active), (1, 2, false));
        assert_eq!(store.weights(&second).await.unwrap(), b"2"[..]);
        assert_eq!(store.delete_model(&rig.id, 2).await.unwrap(), ModelDelete::Deleted);
        assert_eq!(store.delete_model(&rig.id, 2).await.unwrap(), ModelDelete::Missing);
        assert_eq!(store.import(&rig, b"3").await.version, 3);
        let page = PageRequest { limit: 1, cursor: None };
        let listed = store.models(&rig.id, &page).await.unwrap().unwrap();
        assert_eq!((listed.items, listed.next), (vec![first], Some("1".into())));
        let nobody = "nobody".parse().unwrap();
        assert_eq!(store.models(&nobody, &page).await.unwrap(), None);
        assert_eq!(
            store.insert_model(&nobody, imported(b"4"), Activation::Leave, None, now()).await.unwrap(),
            None
        );
        let orphan = store.objects().get(Digest::of(b"4").as_str()).await;
        assert!(matches!(orphan, Err(StoreError::ObjectMissing { .. })));
    }

    #[tokio::test]
    async fn the_active_model_changes_only_for_who_has_seen_it() {
        let store = TestStore::open().await;
        let rig = rig(&store).await;
        let version = store.import(&rig, b"1").await.version;
        let before = store.active_model(&rig.id).await.unwrap().unwrap();
        assert_eq!(before.version, None);
        let set =
            async |version, tag: &str| store.set_active_model(&rig.id, version, tag, now()).await.unwrap();
        let ActiveUpdate::Updated(active) = set(Some(version), &before.etag()).await else {
            panic!("the etag is fresh")
        };
        assert_eq!(active.version, Some(1));
        assert_eq!(set(None, &before.etag()).await, ActiveUpdate::Stale(active.clone()));
        assert_eq!(set(Some(9), &active.etag()).await, ActiveUpdate::MissingModel);
        assert!(store.model(&rig.id, 1).await.unwrap().unwrap().active);
        assert_eq!(store.delete_model(&rig.id, 1).await.unwrap(), ModelDelete::Active);
        assert!(matches!(set(None, "*").await, ActiveUpdate::Updated(ActiveModel { version: None, .. })));
        let nobody = "nobody".parse().unwrap();
        assert_eq!(
            store.set_active_model(&nobody, None, "*", now()).await.unwrap(),
            ActiveUpdate::MissingRig
        );
    }

    #[tokio::test]
    async fn only_a_forward_model_can_be_active() {
        let store = TestStore::open().await;
        let rig = rig(&store).await;
        let mut sensor = imported(b"1");
        sensor.inputs = vec!["y".into()];
        sensor.outputs = vec!["u".into()];
        let sensor =
            store.insert_model(&rig.id, sensor, Activation::Leave, None, now()).await.unwrap().unwrap();
        let update = store.set_active_model(&rig.id, Some(sensor.version), "*", now()).await.unwrap();
        assert_eq!(update, ActiveUpdate::NotForward);
    }

    #[tokio::test]
    async fn a_model_is_published_once_and_with_the_end_of_its_job() {
        let store = TestStore::open().await;
        let rig = rig(&store).await;
        let job = store.queue_fit(&rig).await;
        let until = now() + 30.seconds();
        let lost = store.claim_job("w1", until, now()).await.unwrap().unwrap().lease;
        store.requeue_expired(Timestamp::MAX, &[], now()).await.unwrap();
        let lease = store.claim_job("w2", until, now()).await.unwrap().unwrap().lease;
        let publish = async |lease: &Lease, weights: &'static [u8], activation| {
            let words = |version, active| format!("model {version}, active: {active}");
            store.publish_model(lease, imported(weights), activation, words, now()).await.unwrap()
        };
        assert_eq!(publish(&lost, b"late", Activation::Always).await, None, "its lease is another's");
        assert_eq!(store.active_model(&rig.id).await.unwrap().unwrap().version, None);
        let model = publish(&lease, b"good", Activation::IfStill(None)).await.unwrap();
        assert_eq!((model.version, model.active), (1, true));
        assert_eq!(publish(&lease, b"again", Activation::Always).await, None, "the job has ended");
        let job = store.job(job.id).await.unwrap().unwrap();
        assert_eq!((job.state, job.progress, job.eta_s), (JobState::Succeeded, 1.0, None));
        assert_eq!(job.stage.as_deref(), Some("model 1, active: true"));
        assert_eq!(job.result.unwrap().href, "/v1/rigs/bench/models/1");
        assert!(!store.finish_job(&lease, Outcome::Cancelled, now()).await.unwrap());
        for unpublished in [&b"late"[..], b"again"] {
            let read = store.objects().get(Digest::of(unpublished).as_str()).await;
            assert!(matches!(read, Err(StoreError::ObjectMissing { .. })));
        }
        let running = JobQuery { state: Some(JobState::Running), ..JobQuery::default() };
        assert!(store.jobs(&running, &PageRequest::default()).await.unwrap().items.is_empty());
    }

    #[tokio::test]
    async fn a_fit_that_was_compared_with_a_former_active_model_does_not_become_active() {
        let store = TestStore::open().await;
        let rig = rig(&store).await;
        let version = store.import(&rig, b"1").await.version;
        store.set_active_model(&rig.id, Some(version), "*", now()).await.unwrap();
        store.queue_fit(&rig).await;
        let lease = store.claim_job("w", now() + 30.seconds(), now()).await.unwrap().unwrap().lease;
        let activation = Activation::IfStill(None);
        let published =
            store.publish_model(&lease, imported(b"2"), activation, |_, _| String::new(), now()).await;
        assert!(!published.unwrap().unwrap().active);
        assert_eq!(store.active_model(&rig.id).await.unwrap().unwrap().version, Some(1));
    }
}
