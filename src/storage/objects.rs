//! Objects: immutable bytes, named by their SHA-256, verified whenever they are read.

use bytes::Bytes;

use super::StoreError;

/// SHA-256 of some bytes, as 64 lower-case hex digits.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub struct Digest(String);

impl Digest {
    /// Digest of `bytes`.
    pub fn of(_bytes: &[u8]) -> Self {
        todo!()
    }

    /// As hex.
    pub fn as_str(&self) -> &str {
        &self.0
    }
}

/// The object files of a data directory.
#[derive(Debug, Clone)]
pub struct Objects {}

impl Objects {
    /// Stores `bytes` durably under their digest; storing the same bytes again changes nothing.
    ///
    /// # Errors
    /// The file system's refusals; nothing half-written is ever visible.
    pub async fn put(&self, _digest: &Digest, _bytes: Bytes) -> Result<(), StoreError> {
        todo!()
    }

    /// Reads an object and verifies its digest.
    ///
    /// # Errors
    /// [`StoreError::ObjectMissing`], [`StoreError::ObjectDamaged`], the file system's refusals.
    pub async fn get(&self, _digest: &str) -> Result<Bytes, StoreError> {
        todo!()
    }
}
