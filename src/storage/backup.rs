//! Backup and restore of a data directory, which may be in use.
//!
//! A backup is a directory of the same form: a copy of the database as of one moment, every object that
//! it refers to, verified, and a manifest. The manifest is written last, so that a backup without it is
//! incomplete.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

use bytes::Bytes;
use jiff::Timestamp;
use serde::{Deserialize, Serialize};
use sqlx::sqlite::{SqliteConnectOptions, SqlitePoolOptions};
use sqlx::{Connection, SqliteConnection};

use super::objects::{Objects, REFERENCED, off_thread};
use super::store::{BUSY_TIMEOUT, check_integrity};
use super::{Digest, Store, StoreError};

const DATABASE: &str = "rigcast.db";
const MANIFEST: &str = "backup.json";

/// How often the database is copied again because objects of the last copy were removed meanwhile.
const SNAPSHOTS: usize = 5;

/// The manifest of a backup.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Manifest {
    /// When its database was copied.
    pub created_at: Timestamp,
    /// Program that made it.
    pub code_version: String,
    /// SHA-256 of the database, hex.
    pub database_sha256: String,
    /// Objects that the database refers to.
    pub objects: u64,
    /// Their bytes.
    pub bytes: u64,
}

/// Backs a data directory up into `target`, which must be empty or missing. A service may run on
/// it.
///
/// # Errors
/// A missing or damaged database; a missing or damaged object, by name; a target that is not empty; the
/// file system's errors.
pub async fn backup(data_dir: &Path, target: &Path, now: Timestamp) -> Result<Manifest, StoreError> {
    if !Store::exists(data_dir) {
        let what = format!("it has no {DATABASE}; name the one that `rigcast serve` uses with --data-dir");
        return Err(something_else(data_dir, "data directory", what));
    }
    empty(target)?;
    let objects = target.join("objects");
    std::fs::create_dir_all(&objects).map_err(failed(&objects))?;
    let (from, to) = (Objects::open(&data_dir.join("objects"))?, Objects::open(&objects)?);
    let copy = target.join(DATABASE);
    for attempt in 1.. {
        snapshot(&data_dir.join(DATABASE), &copy).await?;
        let wanted = referenced(&copy).await?;
        match copy_objects(&from, &to, &wanted).await {
            // A run or model was deleted after the copy; a new copy does not name it.
            Err(StoreError::ObjectMissing { .. }) if attempt < SNAPSHOTS => {}
            Err(error) => return Err(error),
            Ok(bytes) => {
                to.retain(&wanted)?;
                let manifest = Manifest {
                    created_at: now,
                    code_version: crate::VERSION.into(),
                    database_sha256: digest(&copy).await?,
                    objects: wanted.len() as u64,
                    bytes,
                };
                let json = serde_json::to_vec_pretty(&manifest).expect("text and numbers always serialise");
                write(&target.join(MANIFEST), &json)?;
                return Ok(manifest);
            }
        }
    }
    unreachable!("the last attempt answers")
}

/// Makes a data directory, which must be empty or missing, from a backup. The database comes last, so
/// that no service starts on an interrupted restore.
///
/// # Errors
/// A missing or damaged backup; a data directory that is not empty; the file system's errors.
pub async fn restore(source: &Path, data_dir: &Path) -> Result<Manifest, StoreError> {
    let manifest = manifest_of(source)?;
    let database = source.join(DATABASE);
    if digest(&database).await? != manifest.database_sha256 {
        return Err(damaged(&database, "its bytes are not those that were backed up".into()));
    }
    empty(data_dir)?;
    let objects = data_dir.join("objects");
    std::fs::create_dir_all(&objects).map_err(failed(&objects))?;
    let (from, to) = (Objects::open(&source.join("objects"))?, Objects::open(&objects)?);
    // Opening a database may write files beside it, and the backup must stay as it is.
    let copy = data_dir.join("rigcast.db.restoring");
    let bytes = std::fs::read(&database).map_err(failed(&database))?;
    write(&copy, &bytes)?;
    copy_objects(&from, &to, &referenced(&copy).await?).await?;
    let place = data_dir.join(DATABASE);
    std::fs::rename(&copy, &place).map_err(failed(&place))?;
    sync_directory(data_dir)?;
    Ok(manifest)
}

/// Reads the manifest of a backup. For anything else the error says what it is.
fn manifest_of(source: &Path) -> Result<Manifest, StoreError> {
    let no_backup = |what: String| something_else(source, "backup", what);
    if !source.exists() {
        return Err(no_backup("there is nothing of that name".into()));
    }
    if !source.is_dir() {
        return Err(no_backup("it is a file; a backup is the directory that `rigcast backup` made".into()));
    }
    let path = source.join(MANIFEST);
    let json = match std::fs::read(&path) {
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => {
            let data_dir = Store::exists(source) && source.join("lock").exists();
            return Err(no_backup(match (data_dir, Store::exists(source)) {
                (true, _) => "it is a data directory; `rigcast backup` makes a backup of it".into(),
                (_, true) => format!("it has no {MANIFEST}: the backup was cut short"),
                _ => format!("it has no {MANIFEST}"),
            }));
        }
        read => read.map_err(failed(&path))?,
    };
    serde_json::from_slice(&json).map_err(|error| damaged(&path, format!("it is no manifest: {error}")))
}

fn something_else(path: &Path, wanted: &'static str, what: String) -> StoreError {
    StoreError::SomethingElse { path: path.to_owned(), wanted, what }
}

/// Copies a database as of one moment, even while others write to it.
async fn snapshot(database: &Path, copy: &Path) -> Result<(), StoreError> {
    match std::fs::remove_file(copy) {
        Err(error) if error.kind() != std::io::ErrorKind::NotFound => return Err(failed(copy)(error)),
        _ => {}
    }
    let options = SqliteConnectOptions::new().filename(database).busy_timeout(BUSY_TIMEOUT);
    let mut connection = SqliteConnection::connect_with(&options).await?;
    sqlx::query("VACUUM INTO ?").bind(copy.to_string_lossy().as_ref()).execute(&mut connection).await?;
    connection.close().await?;
    std::fs::File::open(copy).and_then(|file| file.sync_all()).map_err(failed(copy))?;
    sync_directory(copy.parent().unwrap_or(Path::new(".")))
}

/// Names of all objects that a database refers to.
async fn referenced(database: &Path) -> Result<BTreeSet<String>, StoreError> {
    let options = SqliteConnectOptions::new().filename(database).read_only(true).immutable(true);
    let pool = SqlitePoolOptions::new().max_connections(1).connect_with(options).await?;
    check_integrity(&pool, database).await?;
    let names: Vec<String> = sqlx::query_scalar(REFERENCED).fetch_all(&pool).await?;
    pool.close().await;
    Ok(names.into_iter().collect())
}

/// Copies objects and returns their size in bytes. Each is verified when read, and durable when this
/// returns.
async fn copy_objects(from: &Objects, to: &Objects, wanted: &BTreeSet<String>) -> Result<u64, StoreError> {
    let mut total = 0;
    for name in wanted {
        let bytes: Bytes = match to.get(name).await {
            Ok(there) => there,
            Err(_) => {
                let bytes = from.get(name).await?;
                to.put(&Digest::of(&bytes), bytes.clone()).await?;
                bytes
            }
        };
        total += bytes.len() as u64;
    }
    Ok(total)
}

async fn digest(file: &Path) -> Result<String, StoreError> {
    let file = file.to_owned();
    off_thread(move || {
        let bytes = std::fs::read(&file).map_err(failed(&file))?;
        Ok(Digest::of(&bytes).as_str().to_owned())
    })
    .await
}

/// Writes a file atomically: it is complete or not there.
fn write(path: &Path, bytes: &[u8]) -> Result<(), StoreError> {
    use std::io::Write;
    let directory = path.parent().unwrap_or(Path::new("."));
    let mut file = tempfile::NamedTempFile::new_in(directory).map_err(failed(directory))?;
    file.write_all(bytes).and_then(|()| file.as_file().sync_all()).map_err(failed(path))?;
    file.persist(path).map_err(|error| failed(path)(error.error))?;
    sync_directory(directory)
}

fn sync_directory(directory: &Path) -> Result<(), StoreError> {
    std::fs::File::open(directory).and_then(|file| file.sync_all()).map_err(failed(directory))
}

/// Refuses a directory that holds anything.
fn empty(directory: &Path) -> Result<(), StoreError> {
    match std::fs::read_dir(directory).map(|mut entries| entries.next().is_none()) {
        Ok(true) => Ok(()),
        Ok(false) => {
            let error = std::io::Error::from(std::io::ErrorKind::DirectoryNotEmpty);
            Err(failed(directory)(error))
        }
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => Ok(()),
        Err(error) => Err(failed(directory)(error)),
    }
}

fn failed(path: &Path) -> impl FnOnce(std::io::Error) -> StoreError + use<> {
    let path: PathBuf = path.to_owned();
    move |source| StoreError::DataDir { path, source }
}

fn damaged(path: &Path, what: String) -> StoreError {
    StoreError::Damaged { path: path.to_owned(), what }
}

#[cfg(test)]
mod tests {
    use super::super::testing::{TestStore, draft, now};
    use super::*;
    use crate::domain::PageRequest;

    fn objects_of(directory: &Path) -> BTreeSet<(String, Vec<u8>)> {
        let mut found = BTreeSet::new();
        for folder in std::fs::read_dir(directory.join("objects")).unwrap() {
            for file in std::fs::read_dir(folder.unwrap().path()).unwrap() {
                let path = file.unwrap().path();
                let name = path.file_name().unwrap().to_str().unwrap().to_owned();
                found.insert((name, std::fs::read(path).unwrap()));
            }
        }
        found
    }

    /// A store with a run and a model, and a directory for backups.
    async fn lab() -> (TestStore, tempfile::TempDir) {
        let store = TestStore::open().await;
        let rig = store.insert_rig(&draft("bench"), None, now()).await.unwrap().unwrap();
        store.upload(&rig, &[1.0, 2.0]).await;
        store.import(&rig, b"weights").await;
        (store, tempfile::tempdir().unwrap())
    }

    #[tokio::test]
    async fn what_is_restored_is_what_was_backed_up_while_the_service_ran() {
        let (store, dir) = lab().await;
        let rig = store.rig(&"bench".parse().unwrap()).await.unwrap().unwrap();
        let (copy, again) = (dir.path().join("backup"), dir.path().join("again"));
        let manifest = backup(store.data_dir(), &copy, now()).await.unwrap();
        assert_eq!(manifest.objects, 2);
        // Later additions are not in the backup; later deletions still are.
        store.upload(&rig, &[3.0]).await;
        let run = store.all_runs(&rig.id).await.unwrap().remove(0);
        store.delete_run(&rig.id, run.id).await.unwrap();
        assert_eq!(restore(&copy, &again).await.unwrap(), manifest);
        assert_eq!(objects_of(&copy), objects_of(&again));
        let restored = Store::open(&again).await.unwrap();
        let runs = restored.all_runs(&rig.id).await.unwrap();
        assert_eq!((runs.len(), runs[0].id), (1, run.id));
        assert_eq!(restored.load_signal(&run).await.unwrap().channel(0), [1.0, 2.0]);
        let models = restored.models(&rig.id, &PageRequest::default()).await.unwrap().unwrap();
        assert_eq!(restored.weights(&models.items[0]).await.unwrap(), b"weights"[..]);
        restored.insert_rig(&draft("new"), None, now()).await.unwrap().unwrap();
    }

    #[tokio::test]
    async fn a_directory_that_holds_something_is_not_written_to() {
        let (store, dir) = lab().await;
        let copy = dir.path().join("backup");
        backup(store.data_dir(), &copy, now()).await.unwrap();
        let refused = backup(store.data_dir(), &copy, now()).await.unwrap_err().to_string();
        assert!(refused.contains("not empty"), "{refused}");
        let refused = restore(&copy, store.data_dir()).await.unwrap_err().to_string();
        assert!(refused.contains("not empty"), "{refused}");
        let none = backup(&dir.path().join("nowhere"), &dir.path().join("b"), now()).await.unwrap_err();
        assert!(none.to_string().contains("nowhere is no data directory: it has no rigcast.db"), "{none}");
        assert!(!dir.path().join("b").exists());
    }

    #[tokio::test]
    async fn a_restore_of_something_else_says_what_it_is_and_makes_nothing() {
        let (store, dir) = lab().await;
        let (file, empty, cut) = (dir.path().join("file"), dir.path().join("empty"), dir.path().join("cut"));
        std::fs::write(&file, b"x").unwrap();
        std::fs::create_dir(&empty).unwrap();
        backup(store.data_dir(), &cut, now()).await.unwrap();
        std::fs::remove_file(cut.join(MANIFEST)).unwrap();
        let target = dir.path().join("target");
        for (source, words) in [
            (dir.path().join("nowhere"), "nowhere is no backup: there is nothing of that name"),
            (file, "file is no backup: it is a file"),
            (empty, "empty is no backup: it has no backup.json"),
            (cut, "the backup was cut short"),
            (store.data_dir().to_owned(), "it is a data directory; `rigcast backup`"),
        ] {
            let refused = restore(&source, &target).await.unwrap_err().to_string();
            assert!(refused.contains(words), "{refused}");
            assert!(!target.exists());
        }
    }

    #[tokio::test]
    async fn every_flipped_byte_of_a_backup_is_found_and_nothing_is_started_on_it() {
        let (store, dir) = lab().await;
        let copy = dir.path().join("backup");
        backup(store.data_dir(), &copy, now()).await.unwrap();
        let object = objects_of(&copy).into_iter().next().unwrap().0;
        let files = [copy.join(DATABASE), copy.join("objects").join(&object[..2]).join(&object)];
        for (i, file) in files.iter().enumerate() {
            let whole = std::fs::read(file).unwrap();
            for at in (0..whole.len()).step_by(whole.len() / 7) {
                let mut flipped = whole.clone();
                flipped[at] ^= 1;
                std::fs::write(file, flipped).unwrap();
                let target = dir.path().join(format!("restored-{i}-{at}"));
                assert!(restore(&copy, &target).await.is_err(), "{file:?}, byte {at}");
                assert!(!target.join(DATABASE).exists());
            }
            std::fs::write(file, whole).unwrap();
        }
        std::fs::remove_file(copy.join(MANIFEST)).unwrap();
        let cut = restore(&copy, &dir.path().join("cut")).await;
        assert!(cut.is_err(), "a backup that was cut short has no manifest");
    }

    #[tokio::test]
    async fn a_damaged_object_is_named_and_not_backed_up() {
        let (store, dir) = lab().await;
        let (object, _) = objects_of(store.data_dir()).into_iter().next().unwrap();
        let path = store.data_dir().join("objects").join(&object[..2]).join(&object);
        std::fs::write(path, b"other").unwrap();
        let target = dir.path().join("backup");
        let refused = backup(store.data_dir(), &target, now()).await.unwrap_err().to_string();
        assert!(refused.contains(&object), "{refused}");
        assert!(!target.join(MANIFEST).exists());
    }
}
