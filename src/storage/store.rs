//! Opening a data directory, and the two ways to the database: one writer, several readers.

use std::fs::{File, TryLockError};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use sqlx::pool::PoolConnection;
use sqlx::sqlite::{SqliteConnectOptions, SqliteJournalMode, SqlitePoolOptions, SqliteSynchronous};
use sqlx::{Sqlite, SqlitePool, Transaction};
use tokio::sync::RwLock;

use super::{Objects, StoreError};

/// How long a statement waits for another one's lock; only a backup tool could hold one.
const BUSY_TIMEOUT: Duration = Duration::from_secs(10);

/// Reads at once.
const READERS: u32 = 8;

/// The registry and the objects of one data directory. Clones share everything.
#[derive(Debug, Clone)]
pub struct Store {
    inner: Arc<Inner>,
}

#[derive(Debug)]
struct Inner {
    data_dir: PathBuf,
    /// One connection: writers queue here instead of meeting `SQLITE_BUSY`.
    writer: SqlitePool,
    readers: SqlitePool,
    objects: Objects,
    /// Held shared from before an object is written until a row refers to it, and exclusively
    /// while unreferenced objects are removed: else a removal could take an object that is about
    /// to be referred to.
    objects_gate: Arc<RwLock<()>>,
    /// Held, not read: the lock ends with the file.
    _lock: File,
}

impl Store {
    /// Opens (or makes) a data directory: locks it, migrates the database, opens the objects and
    /// removes what an interrupted upload left.
    ///
    /// # Errors
    /// [`StoreError::Locked`] when another process has it; a damaged or newer database; the
    /// file system's refusals.
    pub async fn open(data_dir: &Path) -> Result<Self, StoreError> {
        let lock = prepare_directory(data_dir)?;
        let database = data_dir.join("rigcast.db");
        let options = SqliteConnectOptions::new()
            .filename(&database)
            .create_if_missing(true)
            .journal_mode(SqliteJournalMode::Wal)
            .synchronous(SqliteSynchronous::Full)
            .foreign_keys(true)
            .busy_timeout(BUSY_TIMEOUT);
        let writer = SqlitePoolOptions::new().max_connections(1).connect_with(options.clone()).await?;
        check_integrity(&writer).await?;
        sqlx::migrate!().run(&writer).await?;
        // Reads cannot write by mistake.
        let reading = options.create_if_missing(false).pragma("query_only", "on");
        let readers = SqlitePoolOptions::new().max_connections(READERS).connect_with(reading).await?;
        let objects = Objects::open(&data_dir.join("objects"))?;
        let inner = Inner {
            data_dir: data_dir.to_owned(),
            writer,
            readers,
            objects,
            objects_gate: Arc::default(),
            _lock: lock,
        };
        let store = Self { inner: Arc::new(inner) };
        store.sweep_objects().await?;
        Ok(store)
    }

    /// Asks the database for a sign of life, and whether the directory can be written.
    ///
    /// # Errors
    /// Whatever keeps the store from working.
    pub async fn ping(&self) -> Result<(), StoreError> {
        sqlx::query("SELECT id FROM rigs LIMIT 1").fetch_optional(self.reader()).await?;
        let path = self.scratch_dir().join(".ping");
        let written = match tokio::fs::write(&path, b"ping").await {
            Ok(()) => tokio::fs::remove_file(&path).await,
            Err(error) => Err(error),
        };
        match written {
            // Two pings at once remove one file.
            Err(source) if source.kind() != std::io::ErrorKind::NotFound => {
                Err(StoreError::DataDir { path, source })
            }
            _ => Ok(()),
        }
    }

    /// The data directory.
    pub fn data_dir(&self) -> &Path {
        &self.inner.data_dir
    }

    /// A directory inside the data directory for files that are not yet anything; emptied by
    /// [`Store::open`].
    pub fn scratch_dir(&self) -> PathBuf {
        self.inner.data_dir.join("scratch")
    }

    /// The objects.
    pub fn objects(&self) -> &Objects {
        &self.inner.objects
    }

    /// Closes the database cleanly. Further calls on any clone fail.
    pub async fn close(&self) {
        self.inner.readers.close().await;
        self.inner.writer.close().await;
    }

    pub(super) fn reader(&self) -> &SqlitePool {
        &self.inner.readers
    }

    pub(super) fn objects_gate(&self) -> &RwLock<()> {
        &self.inner.objects_gate
    }

    /// The connection for a write of one statement.
    pub(super) async fn write_one(&self) -> Result<PoolConnection<Sqlite>, StoreError> {
        Ok(self.inner.writer.acquire().await?)
    }

    /// Begins a write. `BEGIN IMMEDIATE`: what it reads cannot change before it writes.
    pub(super) async fn write(&self) -> Result<Transaction<'static, Sqlite>, StoreError> {
        Ok(self.inner.writer.begin_with("BEGIN IMMEDIATE").await?)
    }
}

/// Makes the directories, takes the lock, empties the scratch directory.
fn prepare_directory(data_dir: &Path) -> Result<File, StoreError> {
    let failed = |source| StoreError::DataDir { path: data_dir.to_owned(), source };
    std::fs::create_dir_all(data_dir).map_err(failed)?;
    let lock = File::options()
        .create(true)
        .truncate(false)
        .write(true)
        .open(data_dir.join("lock"))
        .map_err(failed)?;
    lock.try_lock().map_err(|error| match error {
        TryLockError::WouldBlock => StoreError::Locked { path: data_dir.to_owned() },
        TryLockError::Error(source) => failed(source),
    })?;
    let scratch = data_dir.join("scratch");
    match std::fs::remove_dir_all(&scratch) {
        Err(source) if source.kind() != std::io::ErrorKind::NotFound => return Err(failed(source)),
        _ => {}
    }
    std::fs::create_dir_all(&scratch).map_err(failed)?;
    std::fs::create_dir_all(data_dir.join("objects")).map_err(failed)?;
    Ok(lock)
}

/// A damaged database stops the start; it must not be served, and less so written to.
async fn check_integrity(pool: &SqlitePool) -> Result<(), StoreError> {
    let verdict: String = sqlx::query_scalar("PRAGMA quick_check(1)").fetch_one(pool).await?;
    if verdict == "ok" {
        return Ok(());
    }
    Err(StoreError::Row { table: "sqlite_schema", key: "quick_check".into(), what: verdict })
}

#[cfg(test)]
mod tests {
    use super::*;

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
    async fn a_damaged_database_stops_the_start() {
        let dir = tempfile::tempdir().unwrap();
        Store::open(dir.path()).await.unwrap().close().await;
        std::fs::write(dir.path().join("rigcast.db"), vec![b'x'; 8192]).unwrap();
        assert!(matches!(Store::open(dir.path()).await, Err(StoreError::Database(_))));
    }

    #[tokio::test]
    async fn commits_are_synced_and_the_log_is_write_ahead() {
        let dir = tempfile::tempdir().unwrap();
        let store = Store::open(dir.path()).await.unwrap();
        let mut tx = store.write().await.unwrap();
        let journal: String = sqlx::query_scalar("PRAGMA journal_mode").fetch_one(&mut *tx).await.unwrap();
        let synchronous: i64 = sqlx::query_scalar("PRAGMA synchronous").fetch_one(&mut *tx).await.unwrap();
        let keys: i64 = sqlx::query_scalar("PRAGMA foreign_keys").fetch_one(&mut *tx).await.unwrap();
        assert_eq!((journal.as_str(), synchronous, keys), ("wal", 2, 1));
        drop(tx);
        let refused = sqlx::query("DELETE FROM rigs").execute(store.reader()).await;
        assert!(refused.is_err(), "readers cannot write");
    }
}
