//! The period by which a cyclic drive repeats, and how well the responses repeat with it: the noise floor of the run,
//! below which no model can be told from another.
//!
//! A part of the first drive is sought in the rest of the run by its normalised correlation. The shortest lag at which all
//! drives repeat over the whole run is the period.

use std::io;

use rigcast_numerics::fft::RealFftPlanner;

use super::SHORTEST;
use super::excerpt::spread;
use crate::Samples;

/// Longest period that is sought, samples; half the run if it is shorter.
pub const LONGEST_PERIOD: usize = 1 << 21;
/// Longest part of the drive that is sought.
const PATTERN: usize = 4096;
/// Correlation at which a lag is looked at closer. Noise of 10 % of a drive's RMS leaves 0.99.
const ALIKE: f64 = 0.99;
/// Correlation below which the pattern has left its own place.
const UNLIKE: f64 = 0.5;
/// Lags that are looked at closer.
const CANDIDATES: usize = 64;
/// Excerpts, and their samples, in which repeats are compared.
const EXCERPTS: usize = 32;
const EXCERPT: usize = 1024;
/// A drive repeats if one period differs from another by this share of its standard deviation, divided by the root
/// of two. Beyond it, differences of the responses are the drive's rather than noise.
const DRIVES_DIFFER: f64 = 0.05;

/// Repeats of a cyclic drive.
#[derive(Debug, Clone, PartialEq)]
pub struct Repeats {
    /// Samples of one period.
    pub period_samples: u64,
    /// Whole periods in the run, at least two.
    pub count: u64,
    /// Largest over the drives of: RMS difference of one period from the next / sqrt(2) / standard deviation.
    pub drives_differ: f64,
    /// The same of each response: its noise over its signal. Of four periods and more the last quarter of the run
    /// counts (two periods at least), of three the last two: the rig comes from rest at the start, and its transient
    /// is no noise.
    pub noise: Vec<f64>,
}

/// Repeats of a run; `drives` and `responses` are channels that move.
///
/// # Errors
/// Those of the file that holds the samples.
pub fn repeats(
    samples: &mut impl Samples,
    drives: &[usize],
    responses: &[usize],
) -> io::Result<Option<Repeats>> {
    let n = samples.n_samples();
    let Some(&drive) = drives.first() else { return Ok(None) };
    if n < SHORTEST {
        return Ok(None);
    }
    for period in candidates(samples, drive)? {
        let mut largest = 0.0f64;
        for &drive in drives {
            largest = largest.max(difference(samples, drive, period, 0)?);
            if largest.is_nan() || largest > DRIVES_DIFFER {
                break;
            }
        }
        if largest.is_nan() || largest > DRIVES_DIFFER {
            continue;
        }
        let from = if n >= 4 * period {
            n - (n / 4).max(2 * period)
        } else if n >= 3 * period {
            period
        } else {
            0
        };
        let noise: Vec<f64> = responses
            .iter()
            .map(|&response| difference(samples, response, period, from))
            .collect::<io::Result<_>>()?;
        if noise.iter().any(|share| !share.is_finite()) {
            return Ok(None);
        }
        let (period_samples, count) = (period as u64, (n / period) as u64);
        return Ok(Some(Repeats { period_samples, count, drives_differ: largest, noise }));
    }
    Ok(None)
}

/// RMS of `x(t + period) - x(t)` / sqrt(2) / standard deviation over excerpts from sample `from` on; not finite for a
/// channel that rests there.
fn difference(samples: &mut impl Samples, channel: usize, period: usize, from: usize) -> io::Result<f64> {
    let n = samples.n_samples() - period - from;
    let (mut first, mut second) = (Vec::new(), Vec::new());
    for range in spread(n, EXCERPT.min(n), EXCERPTS) {
        samples.read(channel, from + range.start..from + range.end, &mut first)?;
        samples.read(channel, from + range.start + period..from + range.end + period, &mut second)?;
    }
    let scale = first.iter().chain(&second).fold(0.0, |max: f64, v| max.max(v.abs()));
    let len = first.len() as f64;
    let mean = first.iter().map(|v| v / scale).sum::<f64>() / len;
    let power = first.iter().map(|v| (v / scale - mean).powi(2)).sum::<f64>();
    let between = first.iter().zip(&second).map(|(a, b)| (b / scale - a / scale).powi(2)).sum::<f64>();
    Ok((between / 2.0 / power).sqrt())
}

/// Lags, ascending, at which a part of a channel comes again.
fn candidates(samples: &mut impl Samples, channel: usize) -> io::Result<Vec<usize>> {
    let n = samples.n_samples();
    let len = PATTERN.min(n / 8);
    let (start, pattern) = pattern(samples, channel, len)?;
    let energy = pattern.iter().map(|v| v * v).sum::<f64>();
    if !(energy > 0.0 && energy.is_finite()) {
        return Ok(Vec::new());
    }
    let size = (4 * len).next_power_of_two();
    let mut planner = RealFftPlanner::new();
    let (forward, inverse) = (planner.plan_fft_forward(size), planner.plan_fft_inverse(size));
    let transformed = |values: &[f64]| {
        let (mut input, mut output) = (forward.make_input_vec(), forward.make_output_vec());
        input[..values.len()].copy_from_slice(values);
        forward.process(&mut input, &mut output).expect("buffers have the plan's size");
        output
    };
    let sought = transformed(&pattern);
    let last = (n / 2).min(LONGEST_PERIOD).min(n - start - len);
    let lags = size - len + 1;
    let (mut found, mut left, mut before, mut rising) = (Vec::new(), false, 1.0, false);
    let (mut block, mut product) = (Vec::new(), inverse.make_output_vec());
    for first in (1..=last).step_by(lags) {
        block.clear();
        samples.read(channel, start + first..(start + first + size).min(n), &mut block)?;
        let mean = block.iter().sum::<f64>() / block.len() as f64;
        block.iter_mut().for_each(|v| *v -= mean);
        let mut spectrum = transformed(&block);
        spectrum.iter_mut().zip(&sought).for_each(|(z, s)| *z *= s.conj());
        // Lines of real signals: rounding leaves nothing worth keeping at DC and Nyquist.
        (spectrum[0].im, spectrum[size / 2].im) = (0.0, 0.0);
        inverse.process(&mut spectrum, &mut product).expect("buffers have the plan's size");
        let (mut sum, mut squares) = (0.0, 0.0);
        let mut windows = Vec::with_capacity(block.len() + 1);
        windows.push((0.0, 0.0));
        for v in &block {
            (sum, squares) = (sum + v, squares + v * v);
            windows.push((sum, squares));
        }
        for k in 0..lags.min(last + 1 - first) {
            let (low, high) = (windows[k], windows[k + len]);
            let local = (high.1 - low.1) - (high.0 - low.0).powi(2) / len as f64;
            // Where the channel rests, nothing is alike.
            let alike =
                if local > 1e-6 * energy { product[k] / size as f64 / (energy * local).sqrt() } else { 0.0 };
            left |= alike < UNLIKE;
            if left && rising && alike < before && before >= ALIKE {
                found.push(first + k - 1);
                if found.len() == CANDIDATES {
                    return Ok(found);
                }
            }
            (rising, before) = (alike > before, alike);
        }
    }
    // The last lag has no other after it.
    if left && rising && before >= ALIKE {
        found.push(last);
    }
    Ok(found)
}

/// The part with the most power of some parts of the first half of a channel, its mean subtracted, and its first sample.
fn pattern(samples: &mut impl Samples, channel: usize, len: usize) -> io::Result<(usize, Vec<f64>)> {
    let n = samples.n_samples();
    let mut best = (0, Vec::new(), -1.0);
    for k in 1..8 {
        let start = k * (n / 2 - len) / 8;
        let mut part = Vec::with_capacity(len);
        samples.read(channel, start..start + len, &mut part)?;
        let mean = part.iter().sum::<f64>() / len as f64;
        part.iter_mut().for_each(|v| *v -= mean);
        let power = part.iter().map(|v| v * v).sum::<f64>();
        if power > best.2 {
            best = (start, part, power);
        }
    }
    Ok((best.0, best.1))
}
