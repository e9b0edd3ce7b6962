//! New objects too large for memory: written piece by piece to a temporary file, hashed on the way, and put in
//! their place when they are whole.

use std::fs::Permissions;
use std::io::{self, Write};
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};

use sha2::{Digest as _, Sha256};
use tempfile::NamedTempFile;

use super::files::{failed, sync_directory};
use super::{Digest, StoreError};

/// A whole object in a file of the scratch directory, deleted with this value unless it was put in its place.
#[derive(Debug)]
pub(super) struct ObjectFile {
    file: NamedTempFile,
    digest: Digest,
    size: u64,
}

impl ObjectFile {
    /// Makes the object that `write` writes; it should write some hundred KiB at once.
    ///
    /// # Errors
    /// The file system's errors, and those of `write`.
    pub(super) fn make(
        scratch: &Path,
        write: impl FnOnce(&mut ObjectWriter) -> io::Result<()>,
    ) -> Result<Self, StoreError> {
        // As any file that the program makes: the umask has the last word.
        let mut builder = tempfile::Builder::new();
        let file = builder.permissions(Permissions::from_mode(0o666)).tempfile_in(scratch);
        let mut writer = ObjectWriter { file: file.map_err(failed(scratch))?, hash: Sha256::new(), size: 0 };
        write(&mut writer).map_err(failed(scratch))?;
        let ObjectWriter { file, hash, size } = writer;
        Ok(Self { file, digest: Digest::finished(hash), size })
    }

    /// Digest of its bytes.
    pub(super) fn digest(&self) -> &Digest {
        &self.digest
    }

    /// Where it is now.
    pub(super) fn path(&self) -> &Path {
        self.file.path()
    }

    /// Its bytes.
    pub(super) fn size(&self) -> u64 {
        self.size
    }

    /// Puts it in its place, durably, in place of a file that is there.
    ///
    /// # Errors
    /// The file system's errors; half an object is never visible.
    pub(super) fn persist(self, place: &Path) -> Result<(), StoreError> {
        let directory = place.parent().map_or_else(PathBuf::new, Path::to_owned);
        self.file.as_file().sync_all().map_err(failed(place))?;
        std::fs::create_dir_all(&directory).map_err(failed(&directory))?;
        self.file.persist(place).map_err(|error| failed(place)(error.error))?;
        sync_directory(&directory)?;
        // The directory itself may be new.
        directory.parent().map_or(Ok(()), sync_directory)
    }
}

/// The file of an object that is being made.
#[derive(Debug)]
pub(super) struct ObjectWriter {
    file: NamedTempFile,
    hash: Sha256,
    size: u64,
}

impl Write for ObjectWriter {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        let n = self.file.as_file_mut().write(bytes)?;
        self.hash.update(&bytes[..n]);
        self.size += n as u64;
        Ok(n)
    }

    fn flush(&mut self) -> io::Result<()> {
        self.file.as_file_mut().flush()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_object_appears_whole_under_its_digest_or_leaves_nothing() {
        let directory = tempfile::tempdir().unwrap();
        let (scratch, objects) = (directory.path().join("scratch"), directory.path().join("objects"));
        std::fs::create_dir_all(&scratch).unwrap();
        std::fs::create_dir_all(&objects).unwrap();
        let left = || std::fs::read_dir(&scratch).unwrap().count();
        let made = ObjectFile::make(&scratch, |to| {
            to.write_all(b"a")?;
            to.write_all(b"bc")
        });
        let made = made.unwrap();
        assert_eq!((made.digest(), made.size(), left()), (&Digest::of(b"abc"), 3, 1));
        let place = objects.join("ba").join(made.digest().as_str());
        made.persist(&place).unwrap();
        assert_eq!((std::fs::read(&place).unwrap(), left()), (b"abc".to_vec(), 0));
        // It mends the file that is there.
        std::fs::write(&place, b"damaged").unwrap();
        let again = ObjectFile::make(&scratch, |to| to.write_all(b"abc")).unwrap();
        again.persist(&place).unwrap();
        assert_eq!(std::fs::read(&place).unwrap(), b"abc");
        let failing = ObjectFile::make(&scratch, |to| {
            to.write_all(b"half")?;
            Err(io::Error::other("the disk"))
        });
        assert!(matches!(failing, Err(StoreError::DataDir { .. })));
        drop(ObjectFile::make(&scratch, |to| to.write_all(b"never put")).unwrap());
        assert_eq!(left(), 0);
    }
}
