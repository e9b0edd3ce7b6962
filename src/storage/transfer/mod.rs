//! A registry from a data directory to PostgreSQL and a bucket, and back.
//!
//! Objects go first and rows last, all of them in one transaction, so that a transfer that is cut short has no effect
//! but the objects that are there already. Rows are compared before the transaction ends, objects as they are read.

mod rows;
#[cfg(test)]
mod tests;

use std::path::Path;

use sqlx::sqlite::{SqliteConnectOptions, SqlitePoolOptions};

use super::backup::Progress;
use super::bucket::{self, Bucket, BucketSettings};
use super::database::{Pool, PostgresSettings, Session, postgres};
use super::{Store, StoreError, StoreSettings, migrations};
use rows::Transfer;

/// What a transfer has brought over.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Moved {
    /// Objects, those that were there already included.
    pub objects: u64,
}

/// Copies a data directory, whose service is stopped, into an empty PostgreSQL and a bucket. Afterwards it can no longer
/// be started without them. The same command goes on where it was cut short.
///
/// # Errors
/// A directory that is in use, damaged, or moved already to another place; a database that has another registry; a damaged
/// or missing object, by name; the file system's, the bucket's and the database's errors.
pub async fn move_into(
    data_dir: &Path,
    bucket: &BucketSettings,
    database: &PostgresSettings,
    progress: Progress,
) -> Result<Moved, StoreError> {
    let opened = Bucket::open(bucket)?;
    move_into_opened(data_dir, bucket, opened, database, progress).await
}

async fn move_into_opened(
    data_dir: &Path,
    settings: &BucketSettings,
    bucket: Bucket,
    database: &PostgresSettings,
    progress: Progress,
) -> Result<Moved, StoreError> {
    if !Store::exists(data_dir) {
        return Err(StoreError::SomethingElse {
            path: data_dir.to_owned(),
            wanted: "data directory",
            what: "it has no registry; name the one that `rigcast serve` uses with --data-dir".into(),
        });
    }
    let before = bucket::service_of(data_dir)?;
    let own = before.is_some().then(|| (settings.clone(), bucket.clone()));
    let (own_settings, own_bucket) = own.unzip();
    let own_settings = StoreSettings { bucket: own_settings, database: None };
    let store = Store::open_in(data_dir, own_bucket, own_settings).await?;
    let target = database.open().await?;
    // Objects that are in a bucket already stay with the mark that they have.
    let service = before.unwrap_or(target.service);
    bucket.mark(service).await?;
    let objects = store.store_all_in(&bucket, &progress).await?;
    let mut from = store.snapshot().await?;
    let writers = Pool::Postgres(target.writers);
    let mut to = writers.write().await?;
    let mut transfer = Transfer { from: &mut from, to: &mut to };
    if rows::is_empty(transfer.to).await? {
        postgres::set_service(transfer.to, service).await?;
        transfer.copy().await?;
    }
    if let Some(table) = transfer.difference().await? {
        let what = format!("it has another registry: its {table} are not those of {}", data_dir.display());
        return Err(StoreError::Postgres { database: database.name()?, what });
    }
    to.commit().await?;
    bucket.belong(data_dir, service, Some(database.name()?)).await?;
    drop(from);
    store.close().await;
    writers.close().await;
    Ok(Moved { objects })
}

/// Fills a new SQLite file from a PostgreSQL, as of one moment.
///
/// # Errors
/// The file system's and the database's errors.
pub(super) async fn snapshot(database: &PostgresSettings, file: &Path) -> Result<(), StoreError> {
    let source = Pool::Postgres(database.open_to_read()?);
    let mut from = source.snapshot().await?;
    let options = SqliteConnectOptions::new().filename(file).create_if_missing(true).foreign_keys(true);
    let made = SqlitePoolOptions::new().max_connections(1).connect_with(options).await?;
    migrations::up_to(migrations::latest()).run(&made).await?;
    let mut to = Session::Sqlite(made.begin().await?);
    let mut transfer = Transfer { from: &mut from, to: &mut to };
    transfer.copy().await?;
    if let Some(table) = transfer.difference().await? {
        let what = format!("the copy of its {table} differs");
        return Err(StoreError::Damaged { path: file.to_owned(), what });
    }
    to.commit().await?;
    drop(from);
    made.close().await;
    source.close().await;
    Ok(())
}

/// Refuses a PostgreSQL that other processes use: what they change meanwhile would be left behind.
///
/// # Errors
/// [`StoreError::Postgres`].
pub(super) async fn alone(database: &PostgresSettings) -> Result<(), StoreError> {
    let opened = database.open().await?;
    let others = postgres::others(&opened.readers).await?;
    opened.readers.close().await;
    if others == 0 {
        return Ok(());
    }
    let what = format!("{others} connections of running services are open: stop them first");
    Err(StoreError::Postgres { database: database.name()?, what })
}
