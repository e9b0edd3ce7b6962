//! Samples that are read stretch by stretch, from memory or from a file.

use std::io;
use std::ops::Range;

use super::Signal;

/// Equally long, finite samples of one or more channels at one sample rate.
pub trait Samples: Send {
    /// Samples per second.
    fn sample_rate_hz(&self) -> f64;

    /// Number of channels, at least one.
    fn n_channels(&self) -> usize;

    /// Samples per channel.
    fn n_samples(&self) -> usize;

    /// Appends a range of samples of one channel to `to`.
    ///
    /// # Errors
    /// Those of the file that holds them.
    ///
    /// # Panics
    /// If there is no such channel, or the range leaves it.
    fn read(&mut self, channel: usize, samples: Range<usize>, to: &mut Vec<f64>) -> io::Result<()>;
}

impl Samples for Signal {
    fn sample_rate_hz(&self) -> f64 {
        self.sample_rate_hz()
    }

    fn n_channels(&self) -> usize {
        self.n_channels()
    }

    fn n_samples(&self) -> usize {
        self.n_samples()
    }

    fn read(&mut self, channel: usize, samples: Range<usize>, to: &mut Vec<f64>) -> io::Result<()> {
        to.extend_from_slice(&self.channel(channel)[samples]);
        Ok(())
    }
}

/// Samples that are passed on at once by [`each_block`].
const SAMPLES_AT_ONCE: usize = 1 << 15;

/// Passes on the samples of a channel in order, some at a time.
///
/// # Errors
/// As [`Samples::read`], and those of `take`.
///
/// # Panics
/// If there is no such channel.
pub fn each_block(
    samples: &mut impl Samples,
    channel: usize,
    mut take: impl FnMut(&[f64]) -> io::Result<()>,
) -> io::Result<()> {
    let (n, mut block) = (samples.n_samples(), Vec::new());
    for from in (0..n).step_by(SAMPLES_AT_ONCE) {
        block.clear();
        samples.read(channel, from..n.min(from + SAMPLES_AT_ONCE), &mut block)?;
        take(&block)?;
    }
    Ok(())
}

/// Whether two channels have the same samples.
///
/// # Errors
/// As [`Samples::read`].
///
/// # Panics
/// If there are no such channels.
pub fn are_equal(samples: &mut impl Samples, a: usize, b: usize) -> io::Result<bool> {
    let n = samples.n_samples();
    for from in (0..n).step_by(SAMPLES_AT_ONCE) {
        let range = from..n.min(from + SAMPLES_AT_ONCE);
        let mut blocks = [Vec::new(), Vec::new()];
        samples.read(a, range.clone(), &mut blocks[0])?;
        samples.read(b, range, &mut blocks[1])?;
        if blocks[0] != blocks[1] {
            return Ok(false);
        }
    }
    Ok(true)
}

/// The same range of samples of all channels, `[channel][sample]`.
///
/// # Errors
/// As [`Samples::read`].
pub fn block(samples: &mut impl Samples, range: &Range<usize>) -> io::Result<Vec<Vec<f64>>> {
    (0..samples.n_channels())
        .map(|channel| {
            let mut block = Vec::with_capacity(range.len());
            samples.read(channel, range.clone(), &mut block)?;
            Ok(block)
        })
        .collect()
}
