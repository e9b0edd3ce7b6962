//! What an engineer looks at first in a run: levels, dead channels, clipping.

use serde::{Deserialize, Serialize};

use crate::engine::Signal;

/// A channel counts as clipped when it stays this many samples or more at one of its extremes.
pub const CLIPPED_FROM_SAMPLES: u64 = 3;

/// Figures of one channel, in its unit.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ChannelQuality {
    /// Name.
    pub channel: String,
    /// Smallest value.
    pub min: f64,
    /// Largest value.
    pub max: f64,
    /// Mean.
    pub mean: f64,
    /// Standard deviation (of the samples, divided by their number).
    pub std: f64,
    /// Root mean square.
    pub rms: f64,
    /// Largest absolute value / RMS; `None` for a channel of zeros.
    pub peak_to_rms: Option<f64>,
    /// Whether every sample has the same value.
    pub dead: bool,
    /// Samples of the longest stretch that stays at the smallest or largest value.
    pub longest_at_extreme: u64,
    /// Share of all samples in such stretches of [`CLIPPED_FROM_SAMPLES`] or more, 0..=1.
    pub clipped_share: f64,
}

/// Figures of a run.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Quality {
    /// One entry a channel, in the run's order.
    pub channels: Vec<ChannelQuality>,
    /// Channels in which nothing moves.
    pub dead_channels: Vec<String>,
    /// Channels that look clipped.
    pub clipped_channels: Vec<String>,
}

impl Quality {
    /// Looks at every channel of `signal`; `names` in the signal's order.
    pub fn assess(names: &[String], signal: &Signal) -> Self {
        let channels: Vec<ChannelQuality> = names
            .iter()
            .zip(signal.channels())
            .map(|(name, samples)| ChannelQuality::assess(name, samples))
            .collect();
        let of = |wanted: fn(&ChannelQuality) -> bool| {
            channels.iter().filter(|c| wanted(c)).map(|c| c.channel.clone()).collect()
        };
        Self { dead_channels: of(|c| c.dead), clipped_channels: of(|c| c.clipped_share > 0.0), channels }
    }
}

impl ChannelQuality {
    fn assess(name: &str, samples: &[f64]) -> Self {
        let min = samples.iter().copied().fold(f64::INFINITY, f64::min);
        let max = samples.iter().copied().fold(f64::NEG_INFINITY, f64::max);
        let peak = min.abs().max(max.abs());
        let dead = min == max;
        let mut quality = Self {
            channel: name.to_owned(),
            min,
            max,
            mean: min,
            std: 0.0,
            rms: peak,
            peak_to_rms: (peak > 0.0).then_some(1.0),
            dead,
            longest_at_extreme: samples.len() as u64,
            clipped_share: 0.0,
        };
        if dead || samples.is_empty() {
            return quality;
        }
        // Relative to the peak, so that the squares of no finite value overflow or vanish.
        let n = samples.len() as f64;
        let mean = samples.iter().map(|v| v / peak).sum::<f64>() / n;
        let mean_square = samples.iter().map(|v| (v / peak).powi(2)).sum::<f64>() / n;
        let variance = samples.iter().map(|v| (v / peak - mean).powi(2)).sum::<f64>() / n;
        quality.mean = mean * peak;
        quality.rms = mean_square.sqrt() * peak;
        quality.std = variance.sqrt() * peak;
        quality.peak_to_rms = Some(1.0 / mean_square.sqrt());
        (quality.longest_at_extreme, quality.clipped_share) = clipping(samples, min, max);
        quality
    }
}

/// Longest stretch at an extreme, and the share of samples in stretches that look clipped.
fn clipping(samples: &[f64], min: f64, max: f64) -> (u64, f64) {
    let mut longest = 0;
    let mut clipped = 0;
    for stretch in samples.chunk_by(|a, b| a == b).filter(|s| s[0] == min || s[0] == max) {
        let len = stretch.len() as u64;
        longest = longest.max(len);
        if len >= CLIPPED_FROM_SAMPLES {
            clipped += len;
        }
    }
    (longest, clipped as f64 / samples.len() as f64)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn assess(samples: &[f64]) -> ChannelQuality {
        ChannelQuality::assess("a", samples)
    }

    #[test]
    fn levels_are_those_of_the_samples() {
        let q = assess(&[1.0, -1.0, 3.0, 1.0]);
        assert_eq!((q.min, q.max, q.mean), (-1.0, 3.0, 1.0));
        assert!((q.rms - 3.0f64.sqrt()).abs() < 1e-15);
        assert!((q.std - 2.0f64.sqrt()).abs() < 1e-15);
        assert!((q.peak_to_rms.unwrap() - 3.0 / 3.0f64.sqrt()).abs() < 1e-15);
        assert!(!q.dead);
        assert_eq!((q.longest_at_extreme, q.clipped_share), (1, 0.0));
    }

    #[test]
    fn a_flat_top_is_clipping_and_a_flat_middle_is_not() {
        let q = assess(&[0.0, 1.0, 1.0, 1.0, 0.5, 0.5, 0.5, 0.5, -1.0, 0.0]);
        assert_eq!(q.longest_at_extreme, 3);
        assert!((q.clipped_share - 0.3).abs() < 1e-15);
    }

    #[test]
    fn a_constant_channel_is_dead_and_its_figures_are_finite() {
        let q = assess(&[2.0; 5]);
        assert!(q.dead);
        assert_eq!((q.mean, q.std, q.rms, q.peak_to_rms), (2.0, 0.0, 2.0, Some(1.0)));
        assert_eq!(assess(&[0.0; 5]).peak_to_rms, None);
    }

    #[test]
    fn the_largest_numbers_do_not_overflow_the_figures() {
        let q = assess(&[f64::MAX, -f64::MAX, f64::MAX, f64::MIN_POSITIVE]);
        for figure in [q.mean, q.std, q.rms, q.peak_to_rms.unwrap()] {
            assert!(figure.is_finite(), "{figure}");
        }
    }
}
