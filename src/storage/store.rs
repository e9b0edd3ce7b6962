//! Opening a data directory, and the two ways to the database: one writer, several readers.

use std::fs::{File, TryLockError};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::{Duration, Instant};

use serde::{Deserialize, Serialize};
use sqlx::PgPool;

use super::bucket::{self, Bucket, BucketSettings};
use super::database::{Pool, Session, postgres, sql, sqlite};
use super::files::{self, failed, sync_directory};
use super::journal::{self, Journal};
use super::object_locks::ObjectLocks;
use super::objects::off_thread;
use super::reserve::Reserve;
use super::{Objects, PostgresSettings, StoreError};

/// Name of the database in a data directory and in a backup.
pub(super) const DATABASE: &str = "rigcast.db";

/// The database, its write-ahead log, and the index of that log.
pub(super) const DATABASE_FILES: [&str; 3] = [DATABASE, "rigcast.db-wal", "rigcast.db-shm"];

/// Directory of unfinished files in a data directory.
pub(super) const SCRATCH: &str = "scratch";

/// How long a start waits for the lock of a process that is about to end.
const LOCK_WAIT: Duration = Duration::from_secs(2);

/// How long the database may take to answer before it counts as away: monitors do not wait as long as requests do.
const PING: Duration = Duration::from_secs(2);

/// Where a store is, beyond its data directory.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize)]
pub struct StoreSettings {
    /// Where the objects are; `None`: in the data directory.
    pub bucket: Option<BucketSettings>,
    /// Where the registry is; `None`: in the data directory.
    pub database: Option<PostgresSettings>,
}

/// The registry and the objects of one data directory. Clones share everything.
#[derive(Debug, Clone)]
pub struct Store {
    inner: Arc<Inner>,
}

#[derive(Debug)]
struct Inner {
    data_dir: PathBuf,
    writer: Pool,
    readers: Pool,
    /// For transactions that begin before an object is stored, on PostgreSQL.
    holders: Option<PgPool>,
    objects: Objects,
    /// For the processes of jobs, which open the store themselves.
    settings: StoreSettings,
    /// A store that only reads has none, and PostgreSQL has its own.
    journal: Option<Journal>,
    reserve: Option<Reserve>,
    object_locks: ObjectLocks,
    /// Keeps the lock, which ends with the file.
    _lock: Option<File>,
}

impl Inner {
    /// What each store has; `pools` are those to write and to read by.
    fn new(data_dir: &Path, [writer, readers]: [Pool; 2], objects: Objects, settings: StoreSettings) -> Self {
        Self {
            data_dir: data_dir.to_owned(),
            writer,
            readers,
            holders: None,
            objects,
            settings,
            journal: None,
            reserve: None,
            object_locks: ObjectLocks::default(),
            _lock: None,
        }
    }
}

impl Store {
    /// Opens (or makes) a data directory: locks it, compares the database with its journal, migrates it, opens the
    /// objects and puts aside those that no row names.
    ///
    /// # Errors
    /// [`StoreError::Locked`] if another process uses it; a damaged or newer database, or one that lacks acknowledged
    /// changes; the file system's errors.
    pub async fn open(data_dir: &Path) -> Result<Self, StoreError> {
        Self::open_with(data_dir, &StoreSettings::default()).await
    }

    /// As [`Store::open`], with the objects in a bucket, and the registry on PostgreSQL. Objects that only the data
    /// directory has are stored in the bucket.
    ///
    /// # Errors
    /// As of [`Store::open`]; a bucket or database that cannot be used, or belongs to another service.
    pub async fn open_with(data_dir: &Path, settings: &StoreSettings) -> Result<Self, StoreError> {
        let bucket = settings.bucket.as_ref().map(Bucket::open).transpose()?;
        Self::open_in(data_dir, bucket, settings.clone()).await
    }

    /// As [`Store::open_with`], with an opened bucket.
    pub(super) async fn open_in(
        data_dir: &Path,
        bucket: Option<Bucket>,
        settings: StoreSettings,
    ) -> Result<Self, StoreError> {
        if let Some(postgres) = settings.database.clone() {
            return Self::open_shared(data_dir, bucket, &postgres, settings).await;
        }
        let lock = lock(data_dir)?;
        prepare_directory(data_dir)?;
        match &bucket {
            None => bucket::refuse_without(data_dir)?,
            Some(bucket) => bucket.claim(data_dir, None).await?,
        }
        let store = Self::locked(data_dir, lock, bucket, settings).await?;
        store.sweep_objects().await?;
        store.read_adoptions().await?;
        Ok(store)
    }

    /// Opens a registry on PostgreSQL, which any number of processes share. The data directory is this process' alone,
    /// and has copies of objects only.
    async fn open_shared(
        data_dir: &Path,
        bucket: Option<Bucket>,
        postgres: &PostgresSettings,
        settings: StoreSettings,
    ) -> Result<Self, StoreError> {
        let name = postgres.name()?;
        let refused = |what: String| StoreError::Postgres { database: name.clone(), what };
        let Some(bucket) = bucket else {
            let what = "the objects must be where all processes reach them: name a bucket with --objects";
            return Err(refused(what.into()));
        };
        if Self::exists(data_dir) {
            return Err(refused(format!(
                "{} has a registry of its own. Choose another data directory, or bring it over with `rigcast move`",
                data_dir.display()
            )));
        }
        let lock = lock(data_dir)?;
        prepare_directory(data_dir)?;
        let opened = postgres.open().await?;
        bucket.claim(data_dir, Some((&name, opened.service))).await?;
        let pools = [opened.writers, opened.readers].map(Pool::Postgres);
        let inner = Inner {
            holders: Some(opened.holders),
            reserve: Some(Reserve::of(data_dir)),
            _lock: Some(lock),
            ..Inner::new(data_dir, pools, Objects::open(&data_dir.join("objects"), Some(bucket))?, settings)
        };
        let store = Self { inner: Arc::new(inner) };
        store.sweep_copies().await?;
        Ok(store)
    }

    /// As [`Store::open_with`], for work on rows alone, wherever the objects are. Beside running services only on
    /// PostgreSQL.
    ///
    /// # Errors
    /// As of [`Store::open`].
    pub async fn open_rows(data_dir: &Path, database: Option<&PostgresSettings>) -> Result<Self, StoreError> {
        let Some(postgres) = database else {
            let lock = lock(data_dir)?;
            prepare_directory(data_dir)?;
            return Self::locked(data_dir, lock, None, StoreSettings::default()).await;
        };
        let opened = postgres.open().await?;
        // No object is read or written, so that any directory will do.
        let directory = std::env::temp_dir();
        let pools = [opened.writers, opened.readers].map(Pool::Postgres);
        let settings = StoreSettings { bucket: None, database: Some(postgres.clone()) };
        let inner = Inner::new(&directory, pools, Objects::open(&directory, None)?, settings);
        Ok(Self { inner: Arc::new(inner) })
    }

    /// Opens a data directory that is locked and prepared.
    async fn locked(
        data_dir: &Path,
        lock: File,
        bucket: Option<Bucket>,
        settings: StoreSettings,
    ) -> Result<Self, StoreError> {
        let database = data_dir.join(DATABASE);
        never_empty(&database, data_dir)?;
        let opened = sqlite::open(data_dir, &database).await?;
        let journal = Journal::open(data_dir, &opened)?;
        let pools = [opened.writer, opened.readers].map(Pool::Sqlite);
        let inner = Inner {
            journal: Some(journal),
            reserve: Some(Reserve::of(data_dir)),
            _lock: Some(lock),
            ..Inner::new(data_dir, pools, Objects::open(&data_dir.join("objects"), bucket)?, settings)
        };
        Ok(Self { inner: Arc::new(inner) })
    }

    /// Whether a directory holds a registry already.
    pub fn exists(data_dir: &Path) -> bool {
        data_dir.join(DATABASE).exists()
    }

    /// Opens the data directory of a running service to read from it: for the worker processes of
    /// that service. Nothing is locked, migrated or swept, and every write is refused.
    ///
    /// # Errors
    /// No database; the file system's errors.
    pub async fn open_to_read(data_dir: &Path, settings: &StoreSettings) -> Result<Self, StoreError> {
        let bucket = settings.bucket.as_ref().map(Bucket::open).transpose()?;
        let readers = match &settings.database {
            None => Pool::Sqlite(sqlite::readers(&data_dir.join(DATABASE)).await?),
            Some(postgres) => Pool::Postgres(postgres.open_to_read()?),
        };
        let objects = Objects::open(&data_dir.join("objects"), bucket)?;
        let inner = Inner::new(data_dir, [readers.clone(), readers], objects, settings.clone());
        Ok(Self { inner: Arc::new(inner) })
    }

    /// Checks that the database answers and that the directory can be written. `false` if the disk is
    /// full, in which case reads still work.
    ///
    /// # Errors
    /// Any other failure of the store.
    pub async fn ping(&self) -> Result<bool, StoreError> {
        let asked = sql("SELECT id FROM rigs LIMIT 1");
        let asked = asked.fetch_optional::<String>(self.reader());
        tokio::time::timeout(PING, asked).await.map_err(|_| sqlx::Error::PoolTimedOut)??;
        if let Some(journal) = self.journal() {
            journal.check().await?;
        }
        let path = self.scratch_dir().join(".ping");
        let pinged = off_thread(move || {
            let written = std::fs::write(&path, b"ping").map_err(failed(&path));
            // Two pings at once may remove the same file.
            written.and(files::remove(&path))
        });
        match pinged.await {
            Err(error) if error.is_disk_full() => Ok(false),
            done => done.map(|()| self.reserve().is_none_or(Reserve::hold)),
        }
    }

    /// Checks that the bucket answers. Without it what the local disk has is still read, and no upload is taken.
    ///
    /// # Errors
    /// [`StoreError::Bucket`].
    pub async fn ping_bucket(&self) -> Result<(), StoreError> {
        match self.objects().bucket() {
            None => Ok(()),
            Some(bucket) => bucket.ping().await,
        }
    }

    /// The data directory.
    pub fn data_dir(&self) -> &Path {
        &self.inner.data_dir
    }

    /// A directory inside the data directory for unfinished files; emptied by [`Store::open`].
    pub fn scratch_dir(&self) -> PathBuf {
        self.inner.data_dir.join(SCRATCH)
    }

    /// Where the store is, beyond the data directory.
    pub fn settings(&self) -> &StoreSettings {
        &self.inner.settings
    }

    /// Whether other processes may write to the registry too.
    pub fn is_shared(&self) -> bool {
        matches!(self.inner.writer, Pool::Postgres(_))
    }

    /// The time by the clock that all processes of the registry go by; `None`: that of this machine.
    ///
    /// # Errors
    /// The database's failures.
    pub async fn shared_time(&self) -> Result<Option<jiff::Timestamp>, StoreError> {
        match self.reader() {
            Pool::Sqlite(_) => Ok(None),
            Pool::Postgres(pool) => postgres::time(pool).await.map(Some),
        }
    }

    /// The objects.
    pub fn objects(&self) -> &Objects {
        &self.inner.objects
    }

    /// Closes the database cleanly. Further calls on any clone fail.
    pub async fn close(&self) {
        self.inner.readers.close().await;
        self.inner.writer.close().await;
        if let Some(holders) = &self.inner.holders {
            holders.close().await;
        }
    }

    pub(super) fn reader(&self) -> &Pool {
        &self.inner.readers
    }

    /// A transaction that reads all its rows as of one moment.
    pub(super) async fn snapshot(&self) -> Result<Session, StoreError> {
        Ok(self.reader().snapshot().await?)
    }

    pub(super) fn object_locks(&self) -> &ObjectLocks {
        &self.inner.object_locks
    }

    /// Connections for transactions that begin before an object is stored or removed; `None` where none are needed.
    pub(super) fn holders(&self) -> Option<&PgPool> {
        self.inner.holders.as_ref()
    }

    pub(super) fn writer(&self) -> &Pool {
        &self.inner.writer
    }

    pub(super) fn reserve(&self) -> Option<&Reserve> {
        self.inner.reserve.as_ref()
    }

    pub(super) fn journal(&self) -> Option<&Journal> {
        self.inner.journal.as_ref()
    }
}

/// Makes the data directory and takes its lock. A process that was just killed may still hold it for a moment.
pub(super) fn lock(data_dir: &Path) -> Result<File, StoreError> {
    let new = !data_dir.exists();
    std::fs::create_dir_all(data_dir).map_err(failed(data_dir))?;
    let lock = File::options()
        .create(true)
        .truncate(false)
        .write(true)
        .open(data_dir.join("lock"))
        .map_err(failed(data_dir))?;
    let until = Instant::now() + LOCK_WAIT;
    loop {
        match lock.try_lock() {
            Ok(()) => break,
            Err(TryLockError::WouldBlock) if Instant::now() < until => {
                std::thread::sleep(Duration::from_millis(50));
            }
            Err(TryLockError::WouldBlock) => return Err(StoreError::Locked { path: data_dir.to_owned() }),
            Err(TryLockError::Error(source)) => return Err(failed(data_dir)(source)),
        }
    }
    // Otherwise a power cut could lose a new directory with all acknowledged data.
    let parent = data_dir.parent().filter(|parent| new && !parent.as_os_str().is_empty());
    if let Some(parent) = parent {
        sync_directory(parent)?;
    }
    Ok(lock)
}

/// Makes the directories, empties the scratch directory.
fn prepare_directory(data_dir: &Path) -> Result<(), StoreError> {
    let scratch = data_dir.join(SCRATCH);
    match std::fs::remove_dir_all(&scratch) {
        Err(source) if source.kind() != std::io::ErrorKind::NotFound => return Err(failed(data_dir)(source)),
        _ => {}
    }
    std::fs::create_dir_all(&scratch).map_err(failed(data_dir))?;
    std::fs::create_dir_all(data_dir.join("objects")).map_err(failed(data_dir))?;
    sync_directory(data_dir)
}

/// Refuses objects or a journal without a database: the database was lost, and a start would be an empty one.
fn never_empty(database: &Path, data_dir: &Path) -> Result<(), StoreError> {
    let empty = match std::fs::metadata(database) {
        Ok(found) => found.len() == 0,
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => true,
        Err(source) => return Err(failed(database)(source)),
    };
    if empty && (journal::is_there(data_dir) || Objects::any(&data_dir.join("objects"))) {
        let what = "it is missing or empty, but there are runs and models beside it".into();
        return Err(StoreError::Damaged { path: database.to_owned(), what });
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use sqlx::SqlitePool;
    use sqlx::sqlite::SqliteConnectOptions;

    use super::super::migrations;
    use super::super::testing::{TestStore, draft, now};
    use super::*;
    use crate::domain::Origin;

    #[tokio::test]
    async fn a_data_directory_belongs_to_one_process_at_a_time() {
        let dir = tempfile::tempdir().unwrap();
        let store = Store::open(dir.path()).await.unwrap();
        assert!(matches!(Store::open(dir.path()).await, Err(StoreError::Locked { .. })));
        store.ping().await.unwrap();
        store.close().await;
        drop(store);
        Store::open(dir.path()).await.unwrap();
    }

    #[tokio::test]
    async fn a_worker_reads_beside_the_service_and_cannot_write() {
        let store = TestStore::open().await;
        store.insert_rig(&draft("bench"), None, now()).await.unwrap();
        let reader = Store::open_to_read(store.data_dir(), store.settings()).await.unwrap();
        assert!(reader.rig(&"bench".parse().unwrap()).await.unwrap().is_some());
        assert!(matches!(
            reader.insert_rig(&draft("other"), None, now()).await,
            Err(StoreError::Database(_))
        ));
        store.insert_rig(&draft("third"), None, now()).await.unwrap();
        assert!(reader.rig(&"third".parse().unwrap()).await.unwrap().is_some());
        let nowhere = tempfile::tempdir().unwrap();
        assert!(Store::open_to_read(nowhere.path(), &StoreSettings::default()).await.is_err());
        assert!(!nowhere.path().join("rigcast.db").exists());
    }

    #[tokio::test]
    async fn a_start_empties_the_scratch_directory() {
        let dir = tempfile::tempdir().unwrap();
        let store = Store::open(dir.path()).await.unwrap();
        let left = store.scratch_dir().join("upload");
        std::fs::write(&left, b"half").unwrap();
        drop(store);
        Store::open(dir.path()).await.unwrap();
        assert!(!left.exists());
    }

    #[tokio::test]
    async fn a_data_directory_that_has_gone_away_is_out_of_reach() {
        let store = TestStore::open().await;
        assert!(store.ping().await.unwrap());
        std::fs::remove_dir_all(store.scratch_dir()).unwrap();
        let error = store.ping().await.unwrap_err();
        assert!(error.is_unavailable(), "{error}");
    }

    #[tokio::test]
    async fn a_damaged_database_stops_the_start() {
        let dir = tempfile::tempdir().unwrap();
        Store::open(dir.path()).await.unwrap().close().await;
        std::fs::write(dir.path().join("rigcast.db"), vec![b'x'; 8192]).unwrap();
        let refused = Store::open(dir.path()).await.unwrap_err();
        assert!(matches!(refused, StoreError::Damaged { .. }), "{refused}");
        assert!(refused.to_string().contains("rigcast restore"), "{refused}");
    }

    #[tokio::test]
    async fn a_lost_database_is_not_taken_for_a_new_one() {
        let store = TestStore::open().await;
        let rig = store.insert_rig(&draft("bench"), None, now()).await.unwrap().unwrap();
        store.import(&rig, b"weights").await;
        store.close().await;
        let dir = tempfile::tempdir().unwrap();
        for name in ["objects", "scratch"] {
            std::fs::rename(store.data_dir().join(name), dir.path().join(name)).unwrap();
        }
        for content in [None, Some(b"")] {
            if let Some(content) = content {
                std::fs::write(dir.path().join("rigcast.db"), content).unwrap();
            }
            let refused = Store::open(dir.path()).await;
            assert!(matches!(refused, Err(StoreError::Damaged { .. })), "{refused:?}");
        }
        assert!(Objects::any(&dir.path().join("objects")), "nothing was removed");
    }

    #[tokio::test]
    async fn commits_are_synced_and_the_log_is_write_ahead() {
        let dir = tempfile::tempdir().unwrap();
        let store = Store::open(dir.path()).await.unwrap();
        let mut tx = store.write().await.unwrap();
        let journal: String = sql("PRAGMA journal_mode").fetch_one(&mut *tx).await.unwrap();
        let synchronous: i64 = sql("PRAGMA synchronous").fetch_one(&mut *tx).await.unwrap();
        let keys: i64 = sql("PRAGMA foreign_keys").fetch_one(&mut *tx).await.unwrap();
        assert_eq!((journal.as_str(), synchronous, keys), ("wal", 2, 1));
        drop(tx);
        let refused = sql("DELETE FROM rigs").execute(store.reader()).await;
        assert!(refused.is_err(), "readers cannot write");
    }

    #[tokio::test]
    async fn a_full_database_refuses_writes_loses_nothing_and_works_again_with_more_room() {
        let store = TestStore::open_sqlite().await;
        let rig = store.insert_rig(&draft("bench"), None, now()).await.unwrap().unwrap();
        store.limit_pages(1).await;
        let mut accepted = 0;
        let refused = loop {
            match store.import_again(&rig, accepted).await {
                Ok(_) => accepted += 1,
                Err(error) => break error,
            }
        };
        assert!(refused.is_disk_full(), "{refused}");
        assert!(store.rig(&rig.id).await.unwrap().is_some(), "reads go on");
        let models =
            async || store.models(&rig.id, &crate::domain::PageRequest::default()).await.unwrap().unwrap();
        assert_eq!(models().await.items.len(), accepted);
        store.limit_pages(1 << 30).await;
        store.import_again(&rig, accepted).await.unwrap();
        assert_eq!(models().await.items.len(), accepted + 1);
    }

    #[tokio::test]
    async fn a_database_of_a_newer_program_is_left_alone_and_named() {
        let dir = tempfile::tempdir().unwrap();
        let store = Store::open(dir.path()).await.unwrap();
        let later = "INSERT INTO _sqlx_migrations SELECT 9999, description, installed_on, success, checksum, execution_time
                     FROM _sqlx_migrations WHERE version = 1";
        store.raw(later).await.unwrap();
        store.close().await;
        drop(store);
        let refused = Store::open(dir.path()).await.unwrap_err().to_string();
        assert!(refused.contains("newer Rigcast") && refused.contains("9999"), "{refused}");
    }

    /// A database as the first schema left it, with a rig whose active model was imported.
    async fn first_schema(dir: &Path) {
        let database = SqliteConnectOptions::new().filename(dir.join("rigcast.db")).create_if_missing(true);
        let pool = SqlitePool::connect_with(database.foreign_keys(true)).await.unwrap();
        migrations::up_to(1).run(&pool).await.unwrap();
        for statement in [
            "INSERT INTO rigs (id, name, sample_rate_hz, channels, created_us, updated_us, revision, active_revision, next_version)
             VALUES ('bench', 'Bench', 100, '[]', 1, 1, 1, 7, 3), ('idle', 'Idle', 100, '[]', 1, 1, 1, 1, 1)",
            "INSERT INTO models (rig, version, kind, inputs, outputs, sample_rate_hz, sha256, size_bytes, origin, lineage,
                                 code_version, instruction_set, created_us)
             VALUES ('bench', 2, 'frf', '[\"u\"]', '[\"y\"]', 100, 'ab', 5, 'import',
                     '{\"training\": [], \"frf\": [], \"validation\": []}', '0', 'portable', 9)",
            "UPDATE rigs SET active_version = 2, active_us = 8 WHERE id = 'bench'",
        ] {
            sqlx::query(statement).execute(&pool).await.unwrap();
        }
        pool.close().await;
    }

    #[tokio::test]
    async fn a_database_of_the_first_schema_keeps_its_models_and_which_is_active() {
        let dir = tempfile::tempdir().unwrap();
        first_schema(dir.path()).await;
        let store = Store::open(dir.path()).await.unwrap();
        let bench = "bench".parse().unwrap();
        let active = store.active_model(&bench).await.unwrap().unwrap();
        assert_eq!((active.version, active.revision), (Some(2), 7));
        assert_eq!(store.active_model(&"idle".parse().unwrap()).await.unwrap().unwrap().version, None);
        let model = store.model(&bench, 2).await.unwrap().unwrap();
        assert_eq!((model.origin, model.inputs, model.size_bytes), (Origin::Import, vec!["u".to_owned()], 5));
        assert!(model.active);
        let adopted = store.raw("UPDATE models SET origin = 'diagnosis'").await;
        assert_eq!(adopted.unwrap(), 1);
        let gone = store.raw("DELETE FROM models").await;
        assert!(gone.is_err(), "the rig still points at it");
        let wrong = store.raw("UPDATE models SET origin = 'found'").await;
        assert!(wrong.is_err(), "no such origin");
        store.raw("DELETE FROM rigs").await.unwrap();
        let left: i64 = sql("SELECT count(*) FROM models").fetch_one(store.reader()).await.unwrap();
        assert_eq!(left, 0, "models go with their rig");
    }
}
