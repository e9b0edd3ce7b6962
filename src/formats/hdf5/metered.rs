//! A bound on what is read of a file's structure, which the reader keeps in memory.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use hdf5_pure::{FormatError, Source};

/// Most bytes of the structure of a file: its groups, the heads of its datasets and their attributes.
const STRUCTURE_BYTES: u64 = 64 << 20;

/// The source of a file, of which so many bytes may be read.
pub(super) struct Metered<S> {
    inner: S,
    meter: Meter,
}

/// Bytes that may still be read.
#[derive(Debug, Clone)]
pub(super) struct Meter(Arc<AtomicU64>);

impl Meter {
    pub(super) fn new() -> Self {
        Self(Arc::new(AtomicU64::new(STRUCTURE_BYTES)))
    }

    /// Reads samples, whose size is checked elsewhere and does not count.
    pub(super) fn uncounted<T>(&self, read: impl FnOnce() -> T) -> T {
        let left = self.0.swap(u64::MAX, Ordering::Relaxed);
        let read = read();
        self.0.store(left, Ordering::Relaxed);
        read
    }
}

impl<S: Source> Metered<S> {
    pub(super) fn new(inner: S, meter: Meter) -> Self {
        Self { inner, meter }
    }
}

impl<S: Source> Source for Metered<S> {
    fn len(&self) -> u64 {
        self.inner.len()
    }

    fn read_at(&self, offset: u64, to: &mut [u8]) -> Result<(), FormatError> {
        let taken = |left: u64| left.checked_sub(to.len() as u64);
        if self.meter.0.try_update(Ordering::Relaxed, Ordering::Relaxed, taken).is_err() {
            let reason = format!("the structure is larger than {STRUCTURE_BYTES} bytes");
            return Err(FormatError::Source(reason));
        }
        self.inner.read_at(offset, to)
    }
}

#[cfg(test)]
mod tests {
    use std::io::Cursor;

    use hdf5_pure::ReadSeekSource;

    use super::*;

    #[test]
    fn the_structure_is_bounded_and_samples_are_not() {
        let meter = Meter::new();
        let source = ReadSeekSource::new(Cursor::new(vec![0; 1 << 20])).unwrap();
        let source = Metered::new(source, meter.clone());
        let mut piece = vec![0; 1 << 20];
        for _ in 0..63 {
            source.read_at(0, &mut piece).unwrap();
        }
        for _ in 0..100 {
            meter.uncounted(|| source.read_at(0, &mut piece)).unwrap();
        }
        source.read_at(0, &mut piece).unwrap();
        let error = source.read_at(0, &mut piece[..1]).unwrap_err();
        assert_eq!(error, FormatError::Source("the structure is larger than 67108864 bytes".into()));
    }
}
