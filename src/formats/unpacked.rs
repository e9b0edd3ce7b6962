//! A bound on what a compressed file becomes, so that a small file cannot fill the disk.

use std::io::{self, ErrorKind, Read};

use super::{FormatError, ReadError};

/// Bytes that any file may become.
const ANY: u64 = 256 << 20;

/// Bytes that a file may become per byte of its own. Deflate makes zeros, as of a dead channel, a thousand times
/// shorter, and measured numbers three times.
const PER_BYTE: u64 = 100;

/// Bytes that a file of `len` bytes may become.
pub(super) fn limit(len: u64) -> u64 {
    ANY.max(len.saturating_mul(PER_BYTE))
}

/// Bytes that a file may still become.
#[derive(Debug)]
pub(super) struct Budget {
    limit: u64,
    left: u64,
}

impl Budget {
    /// The budget of a file of `len` bytes.
    pub(super) fn of(len: u64) -> Self {
        Self { limit: limit(len), left: limit(len) }
    }

    /// Reads from `inner`; what is read counts. Beyond the limit it is an error that holds
    /// [`FormatError::Unpacked`].
    pub(super) fn reader<R: Read>(&mut self, inner: R) -> Bounded<'_, R> {
        Bounded { inner, budget: self }
    }
}

/// A reader within a budget.
#[derive(Debug)]
pub(super) struct Bounded<'a, R> {
    inner: R,
    budget: &'a mut Budget,
}

impl<R: Read> Read for Bounded<'_, R> {
    fn read(&mut self, to: &mut [u8]) -> io::Result<usize> {
        let n = self.inner.read(to)?;
        let Some(left) = self.budget.left.checked_sub(n as u64) else {
            let error = FormatError::Unpacked { limit: self.budget.limit };
            return Err(io::Error::new(ErrorKind::InvalidData, error));
        };
        self.budget.left = left;
        Ok(n)
    }
}

/// An error of reading a compressed file: of its content, which `invalid` makes with these reasons, or of the file
/// system.
pub(super) fn fault(
    error: io::Error,
    ended: &'static str,
    damaged: &'static str,
    invalid: impl Fn(&'static str) -> FormatError,
) -> ReadError {
    match error.kind() {
        // Only errors of the file system have a number of the system's.
        _ if error.raw_os_error().is_some() => error.into(),
        ErrorKind::UnexpectedEof => invalid(ended).into(),
        _ => match error.downcast::<FormatError>() {
            Ok(error) => error.into(),
            Err(_) => invalid(damaged).into(),
        },
    }
}
