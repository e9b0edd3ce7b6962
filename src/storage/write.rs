//! Writes: one at a time, in the journal before anybody is told.

use std::ops::{Deref, DerefMut};

use super::database::{On, Session};
use super::reserve::with_reserve;
use super::{Store, StoreError};

/// A write transaction. Dropping it takes it back.
pub(super) struct Write {
    store: Store,
    session: Session,
}

impl Deref for Write {
    type Target = Session;

    fn deref(&self) -> &Session {
        &self.session
    }
}

impl DerefMut for Write {
    fn deref_mut(&mut self) -> &mut Session {
        &mut self.session
    }
}

impl<'a> From<&'a mut Write> for On<'a> {
    fn from(write: &'a mut Write) -> Self {
        Self::Session(&mut write.session)
    }
}

impl Write {
    /// A write in a transaction that may write already.
    pub(super) fn of(store: &Store, session: Session) -> Self {
        Self { store: store.clone(), session }
    }

    /// Commits, and appends the changed rows to the journal. After it the changes may be acknowledged.
    pub(super) async fn commit(self) -> Result<(), StoreError> {
        self.session.commit().await?;
        // The change is made: for its line in the journal the reserve may be used whatever it is.
        let store = self.store;
        with_reserve!(store, store.write_journal())
    }

    /// Commits changes that are not journaled, such as the progress of a job.
    pub(super) async fn commit_progress(self) -> Result<(), StoreError> {
        Ok(self.session.commit().await?)
    }
}

impl Store {
    /// Begins a write. On a full disk it is refused, so that the reserve is left for writes that make room.
    pub(super) async fn write(&self) -> Result<Write, StoreError> {
        self.check_room()?;
        self.write_with_reserve().await
    }

    /// Begins a write that makes room, or that takes none; see `with_reserve!`. Rows that it reads cannot change before
    /// it writes.
    pub(super) async fn write_with_reserve(&self) -> Result<Write, StoreError> {
        Ok(Write::of(self, self.writer().write().await?))
    }
}
