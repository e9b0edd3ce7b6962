//! Which objects are being stored or removed: without this a removal could delete an object between its writing and that
//! of the row that names it.
//!
//! Each object has a lock of its own, so that a slow upload holds up nothing but a removal of the same bytes, which gives
//! way: the upload removes the object itself if no row comes of it.

use std::collections::HashMap;
use std::sync::{Arc, Mutex, PoisonError, Weak};
use std::time::Duration;

use tokio::sync::{OwnedRwLockReadGuard, OwnedRwLockWriteGuard, RwLock};

use super::database::{Session, postgres};
use super::{Digest, Store, StoreError};

/// Locks of this process that nobody holds stay in the table until there are this many.
const TIDY_FROM: usize = 64;

/// How often a removal asks whether somebody stores or removes the object, and the time in between: another removal is
/// short, and the database learns a little later that a transaction was dropped.
const TRIES: u32 = 10;
const PAUSE: Duration = Duration::from_millis(20);

/// The locks of this process, by digest.
#[derive(Debug, Clone, Default)]
pub(super) struct ObjectLocks(Arc<Mutex<HashMap<String, Weak<RwLock<()>>>>>);

/// An object that is not removed while this lives.
pub(super) type Kept = OwnedRwLockReadGuard<()>;

/// An object that nobody stores while this lives.
pub(super) struct Alone {
    _here: OwnedRwLockWriteGuard<()>,
    _everywhere: Option<Session>,
}

impl ObjectLocks {
    fn of(&self, digest: &str) -> Arc<RwLock<()>> {
        let mut locks = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(lock) = locks.get(digest).and_then(Weak::upgrade) {
            return lock;
        }
        if locks.len() >= TIDY_FROM {
            locks.retain(|_, lock| lock.strong_count() > 0);
        }
        let lock = Arc::default();
        locks.insert(digest.to_owned(), Arc::downgrade(&lock));
        lock
    }

    /// Waits until an object is not being removed, and keeps it.
    async fn keep(&self, digest: &str) -> Kept {
        self.of(digest).read_owned().await
    }

    /// An object that nobody keeps.
    fn alone(&self, digest: &str) -> Option<OwnedRwLockWriteGuard<()>> {
        self.of(digest).try_write_owned().ok()
    }
}

impl Store {
    /// Keeps an object from being removed; with a shared registry by a transaction in which the rows are written later,
    /// so that a lost connection loses both.
    pub(super) async fn keep_object(&self, digest: &Digest) -> Result<(Kept, Option<Session>), StoreError> {
        let here = self.object_locks().keep(digest.as_str()).await;
        let everywhere = match self.holders() {
            None => None,
            Some(pool) => {
                let mut session = Session::Postgres(pool.begin().await?);
                postgres::keep_object(&mut session, digest.as_str()).await?;
                Some(session)
            }
        };
        Ok((here, everywhere))
    }

    /// Lets nobody store an object; `None` if somebody does, and goes on doing so.
    pub(super) async fn object_alone(&self, digest: &str) -> Result<Option<Alone>, StoreError> {
        for left in (0..TRIES).rev() {
            if let Some(here) = self.object_locks().alone(digest) {
                let Some(pool) = self.holders() else {
                    return Ok(Some(Alone { _here: here, _everywhere: None }));
                };
                let mut session = Session::Postgres(pool.begin().await?);
                if postgres::object_alone(&mut session, digest).await? {
                    return Ok(Some(Alone { _here: here, _everywhere: Some(session) }));
                }
            }
            if left > 0 {
                tokio::time::sleep(PAUSE).await;
            }
        }
        Ok(None)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn an_object_that_is_stored_is_not_removed_and_another_one_is() {
        let locks = ObjectLocks::default();
        let (one, again) = (locks.keep("a").await, locks.keep("a").await);
        assert!(locks.alone("a").is_none() && locks.alone("b").is_some());
        drop(one);
        assert!(locks.alone("a").is_none());
        drop(again);
        let alone = locks.alone("a").expect("nobody stores it");
        let waits = tokio::time::timeout(Duration::from_millis(50), locks.keep("a")).await;
        assert!(waits.is_err(), "it is being removed");
        drop(alone);
        locks.keep("a").await;
        for k in 0..10 * TIDY_FROM {
            locks.keep(&k.to_string()).await;
        }
        assert!(locks.0.lock().unwrap().len() <= TIDY_FROM);
    }
}
