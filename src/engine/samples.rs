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
