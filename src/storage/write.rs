//! Writes: one at a time, in the journal before anybody is told.

use std::ops::{Deref, DerefMut};

use sqlx::pool::PoolConnection;
use sqlx::{Sqlite, SqliteConnection, Transaction};

use super::reserve::with_reserve;
use super::{Store, StoreError};

/// A write transaction. Dropping it takes it back.
pub(super) struct Write {
    store: Store,
    tx: Transaction<'static, Sqlite>,
}

impl Deref for Write {
    type Target = SqliteConnection;

    fn deref(&self) -> &SqliteConnection {
        &self.tx
    }
}

impl DerefMut for Write {
    fn deref_mut(&mut self) -> &mut SqliteConnection {
        &mut self.tx
    }
}

impl Write {
    /// Commits, and appends the changed rows to the journal. After it the changes may be acknowledged.
    pub(super) async fn commit(self) -> Result<(), StoreError> {
        self.tx.commit().await?;
        // The change is made: for its line in the journal the reserve may be used whatever it is.
        let store = self.store;
        with_reserve!(store, store.write_journal())
    }

    /// Commits changes that are not journaled, such as the progress of a job.
    pub(super) async fn commit_progress(self) -> Result<(), StoreError> {
        Ok(self.tx.commit().await?)
    }
}

impl Store {
    /// The connection for a write of one statement that is not journaled.
    pub(super) async fn write_one(&self) -> Result<PoolConnection<Sqlite>, StoreError> {
        Ok(self.writer().acquire().await?)
    }

    /// Begins a write. On a full disk it is refused, so that the reserve is left for writes that make room.
    pub(super) async fn write(&self) -> Result<Write, StoreError> {
        self.check_room()?;
        self.write_with_reserve().await
    }

    /// Begins a write that makes room, or that takes none; see `with_reserve!`. It begins with
    /// `BEGIN IMMEDIATE`, so that rows that it reads cannot change before it writes.
    pub(super) async fn write_with_reserve(&self) -> Result<Write, StoreError> {
        const BEGIN: &str = "BEGIN IMMEDIATE";
        let tx = match self.writer().begin_with(BEGIN).await {
            Err(sqlx::Error::InvalidSavePointStatement) => {
                // After a full disk or a failed write SQLite has ended the last transaction by itself,
                // but the connection still counts it and cannot be used any more.
                self.writer().acquire().await?.close().await?;
                self.writer().begin_with(BEGIN).await?
            }
            begun => begun?,
        };
        Ok(Write { store: self.clone(), tx })
    }
}
