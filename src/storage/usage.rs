//! Space that the data directory takes, and space that is left.

use std::io;
use std::path::Path;

use super::files::failed;
use super::objects::off_thread;
use super::store::DATABASE_FILES;
use super::{Store, StoreError, journal};

/// Sizes in bytes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Usage {
    /// The registry.
    pub database: u64,
    /// Samples of runs, weights of models, findings of diagnoses, reports of evaluations.
    pub objects: u64,
    /// Uploads under way.
    pub scratch: u64,
    /// Space that the file system has left for this user.
    pub free: u64,
}

impl Usage {
    /// The parts that are used, by name.
    pub fn parts(&self) -> [(&'static str, u64); 3] {
        [("database", self.database), ("objects", self.objects), ("scratch", self.scratch)]
    }
}

impl Store {
    /// Present sizes. That of the objects is kept up to date elsewhere, so it needs no walk over them.
    ///
    /// # Errors
    /// The file system's errors.
    pub async fn usage(&self) -> Result<Usage, StoreError> {
        let (data_dir, scratch, objects) =
            (self.data_dir().to_owned(), self.scratch_dir(), self.objects().bytes());
        off_thread(move || {
            let database =
                DATABASE_FILES.iter().chain([&journal::FILE]).map(|name| size(&data_dir.join(name))).sum();
            let scratch = std::fs::read_dir(&scratch).map_err(failed(&scratch))?;
            let scratch = scratch.flatten().map(|file| size(&file.path())).sum();
            let system =
                rustix::fs::statvfs(&data_dir).map_err(|error| failed(&data_dir)(io::Error::from(error)))?;
            Ok(Usage { database, objects, scratch, free: system.f_bavail.saturating_mul(system.f_frsize) })
        })
        .await
    }
}

/// Size of a file; 0 if it is missing, because files may be removed at any time.
fn size(path: &Path) -> u64 {
    std::fs::metadata(path).map_or(0, |file| file.len())
}

#[cfg(test)]
mod tests {
    use bytes::Bytes;

    use super::super::testing::{draft, imported, now};
    use super::super::{Activation, Digest};
    use super::*;

    #[tokio::test]
    async fn objects_count_once_until_they_go_and_a_restart_counts_the_same() {
        let dir = tempfile::tempdir().unwrap();
        let store = Store::open(dir.path()).await.unwrap();
        let empty = store.usage().await.unwrap();
        assert!(empty.database > 0 && empty.free > 0, "{empty:?}");
        assert_eq!((empty.objects, empty.scratch), (0, 0));
        let rig = store.insert_rig(&draft("bench"), None, now()).await.unwrap().unwrap();
        for _ in 0..2 {
            let model = imported(b"twelve bytes");
            store.insert_model(&rig.id, model, Activation::Leave, None, now()).await.unwrap().unwrap();
        }
        let orphan = Digest::of(b"orphan");
        store.objects().put(&orphan, Bytes::from_static(b"orphan")).await.unwrap();
        std::fs::write(store.scratch_dir().join("upload"), [0; 100]).unwrap();
        let used = store.usage().await.unwrap();
        assert_eq!((used.objects, used.scratch), (12 + 6, 100), "the same bytes are one object");
        for _ in 0..2 {
            store.objects().remove(orphan.as_str()).await.unwrap();
        }
        assert_eq!(store.usage().await.unwrap().objects, 12);
        store.close().await;
        drop(store);
        let again = Store::open(dir.path()).await.unwrap().usage().await.unwrap();
        assert_eq!((again.objects, again.scratch), (12, 0));
    }
}
