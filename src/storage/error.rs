//! Why the store failed, as opposed to what it did not find.

use crate::telemetry::names;

/// A failure of the store; never the client's fault.
#[derive(Debug, thiserror::Error)]
pub enum StoreError {
    /// The database.
    #[error("database: {0}")]
    Database(#[from] sqlx::Error),
    /// Migrations do not fit the database (a newer program made it, or it is damaged).
    #[error("database schema: {0}")]
    Migrate(#[from] sqlx::migrate::MigrateError),
    /// The object files.
    #[error("object files: {0}")]
    Objects(#[from] object_store::Error),
    /// The data directory.
    #[error("data directory {path}: {source}")]
    DataDir {
        /// Its path.
        path: std::path::PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// Another process has the data directory.
    #[error("data directory {path} is in use by another process")]
    Locked {
        /// Its path.
        path: std::path::PathBuf,
    },
    /// An object that a row names is not there.
    #[error("object {digest} is missing")]
    ObjectMissing {
        /// Its name.
        digest: String,
    },
    /// An object whose bytes are not those that were stored.
    #[error("object {digest} is damaged: its bytes have the digest {found}")]
    ObjectDamaged {
        /// Its name: the digest that its bytes had.
        digest: String,
        /// The digest that they have.
        found: String,
    },
    /// Another request with the same idempotency key was done first.
    #[error("the request was done before under its idempotency key")]
    Repeated,
    /// A file that is not as it was written.
    #[error(
        "{path} is damaged: {what}; nothing was changed. Keep the directory as it is and restore a backup \
         into another one with `rigcast restore`"
    )]
    Damaged {
        /// The file.
        path: std::path::PathBuf,
        /// What is wrong with it.
        what: String,
    },
    /// The service stops: work was given up before it was done.
    #[error("the service stops")]
    Stopped,
    /// A row that this program did not write so.
    #[error("{table} row {key}: {what}")]
    Row {
        /// Table.
        table: &'static str,
        /// Key of the row.
        key: String,
        /// What does not fit.
        what: String,
    },
}

impl StoreError {
    /// Whether the disk is full.
    pub fn is_disk_full(&self) -> bool {
        /// `SQLITE_FULL`, and `SQLITE_IOERR_SHMSIZE`: no room for the index of the write-ahead log.
        const FULL: [u32; 2] = [13, 4874];
        match self {
            Self::Database(error) => sqlite_code(error).is_some_and(|code| FULL.contains(&code)),
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
    /// What kind of failure it is, as a metric's label.
    pub fn kind(&self) -> &'static str {
        match self {
            error if error.is_disk_full() => "full",
            Self::ObjectMissing { .. }
            | Self::ObjectDamaged { .. }
            | Self::Damaged { .. }
            | Self::Row { .. } => "damaged",
            error if error.is_unavailable() => "unavailable",
            _ => "defect",
        }
    }

    /// Tells the metrics.
    pub fn count(&self) {
        if !matches!(self, Self::Repeated | Self::Stopped) {
            metrics::counter!(names::STORE_ERRORS, "kind" => self.kind()).increment(1);
        }
    }

    /// Whether the store is out of reach for a while, by no fault of a request: locks, reads and writes
    /// that fail, no connection.
    pub fn is_unavailable(&self) -> bool {
        /// `SQLITE_BUSY`, `SQLITE_LOCKED`, `SQLITE_READONLY`, `SQLITE_IOERR` and `SQLITE_CANTOPEN`,
        /// whatever more an extended code says.
        const UNAVAILABLE: [u32; 5] = [5, 6, 8, 10, 14];
        match self {
            Self::Database(sqlx::Error::PoolTimedOut | sqlx::Error::PoolClosed | sqlx::Error::Io(_)) => true,
            Self::Database(error) => sqlite_code(error).is_some_and(|c| UNAVAILABLE.contains(&(c & 0xff))),
            Self::Objects(_) | Self::DataDir { .. } | Self::Stopped => true,
            _ => false,
        }
    }
}

/// SQLite's extended result code.
pub(super) fn sqlite_code(error: &sqlx::Error) -> Option<u32> {
    error.as_database_error()?.code()?.parse().ok()
}

fn is_storage_full(error: &std::io::Error) -> bool {
    matches!(error.kind(), std::io::ErrorKind::StorageFull | std::io::ErrorKind::QuotaExceeded)
}
