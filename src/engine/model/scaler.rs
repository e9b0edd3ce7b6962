//! Standardisation per channel.

use std::ops::Range;

use crate::Signal;

/// Mean and standard deviation per channel: `z = (v - mean) / std`.
#[derive(Debug, Clone, PartialEq)]
pub struct Scaler {
    /// Mean of each channel, in its unit.
    pub mean: Vec<f64>,
    /// Standard deviation of each channel, in its unit, positive.
    pub std: Vec<f64>,
}

impl Scaler {
    /// Scaler of some samples of several signals taken together (Heindel et al., section 2.2.1:
    /// "collectively standardized"). A channel that does not move is only centred (std 1).
    ///
    /// # Panics
    /// If `parts` is empty.
    pub fn of(parts: &[(&Signal, Range<usize>)]) -> Self {
        let n: usize = parts.iter().map(|(_, samples)| samples.len()).sum();
        let n = n.max(1) as f64;
        let (mut mean, mut std) = (Vec::new(), Vec::new());
        for channel in 0..parts[0].0.n_channels() {
            let each = || parts.iter().flat_map(|(s, samples)| &s.channel(channel)[samples.clone()]);
            let m = each().sum::<f64>() / n;
            let variance = each().map(|v| (v - m) * (v - m)).sum::<f64>() / n;
            let moves = variance.sqrt() > 1e-12 * m.abs();
            mean.push(m);
            std.push(if moves { variance.sqrt() } else { 1.0 });
        }
        Self { mean, std }
    }

    /// Standardised samples of one channel.
    pub fn standardise(&self, channel: usize, samples: &[f64]) -> Vec<f32> {
        let (mean, std) = (self.mean[channel], self.std[channel]);
        samples.iter().map(|v| ((v - mean) / std) as f32).collect()
    }

    /// Back to the channel's unit.
    pub fn restore(&self, channel: usize, z: &[f32]) -> Vec<f64> {
        let (mean, std) = (self.mean[channel], self.std[channel]);
        z.iter().map(|&v| f64::from(v) * std + mean).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn two_runs_are_scaled_as_one() {
        let a = Signal::new(1.0, vec![vec![1.0, 3.0], vec![5.0, 5.0]]).unwrap();
        let b = Signal::new(1.0, vec![vec![5.0, 7.0], vec![5.0, 5.0]]).unwrap();
        let scaler = Scaler::of(&[(&a, 0..2), (&b, 0..2)]);
        assert_eq!(scaler.mean, [4.0, 5.0]);
        assert_eq!(scaler.std, [5.0_f64.sqrt(), 1.0]);
        let z = scaler.standardise(0, a.channel(0));
        assert!((f64::from(z[0]) + 3.0 / 5.0_f64.sqrt()).abs() < 1e-7);
        let back = scaler.restore(0, &z);
        assert!((back[1] - 3.0).abs() < 1e-6);
    }
}
