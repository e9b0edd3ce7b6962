//! Objects: immutable bytes, named by their SHA-256 and verified at each read.

use std::collections::{BTreeMap, BTreeSet};
use std::ffi::OsStr;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use bytes::Bytes;
use object_store::ObjectStoreExt;
use object_store::local::LocalFileSystem;
use object_store::path::Path as Key;
use sha2::{Digest as _, Sha256};

use super::backup::Progress;
use super::bucket::{Bucket, Listed};
use super::corruption::CorruptObjects;
use super::database::{Session, postgres, sql};
use super::files::{self, failed};
use super::object_file::ObjectFile;
use super::object_locks::Kept;
use super::store::SCRATCH;
use super::write::Write;
use super::{Store, StoreError, quarantine};

/// SHA-256 of some bytes, as 64 lower-case hex digits.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub struct Digest(String);

impl Digest {
    /// Digest of `bytes`.
    pub fn of(bytes: &[u8]) -> Self {
        Self(hex(&Sha256::digest(bytes)))
    }

    /// Digest of the bytes that were hashed piece by piece.
    pub(super) fn finished(hash: Sha256) -> Self {
        Self(hex(&hash.finalize()))
    }

    /// As hex.
    pub fn as_str(&self) -> &str {
        &self.0
    }

    /// Whether a file's name is that of an object.
    pub(super) fn is_name(name: &str) -> bool {
        name.len() == 64 && name.bytes().all(|c| c.is_ascii_hexdigit())
    }
}

/// Bytes as lower-case hex digits.
pub(super) fn hex(bytes: &[u8]) -> String {
    use std::fmt::Write;
    let mut hex = String::with_capacity(2 * bytes.len());
    for byte in bytes {
        write!(hex, "{byte:02x}").expect("writing to a string cannot fail");
    }
    hex
}

/// The object files of a data directory; with a bucket, the copies of those that were used last.
#[derive(Debug, Clone)]
pub struct Objects {
    files: Arc<LocalFileSystem>,
    root: PathBuf,
    bucket: Option<Bucket>,
    corrupt: CorruptObjects,
    /// Size of all files together; counted by the sweep at the start and kept up to date.
    bytes: Arc<AtomicU64>,
}

impl Objects {
    /// Opens an existing directory of objects, and the bucket that they are in.
    pub(super) fn open(root: &Path, bucket: Option<Bucket>) -> Result<Self, StoreError> {
        // With fsync a put returns after the file, its rename and its directory are on disk.
        let files = LocalFileSystem::new_with_prefix(root)?.with_fsync(true);
        Ok(Self {
            files: Arc::new(files),
            root: root.to_owned(),
            bucket,
            corrupt: CorruptObjects::default(),
            bytes: Arc::default(),
        })
    }

    /// Stores `bytes` durably under their digest. Storing the same bytes again repairs a damaged object
    /// and otherwise changes nothing.
    ///
    /// # Errors
    /// The file system's refusals, a bucket out of reach; a half-written object is never visible.
    pub async fn put(&self, digest: &Digest, bytes: Bytes) -> Result<(), StoreError> {
        if let Some(bucket) = &self.bucket {
            bucket.put(digest.as_str(), bytes.clone(), self.corrupt.has(digest.as_str())).await?;
        }
        let (before, after) = (self.size(digest.as_str()).await, bytes.len() as u64);
        self.files.put(&key(digest.as_str()), bytes.into()).await?;
        self.bytes.fetch_add(after.wrapping_sub(before), Ordering::Relaxed);
        self.corrupt.note(digest.as_str(), false);
        self.make_room(digest.as_str()).await
    }

    /// Stores an object as [`Objects::put`] does.
    ///
    /// # Errors
    /// The file system's refusals, a bucket out of reach; a half-written object is never visible.
    pub(super) async fn put_file(&self, file: ObjectFile) -> Result<(), StoreError> {
        let digest = file.digest().clone();
        if let Some(bucket) = &self.bucket {
            let mend = self.corrupt.has(digest.as_str());
            bucket.put_file(digest.as_str(), file.path(), file.size(), mend).await?;
        }
        self.take_in(file).await?;
        self.corrupt.note(digest.as_str(), false);
        self.make_room(digest.as_str()).await
    }

    /// Puts the file of a whole object in its place.
    async fn take_in(&self, file: ObjectFile) -> Result<(), StoreError> {
        let (digest, after) = (file.digest().clone(), file.size());
        let before = self.size(digest.as_str()).await;
        let place = self.path_of(digest.as_str());
        off_thread(move || file.persist(&place)).await?;
        self.bytes.fetch_add(after.wrapping_sub(before), Ordering::Relaxed);
        Ok(())
    }

    /// Brings an object from the bucket to the local disk, in place of a file that is there; `false` without a bucket.
    ///
    /// # Errors
    /// [`StoreError::ObjectMissing`] and [`StoreError::ObjectDamaged`], which are noted; a bucket out of reach.
    pub(super) async fn bring(&self, digest: &str) -> Result<bool, StoreError> {
        let Some(bucket) = &self.bucket else { return Ok(false) };
        let scratch = self.root.with_file_name(SCRATCH);
        let fetched = bucket.fetch(digest, &scratch).await;
        if let Err(StoreError::ObjectMissing { .. } | StoreError::ObjectDamaged { .. }) = fetched {
            self.corrupt.note(digest, true);
        }
        self.take_in(fetched?).await?;
        self.make_room(digest).await?;
        Ok(true)
    }

    /// Removes the local copies of objects that were not used for the longest time, where they take more than they may.
    /// That of `kept` is about to be used.
    async fn make_room(&self, kept: &str) -> Result<(), StoreError> {
        let Some(bucket) = &self.bucket else { return Ok(()) };
        let (most, root, held) = (bucket.cache_bytes(), self.root.clone(), Arc::clone(&self.bytes));
        let kept = self.path_of(kept);
        if held.load(Ordering::Relaxed) <= most {
            return Ok(());
        }
        off_thread(move || {
            let mut files = Vec::new();
            for path in all_below(&root)? {
                // Another request may remove it meanwhile.
                if let Ok(file) = std::fs::metadata(&path) {
                    files.push((file.modified().ok(), file.len(), path));
                }
            }
            files.sort();
            // A tenth more, so that this is seldom done.
            let (mut bytes, enough) = (files.iter().map(|file| file.1).sum::<u64>(), most - most / 10);
            for (_, size, path) in files.into_iter().filter(|(.., path)| *path != kept) {
                if bytes <= enough {
                    break;
                }
                files::remove(&path)?;
                bytes -= size;
            }
            held.store(bytes, Ordering::Relaxed);
            Ok(())
        })
        .await
    }

    /// The bucket.
    pub(super) fn bucket(&self) -> Option<&Bucket> {
        self.bucket.as_ref()
    }

    /// Reads an object and verifies its digest.
    ///
    /// # Errors
    /// [`StoreError::ObjectMissing`], [`StoreError::ObjectDamaged`], the file system's errors.
    pub async fn get(&self, digest: &str) -> Result<Bytes, StoreError> {
        self.get_with(digest, Ok).await
    }

    /// Reads and verifies an object that holds JSON; `key` is that of the row of `table` that names it.
    pub(super) async fn get_json<T: serde::de::DeserializeOwned + Send + 'static>(
        &self,
        digest: &str,
        table: &'static str,
        key: String,
    ) -> Result<T, StoreError> {
        let read = move |bytes: Bytes| {
            let read = serde_json::from_slice(&bytes);
            read.map_err(|error| StoreError::Row { table, key, what: error.to_string() })
        };
        self.get_with(digest, read).await
    }

    /// Reads, verifies and converts an object, off the async threads.
    pub(super) async fn get_with<T: Send + 'static>(
        &self,
        digest: &str,
        make: impl FnOnce(Bytes) -> Result<T, StoreError> + Send + 'static,
    ) -> Result<T, StoreError> {
        let found = match self.read(digest).await {
            Err(StoreError::ObjectMissing { .. } | StoreError::ObjectDamaged { .. })
                if self.bring(digest).await? =>
            {
                self.read(digest).await?
            }
            found => found?,
        };
        off_thread(move || make(found)).await
    }

    /// The verified bytes of the local file of an object.
    async fn read(&self, digest: &str) -> Result<Bytes, StoreError> {
        let found = match self.files.get(&key(digest)).await {
            Err(object_store::Error::NotFound { .. }) => {
                self.corrupt.note(digest, true);
                return Err(StoreError::ObjectMissing { digest: digest.to_owned() });
            }
            found => found?.bytes().await?,
        };
        let (path, is_copy) = (self.path_of(digest), self.bucket.is_some());
        let (digest, damaged) = (digest.to_owned(), self.corrupt.clone());
        off_thread(move || {
            let actual = Digest::of(&found);
            damaged.note(&digest, actual.as_str() != digest);
            if actual.as_str() != digest {
                return Err(StoreError::ObjectDamaged { digest, found: actual.0 });
            }
            if is_copy {
                // Only a guess at what will be used again: another request may have removed it.
                let _ = files::touch(&path);
            }
            Ok(found)
        })
        .await
    }

    /// Stores an object in a bucket, verified, unless it is among those that are `there`; whether it was stored.
    ///
    /// # Errors
    /// A damaged or missing object; a bucket out of reach.
    async fn store_in(
        &self,
        bucket: &Bucket,
        there: &BTreeMap<String, Listed>,
        digest: &str,
    ) -> Result<bool, StoreError> {
        let path = self.path_of(digest);
        let size = std::fs::metadata(&path).ok().map(|file| file.len());
        if there.get(digest).is_some_and(|there| size.is_none_or(|size| size == there.bytes)) {
            return Ok(false);
        }
        drop(self.read(digest).await?);
        bucket.put_file(digest, &path, size.unwrap_or_default(), true).await?;
        Ok(true)
    }

    /// Size of all objects together, bytes.
    pub(super) fn bytes(&self) -> u64 {
        self.bytes.load(Ordering::Relaxed)
    }

    /// The file of an object, whether it is there or not.
    pub(super) fn path_of(&self, digest: &str) -> PathBuf {
        place(&self.root, digest)
    }

    /// Size of an object; 0 if it is not there.
    async fn size(&self, digest: &str) -> u64 {
        tokio::fs::metadata(self.path_of(digest)).await.map_or(0, |file| file.len())
    }

    /// Removes all objects but these.
    pub(super) fn retain(&self, wanted: &BTreeSet<String>) -> Result<(), StoreError> {
        self.keep(wanted, files::remove)
    }

    /// Puts all objects but these into the quarantine of the data directory, and removes unfinished files.
    pub(super) fn put_others_aside(
        &self,
        wanted: &BTreeSet<String>,
        data_dir: &Path,
    ) -> Result<(), StoreError> {
        self.keep(wanted, |file| {
            let name = file.file_name().and_then(|name| name.to_str()).unwrap_or_default();
            if Digest::is_name(name) {
                tracing::warn!(object.digest = name, "put an object aside that no row names");
                return quarantine::put_aside(data_dir, file);
            }
            files::remove(file)
        })
    }

    /// Does away with all objects but these, and counts the bytes of these.
    fn keep(
        &self,
        wanted: &BTreeSet<String>,
        do_away: impl Fn(&Path) -> Result<(), StoreError>,
    ) -> Result<(), StoreError> {
        let mut kept = 0;
        for file in all_below(&self.root)? {
            if file.file_name().and_then(OsStr::to_str).is_none_or(|name| !wanted.contains(name)) {
                do_away(&file)?;
            } else {
                kept += std::fs::metadata(&file).map_err(failed(&file))?.len();
            }
        }
        self.bytes.store(kept, Ordering::Relaxed);
        Ok(())
    }

    /// Whether there is any object.
    pub(super) fn any(root: &Path) -> bool {
        let directories = std::fs::read_dir(root).into_iter().flatten().flatten();
        directories.flat_map(|entry| std::fs::read_dir(entry.path())).flatten().next().is_some()
    }

    /// The objects found damaged or missing.
    pub(super) fn corrupt(&self) -> &CorruptObjects {
        &self.corrupt
    }

    /// Removes an object; a missing one is no error.
    pub(super) async fn remove(&self, digest: &str) -> Result<(), StoreError> {
        if let Some(bucket) = &self.bucket {
            bucket.remove(digest).await?;
        }
        let size = self.size(digest).await;
        match self.files.delete(&key(digest)).await {
            Ok(()) => {
                self.bytes.fetch_sub(size, Ordering::Relaxed);
                Ok(())
            }
            Err(object_store::Error::NotFound { .. }) => Ok(()),
            Err(error) => Err(error.into()),
        }
    }
}

/// Names of all objects that rows refer to.
pub(super) const REFERENCED: &str =
    "SELECT object FROM runs UNION SELECT sha256 FROM models UNION SELECT findings FROM diagnoses
     UNION SELECT report FROM evaluations";

/// Every file below a directory of objects.
///
/// # Errors
/// The file system's errors.
pub(super) fn all_below(root: &Path) -> Result<Vec<PathBuf>, StoreError> {
    let mut found = Vec::new();
    for directory in std::fs::read_dir(root).map_err(failed(root))? {
        let directory = directory.map_err(failed(root))?.path();
        if !directory.is_dir() {
            continue;
        }
        for file in std::fs::read_dir(&directory).map_err(failed(&directory))? {
            found.push(file.map_err(failed(&directory))?.path());
        }
    }
    Ok(found)
}

/// Where an object is in a directory of objects.
pub(super) fn place(root: &Path, digest: &str) -> PathBuf {
    root.join(key(digest).as_ref())
}

/// Spreads the objects over 256 directories, to keep each of them small.
pub(super) fn key(digest: &str) -> Key {
    Key::from_iter([digest.get(..2).unwrap_or("xx"), digest])
}

/// Does short work off the async threads; a panic continues in the caller.
pub(super) async fn off_thread<T: Send + 'static>(
    work: impl FnOnce() -> Result<T, StoreError> + Send + 'static,
) -> Result<T, StoreError> {
    let span = tracing::Span::current();
    join(tokio::task::spawn_blocking(move || span.in_scope(work))).await
}

/// Completes work even if the caller goes away.
pub(super) async fn to_the_end<T: Send + 'static>(
    work: impl Future<Output = Result<T, StoreError>> + Send + 'static,
) -> Result<T, StoreError> {
    use tracing::Instrument;
    join(tokio::spawn(work.in_current_span())).await
}

async fn join<T>(task: tokio::task::JoinHandle<Result<T, StoreError>>) -> Result<T, StoreError> {
    match task.await {
        Ok(result) => result,
        Err(error) => match error.try_into_panic() {
            Ok(panic) => std::panic::resume_unwind(panic),
            Err(_) => Err(StoreError::Stopped),
        },
    }
}

/// A write transaction whose rows refer to an object that was just stored. The object is not removed before
/// it ends, by whichever process.
pub(super) struct ObjectWrite {
    pub(super) kept: Kept,
    pub(super) tx: Write,
}

impl Store {
    /// Stores an object durably, then begins the transaction whose rows refer to it.
    pub(super) async fn write_object(
        &self,
        digest: &Digest,
        bytes: &Bytes,
    ) -> Result<ObjectWrite, StoreError> {
        let held = self.keep_object(digest).await?;
        self.objects().put(digest, bytes.clone()).await?;
        self.write_held(held).await
    }

    /// As [`Store::write_object`], for an object in a file.
    pub(super) async fn write_object_file(&self, file: ObjectFile) -> Result<ObjectWrite, StoreError> {
        let held = self.keep_object(file.digest()).await?;
        self.objects().put_file(file).await?;
        self.write_held(held).await
    }

    /// Begins the write that an object was stored for.
    async fn write_held(&self, (kept, held): (Kept, Option<Session>)) -> Result<ObjectWrite, StoreError> {
        let Some(mut held) = held else { return Ok(ObjectWrite { kept, tx: self.write().await? }) };
        self.check_room()?;
        postgres::write_alone(&mut held).await?;
        Ok(ObjectWrite { kept, tx: Write::of(self, held) })
    }

    /// Awaits a write of an object and of its row, and removes the object again if `made` says that no
    /// row came of it.
    pub(super) async fn discard_unless<T>(
        &self,
        made: impl Fn(&T) -> bool,
        digest: &Digest,
        written: impl Future<Output = Result<T, StoreError>>,
    ) -> Result<T, StoreError> {
        let written = written.await;
        if !written.as_ref().is_ok_and(made) {
            self.discard_unreferenced(vec![digest.as_str().to_owned()]).await;
        }
        written
    }

    /// Removes those of `digests` that no row refers to and nobody is about to. Called after the rows were deleted. A
    /// failure is only logged, because the next start removes the files, and an orderly stop those of a bucket.
    pub(super) async fn discard_unreferenced(&self, digests: Vec<String>) {
        for digest in digests {
            let Err(error) = self.discard_one(&digest).await else { continue };
            tracing::warn!(object.digest = digest, %error, "an unreferenced object was left behind");
            // The others would wait for bucket or database in vain.
            if error.is_unavailable() || matches!(error, StoreError::Bucket { .. }) {
                break;
            }
        }
    }

    async fn discard_one(&self, digest: &str) -> Result<(), StoreError> {
        let Some(_alone) = self.object_alone(digest).await? else {
            tracing::debug!(object.digest = digest, "somebody stores an object that was to be removed");
            return Ok(());
        };
        if self.is_referenced(digest).await? { Ok(()) } else { self.objects().remove(digest).await }
    }

    async fn is_referenced(&self, digest: &str) -> Result<bool, StoreError> {
        let found: bool = sql("SELECT EXISTS (SELECT 1 FROM runs WHERE object = $1)
                 OR EXISTS (SELECT 1 FROM models WHERE sha256 = $1)
                 OR EXISTS (SELECT 1 FROM diagnoses WHERE findings = $1)
                 OR EXISTS (SELECT 1 FROM evaluations WHERE report = $1)")
        .bind(digest)
        .fetch_one(self.reader())
        .await?;
        Ok(found)
    }

    /// Names of all objects that rows refer to.
    async fn referenced(&self) -> Result<BTreeSet<String>, StoreError> {
        let rows: Vec<String> = sql(REFERENCED).fetch_all(self.reader()).await?;
        Ok(rows.into_iter().collect())
    }

    /// Puts every object aside that no row refers to: its upload was cut short, or its row was lost. Only at a start,
    /// while no one else writes.
    pub(super) async fn sweep_objects(&self) -> Result<(), StoreError> {
        let wanted = self.referenced().await?;
        let (objects, data_dir) = (self.objects().clone(), self.data_dir().to_owned());
        let names = wanted.clone();
        off_thread(move || {
            quarantine::bring_back(&data_dir, &names)?;
            objects.put_others_aside(&names, &data_dir)
        })
        .await?;
        self.fill_bucket(&wanted).await
    }

    /// Removes the local copies of objects that no row names. For a start on a shared registry, whose objects are all in
    /// the bucket.
    pub(super) async fn sweep_copies(&self) -> Result<(), StoreError> {
        let (wanted, objects) = (self.referenced().await?, self.objects().clone());
        off_thread(move || objects.retain(&wanted)).await?;
        self.objects().make_room("").await
    }

    /// Stores those of `wanted` in the bucket that only the local disk has: all of them when a bucket is new.
    async fn fill_bucket(&self, wanted: &BTreeSet<String>) -> Result<(), StoreError> {
        let objects = self.objects();
        let Some(bucket) = objects.bucket() else { return Ok(()) };
        let there = bucket.list().await?;
        let mut filled = 0;
        for digest in wanted.iter().filter(|digest| objects.path_of(digest).exists()) {
            match objects.store_in(bucket, &there, digest).await {
                // Only what is whole goes into the bucket, where nobody has looked at it.
                Err(StoreError::ObjectMissing { .. } | StoreError::ObjectDamaged { .. }) => {}
                stored => filled += u64::from(stored?),
            }
        }
        if filled > 0 {
            tracing::info!(objects = filled, "stored objects in the bucket that only the data directory had");
        }
        objects.make_room("").await
    }

    /// Stores every object that a row names in a bucket, unless it is there. Returns how many there are.
    ///
    /// # Errors
    /// A damaged or missing object, by name; a bucket out of reach.
    pub(super) async fn store_all_in(&self, bucket: &Bucket, progress: &Progress) -> Result<u64, StoreError> {
        let (wanted, there) = (self.referenced().await?, bucket.list().await?);
        let all = wanted.len() as u64;
        for (done, digest) in wanted.iter().enumerate() {
            self.objects().store_in(bucket, &there, digest).await?;
            progress(done as u64 + 1, all);
        }
        Ok(all)
    }

    /// Removes objects of the bucket that no row has named for a week. For an orderly stop, never after a crash.
    pub(super) async fn sweep_bucket(&self, now: jiff::Timestamp) -> Result<(), StoreError> {
        let Some(bucket) = self.objects().bucket() else { return Ok(()) };
        let listed = bucket.list().await?;
        let wanted = self.referenced().await?;
        let old = listed.into_iter().filter(|(name, listed)| listed.is_old(now) && !wanted.contains(name));
        let old = old.map(|(name, _)| name).collect();
        self.discard_unreferenced(old).await;
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::super::testing::{TestStore, draft, now};
    use super::*;

    fn file_of(dir: &Path, digest: &Digest) -> PathBuf {
        dir.join("objects").join(&digest.as_str()[..2]).join(digest.as_str())
    }

    #[test]
    fn the_digest_is_sha_256() {
        // FIPS 180-2, appendix B.1.
        let expected = "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad";
        assert_eq!(Digest::of(b"abc").as_str(), expected);
    }

    #[tokio::test]
    async fn a_flipped_bit_is_found_on_every_byte_and_mended_by_storing_again() {
        let dir = tempfile::tempdir().unwrap();
        let store = Store::open(dir.path()).await.unwrap();
        let bytes = Bytes::from_static(b"the weights of a model");
        let digest = Digest::of(&bytes);
        store.objects().put(&digest, bytes.clone()).await.unwrap();
        assert_eq!(store.objects().get(digest.as_str()).await.unwrap(), bytes);
        let path = file_of(dir.path(), &digest);
        for i in 0..bytes.len() {
            let mut damaged = bytes.to_vec();
            damaged[i] ^= 1;
            std::fs::write(&path, &damaged).unwrap();
            let read = store.objects().get(digest.as_str()).await;
            assert!(matches!(read, Err(StoreError::ObjectDamaged { .. })), "byte {i}: {read:?}");
        }
        store.objects().put(&digest, bytes.clone()).await.unwrap();
        assert_eq!(store.objects().get(digest.as_str()).await.unwrap(), bytes);
        std::fs::remove_file(&path).unwrap();
        let read = store.objects().get(digest.as_str()).await;
        assert!(matches!(read, Err(StoreError::ObjectMissing { .. })));
    }

    #[tokio::test]
    async fn a_start_puts_objects_without_a_row_aside_and_removes_unfinished_files() {
        let dir = tempfile::tempdir().unwrap();
        let store = Store::open(dir.path()).await.unwrap();
        let digest = Digest::of(b"orphan");
        store.objects().put(&digest, Bytes::from_static(b"orphan")).await.unwrap();
        let path = file_of(dir.path(), &digest);
        let unfinished = path.with_file_name(format!("{}#1", digest.as_str()));
        std::fs::write(&unfinished, b"orp").unwrap();
        drop(store);
        let store = Store::open(dir.path()).await.unwrap();
        assert!(!path.exists() && !unfinished.exists());
        assert_eq!(store.quarantined().await.unwrap(), [digest.as_str()]);
        assert_eq!(store.usage().await.unwrap().objects, 0);
        let aside = dir.path().join("quarantine").join(digest.as_str());
        assert_eq!(std::fs::read(&aside).unwrap(), b"orphan");
        let since: std::time::SystemTime = std::fs::metadata(&aside).unwrap().modified().unwrap();
        let since = jiff::Timestamp::try_from(since).unwrap();
        store.empty_quarantine(since + jiff::SignedDuration::from_hours(6 * 24)).await.unwrap();
        assert!(aside.exists(), "its week is not over");
        store.empty_quarantine(since + jiff::SignedDuration::from_hours(8 * 24)).await.unwrap();
        assert!(!aside.exists());
    }

    #[tokio::test]
    async fn an_object_that_was_put_aside_comes_back_with_its_row() {
        let store = TestStore::open_sqlite().await;
        let rig = store.insert_rig(&draft("bench"), None, now()).await.unwrap().unwrap();
        let run = store.upload(&rig, &[1.0]).await.run;
        let data_dir = store.data_dir().to_owned();
        quarantine::put_aside(&data_dir, &file_of(&data_dir, &Digest(run.object.clone()))).unwrap();
        assert!(store.load_signal(&run).await.is_err());
        let store = store.reopened().await;
        assert_eq!(store.load_signal(&run).await.unwrap().channel(0), [1.0]);
        assert_eq!(store.quarantined().await.unwrap(), [] as [String; 0]);
    }
}
