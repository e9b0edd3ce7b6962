//! SQLite in the data directory: one writer, several readers, a write-ahead log that is synced at each commit.

use std::path::Path;
use std::time::Duration;

use sqlx::migrate::MigrateError;
use sqlx::sqlite::{SqliteConnectOptions, SqliteJournalMode, SqlitePoolOptions, SqliteSynchronous};
use sqlx::{Sqlite, SqliteConnection, SqlitePool, Transaction};

use crate::storage::error::sqlite_code;
use crate::storage::{StoreError, journal, migrations};

/// How long a statement waits for a lock of another process, such as a backup tool.
pub(in crate::storage) const BUSY_TIMEOUT: Duration = Duration::from_secs(10);

/// Reads at once.
const READERS: u32 = 8;

/// Pages that each reader keeps, as SQLite's `cache_size`: KiB, negative. The system has the file in memory anyway, and
/// SQLite's 2 MiB a reader would fill over weeks.
const READER_CACHE: &str = "-256";

/// An opened database.
pub(in crate::storage) struct Opened {
    /// One connection, so that writers queue here instead of getting `SQLITE_BUSY`.
    pub(in crate::storage) writer: SqlitePool,
    pub(in crate::storage) readers: SqlitePool,
    /// Number of the last change that the journal has.
    pub(in crate::storage) last: i64,
}

/// Opens or makes the database of a data directory: compares it with its journal, migrates it, and brings the journal
/// up to it.
pub(in crate::storage) async fn open(data_dir: &Path, database: &Path) -> Result<Opened, StoreError> {
    let options = options(database).create_if_missing(true);
    let writer = SqlitePoolOptions::new().max_connections(1).connect_with(options).await;
    let writer = writer.map_err(|error| sound(error, database))?;
    let mut connection = writer.acquire().await?;
    let started = start(data_dir, database, &mut connection).await;
    drop(connection);
    match started {
        Ok(last) => Ok(Opened { writer, readers: readers(database).await?, last }),
        Err(error) => {
            writer.close().await;
            Err(error)
        }
    }
}

/// Begins with `BEGIN IMMEDIATE`, so that rows that are read cannot change before they are written.
pub(super) async fn write(pool: &SqlitePool) -> sqlx::Result<Transaction<'static, Sqlite>> {
    const BEGIN: &str = "BEGIN IMMEDIATE";
    match pool.begin_with(BEGIN).await {
        Err(sqlx::Error::InvalidSavePointStatement) => {
            // After a full disk or a failed write SQLite has ended the last transaction by itself,
            // but the connection still counts it and cannot be used any more.
            pool.acquire().await?.close().await?;
            pool.begin_with(BEGIN).await
        }
        begun => begun,
    }
}

/// Compares the database with its journal, migrates it, and brings the journal up to it. Returns the number of its
/// last change.
async fn start(
    data_dir: &Path,
    database: &Path,
    connection: &mut SqliteConnection,
) -> Result<i64, StoreError> {
    let into_damage = |error: StoreError| error.into_damage(database);
    check_integrity(connection, database).await?;
    let compared = journal::compare(data_dir, connection).await.map_err(into_damage)?;
    check_references(connection, database).await?;
    migrate(connection, database).await.map_err(into_damage)?;
    compared.bring_up(data_dir, connection).await.map_err(into_damage)
}

fn options(database: &Path) -> SqliteConnectOptions {
    SqliteConnectOptions::new()
        .filename(database)
        .create_if_missing(false)
        .journal_mode(SqliteJournalMode::Wal)
        .synchronous(SqliteSynchronous::Full)
        .foreign_keys(true)
        .busy_timeout(BUSY_TIMEOUT)
}

/// Read-only connections.
pub(in crate::storage) async fn readers(database: &Path) -> Result<SqlitePool, StoreError> {
    let reading = options(database).pragma("query_only", "on").pragma("cache_size", READER_CACHE);
    Ok(SqlitePoolOptions::new().max_connections(READERS).connect_with(reading).await?)
}

/// Brings the schema up to this program's.
async fn migrate(connection: &mut SqliteConnection, database: &Path) -> Result<(), StoreError> {
    let known = migrations::latest();
    match migrations::up_to(known).run(connection).await {
        Err(MigrateError::VersionMissing(found)) if found > known => {
            Err(StoreError::Newer { path: database.to_owned(), found, known })
        }
        done => Ok(done?),
    }
}

/// Refuses a damaged database, which must be neither read nor written.
pub(in crate::storage) async fn check_integrity(
    connection: &mut SqliteConnection,
    database: &Path,
) -> Result<(), StoreError> {
    let verdict: String = sqlx::query_scalar("PRAGMA integrity_check(1)")
        .fetch_one(connection)
        .await
        .map_err(|error| sound(error, database))?;
    if verdict == "ok" {
        return Ok(());
    }
    Err(StoreError::Damaged { path: database.to_owned(), what: verdict })
}

/// Refuses a database with a row that belongs to a row that is gone.
pub(in crate::storage) async fn check_references(
    connection: &mut SqliteConnection,
    database: &Path,
) -> Result<(), StoreError> {
    let orphan: Option<(String, Option<i64>, String, i64)> =
        sqlx::query_as("PRAGMA foreign_key_check").fetch_optional(connection).await?;
    let Some((table, _, parent, _)) = orphan else { return Ok(()) };
    let what = format!("a row of {table} names one of {parent} that is gone");
    Err(StoreError::Damaged { path: database.to_owned(), what })
}

/// Turns SQLite's error about a damaged file into a helpful message.
fn sound(error: sqlx::Error, database: &Path) -> StoreError {
    /// `SQLITE_CORRUPT` and `SQLITE_NOTADB`, in any extended code.
    const DAMAGED: [u32; 2] = [11, 26];
    if sqlite_code(&error).is_some_and(|code| DAMAGED.contains(&(code & 0xff))) {
        return StoreError::Damaged { path: database.to_owned(), what: error.to_string() };
    }
    error.into()
}
