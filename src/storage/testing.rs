//! Shared by the tests of the store and of the layers above: a store in a directory of its own, and
//! short ways to rigs, runs, models and jobs.

use std::fmt::Debug;
use std::ops::Deref;
use std::str::FromStr;
use std::sync::Arc;

use bytes::Bytes;
use jiff::Timestamp;
use object_store::memory::InMemory;
use object_store::path::Path as Key;
use sqlx::pool::PoolConnection;
use sqlx::{Connection as _, PgConnection, Sqlite};
use tempfile::TempDir;

use super::bucket::Bucket;
use super::database::{Pool, sql};
use super::{
    Activation, Asker, Digest, JobInsert, NewModel, PostgresSettings, PreparedRun, RunInsert, Store,
    StoreError, StoreSettings,
};
use crate::domain::fits::FitRequest;
use crate::domain::{
    Channel, InsertedRun, Job, Lineage, Model, Origin, Quantity, Rig, RigDraft, Role, Run, RunKind, RunMeta,
    Span, Split,
};
use crate::engine::Signal;
use crate::engine::model::ModelKind;

/// How much a test does: the number that the environment sets for a longer check, or its own.
pub(crate) fn setting<T: FromStr<Err: Debug>>(name: &str, default: T) -> T {
    std::env::var(name).map_or(default, |value| value.parse().expect("a number"))
}

pub(crate) fn now() -> Timestamp {
    "2026-03-01T12:00:00Z".parse().unwrap()
}

/// One drive `u` (kN) and one response `y` (mm) at 100 Hz.
pub(crate) fn draft(id: &str) -> RigDraft {
    let channel = |name: &str, unit: &str, role| Channel {
        name: name.into(),
        unit: unit.into(),
        role,
        quantity: Quantity::Other,
        axis: None,
        group: None,
        aliases: Vec::new(),
    };
    RigDraft {
        id: id.parse().unwrap(),
        name: id.into(),
        sample_rate_hz: 100.0,
        channels: vec![channel("u", "kN", Role::Drive), channel("y", "mm", Role::Response)],
        fit_policy: None,
    }
}

/// A rig that is not stored.
pub(crate) fn rig(draft: &RigDraft) -> Rig {
    Rig {
        id: draft.id.clone(),
        name: draft.name.clone(),
        sample_rate_hz: draft.sample_rate_hz,
        channels: draft.channels.clone(),
        fit_policy: draft.fit_policy.clone(),
        created_at: now(),
        updated_at: now(),
        revision: 1,
    }
}

/// A noise run for training.
pub(crate) fn meta() -> RunMeta {
    RunMeta {
        name: String::new(),
        kind: RunKind::Noise,
        split: Split::Training,
        tags: Vec::new(),
        started_at: None,
    }
}

/// A model of the rig of [`draft`] with bytes that are no weights.
pub(crate) fn imported(weights: &[u8]) -> NewModel {
    NewModel {
        kind: ModelKind::Frf,
        adoption: None,
        inputs: vec!["u".into()],
        outputs: vec!["y".into()],
        sample_rate_hz: 100.0,
        weights: Bytes::copy_from_slice(weights),
        origin: Origin::Import,
        job: None,
        request: None,
        report: None,
        record: None,
        frf: None,
        lineage: Lineage::default(),
        instruction_set: "portable".into(),
    }
}

/// A store in a temporary directory, which is deleted with it. With `RIGCAST_TEST_DATABASE`, a PostgreSQL in which
/// databases may be made, its registry is there, and its objects are in a bucket in memory.
pub(crate) struct TestStore {
    store: Store,
    dir: TempDir,
    bucket: Option<Bucket>,
    settings: StoreSettings,
}

impl Deref for TestStore {
    type Target = Store;

    fn deref(&self) -> &Store {
        &self.store
    }
}

/// A new database of a PostgreSQL.
pub(super) async fn new_database(server: &str) -> String {
    let (place, _) = server.rsplit_once('/').expect("postgres://user@host/database");
    let name = format!("test_{}", uuid::Uuid::new_v4().simple());
    let mut connection = PgConnection::connect(server).await.unwrap();
    let create = sqlx::AssertSqlSafe(format!("CREATE DATABASE {name}"));
    sqlx::query(create).execute(&mut connection).await.unwrap();
    connection.close().await.unwrap();
    format!("{place}/{name}")
}

impl Store {
    /// Does statements as they stand.
    pub(crate) async fn raw(&self, statements: impl Into<String>) -> sqlx::Result<u64> {
        let statements = sqlx::raw_sql(sqlx::AssertSqlSafe(statements.into()));
        match self.writer() {
            Pool::Sqlite(pool) => Ok(statements.execute(pool).await?.rows_affected()),
            Pool::Postgres(pool) => Ok(statements.execute(pool).await?.rows_affected()),
        }
    }

    /// A connection to the database in the data directory.
    pub(super) async fn sqlite(&self) -> PoolConnection<Sqlite> {
        match self.reader() {
            Pool::Sqlite(pool) => pool.acquire().await.unwrap(),
            Pool::Postgres(_) => panic!("a test of SQLite alone"),
        }
    }
}

impl TestStore {
    pub(crate) async fn open() -> Self {
        let Ok(server) = std::env::var("RIGCAST_TEST_DATABASE") else { return Self::open_sqlite().await };
        let url = new_database(&server).await;
        let bucket = Bucket::of(Arc::new(InMemory::new()), Key::from("lab"), "s3://lab/lab", u64::MAX);
        let settings = StoreSettings { bucket: None, database: Some(PostgresSettings { url }) };
        Self::made(Some(bucket), settings).await
    }

    /// A store whose registry is in the data directory, whatever the tests are for.
    pub(crate) async fn open_sqlite() -> Self {
        Self::made(None, StoreSettings::default()).await
    }

    /// A new one whose objects are in a bucket.
    pub(super) async fn open_in(bucket: Bucket) -> Self {
        Self::made(Some(bucket), StoreSettings::default()).await
    }

    async fn made(bucket: Option<Bucket>, settings: StoreSettings) -> Self {
        let dir = tempfile::tempdir().unwrap();
        let store = Store::open_in(dir.path(), bucket.clone(), settings.clone()).await.unwrap();
        Self { store, dir, bucket, settings }
    }

    /// Another process on the same registry and bucket.
    pub(crate) async fn beside(&self) -> Self {
        Self::made(self.bucket.clone(), self.settings.clone()).await
    }

    /// Its directory after an orderly stop.
    pub(crate) async fn stopped(self) -> TempDir {
        self.store.close().await;
        self.dir
    }

    /// As [`TestStore::reopened`], with the objects in a bucket.
    pub(super) async fn reopened_in(self, bucket: Bucket) -> Self {
        Self { bucket: Some(bucket), ..self }.reopened().await
    }

    /// The same data after an orderly stop and a new start.
    pub(crate) async fn reopened(self) -> Self {
        let Self { store, dir, bucket, settings } = self;
        store.close().await;
        drop(store);
        let store = Store::open_in(dir.path(), bucket.clone(), settings.clone()).await.unwrap();
        Self { store, dir, bucket, settings }
    }

    /// A run whose drive is `u` and whose response is twice as large.
    pub(crate) fn prepare(&self, rig: &Rig, meta: RunMeta, u: &[f64]) -> PreparedRun {
        let y = u.iter().map(|v| 2.0 * v.clamp(-1e100, 1e100)).collect();
        let signal = Signal::new(rig.sample_rate_hz, vec![u.to_vec(), y]).unwrap();
        let file: Vec<u8> = u.iter().flat_map(|v| v.to_le_bytes()).collect();
        let sha256 = Digest::of(&file).as_str().to_owned();
        let names = vec!["u".into(), "y".into()];
        PreparedRun::new(&self.scratch_dir(), rig, meta, names, Vec::new(), signal, sha256).unwrap()
    }

    pub(crate) async fn upload_with(&self, rig: &Rig, meta: RunMeta, u: &[f64]) -> InsertedRun {
        let prepared = self.prepare(rig, meta, u);
        match self.insert_run(&rig.id, prepared, None, None, now()).await.unwrap() {
            RunInsert::Inserted(inserted) => *inserted,
            other => panic!("{other:?}"),
        }
    }

    pub(crate) async fn upload(&self, rig: &Rig, u: &[f64]) -> InsertedRun {
        self.upload_with(rig, meta(), u).await
    }

    pub(crate) async fn import(&self, rig: &Rig, weights: &[u8]) -> Model {
        self.insert_model(&rig.id, imported(weights), Activation::Leave, None, now()).await.unwrap().unwrap()
    }

    /// Limits the pages of the database. A limit below its present size acts like a full disk.
    pub(crate) async fn limit_pages(&self, pages: i64) {
        self.raw(format!("PRAGMA max_page_count = {pages}")).await.unwrap();
    }

    /// A model that fills some pages of the database, or the store's refusal.
    pub(crate) async fn import_again(&self, rig: &Rig, n: usize) -> Result<Model, StoreError> {
        let mut model = imported(n.to_string().as_bytes());
        model.instruction_set = "x".repeat(20_000);
        let inserted = self.insert_model(&rig.id, model, Activation::Leave, None, now()).await?;
        Ok(inserted.expect("the rig is there"))
    }

    pub(crate) async fn import_fitted_on(&self, rig: &Rig, weights: &[u8], run: &Run) -> Model {
        let mut model = imported(weights);
        let span = Span { run: run.id, sha256: run.sha256.clone(), from_sample: 0, to_sample: run.samples };
        model.lineage.training = vec![span];
        self.insert_model(&rig.id, model, Activation::Leave, None, now()).await.unwrap().unwrap()
    }

    pub(crate) async fn count_checkpoints(&self) -> i64 {
        sql("SELECT count(*) FROM checkpoints").fetch_one(self.reader()).await.unwrap()
    }

    pub(crate) async fn queue_fit(&self, rig: &Rig) -> Job {
        let request: FitRequest = serde_json::from_value(serde_json::json!({"kind": "frf"})).unwrap();
        let asker = Asker { token: None, max_waiting: u64::MAX };
        match self.insert_job(&rig.id, &request, asker, None, now()).await.unwrap() {
            JobInsert::Queued(job) => *job,
            other => panic!("{other:?}"),
        }
    }
}
