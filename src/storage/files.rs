//! Steps on files and directories whose errors name the path.

use std::fs::File;
use std::io::{self, ErrorKind};
use std::path::Path;

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
