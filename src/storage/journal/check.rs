//! At a start: the database against the journal.

use std::collections::BTreeSet;
use std::path::Path;

use futures::TryStreamExt;
use sqlx::{Connection, SqliteConnection};

use super::entry::RowName;
use super::file::{self, Contents, Outline};
use super::tables::{TABLES, Table};
use super::{entries_after, last_change, layout, path_in, rewrite, schema};
use crate::storage::objects::off_thread;
use crate::storage::store::DATABASE;
use crate::storage::{StoreError, error::Acknowledged};
use crate::telemetry::names;

/// Names of changes and rows in a message.
const NAMED: usize = 10;

/// What the comparison found.
#[derive(Debug)]
pub(in crate::storage) struct Compared {
    /// Whether the journal must be written anew: it is missing, damaged or behind, or much of it is old.
    stale: bool,
    schema: i64,
    last: i64,
}

impl Compared {
    /// Brings the journal up to the database, which was migrated meanwhile. Returns the number of its last change.
    ///
    /// # Errors
    /// The store's failures.
    pub(in crate::storage) async fn bring_up(
        self,
        data_dir: &Path,
        connection: &mut SqliteConnection,
    ) -> Result<i64, StoreError> {
        if self.stale || schema(connection).await? != self.schema {
            return rewrite(data_dir, connection).await;
        }
        Ok(self.last)
    }
}

/// Refuses a database that lacks acknowledged changes, before anything is changed in it, and mends rows that are not
/// as they were written.
///
/// # Errors
/// [`StoreError::Behind`], [`StoreError::JournalMissing`], the database's and the file system's failures.
pub(in crate::storage) async fn compare(
    data_dir: &Path,
    connection: &mut SqliteConnection,
) -> Result<Compared, StoreError> {
    let path = path_in(data_dir);
    let contents = off_thread({
        let path = path.clone();
        move || file::outline(&path)
    })
    .await?;
    let (last, schema) = (last_change(connection).await?, schema(connection).await?);
    let Some(contents) = contents else {
        // A database that has not had a change is new, or from before there was a journal.
        if last > 0 {
            return Err(StoreError::JournalMissing { path });
        }
        return Ok(Compared { stale: true, schema, last });
    };
    if last < contents.last + contents.damaged_at_end {
        let changes = contents.last + contents.damaged_at_end - last;
        return Err(behind(data_dir, connection, changes).await);
    }
    let header = contents.header.as_ref().filter(|header| header.schema == schema);
    if let Some(header) = header
        && header.layout != layout(connection).await?
    {
        let what = "its definitions of tables are not those that were written".into();
        return Err(StoreError::Damaged { path: data_dir.join(DATABASE), what });
    }
    if contents.damaged > 0 {
        // A damaged line may have been the last about any row, so no row is held against an older line.
        let (lines, path) = (contents.damaged, path.display());
        tracing::warn!(lines, %path, "the journal has damaged lines; it is written anew from the database");
    } else if header.is_some() {
        mend(connection, &contents, &path).await?;
    }
    let stale = last > contents.last || contents.damaged > 0 || contents.mostly_old();
    Ok(Compared { stale, schema, last })
}

/// Whether a data directory has a journal.
pub(in crate::storage) fn is_there(data_dir: &Path) -> bool {
    path_in(data_dir).exists()
}

async fn behind(data_dir: &Path, connection: &mut SqliteConnection, changes: i64) -> StoreError {
    let mut lacking = BTreeSet::new();
    let path = path_in(data_dir);
    let contents = match off_thread(move || file::read(&path)).await {
        Ok(contents) => contents.unwrap_or_default(),
        Err(error) => return error,
    };
    for (name, line) in &contents.rows {
        let Some(table) = Table::named(&name.table) else { continue };
        // An empty database has no tables.
        let found = table.row(connection, &name.key).await.unwrap_or_default();
        if found != line.row {
            lacking.insert(name.to_string());
        }
    }
    let mut named: Vec<String> = lacking.iter().take(NAMED).cloned().collect();
    if lacking.len() > NAMED {
        named.push(format!("and {} more", lacking.len() - NAMED));
    }
    StoreError::Behind(Box::new(Acknowledged {
        path: data_dir.join(DATABASE),
        data_dir: data_dir.to_owned(),
        changes,
        rows: named.join(", "),
    }))
}

/// Writes rows again that differ from their last line in the journal. Rows that have changed since that line was
/// written are passed over. Returns the number of mended rows. It takes some hundred bytes a row, whatever the rows hold.
pub(super) async fn mend(
    connection: &mut SqliteConnection,
    contents: &Contents<Outline>,
    path: &Path,
) -> Result<usize, StoreError> {
    let newer = entries_after(connection, contents.last).await?;
    let newer: BTreeSet<RowName> = newer.into_iter().map(|entry| entry.name).collect();
    let mut found = BTreeSet::new();
    let mut differing: Vec<(Table, &RowName, Outline)> = Vec::new();
    for table in TABLES {
        let mut rows = table.stream(&mut *connection);
        while let Some((name, image)) = rows.try_next().await? {
            let Some((name, line)) = contents.rows.get_key_value(&name) else { continue };
            found.insert(name);
            if let Some(kept) = line.row
                && kept.digest != Outline::digest_of(&image)
            {
                differing.push((table, name, kept));
            }
        }
    }
    for (name, line) in &contents.rows {
        if let (Some(kept), Some(table)) = (line.row, Table::named(&name.table))
            && !found.contains(name)
        {
            differing.push((table, name, kept));
        }
    }
    differing.retain(|(_, name, _)| !newer.contains(name));
    if differing.is_empty() {
        return Ok(0);
    }
    let mut tx = connection.begin().await?;
    let triggers = without_triggers(&mut tx).await?;
    for (table, name, kept) in &differing {
        tracing::warn!(row = %name, "a row was not as it was written; it was mended from the journal");
        metrics::counter!(names::ROWS_MENDED).increment(1);
        table.put(&mut tx, &kept.read(path)?).await?;
    }
    with_triggers(&mut tx, triggers).await?;
    tx.commit().await?;
    Ok(differing.len())
}

/// Drops all triggers and returns their definitions.
pub(super) async fn without_triggers(connection: &mut SqliteConnection) -> Result<Vec<String>, StoreError> {
    let triggers: Vec<(String, String)> =
        sqlx::query_as("SELECT name, sql FROM sqlite_master WHERE type = 'trigger'")
            .fetch_all(&mut *connection)
            .await?;
    let mut definitions = Vec::with_capacity(triggers.len());
    for (name, definition) in triggers {
        let drop = sqlx::AssertSqlSafe(format!("DROP TRIGGER {name}"));
        sqlx::query(drop).execute(&mut *connection).await?;
        definitions.push(definition);
    }
    Ok(definitions)
}

/// Makes the triggers again.
pub(super) async fn with_triggers(
    connection: &mut SqliteConnection,
    definitions: Vec<String>,
) -> Result<(), StoreError> {
    for definition in definitions {
        sqlx::query(sqlx::AssertSqlSafe(definition)).execute(&mut *connection).await?;
    }
    Ok(())
}
