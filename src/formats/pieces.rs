//! Samples in the pieces in which files are written: a few thousand rows at a time.

use std::io;
use std::ops::Range;

use super::NUMBERS_AT_ONCE;
use crate::engine::{Samples, samples};

/// Blocks of rows, `[channel][row]`, with the samples that they are. There is one block at least, so that a file
/// without samples has its head.
#[derive(Debug)]
pub(super) struct RowBlocks<S> {
    samples: S,
    /// Rows that were taken.
    at: usize,
    begun: bool,
}

impl<S: Samples> RowBlocks<S> {
    pub(super) fn new(samples: S) -> Self {
        Self { samples, at: 0, begun: false }
    }

    pub(super) fn samples(&self) -> &S {
        &self.samples
    }
}

impl<S: Samples> Iterator for RowBlocks<S> {
    type Item = io::Result<(Range<usize>, Vec<Vec<f64>>)>;

    fn next(&mut self) -> Option<Self::Item> {
        let n = self.samples.n_samples();
        if self.begun && self.at >= n {
            return None;
        }
        let rows = (NUMBERS_AT_ONCE / self.samples.n_channels()).max(1);
        let range = self.at..n.min(self.at + rows);
        (self.begun, self.at) = (true, range.end);
        Some(samples::block(&mut self.samples, &range).map(|block| (range, block)))
    }
}
