//! `rigcast recover`: a database made anew from the journal and from the readable part of the old database.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use jiff::Timestamp;
use sqlx::sqlite::SqliteConnectOptions;
use sqlx::{ConnectOptions, Connection, SqliteConnection};

use super::check::{with_triggers, without_triggers};
use super::entry::{Cell, Image, RowName};
use super::file::{self, Contents};
use super::tables::{TABLES, Table};
use super::{FILE, entries_after, last_change, path_in, rewrite, schema};
use crate::storage::bucket::{Bucket, BucketSettings};
use crate::storage::database::sqlite::check_integrity;
use crate::storage::files::{self, failed, sync_directory};
use crate::storage::objects::{Objects, REFERENCED, all_below, off_thread};
use crate::storage::store::{DATABASE, DATABASE_FILES, lock};
use crate::storage::{StoreError, migrations, quarantine};

/// What a recovery did.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Recovered {
    /// Rows of each kind in the new database.
    pub rows: Vec<(&'static str, usize)>,
    /// Rows that came from the journal because the database had lost them or had them otherwise.
    pub restored: Vec<String>,
    /// What the new database names but nothing has, and what is kept but no row names.
    pub lost: Vec<Lost>,
    /// Sources that were missing or damaged, in words.
    pub sources: Vec<String>,
    /// The old files.
    pub kept_in: PathBuf,
}

/// Data that could not be brought back whole.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
pub enum Lost {
    /// A row whose samples, weights or findings are missing or damaged.
    Object {
        /// The row.
        row: String,
        /// The reason.
        reason: String,
    },
    /// A row that belongs to a rig or run that is gone.
    Orphan(String),
    /// An object that no row names; it is kept.
    Unknown(String),
}

impl std::fmt::Display for Lost {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Object { row, reason } => write!(f, "{row}: {reason}"),
            Self::Orphan(row) => write!(f, "{row}: what it belongs to is gone"),
            Self::Unknown(digest) => f.write_str(digest),
        }
    }
}

/// Rows by name.
type Rows = BTreeMap<RowName, Image>;

/// What could be read of the old database.
#[derive(Debug, Default)]
struct Old {
    rows: Rows,
    /// Rows that have changed since the journal's last line.
    newer: BTreeSet<RowName>,
    last: i64,
    schema: i64,
    damage: Option<String>,
}

/// Makes the database of a data directory anew, whose objects may be in a bucket. The service must be stopped. The old
/// files are kept beside it, and no object is removed.
///
/// # Errors
/// [`StoreError::Locked`]; [`StoreError::NothingToRecover`] when neither the journal nor the database can be read; a
/// journal of a newer program; the file system's errors.
pub async fn recover(
    data_dir: &Path,
    bucket: Option<&BucketSettings>,
    now: Timestamp,
) -> Result<Recovered, StoreError> {
    let _lock = lock(data_dir)?;
    let bucket = Bucket::of_data_dir(data_dir, bucket)?;
    let journal = off_thread({
        let path = path_in(data_dir);
        move || file::read(&path)
    })
    .await?;
    let kept_in = set_aside(data_dir, now)?;
    let contents = journal.unwrap_or_default();
    let old = read_old(data_dir, contents.last).await;
    let mut sources = Vec::new();
    match (&contents.header, contents.damaged) {
        (Some(_), 0) => {}
        (Some(_), lines) => sources.push(format!("the journal has {lines} damaged lines")),
        (None, 0) => sources.push("there is no journal".into()),
        (None, lines) => sources.push(format!("the journal has {lines} damaged lines, its first among them")),
    }
    sources.extend(old.damage.clone());
    let schema = match contents.header.as_ref().map_or(0, |header| header.schema).max(old.schema) {
        // Neither says; the rows are most likely of this program.
        0 => migrations::latest(),
        schema => schema,
    };
    if old.rows.is_empty() && contents.rows.is_empty() {
        return Err(StoreError::NothingToRecover { path: data_dir.to_owned(), why: sources.join("; ") });
    }
    if schema > migrations::latest() {
        let (path, known) = (data_dir.join(DATABASE), migrations::latest());
        return Err(StoreError::Newer { path, found: schema, known });
    }
    let (rows, restored) = merge(&contents, &old);
    let new = data_dir.join("rigcast.db.recovering");
    let mut lost = build(&new, schema, &rows, contents.last.max(old.last) + 1).await?;
    put_in_place(data_dir, &new).await?;
    lost.extend(check_objects(data_dir, bucket.as_ref()).await?);
    lost.sort();
    let count = |table: Table| rows.keys().filter(|name| name.table == table.name).count();
    let rows = TABLES.map(|table| (table.name, count(table))).to_vec();
    Ok(Recovered { rows, restored, lost, sources, kept_in })
}

/// Copies the old files to where they are kept. Opening a database changes it, so the copies are made first.
fn set_aside(data_dir: &Path, now: Timestamp) -> Result<PathBuf, StoreError> {
    let kept_in = data_dir.join(format!("before-recover-{}", now.as_millisecond()));
    std::fs::create_dir(&kept_in).map_err(failed(&kept_in))?;
    for name in DATABASE_FILES.into_iter().chain([FILE]) {
        let from = data_dir.join(name);
        match std::fs::copy(&from, kept_in.join(name)) {
            Err(error) if error.kind() != std::io::ErrorKind::NotFound => return Err(failed(&from)(error)),
            _ => {}
        }
    }
    Ok(kept_in)
}

/// Reads the old database, or as much of it as can be read.
async fn read_old(data_dir: &Path, journaled: i64) -> Old {
    let path = data_dir.join(DATABASE);
    if std::fs::metadata(&path).map_or(0, |file| file.len()) == 0 {
        return Old { damage: Some("the database is missing or empty".into()), ..Old::default() };
    }
    let mut old = Old::default();
    if let Err(error) = read_rows(&path, journaled, &mut old).await {
        old.damage = Some(format!("the database is damaged: {error}"));
        // Its numbers may be as wrong as its rows.
        (old.newer, old.last) = (BTreeSet::new(), 0);
    }
    old
}

async fn read_rows(path: &Path, journaled: i64, old: &mut Old) -> Result<(), StoreError> {
    let options = SqliteConnectOptions::new().filename(path).disable_statement_logging();
    let mut connection = SqliteConnection::connect_with(&options).await?;
    let sound = check_integrity(&mut connection, path).await;
    old.schema = schema(&mut connection).await?;
    let mut first_failure = sound.err();
    for table in TABLES {
        match table.rows(&mut connection).await {
            Ok(rows) => old.rows.extend(rows),
            Err(error) => first_failure = first_failure.or(Some(error)),
        }
    }
    if let Some(error) = first_failure {
        return Err(error);
    }
    old.last = last_change(&mut connection).await?;
    if old.last > 0 {
        let newer = entries_after(&mut connection, journaled).await?;
        old.newer = newer.into_iter().map(|entry| entry.name).collect();
    }
    connection.close().await?;
    Ok(())
}

/// The rows of the journal, or of the database where that is newer or the journal has none. Also returns the names of
/// those that the database did not have so.
fn merge(contents: &Contents, old: &Old) -> (Rows, Vec<String>) {
    let whole = contents.header.is_some() && contents.damaged == 0;
    let sound = old.damage.is_none();
    let mut rows = Rows::new();
    for (name, image) in &old.rows {
        let newer = match contents.rows.get(name) {
            // Of a damaged database only what the journal has lost is taken.
            None => sound || !whole,
            // A line of the journal that was damaged may have been about this row.
            Some(line) => sound && !whole && line.seq <= old.last,
        };
        if newer || old.newer.contains(name) {
            rows.insert(name.clone(), image.clone());
        }
    }
    let mut restored = Vec::new();
    for (name, line) in &contents.rows {
        let Some(image) = &line.row else { continue };
        let gone_since = sound && !whole && line.seq <= old.last;
        if rows.contains_key(name) || old.newer.contains(name) || gone_since {
            continue;
        }
        if old.rows.get(name) != Some(image) {
            restored.push(name.to_string());
        }
        rows.insert(name.clone(), image.clone());
    }
    (rows, restored)
}

/// Makes a database of these rows. Returns the rows that belong to nothing any more, which it does not have.
async fn build(path: &Path, schema: i64, rows: &Rows, next: i64) -> Result<Vec<Lost>, StoreError> {
    files::remove(path)?;
    let options = SqliteConnectOptions::new().filename(path).create_if_missing(true).foreign_keys(false);
    let mut connection = SqliteConnection::connect_with(&options).await?;
    migrations::up_to(schema).run(&mut connection).await?;
    let mut tx = connection.begin().await?;
    let triggers = without_triggers(&mut tx).await?;
    for table in TABLES {
        for (name, image) in rows.iter().filter(|(name, _)| name.table == table.name) {
            table.put(&mut tx, &startable(name, image)).await?;
        }
    }
    let mut lost = Vec::new();
    loop {
        let orphans: Vec<(String, i64, String, i64)> =
            sqlx::query_as("PRAGMA foreign_key_check").fetch_all(&mut *tx).await?;
        if orphans.is_empty() {
            break;
        }
        for (table, rowid, ..) in orphans {
            lost.extend(drop_orphan(&mut tx, &table, rowid).await?);
        }
    }
    with_triggers(&mut tx, triggers).await?;
    if super::has_table(&mut tx, "changes").await? {
        sqlx::query("DELETE FROM sqlite_sequence WHERE name = 'changes'").execute(&mut *tx).await?;
        sqlx::query("INSERT INTO sqlite_sequence (name, seq) VALUES ('changes', ?)")
            .bind(next)
            .execute(&mut *tx)
            .await?;
    }
    tx.commit().await?;
    connection.close().await?;
    Ok(lost)
}

/// A row as it is inserted: a job that ran is one whose lease has ended, so that the next start queues it again.
fn startable(name: &RowName, image: &Image) -> Image {
    let mut image = image.clone();
    if name.table == "jobs" && image.get("state") == Some(&Cell::Text("running".into())) {
        image.insert("lease_until_us".into(), Cell::Int(0));
        image.insert("started_us".into(), image.get("created_us").cloned().unwrap_or(Cell::Int(0)));
    }
    image
}

/// Deletes a row that refers to one that is gone. A rig only forgets its active model.
async fn drop_orphan(
    connection: &mut SqliteConnection,
    table: &str,
    rowid: i64,
) -> Result<Option<Lost>, StoreError> {
    let statement = match table {
        "rigs" => "UPDATE rigs SET active_version = NULL WHERE rowid = ?".to_owned(),
        _ => format!("DELETE FROM {table} WHERE rowid = ?"),
    };
    let done = sqlx::query(sqlx::AssertSqlSafe(statement)).bind(rowid).execute(connection).await?;
    Ok((done.rows_affected() > 0).then(|| Lost::Orphan(format!("{table}, row {rowid}"))))
}

/// Replaces the old database with the new one, and the journal with one of the new database.
async fn put_in_place(data_dir: &Path, new: &Path) -> Result<(), StoreError> {
    let options = SqliteConnectOptions::new().filename(new);
    let mut connection = SqliteConnection::connect_with(&options).await?;
    // The database goes first: if this is cut short, a journal without a database is what `recover` starts from.
    for name in DATABASE_FILES {
        files::remove(&data_dir.join(name))?;
    }
    rewrite(data_dir, &mut connection).await?;
    connection.close().await?;
    let place = data_dir.join(DATABASE);
    std::fs::rename(new, &place).map_err(failed(&place))?;
    sync_directory(data_dir)
}

/// Looks for every object that the new database names, in the quarantine too.
async fn check_objects(data_dir: &Path, bucket: Option<&Bucket>) -> Result<Vec<Lost>, StoreError> {
    let options = SqliteConnectOptions::new().filename(data_dir.join(DATABASE));
    let mut connection = SqliteConnection::connect_with(&options).await?;
    let wanted: Vec<String> = sqlx::query_scalar(REFERENCED).fetch_all(&mut connection).await?;
    let wanted: BTreeSet<String> = wanted.into_iter().collect();
    let objects = Objects::open(&data_dir.join("objects"), None)?;
    quarantine::bring_back(data_dir, &wanted)?;
    // The bucket has checked them as they came.
    let in_bucket: BTreeSet<String> = match bucket {
        None => BTreeSet::new(),
        Some(bucket) => bucket.list().await?.into_keys().collect(),
    };
    let mut lost = Vec::new();
    for digest in wanted.difference(&in_bucket) {
        if let Err(error) = objects.get(digest).await {
            let rows: Vec<String> = sqlx::query_scalar(
                "SELECT 'runs ' || rig || '/' || id FROM runs WHERE object = ?1
                 UNION ALL SELECT 'models ' || rig || '/' || version FROM models WHERE sha256 = ?1
                 UNION ALL SELECT 'diagnoses ' || rig || '/' || id FROM diagnoses WHERE findings = ?1
                 UNION ALL SELECT 'evaluations ' || rig || '/' || id FROM evaluations WHERE report = ?1",
            )
            .bind(digest)
            .fetch_all(&mut connection)
            .await?;
            let reason = error.to_string();
            lost.extend(rows.into_iter().map(|row| Lost::Object { row, reason: reason.clone() }));
        }
    }
    connection.close().await?;
    let there = all_below(&data_dir.join("objects"))?;
    let names = there.iter().filter_map(|file| Some(file.file_name()?.to_str()?.to_owned()));
    let there: BTreeSet<String> = names.chain(in_bucket).collect();
    lost.extend(there.difference(&wanted).cloned().map(Lost::Unknown));
    Ok(lost)
}
