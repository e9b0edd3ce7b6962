//! What signals differ by, the beginning left aside that a start from rest colours.

use crate::diagnosis::input::Run;
use crate::diagnosis::numerics::linear::squares_about_mean;

/// One part of a run in so many is its beginning.
const BEGINNING: usize = 5;

/// A signal without its beginning.
pub fn settled(signal: &[f64]) -> &[f64] {
    &signal[signal.len() / BEGINNING..]
}

/// Sum of the squares of what two signals differ by.
pub fn differ(a: &[f64], b: &[f64]) -> f64 {
    settled(a).iter().zip(settled(b)).map(|(a, b)| (a - b) * (a - b)).sum()
}

/// Sum of the squares of a signal about its mean.
pub fn size(signal: &[f64]) -> f64 {
    squares_about_mean(settled(signal))
}

/// What a sim leaves of a response, over runs.
pub struct Left {
    /// Sum of its squares.
    pub by_sim: f64,
    /// Sum of the squares of the response about its mean.
    pub size: f64,
    /// Samples that both are sums over.
    pub samples: usize,
}

impl Left {
    /// `None` where the sim does not say, or the response stands still.
    pub fn of(runs: &[Run], response: usize) -> Option<Self> {
        let mut sums = Self { by_sim: 0.0, size: 0.0, samples: 0 };
        for run in runs {
            let y = run.response.channel(response);
            sums.by_sim += differ(y, run.simulated.as_ref()?.channel(response));
            sums.size += size(y);
            sums.samples += settled(y).len();
        }
        (sums.size > 0.0).then_some(sums)
    }

    /// Mean square.
    pub fn mean_square(&self) -> f64 {
        self.by_sim / self.samples as f64
    }

    /// Variance of the response.
    pub fn variance(&self) -> f64 {
        self.size / self.samples as f64
    }

    /// RMS, relative to the response.
    pub fn relative(&self) -> f64 {
        (self.by_sim / self.size).sqrt()
    }
}
