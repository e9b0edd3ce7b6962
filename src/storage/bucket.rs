//! Objects in S3-compatible storage: the data directory then holds copies of those that were used last.
//!
//! A bucket and prefix belong to one service. A mark in it says to which, so that two services that were given the same
//! prefix by mistake do not remove each other's objects. Every step has a deadline: while the storage is away, uploads are
//! refused soon and what is on the local disk is still read.

use std::collections::BTreeMap;
use std::future::Future;
use std::io::Write as _;
use std::path::Path;
use std::sync::Arc;
use std::time::Duration;

use bytes::Bytes;
use futures::TryStreamExt as _;
use jiff::{SignedDuration, Timestamp};
use object_store::aws::{AmazonS3Builder, Checksum};
use object_store::path::Path as Key;
use object_store::{
    ClientOptions, Error, ObjectStore, ObjectStoreExt as _, PutMode, RetryConfig, WriteMultipart,
};
use serde::{Deserialize, Serialize};
use tokio::io::AsyncReadExt as _;
use uuid::Uuid;

use super::files::failed;
use super::object_file::ObjectFile;
use super::objects::{key, off_thread};
use super::quarantine::KEPT;
use super::{Digest, StoreError};

/// Where a bucket is. Keys come from the environment, as AWS names them (`AWS_ACCESS_KEY_ID`, `AWS_SECRET_ACCESS_KEY`).
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct BucketSettings {
    /// `s3://bucket/prefix`.
    pub url: String,
    /// Address of the storage, such as `http://127.0.0.1:9000`; `None`: that of AWS.
    pub endpoint: Option<String>,
    /// Region; `None`: that of the environment, or `us-east-1`.
    pub region: Option<String>,
    /// The bucket's name is in the host and not in the path.
    pub virtual_hosted: bool,
    /// Bytes of objects that the local disk may hold.
    pub cache_bytes: u64,
}

/// An opened bucket.
#[derive(Debug, Clone)]
pub(super) struct Bucket {
    store: Arc<dyn ObjectStore>,
    prefix: Key,
    /// Its URL.
    name: Arc<str>,
    /// Bytes of objects that the local disk may hold.
    cache_bytes: u64,
}

/// The mark of the service that a prefix belongs to.
#[derive(Debug, Serialize, Deserialize)]
struct Mark {
    service: Uuid,
}

/// What a data directory says of its bucket.
#[derive(Debug, Serialize, Deserialize)]
struct Belongs {
    url: String,
    service: Uuid,
    /// The PostgreSQL that has the rows; none: the data directory has them.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    database: Option<String>,
}

/// Name of the mark in a prefix.
const MARK: &str = "rigcast.json";

/// Name of the file in a data directory that says which bucket it belongs to.
const BELONGS: &str = "bucket.json";

/// Objects are below this part of the prefix.
const OBJECTS: &str = "objects";

/// Bytes of one part of a large object; S3 takes parts of at least 5 MiB.
const PART: usize = 8 << 20;

/// Parts on their way at once.
const PARTS: usize = 4;

/// Time for a small step.
const STEP: Duration = Duration::from_secs(10);

/// Time for the answer to a look at whether the storage is there: who asks for `readyz` does not wait long.
const PING: Duration = Duration::from_secs(2);

/// Slowest transfer that is waited for, bytes a second.
const SLOWEST: u64 = 1 << 20;

/// An object of the bucket in a listing.
#[derive(Debug, Clone, Copy)]
pub(super) struct Listed {
    pub(super) bytes: u64,
    since: i64,
}

impl Bucket {
    /// Opens a bucket; nothing is sent yet.
    ///
    /// # Errors
    /// [`StoreError::Bucket`] for settings that cannot be.
    pub(super) fn open(settings: &BucketSettings) -> Result<Self, StoreError> {
        let refused = |what: String| StoreError::Bucket { bucket: without_secrets(&settings.url), what };
        let place = settings.url.strip_prefix("s3://").filter(|place| !place.contains(['@', '?', '#']));
        let place = place.ok_or_else(|| {
            refused(
                "write s3://bucket/prefix; keys belong into AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY"
                    .into(),
            )
        })?;
        let (bucket, prefix) = place.split_once('/').unwrap_or((place, ""));
        if bucket.is_empty() {
            return Err(refused("it names no bucket".into()));
        }
        let prefix = Key::parse(prefix.trim_end_matches('/')).map_err(|error| refused(error.to_string()))?;
        let client = ClientOptions::new()
            .with_connect_timeout(Duration::from_secs(3))
            .with_timeout(Duration::from_secs(60));
        let retry = RetryConfig { max_retries: 4, retry_timeout: STEP, ..RetryConfig::default() };
        let mut builder = AmazonS3Builder::from_env()
            .with_bucket_name(bucket)
            .with_virtual_hosted_style_request(settings.virtual_hosted)
            .with_checksum_algorithm(Checksum::SHA256)
            .with_client_options(client)
            .with_retry(retry);
        if let Some(region) = &settings.region {
            builder = builder.with_region(region);
        }
        if let Some(endpoint) = &settings.endpoint {
            builder = builder.with_endpoint(endpoint).with_allow_http(endpoint.starts_with("http://"));
        }
        let store = builder.build().map_err(|error| refused(in_words(&error)))?;
        Ok(Self::of(Arc::new(store), prefix, &settings.url, settings.cache_bytes))
    }

    /// Opens the bucket of a data directory; refuses one whose objects are in a bucket that is not named.
    ///
    /// # Errors
    /// [`StoreError::Bucket`].
    pub(super) fn of_data_dir(
        data_dir: &Path,
        settings: Option<&BucketSettings>,
    ) -> Result<Option<Self>, StoreError> {
        match settings {
            None => refuse_without(data_dir).map(|()| None),
            Some(settings) => Self::open(settings).map(Some),
        }
    }

    /// A bucket in any object store.
    pub(super) fn of(store: Arc<dyn ObjectStore>, prefix: Key, name: &str, cache_bytes: u64) -> Self {
        Self { store, prefix, name: name.trim_end_matches('/').into(), cache_bytes }
    }

    /// Bytes of objects that the local disk may hold.
    pub(super) fn cache_bytes(&self) -> u64 {
        self.cache_bytes
    }

    fn key(&self, digest: &str) -> Key {
        self.prefix.clone().join(OBJECTS).parts().chain(key(digest).parts()).collect()
    }

    fn failed(&self, error: &Error) -> StoreError {
        StoreError::Bucket { bucket: self.name.to_string(), what: in_words(error) }
    }

    /// Does a step that moves so many bytes within its time.
    async fn within<T>(
        &self,
        bytes: u64,
        step: impl Future<Output = Result<T, Error>>,
    ) -> Result<Result<T, Error>, StoreError> {
        self.in_time(STEP + Duration::from_secs(bytes / SLOWEST), step).await
    }

    async fn in_time<T>(
        &self,
        time: Duration,
        step: impl Future<Output = Result<T, Error>>,
    ) -> Result<Result<T, Error>, StoreError> {
        tokio::time::timeout(time, step).await.map_err(|_| StoreError::Bucket {
            bucket: self.name.to_string(),
            what: format!("no answer within {} s", time.as_secs()),
        })
    }

    /// As [`Bucket::within`], where every error is a failure.
    async fn done<T>(
        &self,
        bytes: u64,
        step: impl Future<Output = Result<T, Error>>,
    ) -> Result<T, StoreError> {
        self.within(bytes, step).await?.map_err(|error| self.failed(&error))
    }

    /// Stores the bytes of an object; the storage checks them against their SHA-256. One that is there is left
    /// unless it is to be mended.
    pub(super) async fn put(&self, digest: &str, bytes: Bytes, mend: bool) -> Result<(), StoreError> {
        let (size, key) = (bytes.len() as u64, self.key(digest));
        let mode = if mend { PutMode::Overwrite } else { PutMode::Create };
        let put = self.store.put_opts(&key, bytes.into(), mode.into());
        match self.within(size, put).await? {
            Ok(_) | Err(Error::AlreadyExists { .. }) => Ok(()),
            Err(error) => Err(self.failed(&error)),
        }
    }

    /// Stores the object of a file, in parts if it is large.
    pub(super) async fn put_file(
        &self,
        digest: &str,
        file: &Path,
        size: u64,
        mend: bool,
    ) -> Result<(), StoreError> {
        if size <= PART as u64 {
            let bytes = tokio::fs::read(file).await.map_err(failed(file))?;
            return self.put(digest, bytes.into(), mend).await;
        }
        let key = self.key(digest);
        if !mend && self.within(0, self.store.head(&key)).await?.is_ok_and(|there| there.size == size) {
            return Ok(());
        }
        let mut source = tokio::fs::File::open(file).await.map_err(failed(file))?;
        let parts = self.done(0, self.store.put_multipart(&key)).await?;
        let mut parts = WriteMultipart::new_with_chunk_size(parts, PART);
        let (mut left, mut piece) = (size, vec![0; 1 << 20]);
        while left > 0 {
            let n = source.read(&mut piece).await.map_err(failed(file))?;
            if n == 0 {
                let cut = std::io::Error::from(std::io::ErrorKind::UnexpectedEof);
                return Err(failed(file)(cut));
            }
            self.done(PART as u64, parts.wait_for_capacity(PARTS)).await?;
            parts.write(&piece[..n]);
            left -= (n as u64).min(left);
        }
        self.done(PART as u64 * PARTS as u64, parts.finish()).await?;
        Ok(())
    }

    /// Brings an object into a file of `scratch`, verified.
    ///
    /// # Errors
    /// [`StoreError::ObjectMissing`], [`StoreError::ObjectDamaged`], [`StoreError::Bucket`], the file system's errors.
    pub(super) async fn fetch(&self, digest: &str, scratch: &Path) -> Result<ObjectFile, StoreError> {
        let found = match self.within(0, self.store.get(&self.key(digest))).await? {
            Err(Error::NotFound { .. }) => {
                return Err(StoreError::ObjectMissing { digest: digest.to_owned() });
            }
            found => found.map_err(|error| self.failed(&error))?,
        };
        let (pieces, mut taken) = tokio::sync::mpsc::channel::<Bytes>(4);
        let scratch = scratch.to_owned();
        let file = tokio::spawn(off_thread(move || {
            ObjectFile::make(&scratch, |to| {
                while let Some(piece) = taken.blocking_recv() {
                    to.write_all(&piece)?;
                }
                Ok(())
            })
        }));
        let mut stream = found.into_stream();
        while let Some(piece) = self.done(PART as u64, stream.try_next()).await? {
            // The writer ends early only with an error, which it tells below.
            if pieces.send(piece).await.is_err() {
                break;
            }
        }
        drop(pieces);
        let file = file.await.map_err(|_| StoreError::Stopped)??;
        if file.digest().as_str() != digest {
            let (digest, found) = (digest.to_owned(), file.digest().as_str().to_owned());
            return Err(StoreError::ObjectDamaged { digest, found });
        }
        Ok(file)
    }

    /// Removes an object; a missing one is no error.
    pub(super) async fn remove(&self, digest: &str) -> Result<(), StoreError> {
        match self.within(0, self.store.delete(&self.key(digest))).await? {
            Ok(()) | Err(Error::NotFound { .. }) => Ok(()),
            Err(error) => Err(self.failed(&error)),
        }
    }

    /// All objects, by name.
    pub(super) async fn list(&self) -> Result<BTreeMap<String, Listed>, StoreError> {
        let below = self.prefix.clone().join(OBJECTS);
        let mut pages = self.store.list(Some(&below));
        let mut found = BTreeMap::new();
        while let Some(object) = self.done(0, pages.try_next()).await? {
            let Some(name) = object.location.filename() else { continue };
            if Digest::is_name(name) {
                let listed = Listed { bytes: object.size, since: object.last_modified.timestamp() };
                found.insert(name.to_owned(), listed);
            }
        }
        Ok(found)
    }

    /// Whether the storage answers, and the mark is there.
    pub(super) async fn ping(&self) -> Result<(), StoreError> {
        let mark = self.prefix.clone().join(MARK);
        let asked = self.in_time(PING, self.store.head(&mark)).await?;
        asked.map(|_| ()).map_err(|error| self.failed(&error))
    }

    /// Takes the prefix for the service of a data directory, or makes sure that it has it. `shared` has the name of the
    /// PostgreSQL of a registry, and the service that it belongs to.
    ///
    /// # Errors
    /// [`StoreError::Bucket`] if it belongs to another service, or the data directory to another bucket or database.
    pub(super) async fn claim(
        &self,
        data_dir: &Path,
        shared: Option<(&str, Uuid)>,
    ) -> Result<(), StoreError> {
        let refused = |what: String| StoreError::Bucket { bucket: self.name.to_string(), what };
        let known = belongs(data_dir)?;
        if let Some(known) = &known
            && known.url != *self.name
        {
            return Err(refused(format!(
                "the objects of {} are in {}. Start it with that bucket",
                data_dir.display(),
                known.url
            )));
        }
        let database = shared.map(|(database, _)| database.to_owned());
        if let Some(known) = &known
            && known.database != database
        {
            let place = match &known.database {
                Some(database) => format!("in {database}. Start it with that one as --database"),
                None => "in the directory itself. Start it without --database".into(),
            };
            return Err(refused(format!("the registry of {} is {place}", data_dir.display())));
        }
        let is_new = known.is_none();
        let service = known.map_or_else(Uuid::new_v4, |known| known.service);
        let service = shared.map_or(service, |(_, service)| service);
        if is_new {
            self.belong(data_dir, service, database).await?;
        }
        let marked = self.mark(service).await;
        if is_new && marked.is_err() {
            super::files::remove(&data_dir.join(BELONGS))?;
        }
        marked
    }

    /// Notes in a data directory that its objects are here, and its rows in `database`.
    pub(super) async fn belong(
        &self,
        data_dir: &Path,
        service: Uuid,
        database: Option<String>,
    ) -> Result<(), StoreError> {
        let belongs = Belongs { url: self.name.to_string(), service, database };
        let json = serde_json::to_vec(&belongs).expect("texts serialise");
        let path = data_dir.join(BELONGS);
        off_thread(move || super::files::write(&path, &json)).await
    }

    /// Marks the prefix as a service's, or makes sure that it is.
    ///
    /// # Errors
    /// [`StoreError::Bucket`] if it belongs to another service.
    pub(super) async fn mark(&self, service: Uuid) -> Result<(), StoreError> {
        let mark = self.prefix.clone().join(MARK);
        let json = serde_json::to_vec(&Mark { service }).expect("texts serialise");
        let put = self.store.put_opts(&mark, json.into(), PutMode::Create.into());
        let found = match self.within(0, put).await? {
            Ok(_) => return Ok(()),
            Err(Error::AlreadyExists { .. } | Error::Precondition { .. }) => {
                let found = self.done(0, async { self.store.get(&mark).await?.bytes().await }).await?;
                serde_json::from_slice::<Mark>(&found).ok().map(|mark| mark.service)
            }
            Err(error) => return Err(self.failed(&error)),
        };
        if found == Some(service) {
            return Ok(());
        }
        let what = format!(
            "it belongs to another Rigcast, so that this one would remove what it does not know. Choose another prefix, or \
             restore the data directory that the mark {MARK} in the bucket belongs to"
        );
        Err(StoreError::Bucket { bucket: self.name.to_string(), what })
    }
}

impl Listed {
    /// Whether it has been there for more than a week.
    pub(super) fn is_old(self, now: Timestamp) -> bool {
        let since = SignedDuration::from_secs(self.since);
        now.as_duration().saturating_sub(since) > KEPT
    }
}

/// Refuses a data directory whose objects are in a bucket, if none is named.
///
/// # Errors
/// [`StoreError::Bucket`].
pub(super) fn refuse_without(data_dir: &Path) -> Result<(), StoreError> {
    match belongs(data_dir)? {
        None => Ok(()),
        Some(known) => {
            let what = format!("the objects of {} are there: name it with --objects", data_dir.display());
            Err(StoreError::Bucket { bucket: known.url, what })
        }
    }
}

/// The service that a data directory's bucket is marked with; `None`: its objects are in itself.
///
/// # Errors
/// The file system's errors.
pub(super) fn service_of(data_dir: &Path) -> Result<Option<Uuid>, StoreError> {
    Ok(belongs(data_dir)?.map(|known| known.service))
}

fn belongs(data_dir: &Path) -> Result<Option<Belongs>, StoreError> {
    let path = data_dir.join(BELONGS);
    match std::fs::read(&path) {
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => Ok(None),
        read => {
            let read = read.map_err(failed(&path))?;
            let damaged = |error: serde_json::Error| StoreError::Damaged { path, what: error.to_string() };
            serde_json::from_slice(&read).map(Some).map_err(damaged)
        }
    }
}

/// A URL without what may be a key in it.
fn without_secrets(url: &str) -> String {
    match url.rsplit_once('@') {
        None => url.split(['?', '#']).next().unwrap_or_default().to_owned(),
        Some((_, place)) => format!("s3://...@{}", place.split(['?', '#']).next().unwrap_or_default()),
    }
}

/// The innermost cause that says something, without the request.
fn in_words(error: &Error) -> String {
    match error {
        Error::PermissionDenied { .. } | Error::Unauthenticated { .. } => {
            "the keys may not read or write it".into()
        }
        Error::NotFound { .. } => "there is no such bucket, or its mark is gone".into(),
        other => {
            let mut cause: &dyn std::error::Error = other;
            while let Some(inner) = cause.source() {
                cause = inner;
            }
            let words = cause.to_string();
            words.lines().next().unwrap_or_default().chars().take(200).collect()
        }
    }
}

#[cfg(test)]
mod tests {
    use std::fmt;
    use std::sync::atomic::{AtomicBool, Ordering};

    use futures::StreamExt as _;
    use futures::stream::BoxStream;
    use object_store::memory::InMemory;
    use object_store::{
        CopyOptions, GetOptions, GetResult, ListResult, MultipartUpload, ObjectMeta, PutMultipartOptions,
        PutOptions, PutPayload, PutResult, Result as Done,
    };

    use super::super::testing::{TestStore, draft, now};
    use super::super::{PreparedRun, RunInsert};
    use super::*;
    use crate::domain::Rig;

    /// Storage that may go away.
    #[derive(Debug, Default)]
    struct Storage {
        inner: InMemory,
        away: AtomicBool,
    }

    impl Storage {
        fn check(&self) -> Done<()> {
            if self.away.load(Ordering::Relaxed) {
                return Err(Error::Generic { store: "test", source: "it answers 500".into() });
            }
            Ok(())
        }
    }

    impl fmt::Display for Storage {
        fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
            write!(f, "storage of a test")
        }
    }

    #[async_trait::async_trait]
    impl ObjectStore for Storage {
        async fn put_opts(&self, to: &Key, bytes: PutPayload, options: PutOptions) -> Done<PutResult> {
            self.check()?;
            self.inner.put_opts(to, bytes, options).await
        }

        async fn put_multipart_opts(
            &self,
            to: &Key,
            options: PutMultipartOptions,
        ) -> Done<Box<dyn MultipartUpload>> {
            self.check()?;
            self.inner.put_multipart_opts(to, options).await
        }

        async fn get_opts(&self, from: &Key, options: GetOptions) -> Done<GetResult> {
            self.check()?;
            self.inner.get_opts(from, options).await
        }

        fn delete_stream(&self, these: BoxStream<'static, Done<Key>>) -> BoxStream<'static, Done<Key>> {
            match self.check() {
                Ok(()) => self.inner.delete_stream(these),
                Err(away) => futures::stream::once(async { Err(away) }).boxed(),
            }
        }

        fn list(&self, below: Option<&Key>) -> BoxStream<'static, Done<ObjectMeta>> {
            self.inner.list(below)
        }

        async fn list_with_delimiter(&self, below: Option<&Key>) -> Done<ListResult> {
            self.inner.list_with_delimiter(below).await
        }

        async fn copy_opts(&self, from: &Key, to: &Key, options: CopyOptions) -> Done<()> {
            self.inner.copy_opts(from, to, options).await
        }
    }

    fn bucket(storage: &Arc<Storage>, cache_bytes: u64) -> Bucket {
        let storage = Arc::clone(storage) as Arc<dyn ObjectStore>;
        Bucket::of(storage, Key::from("lab/one"), "s3://bucket/lab/one", cache_bytes)
    }

    const ROOM: u64 = 1 << 30;

    async fn rig(store: &TestStore) -> Rig {
        store.insert_rig(&draft("bench"), None, now()).await.unwrap().unwrap()
    }

    #[tokio::test]
    async fn what_the_local_disk_lacks_or_has_damaged_comes_from_the_bucket() {
        let storage = Arc::<Storage>::default();
        let store = TestStore::open_in(bucket(&storage, ROOM)).await;
        let rig = rig(&store).await;
        let run = store.upload(&rig, &[1.0, 2.0]).await.run;
        let model = store.import(&rig, b"weights").await;
        let listed = bucket(&storage, ROOM).list().await.unwrap();
        assert_eq!(
            listed.keys().collect::<std::collections::BTreeSet<_>>(),
            [&run.object, &model.sha256].into()
        );
        let copy = store.objects().path_of(&run.object);
        let whole = std::fs::read(&copy).unwrap();
        for damage in [None, Some(b"other".as_slice()), Some(b"".as_slice())] {
            match damage {
                None => std::fs::remove_file(&copy).unwrap(),
                Some(bytes) => std::fs::write(&copy, bytes).unwrap(),
            }
            assert_eq!(store.load_signal(&run).await.unwrap().channel(0), [1.0, 2.0]);
            assert_eq!(std::fs::read(&copy).unwrap(), whole);
        }
        std::fs::write(store.objects().path_of(&model.sha256), b"other").unwrap();
        assert_eq!(store.weights(&model).await.unwrap(), b"weights"[..]);
        assert_eq!(store.corrupt_objects().await.unwrap(), []);
        // Damaged in both: it is told, and storing it again mends both.
        let key = bucket(&storage, ROOM).key(&model.sha256);
        storage.inner.put(&key, Bytes::from_static(b"bad").into()).await.unwrap();
        std::fs::remove_file(store.objects().path_of(&model.sha256)).unwrap();
        assert!(matches!(store.weights(&model).await, Err(StoreError::ObjectDamaged { .. })));
        assert_eq!(store.corrupt_objects().await.unwrap().len(), 1);
        store.import(&rig, b"weights").await;
        assert_eq!(store.weights(&model).await.unwrap(), b"weights"[..]);
        assert_eq!(bucket(&storage, ROOM).list().await.unwrap()[&model.sha256].bytes, 7);
        assert!(store.delete_run(&rig.id, run.id).await.unwrap());
        assert!(!bucket(&storage, ROOM).list().await.unwrap().contains_key(&run.object));
    }

    #[tokio::test]
    async fn a_prefix_belongs_to_one_service_and_a_data_directory_to_one_bucket() {
        let storage = Arc::<Storage>::default();
        let store = TestStore::open_in(bucket(&storage, ROOM)).await;
        bucket(&storage, ROOM).ping().await.unwrap();
        let other = tempfile::tempdir().unwrap();
        let refused = bucket(&storage, ROOM).claim(other.path(), None).await.unwrap_err().to_string();
        assert!(refused.contains("belongs to another Rigcast"), "{refused}");
        assert!(!other.path().join(BELONGS).exists(), "the refused one may take another prefix");
        let data_dir = store.data_dir();
        bucket(&storage, ROOM).claim(data_dir, None).await.unwrap();
        let without = refuse_without(data_dir).unwrap_err().to_string();
        assert!(without.contains("name it with --objects"), "{without}");
        let elsewhere = Bucket::of(Arc::<Storage>::default(), Key::from("x"), "s3://x", ROOM);
        let refused = elsewhere.claim(data_dir, None).await.unwrap_err().to_string();
        assert!(refused.contains("s3://bucket/lab/one"), "{refused}");
    }

    #[tokio::test]
    async fn while_the_storage_is_away_copies_are_read_and_uploads_refused() {
        let storage = Arc::<Storage>::default();
        let store = TestStore::open_in(bucket(&storage, ROOM)).await;
        let rig = rig(&store).await;
        let run = store.upload(&rig, &[1.0, 2.0]).await.run;
        storage.away.store(true, Ordering::Relaxed);
        assert!(store.ping().await.unwrap() && store.ping_bucket().await.is_err());
        assert_eq!(store.load_signal(&run).await.unwrap().channel(0), [1.0, 2.0]);
        let prepared: PreparedRun = store.prepare(&rig, super::super::testing::meta(), &[3.0]);
        let refused = store.insert_run(&rig.id, prepared, None, None, now()).await.unwrap_err();
        assert!(refused.is_unavailable() && refused.to_string().contains("it answers 500"), "{refused}");
        // A run is gone for those who ask, and its object with the next orderly stop after a week.
        assert!(store.delete_run(&rig.id, run.id).await.unwrap());
        storage.away.store(false, Ordering::Relaxed);
        assert!(bucket(&storage, ROOM).list().await.unwrap().contains_key(&run.object));
        store.empty_quarantine(Timestamp::now() + SignedDuration::from_hours(8 * 24)).await.unwrap();
        assert!(bucket(&storage, ROOM).list().await.unwrap().is_empty());
        let prepared = store.prepare(&rig, super::super::testing::meta(), &[3.0]);
        let stored = store.insert_run(&rig.id, prepared, None, None, now()).await.unwrap();
        assert!(matches!(stored, RunInsert::Inserted(_)));
        store.ping_bucket().await.unwrap();
    }

    #[tokio::test]
    async fn a_data_directory_moves_into_a_bucket_and_keeps_the_copies_that_were_used_last() {
        let storage = Arc::<Storage>::default();
        let store = TestStore::open_sqlite().await;
        let rig = rig(&store).await;
        let mut runs = Vec::new();
        for i in 0..4 {
            runs.push(store.upload(&rig, &[f64::from(i); 1000]).await.run);
        }
        // The fifth is as large as a part.
        let large: Vec<f64> = (0..600_000).map(f64::from).collect();
        runs.push(store.upload(&rig, &large).await.run);
        let held = || async { store_files(&store).len() };
        assert_eq!(held().await, 5);
        let store = store.reopened_in(bucket(&storage, 40_000)).await;
        assert_eq!(bucket(&storage, ROOM).list().await.unwrap().len(), 5);
        assert!(store_files(&store).len() < 3, "they would take more than they may");
        for run in &runs {
            assert_eq!(store.load_signal(run).await.unwrap().n_samples() as u64, run.samples);
        }
        assert!(!store_files(&store).is_empty() && store_files(&store).len() < 3);
        // An object that no row names is kept for a week.
        bucket(&storage, ROOM).put(Digest::of(b"x").as_str(), Bytes::from_static(b"x"), false).await.unwrap();
        store.empty_quarantine(Timestamp::now()).await.unwrap();
        assert_eq!(bucket(&storage, ROOM).list().await.unwrap().len(), 6);
        store.empty_quarantine(Timestamp::now() + SignedDuration::from_hours(8 * 24)).await.unwrap();
        assert_eq!(bucket(&storage, ROOM).list().await.unwrap().len(), 5);
    }

    fn store_files(store: &TestStore) -> Vec<std::path::PathBuf> {
        super::super::objects::all_below(&store.data_dir().join("objects")).unwrap()
    }

    #[test]
    fn settings_that_cannot_be_are_refused_without_telling_keys() {
        let open = |url: &str| {
            let settings = BucketSettings {
                url: url.into(),
                endpoint: None,
                region: None,
                virtual_hosted: false,
                cache_bytes: ROOM,
            };
            Bucket::open(&settings).map(|bucket| bucket.name.to_string()).map_err(|error| error.to_string())
        };
        assert_eq!(open("s3://bucket/lab/").unwrap(), "s3://bucket/lab");
        assert_eq!(open("s3://bucket").unwrap(), "s3://bucket");
        for (url, words) in [
            ("bucket/lab", "write s3://bucket/prefix"),
            ("s3://", "it names no bucket"),
            ("s3://AKIA:hunter2@bucket/lab", "keys belong into"),
            ("s3://bucket/lab?secret=hunter2", "keys belong into"),
        ] {
            let refused = open(url).unwrap_err();
            assert!(refused.contains(words) && !refused.contains("hunter2"), "{refused}");
        }
    }
}
