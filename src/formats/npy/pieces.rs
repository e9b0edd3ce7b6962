//! Writing NPY piece by piece, so that a file of any length takes the memory of a few thousand samples.

use std::io;

use super::{Dtype, Order, npy_header, put};
use crate::engine::Samples;
use crate::formats::pieces::RowBlocks;

/// The pieces of a `<f8` file of shape `[samples, channels]` in C order.
#[derive(Debug)]
pub struct NpyPieces<S> {
    head: Vec<u8>,
    blocks: RowBlocks<S>,
}

impl<S: Samples> NpyPieces<S> {
    /// The file of these samples.
    pub fn new(samples: S) -> Self {
        let head = npy_header(samples.n_samples(), samples.n_channels(), Dtype::F8, Order::C);
        Self { head, blocks: RowBlocks::new(samples) }
    }

    /// Bytes of the whole file, before its first piece was taken.
    pub fn size(&self) -> u64 {
        let samples = self.blocks.samples();
        let numbers = samples.n_samples() as u64 * samples.n_channels() as u64;
        self.head.len() as u64 + numbers * Dtype::F8.size() as u64
    }

    fn piece(&mut self, from: usize, block: &[Vec<f64>]) -> io::Result<Vec<u8>> {
        let mut bytes = std::mem::take(&mut self.head);
        put(&mut bytes, block, Dtype::F8, from).map_err(io::Error::other)?;
        Ok(bytes)
    }
}

impl<S: Samples> Iterator for NpyPieces<S> {
    type Item = io::Result<Vec<u8>>;

    fn next(&mut self) -> Option<io::Result<Vec<u8>>> {
        let block = self.blocks.next()?;
        Some(block.and_then(|(range, block)| self.piece(range.start, &block)))
    }
}

#[cfg(test)]
mod tests {
    use super::super::write;
    use super::*;
    use crate::engine::Signal;
    use crate::formats::NUMBERS_AT_ONCE;

    #[test]
    fn pieces_make_the_file_of_the_whole_and_its_size_is_known() {
        for n in [1, NUMBERS_AT_ONCE / 3, 2 * NUMBERS_AT_ONCE + 1] {
            let channels: Vec<Vec<f64>> =
                (1..4).map(|k| (0..n).map(|i| f64::from(k) + i as f64).collect()).collect();
            let whole = write(&channels, Dtype::F8, Order::C).unwrap();
            let pieces = NpyPieces::new(Signal::new(1.0, channels).unwrap());
            assert_eq!(pieces.size(), whole.len() as u64);
            let pieces: Vec<Vec<u8>> = pieces.collect::<io::Result<_>>().unwrap();
            assert_eq!(pieces.len(), n.div_ceil(NUMBERS_AT_ONCE / 3));
            assert!(pieces.concat() == whole, "{n} samples");
        }
    }
}
