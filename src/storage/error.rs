//! Errors of the store. A missing row is no error.

use sqlx::error::DatabaseError as _;
use sqlx::postgres::PgDatabaseError;
use sqlx::sqlite::SqliteError;

use crate::telemetry::names;

/// Acknowledged changes that a database lacks.
#[derive(Debug)]
pub struct Acknowledged {
    /// The database.
    pub path: std::path::PathBuf,
    /// Its data directory.
    pub data_dir: std::path::PathBuf,
    /// How many changes it lacks.
    pub changes: i64,
    /// Rows that it does not have as they were acknowledged.
    pub rows: String,
}

/// A failure of the store; never the client's fault.
#[derive(Debug, thiserror::Error)]
pub enum StoreError {
    /// The database.
    #[error("database: {0}")]
    Database(#[from] sqlx::Error),
    /// Migrations do not fit the database.
    #[error("database schema: {0}")]
    Migrate(#[from] sqlx::migrate::MigrateError),
    /// A newer program made the database.
    #[error(
        "the database {path} was made by a newer Rigcast: it has schema {found}, and this program ({}) knows those up \
         to {known}. Start the newer program, or restore a backup of before into another directory",
        crate::VERSION
    )]
    Newer {
        /// The database.
        path: std::path::PathBuf,
        /// Its schema.
        found: i64,
        /// The latest that this program knows.
        known: i64,
    },
    /// The directory to restore or back up is something else.
    #[error("{path} is no {wanted}: {what}")]
    SomethingElse {
        /// The directory.
        path: std::path::PathBuf,
        /// `backup` or `data directory`.
        wanted: &'static str,
        /// What the directory lacks, or what it is.
        what: String,
    },
    /// The object files.
    #[error("object files: {0}")]
    Objects(#[from] object_store::Error),
    /// The bucket of the objects.
    #[error("the bucket {bucket} cannot be used: {what}")]
    Bucket {
        /// Its URL.
        bucket: String,
        /// What is wrong with it.
        what: String,
    },
    /// The PostgreSQL of the registry.
    #[error("the database {database} cannot be used: {what}")]
    Postgres {
        /// Its host and name.
        database: String,
        /// What is wrong with it.
        what: String,
    },
    /// Nothing has come back from the database for too long.
    #[error("the database does not answer")]
    Silent,
    /// The data directory, a backup, or a file in one.
    #[error("cannot use {path}: {}", in_words(.source))]
    DataDir {
        /// Its path.
        path: std::path::PathBuf,
        /// The system's error.
        source: std::io::Error,
    },
    /// Another process has the data directory.
    #[error(
        "the data directory {path} is in use by another rigcast: stop that one, or choose another directory with \
         --data-dir"
    )]
    Locked {
        /// Its path.
        path: std::path::PathBuf,
    },
    /// An object that a row names is missing.
    #[error("object {digest} is missing")]
    ObjectMissing {
        /// Its name.
        digest: String,
    },
    /// An object whose bytes have changed.
    #[error("object {digest} is damaged: its bytes have the digest {found}")]
    ObjectDamaged {
        /// Its name: the digest of its original bytes.
        digest: String,
        /// The digest of its present bytes.
        found: String,
    },
    /// Another request with the same idempotency key was done first.
    #[error("the request was done before under its idempotency key")]
    Repeated,
    /// The database lacks changes that clients were told are stored.
    #[error(
        "{path} lacks the last {changes} changes that were acknowledged ({rows}): its write-ahead log was lost or damaged. \
         Nothing was removed. `rigcast recover --data-dir {data_dir}` puts them back",
        path = .0.path.display(), changes = .0.changes, rows = .0.rows, data_dir = .0.data_dir.display()
    )]
    Behind(Box<Acknowledged>),
    /// The journal is gone, though the database has had one.
    #[error(
        "{path} is missing, so nobody can tell whether the database has all that was acknowledged. Put the file back, or \
         go on with the database as it is by `rigcast recover`"
    )]
    JournalMissing {
        /// The journal.
        path: std::path::PathBuf,
    },
    /// The journal could not be synced to the disk.
    #[error("{path} could not be synced to the disk, so nothing more is accepted; start the service again")]
    JournalStopped {
        /// The journal.
        path: std::path::PathBuf,
    },
    /// There is nothing that a database could be made of.
    #[error(
        "nothing in {path} says what was stored: {why}. Restore a backup into another directory with `rigcast restore`"
    )]
    NothingToRecover {
        /// The data directory.
        path: std::path::PathBuf,
        /// What was found.
        why: String,
    },
    /// A damaged file.
    #[error(
        "{path} is damaged: {what}; nothing was changed. Keep the directory as it is; `rigcast recover` makes the \
         database anew from its journal, and `rigcast restore` makes another directory from a backup"
    )]
    Damaged {
        /// The file.
        path: std::path::PathBuf,
        /// The damage.
        what: String,
    },
    /// The disk has no room but the reserve for writes that make room.
    #[error("the disk is full")]
    Full,
    /// The service stops, and the work was given up.
    #[error("the service stops")]
    Stopped,
    /// A row that this program cannot have written.
    #[error("{table} row {key}: {what}")]
    Row {
        /// Table.
        table: &'static str,
        /// Key of the row.
        key: String,
        /// The mismatch.
        what: String,
    },
}

impl StoreError {
    /// Whether the disk is full.
    pub fn is_disk_full(&self) -> bool {
        /// `SQLITE_FULL`, and `SQLITE_IOERR_SHMSIZE`: no room for the index of the write-ahead log.
        const FULL: [u32; 2] = [13, 4874];
        /// `disk_full` of PostgreSQL.
        const DISK_FULL: &str = "53100";
        match self {
            Self::Full => true,
            Self::Database(error) => {
                sqlite_code(error).is_some_and(|code| FULL.contains(&code))
                    || postgres_code(error).is_some_and(|code| code == DISK_FULL)
            }
            Self::DataDir { source, .. } => is_storage_full(source),
            Self::Objects(error) => {
                let mut cause: Option<&(dyn std::error::Error + 'static)> = Some(error);
                while let Some(found) = cause {
                    if found.downcast_ref::<std::io::Error>().is_some_and(is_storage_full) {
                        return true;
                    }
                    cause = found.source();
                }
                false
            }
            _ => false,
        }
    }
}

impl StoreError {
    /// A failure that sound tables and rows cannot have, as damage of the database; others stay as they are.
    pub(super) fn into_damage(self, database: &std::path::Path) -> Self {
        let damage = match &self {
            Self::Database(_) => !self.is_unavailable() && !self.is_disk_full(),
            Self::Row { .. } | Self::Migrate(_) => true,
            _ => false,
        };
        if !damage {
            return self;
        }
        Self::Damaged { path: database.to_owned(), what: self.to_string() }
    }

    /// Kind of the failure, as a metric's label.
    pub fn kind(&self) -> &'static str {
        match self {
            error if error.is_disk_full() => "full",
            Self::ObjectMissing { .. } | Self::ObjectDamaged { .. } | Self::Damaged { .. } => "damaged",
            error if error.is_damaged_row() => "damaged",
            error if error.is_unavailable() => "unavailable",
            _ => "defect",
        }
    }

    /// Counts the failure in the metrics.
    pub fn count(&self) {
        if !matches!(self, Self::Repeated | Self::Stopped) {
            metrics::counter!(names::STORE_ERRORS, "kind" => self.kind()).increment(1);
        }
    }

    /// Whether a row holds what was never written.
    pub fn is_damaged_row(&self) -> bool {
        use sqlx::Error::{ColumnDecode, Decode};
        matches!(self, Self::Row { .. } | Self::Database(ColumnDecode { .. } | Decode(_)))
    }

    /// Whether the store is out of reach for a while, through no fault of the request: locks, failing
    /// reads and writes, no connection.
    pub fn is_unavailable(&self) -> bool {
        /// `SQLITE_BUSY`, `SQLITE_LOCKED`, `SQLITE_READONLY`, `SQLITE_IOERR` and `SQLITE_CANTOPEN`, in
        /// any extended code.
        const UNAVAILABLE: [u32; 5] = [5, 6, 8, 10, 14];
        /// Of PostgreSQL: connections, conflicts of transactions, resources, a lock that was not to be had in time, a
        /// server that stops or stands by, a transaction in which nothing came for too long, failing reads and writes.
        const AWAY: [&str; 9] = ["08", "40", "53", "55P03", "57", "25006", "25P03", "58", "XX"];
        match self {
            Self::Database(
                sqlx::Error::PoolTimedOut
                | sqlx::Error::PoolClosed
                | sqlx::Error::Io(_)
                | sqlx::Error::Tls(_)
                // A proxy before a database that starts takes the connection and ends it in the middle of a message.
                | sqlx::Error::Protocol(_),
            ) => true,
            Self::Database(error) => {
                sqlite_code(error).is_some_and(|c| UNAVAILABLE.contains(&(c & 0xff)))
                    || postgres_code(error).is_some_and(|code| AWAY.iter().any(|away| code.starts_with(away)))
            }
            Self::Objects(_)
            | Self::Bucket { .. }
            | Self::Postgres { .. }
            | Self::Silent
            | Self::DataDir { .. }
            | Self::JournalStopped { .. }
            | Self::Stopped => true,
            _ => false,
        }
    }
}

/// SQLite's extended result code.
pub(super) fn sqlite_code(error: &sqlx::Error) -> Option<u32> {
    error.as_database_error()?.try_downcast_ref::<SqliteError>()?.code()?.parse().ok()
}

/// PostgreSQL's `SQLSTATE`.
fn postgres_code(error: &sqlx::Error) -> Option<&str> {
    Some(error.as_database_error()?.try_downcast_ref::<PgDatabaseError>()?.code())
}

/// The system's error, with advice.
fn in_words(source: &std::io::Error) -> String {
    use std::io::ErrorKind::{
        AlreadyExists, DirectoryNotEmpty, NotADirectory, NotFound, PermissionDenied, ReadOnlyFilesystem,
    };
    match source.kind() {
        AlreadyExists => "there is a file of that name; a directory is needed".into(),
        NotADirectory => "a part of this path is a file, not a directory".into(),
        NotFound => "it does not exist".into(),
        PermissionDenied => "the user that rigcast runs as may not read or write it".into(),
        ReadOnlyFilesystem => "its file system is read-only".into(),
        DirectoryNotEmpty => "it is not empty; name a directory that is empty or does not exist".into(),
        _ if is_storage_full(source) => "the disk is full".into(),
        _ => source.to_string(),
    }
}

fn is_storage_full(error: &std::io::Error) -> bool {
    matches!(error.kind(), std::io::ErrorKind::StorageFull | std::io::ErrorKind::QuotaExceeded)
}
