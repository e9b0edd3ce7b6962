//! Opening a data directory, and the two ways to the database: one writer, several readers.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use sqlx::SqlitePool;

use super::{Objects, StoreError};

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
    /// Held, not read: the lock ends with the file.
    _lock: std::fs::File,
}

impl Store {
    /// Opens (or makes) a data directory: locks it, migrates the database, opens the objects.
    ///
    /// # Errors
    /// [`StoreError::Locked`] when another process has it; a damaged or newer database; the
    /// file system's refusals.
    pub async fn open(_data_dir: &Path) -> Result<Self, StoreError> {
        todo!()
    }

    /// Asks the database for a sign of life, and whether the directory can be written.
    ///
    /// # Errors
    /// Whatever keeps the store from working.
    pub async fn ping(&self) -> Result<(), StoreError> {
        todo!()
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
}
