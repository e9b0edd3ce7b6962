//! The step of a channel's values, and how many steps its signal spans.

use serde::{Deserialize, Serialize};

use super::{Excerpts, SHORTEST};

/// Two values that are closer than this share of the largest one are the same value: twice the rounding of 32-bit
/// floats, in which most files store counts times a scale.
const ROUNDING: f64 = 1.0 / (1 << 22) as f64;
/// Steps finer than this share of the largest value are not told: they are sixteen times the rounding, below which a
/// step cannot be told from the rounding of the file. Steps of 16-bit converters are eight times larger.
const FINEST: f64 = 16.0 * ROUNDING;
/// Distances between neighbouring values that are looked at, the smallest first: the step is among them or divides them.
const DISTANCES: usize = 4096;

/// Steps of the values of one channel.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Quantisation {
    /// The largest step of which all distances between values are multiples, in the channel's unit.
    pub step: f64,
    /// Standard deviation / step.
    pub steps_per_std: f64,
    /// Bits that the channel's range uses: `log2((max - min) / step + 1)`.
    pub bits: f64,
    /// Deviation of the rounding error, `step / sqrt(12)`, over the standard deviation.
    pub noise_share: f64,
}

impl Quantisation {
    /// Steps of a channel from its excerpts and the figures of the whole: `None` where the values are on no common steps
    /// that are coarser than the rounding of 32-bit floats, where there are fewer than [`SHORTEST`] samples, and
    /// where there are only two values, which are a switch's. The step of a channel that uses few of its levels may
    /// be a multiple of its converter's.
    pub fn of(excerpts: &Excerpts, min: f64, max: f64, std: f64) -> Option<Self> {
        let peak = min.abs().max(max.abs());
        let mut values: Vec<f64> = excerpts.values().map(|v| v / peak).collect();
        if values.len() < SHORTEST || !(std > 0.0 && peak.is_finite()) {
            return None;
        }
        values.sort_unstable_by(f64::total_cmp);
        let mut distances: Vec<f64> =
            values.windows(2).map(|pair| pair[1] - pair[0]).filter(|d| *d > ROUNDING).collect();
        // Chance alone puts a few values on common steps. Samples of a coarse signal come back to the same levels.
        if distances.len() < 2 || 2 * distances.len() > values.len() {
            return None;
        }
        distances.sort_unstable_by(f64::total_cmp);
        distances.truncate(DISTANCES);
        let step = common_step(&distances)? * peak;
        let noise_share = step / 12f64.sqrt() / std;
        let figures = Self {
            step,
            steps_per_std: std / step,
            bits: ((max - min) / step).ln_1p() / 2f64.ln(),
            noise_share,
        };
        [figures.step, figures.steps_per_std, figures.bits, noise_share]
            .iter()
            .all(|f| f.is_finite())
            .then_some(figures)
    }
}

/// The largest number of which all distances (ascending) are multiples within the rounding, by Euclid's algorithm.
/// Values of no common step bring it down below [`FINEST`] at once.
fn common_step(distances: &[f64]) -> Option<f64> {
    let mut step = *distances.first()?;
    // The mean over many distances is closer to the step than one of them.
    let (mut sum, mut steps) = (step, 1.0);
    for &distance in &distances[1..] {
        if step < FINEST {
            return None;
        }
        let multiple = (distance / step).round();
        let rest = (distance - multiple * step).abs();
        if rest <= ROUNDING * (1.0 + multiple) {
            (sum, steps) = (sum + distance, steps + multiple);
            step = sum / steps;
        } else {
            (step, sum, steps) = (rest, rest, 1.0);
        }
    }
    (step >= FINEST).then_some(step)
}
