//! Envelopes: the smallest and the largest sample in each of some equal stretches, so that a plot of any length shows
//! every peak at the resolution of a screen.

use std::io;
use std::ops::Range;

use super::Samples;
use super::samples::each_block;

/// Samples of the finest block.
const BLOCK: usize = 256;

/// Most blocks of a channel: some eight for each column of a wide screen.
const MOST_BLOCKS: usize = 1 << 14;

/// Blocks that a column must hold at least to be made of whole ones: its ends are then a quarter of a column off at
/// most.
const BLOCKS_A_COLUMN: usize = 4;

/// The smallest and the largest sample of each column; more columns than samples are never asked for.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Envelope {
    /// Smallest samples.
    pub low: Vec<f64>,
    /// Largest samples.
    pub high: Vec<f64>,
}

/// Envelopes of all channels by blocks.
#[derive(Debug, Clone, PartialEq)]
pub struct Blocks {
    /// Samples of a block; the last block may have fewer.
    block: usize,
    channels: Vec<Envelope>,
}

impl Blocks {
    /// Reads all samples once.
    ///
    /// # Errors
    /// Those of the file that holds the samples.
    pub fn of(samples: &mut impl Samples) -> io::Result<Self> {
        let block = (samples.n_samples().div_ceil(MOST_BLOCKS)).next_power_of_two().max(BLOCK);
        let mut channels = Vec::with_capacity(samples.n_channels());
        for channel in 0..samples.n_channels() {
            let mut envelope = Envelope::default();
            let mut open = Extremes::default();
            each_block(samples, channel, |piece| {
                let mut rest = piece;
                while !rest.is_empty() {
                    let (head, tail) = rest.split_at(rest.len().min(block - open.count));
                    open.add(head);
                    rest = tail;
                    if open.count == block {
                        envelope.push(std::mem::take(&mut open));
                    }
                }
                Ok(())
            })?;
            if open.count > 0 {
                envelope.push(open);
            }
            channels.push(envelope);
        }
        Ok(Self { block, channels })
    }

    /// The envelope of a range of samples of a channel in `columns` columns, at most one a sample. Where a column holds
    /// few blocks, the samples are read.
    ///
    /// # Errors
    /// Those of the file that holds the samples.
    ///
    /// # Panics
    /// If there is no such channel, or the range leaves it.
    pub fn view(
        &self,
        samples: &mut impl Samples,
        channel: usize,
        range: Range<usize>,
        columns: usize,
    ) -> io::Result<Envelope> {
        let columns = columns.clamp(1, range.len().max(1));
        let edge = |column: usize, n: usize| (column as u128 * n as u128 / columns as u128) as usize;
        if range.len() / columns >= BLOCKS_A_COLUMN * self.block {
            let blocks = &self.channels[channel];
            let (first, last) = (range.start / self.block, range.end.div_ceil(self.block));
            return Ok(Envelope::by(columns, |column| {
                let (from, to) = (edge(column, last - first), edge(column + 1, last - first));
                let (low, high) =
                    (&blocks.low[first + from..first + to], &blocks.high[first + from..first + to]);
                [
                    low.iter().copied().fold(f64::INFINITY, f64::min),
                    high.iter().copied().fold(f64::NEG_INFINITY, f64::max),
                ]
            }));
        }
        let mut read = Vec::with_capacity(range.len());
        samples.read(channel, range, &mut read)?;
        Ok(Envelope::of(&read, columns))
    }
}

/// The extremes of the samples so far.
#[derive(Debug, Clone, Copy)]
struct Extremes {
    low: f64,
    high: f64,
    count: usize,
}

impl Default for Extremes {
    fn default() -> Self {
        Self { low: f64::INFINITY, high: f64::NEG_INFINITY, count: 0 }
    }
}

impl Extremes {
    fn add(&mut self, samples: &[f64]) {
        for &x in samples {
            self.low = self.low.min(x);
            self.high = self.high.max(x);
        }
        self.count += samples.len();
    }
}

impl Envelope {
    /// The envelope of samples in memory in at most this many columns.
    pub fn of(samples: &[f64], columns: usize) -> Self {
        let columns = columns.clamp(1, samples.len().max(1));
        let edge = |column: usize| (column as u128 * samples.len() as u128 / columns as u128) as usize;
        Self::by(columns, |column| {
            let mut extremes = Extremes::default();
            extremes.add(&samples[edge(column)..edge(column + 1)]);
            [extremes.low, extremes.high]
        })
    }

    fn by(columns: usize, extremes: impl Fn(usize) -> [f64; 2]) -> Self {
        let (low, high) = (0..columns).map(|column| extremes(column).into()).unzip();
        Self { low, high }
    }

    fn push(&mut self, extremes: Extremes) {
        self.low.push(extremes.low);
        self.high.push(extremes.high);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Signal;

    fn signal(n: usize) -> Signal {
        Signal::new(1000.0, vec![(0..n).map(|i| (i as f64 * 0.37).sin()).collect(), vec![2.5; n]]).unwrap()
    }

    #[test]
    fn a_single_spike_is_seen_at_every_resolution() {
        let mut x = vec![0.0; 1_000_000];
        x[654_321] = 7.0;
        x[123_456] = -3.0;
        let mut signal = Signal::new(1000.0, vec![x]).unwrap();
        let blocks = Blocks::of(&mut signal).unwrap();
        for columns in [1, 7, 100, 1000, 3000] {
            let seen = blocks.view(&mut signal, 0, 0..1_000_000, columns).unwrap();
            assert_eq!(seen.low.len(), columns);
            assert_eq!(seen.high.iter().filter(|y| **y == 7.0).count(), 1, "{columns}");
            let at = seen.low.iter().position(|y| *y == -3.0).unwrap();
            let expected = 123_456 * columns / 1_000_000;
            assert!(at.abs_diff(expected) <= 1, "{at} of {columns}");
        }
    }

    #[test]
    fn a_short_range_shows_its_samples_themselves() {
        let mut signal = signal(5000);
        let blocks = Blocks::of(&mut signal).unwrap();
        let seen = blocks.view(&mut signal, 0, 1000..1050, 900).unwrap();
        assert_eq!(seen.low, signal.channel(0)[1000..1050]);
        assert_eq!(seen.low, seen.high);
    }

    #[test]
    fn constant_short_and_odd_lengths_have_envelopes_without_gaps() {
        for n in [1, 2, 255, 256, 257, 70_001] {
            let mut signal = signal(n);
            let blocks = Blocks::of(&mut signal).unwrap();
            for columns in [1, 3, 800] {
                for channel in 0..2 {
                    let seen = blocks.view(&mut signal, channel, 0..n, columns).unwrap();
                    assert_eq!(seen.low.len(), columns.min(n));
                    assert!(
                        seen.low.iter().zip(&seen.high).all(|(low, high)| low <= high && low.is_finite())
                    );
                }
                assert_eq!(blocks.view(&mut signal, 1, 0..n, columns).unwrap().low[0], 2.5);
            }
        }
    }

    #[test]
    fn whole_blocks_and_samples_give_the_same_envelope_where_columns_are_whole_blocks() {
        let mut signal = signal(256 * 4 * 50);
        let blocks = Blocks::of(&mut signal).unwrap();
        let n = signal.n_samples();
        assert_eq!(blocks.view(&mut signal, 0, 0..n, 50).unwrap(), Envelope::of(signal.channel(0), 50));
    }
}
