//! The manifest of a backup.

use std::path::Path;

use jiff::Timestamp;
use serde::{Deserialize, Serialize};

use super::{UNFINISHED, damaged, something_else};
use crate::storage::files::failed;
use crate::storage::{Store, StoreError};

pub(super) const MANIFEST: &str = "backup.json";

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

/// Reads the manifest of a backup. For anything else the error says what it is.
pub(super) fn of(source: &Path) -> Result<Manifest, StoreError> {
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
            let cut_short = source.join(UNFINISHED).exists() || Store::exists(source);
            return Err(no_backup(match (data_dir, cut_short) {
                (true, _) => "it is a data directory; `rigcast backup` makes a backup of it".into(),
                (_, true) => format!(
                    "it has no {MANIFEST}: the backup was cut short. `rigcast backup` into the same directory goes on with it"
                ),
                _ => format!("it has no {MANIFEST}"),
            }));
        }
        read => read.map_err(failed(&path))?,
    };
    serde_json::from_slice(&json).map_err(|error| damaged(&path, format!("it is no manifest: {error}")))
}
