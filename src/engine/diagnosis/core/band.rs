//! The band in which low-level runs can tell the core anything.

use crate::diagnosis::numerics::hann::Hann;
use crate::diagnosis::numerics::rows::fast_len;

/// Share of the drive's power that lies inside the band.
const SHARE: f64 = 0.995;
/// A lower edge below this share of the upper one is no edge: the drive reaches down to rest.
const REACHES_ZERO: f64 = 0.04;

/// First and last frequency, cycles a sample, between which 99.5 % of the drives' power lies, each
/// drive counted alike; `[stretch][drive]` samples. `None` if no drive moves.
pub(in crate::diagnosis) fn drive_band(stretches: &[Vec<&[f64]>]) -> Option<[f64; 2]> {
    const BINS: usize = 2048;
    let drives = stretches.first()?.len();
    let mut power = vec![0.0; BINS + 1];
    for drive in 0..drives {
        let mut of_drive = vec![0.0; BINS + 1];
        for stretch in stretches {
            let n = fast_len(stretch[drive].len());
            for (line, z) in Hann::new(n).lines(&stretch[drive][..n]).iter().enumerate() {
                of_drive[2 * BINS * line / n] += z.norm_sqr() / n as f64;
            }
        }
        let total: f64 = of_drive.iter().sum();
        if total > 0.0 {
            power.iter_mut().zip(&of_drive).for_each(|(p, x)| *p += x / total);
        }
    }
    let total: f64 = power.iter().sum();
    if total <= 0.0 {
        return None;
    }
    let outside = 0.5 * (1.0 - SHARE) * total;
    let low = quantile(power.iter().enumerate(), outside);
    let high = quantile(power.iter().enumerate().rev(), outside);
    let (low, high) = (low as f64 / (2 * BINS) as f64, ((high + 1) as f64 / (2 * BINS) as f64).min(0.5));
    Some([if low < REACHES_ZERO * high { 0.0 } else { low }, high])
}

/// First bin at which the sum exceeds `outside`.
fn quantile<'a>(bins: impl Iterator<Item = (usize, &'a f64)>, outside: f64) -> usize {
    let mut sum = 0.0;
    for (bin, power) in bins {
        sum += power;
        if sum > outside {
            return bin;
        }
    }
    0
}
