//! Disk space that is kept free for the writes that make room: deletions, and changes of the active model.

use std::fs::File;
use std::io::{self, Write};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};

use rustix::fs::{FallocateFlags, fallocate, statvfs};

use super::{Store, StoreError};

/// Share of the file system that is reserved, within the limits below.
const SHARE: u64 = 64;
/// Smallest and largest reserve, bytes. A deletion writes the pages of the database that it changes once, and the
/// rows to the journal.
const BYTES: [u64; 2] = [1 << 20, 16 << 20];

/// A file that holds the reserve. It is removed for a write that makes room, and made again as soon as there is some.
#[derive(Debug)]
pub(super) struct Reserve {
    path: PathBuf,
    bytes: u64,
    held: AtomicBool,
}

impl Reserve {
    /// The reserve of a data directory; it is not an error if there is no room for it.
    pub(super) fn of(data_dir: &Path) -> Self {
        let all = statvfs(data_dir).map_or(0, |system| system.f_blocks.saturating_mul(system.f_frsize));
        let bytes = (all / SHARE).clamp(BYTES[0], BYTES[1]);
        let reserve = Self { path: data_dir.join("reserve"), bytes, held: AtomicBool::new(false) };
        if !reserve.hold() {
            tracing::warn!("the disk has no room for a reserve: nothing is stored until there is some");
        }
        reserve
    }

    /// Whether there is a reserve now; it is made if there is room for it.
    pub(super) fn hold(&self) -> bool {
        if self.held.load(Ordering::Acquire) {
            return true;
        }
        let held = match self.make() {
            Ok(()) => true,
            Err(error) => {
                // Half a reserve would only take room.
                let _ = std::fs::remove_file(&self.path);
                // Another failure than a full disk shows at the write itself.
                !matches!(error.kind(), io::ErrorKind::StorageFull | io::ErrorKind::QuotaExceeded)
            }
        };
        self.held.store(held, Ordering::Release);
        held
    }

    fn make(&self) -> io::Result<()> {
        let mut file = File::options().create(true).truncate(false).write(true).open(&self.path)?;
        match fallocate(&file, FallocateFlags::empty(), 0, self.bytes) {
            Err(rustix::io::Errno::OPNOTSUPP | rustix::io::Errno::NOSYS) => {
                let zeros = vec![0; 1 << 16];
                let mut left = self.bytes as usize;
                while left > 0 {
                    left -= file.write(&zeros[..zeros.len().min(left)])?;
                }
                file.sync_all()
            }
            done => Ok(done?),
        }
    }

    /// Gives the reserve up; `false` if there was none.
    fn release(&self) -> bool {
        self.held.swap(false, Ordering::AcqRel) && std::fs::remove_file(&self.path).is_ok()
    }
}

/// Does a write that makes room; on a full disk it is done again with the reserve.
macro_rules! with_reserve {
    ($store:expr, $write:expr) => {{
        let done = match $write.await {
            Err(error) if $store.gives_reserve_up(&error) => $write.await,
            done => done,
        };
        $store.hold_reserve();
        done
    }};
}
pub(super) use with_reserve;

impl Store {
    /// Whether a write that failed so is to be tried again: the disk is full, and the reserve was given up for it.
    pub(super) fn gives_reserve_up(&self, error: &StoreError) -> bool {
        error.is_disk_full() && self.reserve().is_some_and(Reserve::release)
    }

    /// Holds the reserve again if there is room.
    pub(super) fn hold_reserve(&self) {
        self.reserve().map(Reserve::hold);
    }

    /// Refuses a write that takes room while there is no reserve.
    ///
    /// # Errors
    /// [`StoreError::Full`].
    pub(super) fn check_room(&self) -> Result<(), StoreError> {
        match self.reserve() {
            Some(reserve) if !reserve.hold() => Err(StoreError::Full),
            _ => Ok(()),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_reserve_takes_its_room_until_it_is_given_up() {
        let dir = tempfile::tempdir().unwrap();
        let reserve = Reserve::of(dir.path());
        let path = dir.path().join("reserve");
        let taken = || {
            use std::os::unix::fs::MetadataExt;
            std::fs::metadata(&path).map_or(0, |file| 512 * file.blocks())
        };
        assert!(reserve.hold() && taken() >= BYTES[0], "{}", taken());
        assert!(reserve.release() && !path.exists());
        assert!(!reserve.release(), "it is given up once");
        assert!(reserve.hold() && path.exists());
    }
}
