//! Steps on files and directories whose errors name the path.

use std::fs::File;
use std::io::{self, ErrorKind};
use std::path::Path;

use rustix::fs::{AtFlags, CWD, Timespec, Timestamps, UTIME_NOW, utimensat};

use super::StoreError;

/// The error of a failed step on a path.
pub(super) fn failed(path: &Path) -> impl FnOnce(io::Error) -> StoreError + use<> {
    let path = path.to_owned();
    move |source| StoreError::DataDir { path, source }
}

/// Makes new, renamed and removed entries of a directory durable.
///
/// # Errors
/// The file system's errors.
pub(super) fn sync_directory(directory: &Path) -> Result<(), StoreError> {
    File::open(directory).and_then(|directory| directory.sync_all()).map_err(failed(directory))
}

/// Removes a file; a missing one is no error.
///
/// # Errors
/// The file system's errors.
pub(super) fn remove(path: &Path) -> Result<(), StoreError> {
    match std::fs::remove_file(path) {
        Err(error) if error.kind() != ErrorKind::NotFound => Err(failed(path)(error)),
        _ => Ok(()),
    }
}

/// Writes a file atomically: it is complete or not there.
///
/// # Errors
/// The file system's errors.
pub(super) fn write(path: &Path, bytes: &[u8]) -> Result<(), StoreError> {
    use std::io::Write;
    let directory = path.parent().unwrap_or(Path::new("."));
    let mut file = tempfile::NamedTempFile::new_in(directory).map_err(failed(directory))?;
    file.write_all(bytes).and_then(|()| file.as_file().sync_all()).map_err(failed(path))?;
    file.persist(path).map_err(|error| failed(path)(error.error))?;
    sync_directory(directory)
}

/// Sets the times of a file to now, by the clock of the file system.
///
/// # Errors
/// The file system's errors.
pub(super) fn touch(path: &Path) -> Result<(), StoreError> {
    let now = Timespec { tv_sec: 0, tv_nsec: UTIME_NOW };
    let times = Timestamps { last_access: now, last_modification: now };
    utimensat(CWD, path, &times, AtFlags::empty()).map_err(|error| failed(path)(error.into()))
}
