//! Backup and restore of a data directory, which may be in use.
//!
//! A backup is a directory of the same form: a copy of the database as of one moment, every object that
//! it refers to, verified, and a manifest. The manifest is written last, so that a backup without it is
//! incomplete. An incomplete backup or restore is gone on with by the same command.

mod copy;
mod manifest;
#[cfg(test)]
mod tests;

use std::collections::BTreeSet;
use std::path::Path;

use jiff::Timestamp;
use sqlx::sqlite::SqliteConnectOptions;
use sqlx::{Connection, SqliteConnection};

use super::bucket::{Bucket, BucketSettings};
use super::database::sqlite::{BUSY_TIMEOUT, check_integrity, check_references};
use super::files::{self, failed, sync_directory};
use super::objects::{Objects, REFERENCED, off_thread};
use super::store::DATABASE;
use super::{Digest, PostgresSettings, Store, StoreError, journal, transfer};
use copy::copy_objects;

pub use copy::Progress;
use manifest::MANIFEST;
pub use manifest::Manifest;

/// Marks a directory whose backup or restore has begun and not ended.
const UNFINISHED: &str = "unfinished";

/// How often the database is copied again because objects of the last copy were removed meanwhile.
const SNAPSHOTS: usize = 5;

/// What is backed up.
#[derive(Debug, Clone, Copy)]
pub enum Source<'a> {
    /// A data directory.
    DataDir(&'a Path),
    /// A registry on PostgreSQL, whose objects are in a bucket.
    Postgres(&'a PostgresSettings),
}

/// Backs a registry and its objects up into `target`, which is empty, missing, or an incomplete backup. Services may run
/// on it. Objects come from the data directory, or from the `bucket`. Those that `previous`, an earlier backup, has are
/// linked to it, or copied from it if its file system cannot.
///
/// # Errors
/// A missing or damaged database; a missing or damaged object, by name; a target that holds something else; a
/// `previous` that is no backup; the file system's errors.
pub async fn backup(
    source: Source<'_>,
    bucket: Option<&BucketSettings>,
    target: &Path,
    previous: Option<&Path>,
    now: Timestamp,
    progress: Progress,
) -> Result<Manifest, StoreError> {
    if let Source::DataDir(data_dir) = source
        && !Store::exists(data_dir)
    {
        let what = format!("it has no {DATABASE}; name the one that `rigcast serve` uses with --data-dir");
        return Err(something_else(data_dir, "data directory", what));
    }
    if let Some(previous) = previous {
        manifest::of(previous)?;
    }
    let bucket = match source {
        Source::DataDir(data_dir) => Bucket::of_data_dir(data_dir, bucket)?,
        Source::Postgres(database) => Some(bucket_of(database, bucket)?),
    };
    begin(target)?;
    let objects = target.join("objects");
    std::fs::create_dir_all(&objects).map_err(failed(&objects))?;
    let from = match source {
        Source::DataDir(data_dir) => data_dir.join("objects"),
        // All of them come from the bucket.
        Source::Postgres(_) => objects.clone(),
    };
    let previous = previous.map(|previous| previous.join("objects"));
    let copy = target.join(DATABASE);
    for attempt in 1.. {
        snapshot(source, &copy).await?;
        let wanted = referenced(&copy).await?;
        match copy_objects(&from, bucket.as_ref(), previous.as_deref(), &objects, &wanted, &progress).await {
            // A run or model was deleted after the copy; a new copy does not name it.
            Err(StoreError::ObjectMissing { .. }) if attempt < SNAPSHOTS => {}
            Err(error) => return Err(error),
            Ok(bytes) => {
                Objects::open(&objects, None)?.retain(&wanted)?;
                let manifest = Manifest {
                    created_at: now,
                    code_version: crate::VERSION.into(),
                    database_sha256: digest(&copy).await?,
                    objects: wanted.len() as u64,
                    bytes,
                };
                let json = serde_json::to_vec_pretty(&manifest).expect("text and numbers always serialise");
                files::write(&target.join(MANIFEST), &json)?;
                end(target)?;
                return Ok(manifest);
            }
        }
    }
    unreachable!("the last attempt answers")
}

/// Makes a data directory, which is empty, missing, or an incomplete restore, from a backup. The database comes last,
/// so that no service starts on an interrupted restore.
///
/// # Errors
/// A missing or damaged backup; a data directory that holds something else; the file system's errors.
pub async fn restore(source: &Path, data_dir: &Path, progress: Progress) -> Result<Manifest, StoreError> {
    let manifest = manifest::of(source)?;
    let database = source.join(DATABASE);
    if digest(&database).await? != manifest.database_sha256 {
        return Err(damaged(&database, "its bytes are not those that were backed up".into()));
    }
    begin(data_dir)?;
    let objects = data_dir.join("objects");
    std::fs::create_dir_all(&objects).map_err(failed(&objects))?;
    // Opening a database may write files beside it, and the backup must stay as it is.
    let copy = data_dir.join("rigcast.db.restoring");
    let bytes = std::fs::read(&database).map_err(failed(&database))?;
    files::write(&copy, &bytes)?;
    let wanted = referenced(&copy).await?;
    copy_objects(&source.join("objects"), None, None, &objects, &wanted, &progress).await?;
    Objects::open(&objects, None)?.retain(&wanted)?;
    make_data_dir(data_dir, &copy).await?;
    Ok(manifest)
}

/// Makes a data directory, which is empty, missing, or of a command that was cut short, from a registry on PostgreSQL and
/// its bucket, which stay as they are. No service may run meanwhile. Returns the number of objects.
///
/// # Errors
/// Services that run; a missing or damaged object, by name; a data directory that holds something else; the file system's,
/// the bucket's and the database's errors.
pub async fn move_back(
    database: &PostgresSettings,
    bucket: &BucketSettings,
    data_dir: &Path,
    progress: Progress,
) -> Result<u64, StoreError> {
    transfer::alone(database).await?;
    let bucket = Bucket::open(bucket)?;
    begin(data_dir)?;
    let objects = data_dir.join("objects");
    std::fs::create_dir_all(&objects).map_err(failed(&objects))?;
    let copy = data_dir.join("rigcast.db.restoring");
    snapshot(Source::Postgres(database), &copy).await?;
    let wanted = referenced(&copy).await?;
    copy_objects(&objects, Some(&bucket), None, &objects, &wanted, &progress).await?;
    Objects::open(&objects, None)?.retain(&wanted)?;
    make_data_dir(data_dir, &copy).await?;
    Ok(wanted.len() as u64)
}

/// Makes the registry of a directory that has its objects from a database in it. The database comes last, so that no
/// service starts before.
async fn make_data_dir(data_dir: &Path, database: &Path) -> Result<(), StoreError> {
    let options = SqliteConnectOptions::new().filename(database);
    let mut connection = SqliteConnection::connect_with(&options).await?;
    journal::rewrite(data_dir, &mut connection).await?;
    connection.close().await?;
    let place = data_dir.join(DATABASE);
    std::fs::rename(database, &place).map_err(failed(&place))?;
    end(data_dir)
}

/// Marks a directory as unfinished. One that holds anything must have the mark already.
fn begin(directory: &Path) -> Result<(), StoreError> {
    let mark = directory.join(UNFINISHED);
    if !mark.exists() {
        empty(directory)?;
        std::fs::create_dir_all(directory).map_err(failed(directory))?;
        std::fs::write(&mark, b"").map_err(failed(&mark))?;
    }
    sync_directory(directory)
}

/// Takes the mark away.
fn end(directory: &Path) -> Result<(), StoreError> {
    let mark = directory.join(UNFINISHED);
    files::remove(&mark)?;
    sync_directory(directory)
}

fn something_else(path: &Path, wanted: &'static str, what: String) -> StoreError {
    StoreError::SomethingElse { path: path.to_owned(), wanted, what }
}

/// The bucket of a registry on PostgreSQL, which always has one.
fn bucket_of(database: &PostgresSettings, bucket: Option<&BucketSettings>) -> Result<Bucket, StoreError> {
    match bucket {
        Some(settings) => Bucket::open(settings),
        None => {
            let what = "its objects are in a bucket: name it with --objects".into();
            Err(StoreError::Postgres { database: database.name()?, what })
        }
    }
}

/// Copies a database into an SQLite file as of one moment, even while others write to it.
async fn snapshot(source: Source<'_>, copy: &Path) -> Result<(), StoreError> {
    files::remove(copy)?;
    match source {
        Source::Postgres(database) => transfer::snapshot(database, copy).await?,
        Source::DataDir(data_dir) => {
            let database = data_dir.join(DATABASE);
            let options = SqliteConnectOptions::new().filename(database).busy_timeout(BUSY_TIMEOUT);
            let mut connection = SqliteConnection::connect_with(&options).await?;
            let into = copy.to_string_lossy();
            sqlx::query("VACUUM INTO ?").bind(into.as_ref()).execute(&mut connection).await?;
            connection.close().await?;
        }
    }
    std::fs::File::open(copy).and_then(|file| file.sync_all()).map_err(failed(copy))?;
    sync_directory(copy.parent().unwrap_or(Path::new(".")))
}

/// Names of all objects that a database refers to.
async fn referenced(database: &Path) -> Result<BTreeSet<String>, StoreError> {
    let options = SqliteConnectOptions::new().filename(database).read_only(true).immutable(true);
    let mut connection = SqliteConnection::connect_with(&options).await?;
    check_integrity(&mut connection, database).await?;
    check_references(&mut connection, database).await?;
    let names: Vec<String> = sqlx::query_scalar(REFERENCED).fetch_all(&mut connection).await?;
    connection.close().await?;
    Ok(names.into_iter().collect())
}

async fn digest(file: &Path) -> Result<String, StoreError> {
    let file = file.to_owned();
    off_thread(move || {
        let bytes = std::fs::read(&file).map_err(failed(&file))?;
        Ok(Digest::of(&bytes).as_str().to_owned())
    })
    .await
}

/// Refuses a directory that holds anything.
fn empty(directory: &Path) -> Result<(), StoreError> {
    match std::fs::read_dir(directory).map(|mut entries| entries.next().is_none()) {
        Ok(true) => Ok(()),
        Ok(false) => {
            let error = std::io::Error::from(std::io::ErrorKind::DirectoryNotEmpty);
            Err(failed(directory)(error))
        }
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => Ok(()),
        Err(error) => Err(failed(directory)(error)),
    }
}

fn damaged(path: &Path, what: String) -> StoreError {
    StoreError::Damaged { path: path.to_owned(), what }
}
