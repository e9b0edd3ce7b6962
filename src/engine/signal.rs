//! A checked multi-channel signal, the argument of most engine functions.

use super::EngineError;

/// Equally long, finite samples of one or more channels at one sample rate, `[channel, sample]`.
#[derive(Debug, Clone, PartialEq)]
pub struct Signal {
    sample_rate_hz: f64,
    channels: Vec<Vec<f64>>,
}

impl Signal {
    /// Takes over `channels` after checking them.
    ///
    /// # Errors
    /// No channel, a sample rate that is not positive and finite, unequal lengths, NaN, infinity.
    pub fn new(sample_rate_hz: f64, channels: Vec<Vec<f64>>) -> Result<Self, EngineError> {
        if !(sample_rate_hz.is_finite() && sample_rate_hz > 0.0) {
            return Err(EngineError::Setting {
                setting: "sample_rate_hz",
                found: sample_rate_hz.to_string(),
                limit: "a positive, finite number of hertz".into(),
            });
        }
        let Some(expected) = channels.first().map(Vec::len) else {
            return Err(EngineError::ChannelCount { what: "signal", expected: 1, found: 0 });
        };
        for (channel, samples) in channels.iter().enumerate() {
            if samples.len() != expected {
                return Err(EngineError::UnequalLength {
                    what: "signal",
                    channel,
                    expected,
                    found: samples.len(),
                });
            }
            if let Some(sample) = first_not_finite(samples) {
                return Err(EngineError::NonFinite { what: "signal", channel, sample });
            }
        }
        Ok(Self { sample_rate_hz, channels })
    }

    /// Wraps channels that the engine has made, checked sample by sample and equally long.
    pub(super) fn of_checked(sample_rate_hz: f64, channels: Vec<Vec<f64>>) -> Self {
        debug_assert!(channels.iter().all(|c| c.len() == channels[0].len() && first_not_finite(c).is_none()));
        Self { sample_rate_hz, channels }
    }

    /// Samples per second.
    pub fn sample_rate_hz(&self) -> f64 {
        self.sample_rate_hz
    }

    /// Number of channels, at least one.
    pub fn n_channels(&self) -> usize {
        self.channels.len()
    }

    /// Samples per channel; may be zero.
    pub fn n_samples(&self) -> usize {
        self.channels[0].len()
    }

    /// Length in seconds.
    pub fn duration_s(&self) -> f64 {
        self.n_samples() as f64 / self.sample_rate_hz
    }

    /// Samples of one channel.
    ///
    /// # Panics
    /// If there is no such channel.
    pub fn channel(&self, index: usize) -> &[f64] {
        &self.channels[index]
    }

    /// All channels, `[channel][sample]`.
    pub fn channels(&self) -> &[Vec<f64>] {
        &self.channels
    }

    /// The samples, by value.
    pub fn into_channels(self) -> Vec<Vec<f64>> {
        self.channels
    }

    /// The same samples of some channels, in the order of `indices`.
    ///
    /// # Panics
    /// If `indices` is empty or names a channel that does not exist.
    pub fn select(&self, indices: &[usize]) -> Self {
        assert!(!indices.is_empty(), "a signal has at least one channel");
        Self {
            sample_rate_hz: self.sample_rate_hz,
            channels: indices.iter().map(|&i| self.channels[i].clone()).collect(),
        }
    }

    /// The first `n` samples, or all if there are fewer, in the same memory.
    #[must_use]
    pub fn truncated(mut self, n: usize) -> Self {
        for channel in &mut self.channels {
            channel.truncate(n);
            channel.shrink_to_fit();
        }
        self
    }

    /// A range of samples of all channels.
    ///
    /// # Panics
    /// If the range leaves the signal.
    pub fn slice(&self, samples: std::ops::Range<usize>) -> Self {
        Self {
            sample_rate_hz: self.sample_rate_hz,
            channels: self.channels.iter().map(|c| c[samples.clone()].to_vec()).collect(),
        }
    }

    /// Whether two sample rates are equal (1e-6 relative).
    pub fn same_rate(a_hz: f64, b_hz: f64) -> bool {
        (a_hz - b_hz).abs() <= 1e-6 * a_hz.abs().max(b_hz.abs())
    }
}

/// Index of the first NaN or infinity.
///
/// Whole blocks are checked without a branch per sample, since every signal passes here several times.
pub fn first_not_finite(samples: &[f64]) -> Option<usize> {
    const BLOCK: usize = 512;
    let bad = |block: &[f64]| block.iter().fold(false, |bad, v| bad | !v.is_finite());
    let block = samples.chunks(BLOCK).position(bad)? * BLOCK;
    samples[block..].iter().position(|v| !v.is_finite()).map(|at| block + at)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_first_sample_that_is_not_finite_is_found_in_any_block() {
        let mut samples = vec![f64::MAX; 1300];
        assert_eq!(first_not_finite(&samples), None);
        for at in [1299, 1024, 600, 511, 0] {
            samples[at] = f64::NEG_INFINITY;
            assert_eq!(first_not_finite(&samples), Some(at));
        }
        assert_eq!(first_not_finite(&[]), None);
    }

    #[test]
    fn a_signal_names_the_channel_and_sample_that_is_not_finite() {
        let error = Signal::new(1.0, vec![vec![0.0, 1.0], vec![0.0, f64::NAN]]).unwrap_err();
        assert_eq!(error, EngineError::NonFinite { what: "signal", channel: 1, sample: 1 });
    }

    #[test]
    fn unequal_channels_and_senseless_rates_are_refused() {
        assert!(matches!(
            Signal::new(1.0, vec![vec![0.0], vec![]]),
            Err(EngineError::UnequalLength { channel: 1, expected: 1, found: 0, .. })
        ));
        for rate in [0.0, -1.0, f64::NAN, f64::INFINITY] {
            assert!(matches!(Signal::new(rate, vec![vec![]]), Err(EngineError::Setting { .. })));
        }
        assert!(Signal::new(1.0, vec![]).is_err());
    }
}
