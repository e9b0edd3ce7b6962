//! Objects that no row names. They are put aside, not deleted: the row may have been lost and not the object.

use std::collections::BTreeSet;
use std::io;
use std::path::{Path, PathBuf};
use std::time::UNIX_EPOCH;

use jiff::{SignedDuration, Timestamp};

use super::files::{self, failed};
use super::objects::{off_thread, place};
use super::{Store, StoreError};

/// How long an object is kept after it was put aside.
pub(super) const KEPT: SignedDuration = SignedDuration::from_hours(7 * 24);

fn directory(data_dir: &Path) -> PathBuf {
    data_dir.join("quarantine")
}

/// Puts an object aside. Its week begins now, by the clock of the file system.
///
/// # Errors
/// The file system's errors.
pub(super) fn put_aside(data_dir: &Path, object: &Path) -> Result<(), StoreError> {
    let directory = directory(data_dir);
    std::fs::create_dir_all(&directory).map_err(failed(&directory))?;
    let Some(name) = object.file_name() else { return Ok(()) };
    files::touch(object)?;
    std::fs::rename(object, directory.join(name)).map_err(failed(object))
}

/// Puts those of `wanted` back that are missing among the objects.
///
/// # Errors
/// The file system's errors.
pub(super) fn bring_back(data_dir: &Path, wanted: &BTreeSet<String>) -> Result<(), StoreError> {
    for (name, path) in files(data_dir)? {
        let place = place(&data_dir.join("objects"), &name);
        if wanted.contains(&name) && !place.exists() {
            let folder = place.parent().unwrap_or(data_dir);
            std::fs::create_dir_all(folder).map_err(failed(folder))?;
            std::fs::rename(&path, &place).map_err(failed(&place))?;
            tracing::warn!(object.digest = name, "an object that a row names was brought back");
        }
    }
    Ok(())
}

/// Names and paths of the objects that were put aside.
fn files(data_dir: &Path) -> Result<Vec<(String, PathBuf)>, StoreError> {
    let directory = directory(data_dir);
    let entries = match std::fs::read_dir(&directory) {
        Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(Vec::new()),
        entries => entries.map_err(failed(&directory))?,
    };
    let mut files = Vec::new();
    for entry in entries {
        let path = entry.map_err(failed(&directory))?.path();
        if let Some(name) = path.file_name().and_then(|name| name.to_str()) {
            files.push((name.to_owned(), path));
        }
    }
    files.sort();
    Ok(files)
}

impl Store {
    /// Names of the objects that were put aside because no row names them.
    ///
    /// # Errors
    /// The file system's errors.
    pub async fn quarantined(&self) -> Result<Vec<String>, StoreError> {
        let data_dir = self.data_dir().to_owned();
        off_thread(move || Ok(files(&data_dir)?.into_iter().map(|(name, _)| name).collect())).await
    }

    /// Deletes what was put aside more than a week before `now`, in the bucket what no row names and was stored before
    /// then. For an orderly stop, never after a crash.
    ///
    /// # Errors
    /// The file system's errors, a bucket out of reach.
    pub async fn empty_quarantine(&self, now: Timestamp) -> Result<(), StoreError> {
        self.sweep_bucket(now).await?;
        let data_dir = self.data_dir().to_owned();
        off_thread(move || {
            for (name, path) in files(&data_dir)? {
                let since =
                    std::fs::metadata(&path).and_then(|file| file.modified()).map_err(failed(&path))?;
                let since = since.duration_since(UNIX_EPOCH).unwrap_or_default();
                let since = SignedDuration::try_from(since).unwrap_or(SignedDuration::MAX);
                if now.as_duration().saturating_sub(since) > KEPT {
                    tracing::info!(object.digest = name, "deleted an object that no row named for a week");
                    files::remove(&path)?;
                }
            }
            Ok(())
        })
        .await
    }
}
