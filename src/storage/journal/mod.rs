//! The journal: a second, append-only copy of every acknowledged row, beside the database.
//!
//! SQLite drops the end of its write-ahead log at the first damaged frame, and starts without the log if it is gone;
//! either way without a word. Each commit therefore also appends the rows that it changed to the journal, synced
//! before a client is told. At a start the two are compared: a database that lacks acknowledged changes is refused,
//! a row that is not as it was written is mended, and `rigcast recover` makes the database anew. Rows are compared
//! again while the service runs.
//!
//! The database comes first and the journal second. After a crash the database may thus be ahead of the journal,
//! never behind it.

mod check;
mod entry;
mod file;
mod recover;
mod scrub;
mod tables;
#[cfg(test)]
mod tests;

use std::path::{Path, PathBuf};
use std::sync::Arc;

use sqlx::{SqliteConnection, SqlitePool};
use tokio::sync::{Mutex, Notify};

use super::database::sqlite::Opened;
use super::objects::{off_thread, to_the_end};
use super::{Digest, Store, StoreError};
use entry::{Entry, Header, RowName};
use file::JournalFile;
use tables::{TABLES, Table};

pub(super) use check::{compare, is_there};
pub use recover::{Lost, Recovered, recover};

/// Journaled changes stay in the database until there are so many.
const TRIMMED_EVERY: i64 = 1000;

/// The journal of an open store.
#[derive(Debug, Clone)]
pub(super) struct Journal {
    state: Arc<Mutex<State>>,
    /// The writing connection of the database.
    writer: SqlitePool,
    readers: SqlitePool,
    /// Told when a row of the database could not be read.
    doubt: Arc<Notify>,
}

#[derive(Debug)]
struct State {
    /// `None` after a failed sync: what reached the disk is not known, so nothing more is acknowledged.
    file: Option<JournalFile>,
    path: PathBuf,
    /// Number of the last change that is in the file.
    last: i64,
    /// Number of the last change that was deleted from the database.
    trimmed: i64,
}

/// Name of the journal in a data directory.
pub(super) const FILE: &str = "rigcast.journal";

/// Where the journal of a data directory is.
pub(super) fn path_in(data_dir: &Path) -> PathBuf {
    data_dir.join(FILE)
}

impl Journal {
    /// Opens a journal that has every change of the database up to `last`, to append to it.
    pub(super) fn open(data_dir: &Path, opened: &Opened) -> Result<Self, StoreError> {
        let Opened { writer, readers, last } = opened;
        let last = *last;
        let path = path_in(data_dir);
        let file = Some(JournalFile::append_to(&path)?);
        let state = Arc::new(Mutex::new(State { file, path, last, trimmed: last }));
        Ok(Self { state, writer: writer.clone(), readers: readers.clone(), doubt: Arc::default() })
    }

    /// Whether changes can be acknowledged.
    ///
    /// # Errors
    /// [`StoreError::JournalStopped`] after a failed sync.
    pub(super) async fn check(&self) -> Result<(), StoreError> {
        let state = self.state.lock().await;
        match state.file {
            Some(_) => Ok(()),
            None => Err(StoreError::JournalStopped { path: state.path.clone() }),
        }
    }
}

impl Store {
    /// Appends all committed changes that the journal lacks, durably. Completes even if the caller goes away.
    /// Commits that wait for each other share one sync.
    ///
    /// # Errors
    /// The store's failures; the changes are then not acknowledged, and a later call appends them.
    pub(super) async fn write_journal(&self) -> Result<(), StoreError> {
        let Some(journal) = self.journal() else { return Ok(()) };
        let journal = journal.clone();
        to_the_end(async move {
            let mut state = journal.state.lock().await;
            let entries = entries_after(&mut *journal.readers.acquire().await?, state.last).await?;
            let Some(newest) = entries.last().map(|entry| entry.seq) else { return Ok(()) };
            let path = state.path.clone();
            let mut file = state.file.take().ok_or(StoreError::JournalStopped { path })?;
            let (file, written) = off_thread(move || {
                let written = file.append(&entries);
                Ok((file, written))
            })
            .await?;
            if !matches!(written, Err(file::AppendError::Unsynced(_))) {
                state.file = Some(file);
            }
            written.map_err(|error| error.on(&state.path))?;
            state.last = newest;
            if newest - state.trimmed >= TRIMMED_EVERY {
                trim(&journal.writer, newest).await?;
                state.trimmed = newest;
            }
            Ok(())
        })
        .await
    }
}

/// Deletes changes that the journal has.
async fn trim(writer: &SqlitePool, up_to: i64) -> Result<(), StoreError> {
    sqlx::query("DELETE FROM changes WHERE seq <= ?").bind(up_to).execute(writer).await?;
    Ok(())
}

/// The changes after `last`, each with its row as it is now. A row that has changed again since then has a later
/// entry with the same state.
async fn entries_after(connection: &mut SqliteConnection, last: i64) -> Result<Vec<Entry>, StoreError> {
    let changes: Vec<(i64, String, String)> =
        sqlx::query_as("SELECT seq, tbl, key FROM changes WHERE seq > ? ORDER BY seq")
            .bind(last)
            .fetch_all(&mut *connection)
            .await?;
    let mut entries = Vec::with_capacity(changes.len());
    for (seq, table, key) in changes {
        let bad = |what: &str| StoreError::Row { table: "changes", key: seq.to_string(), what: what.into() };
        let tables = Table::named(&table).ok_or_else(|| bad("no journaled table"))?;
        // Written by SQLite; our own form of the same JSON is what rows are known by.
        let key: Vec<entry::Cell> = serde_json::from_str(&key).map_err(|_| bad("no key"))?;
        let key = serde_json::to_string(&key).expect("keys are texts and integers");
        let row = tables.row(connection, &key).await?;
        entries.push(Entry { seq, name: RowName { table, key }, row });
    }
    Ok(entries)
}

/// Number of the last change of a database; 0 for one that has had none, or is from before there was a journal.
async fn last_change(connection: &mut SqliteConnection) -> Result<i64, StoreError> {
    if !has_table(connection, "changes").await? {
        return Ok(0);
    }
    let last: Option<i64> = sqlx::query_scalar("SELECT seq FROM sqlite_sequence WHERE name = 'changes'")
        .fetch_optional(connection)
        .await?;
    Ok(last.unwrap_or_default())
}

async fn has_table(connection: &mut SqliteConnection, name: &str) -> Result<bool, StoreError> {
    let found: i64 =
        sqlx::query_scalar("SELECT EXISTS (SELECT 1 FROM sqlite_master WHERE type = 'table' AND name = ?)")
            .bind(name)
            .fetch_one(connection)
            .await?;
    Ok(found != 0)
}

/// Number of the last migration of a database; 0 for an empty one.
async fn schema(connection: &mut SqliteConnection) -> Result<i64, StoreError> {
    if !has_table(connection, "_sqlx_migrations").await? {
        return Ok(0);
    }
    let version: Option<i64> =
        sqlx::query_scalar("SELECT max(version) FROM _sqlx_migrations").fetch_one(connection).await?;
    Ok(version.unwrap_or_default())
}

/// Digest of the definitions of all tables, indices and triggers. Damage in them leaves the database sound in form.
async fn layout(connection: &mut SqliteConnection) -> Result<String, StoreError> {
    let definitions: Vec<String> = sqlx::query_scalar(
        "SELECT type || ' ' || name || ' ' || coalesce(sql, '') FROM sqlite_master ORDER BY type, name",
    )
    .fetch_all(connection)
    .await?;
    Ok(Digest::of(definitions.join("\n").as_bytes()).as_str().to_owned())
}

/// Writes the journal anew from a sound database and puts it in the place of the old one, whole or not at all.
/// Returns the number of the last change in it.
pub(super) async fn rewrite(data_dir: &Path, connection: &mut SqliteConnection) -> Result<i64, StoreError> {
    let (seq, schema, layout) =
        (last_change(connection).await?, schema(connection).await?, layout(connection).await?);
    let mut entries = Vec::new();
    for table in TABLES {
        let rows = table.rows(connection).await?;
        entries.extend(rows.into_iter().map(|(name, row)| Entry { seq, name, row: Some(row) }));
    }
    let path = path_in(data_dir);
    let header = Header { journal: file::FORM, schema, layout, seq };
    off_thread(move || file::replace(&path, &header, &entries)).await?;
    Ok(seq)
}
