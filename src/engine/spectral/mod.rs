//! Averaged spectra by Welch's method, in double precision.
//!
//! Conventions: transforms with `exp(-j w t)` (so that an FRF has `exp(+j w t)`), periodic Hann
//! window, one-sided densities in unit^2/Hz (all lines but DC and Nyquist count double), lines at
//! `line * df_hz`. `S_ab` is the average of `A * conj(B)`. Segments never straddle runs. The order
//! of sums depends on sizes alone, so that the result is bit-identical for any thread count.

mod accumulate;
mod cross;
#[cfg(test)]
mod tests;

use serde::{Deserialize, Serialize};

use super::{EngineError, Signal};
use accumulate::accumulate;

pub(crate) use accumulate::{PART_BYTES, PARTS};

pub use cross::CrossSpectra;
pub(crate) use cross::{Means, Record, cross_spectra};

/// The value that is subtracted from each segment before its transform.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Detrend {
    /// Nothing: the mean is kept.
    #[default]
    None,
    /// The segment's own mean.
    Constant,
}

/// Segmentation of a signal (Welch 1967; Bendat and Piersol, Random Data, section 11.5).
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Welch {
    /// Samples per segment, at least one.
    pub segment_len: usize,
    /// Fraction that neighbouring segments share, 0 <= overlap <= [`Welch::MAX_OVERLAP`].
    pub overlap: f64,
    /// The value that is subtracted from each segment.
    pub detrend: Detrend,
}

impl Welch {
    /// Largest overlap: beyond it, segments cost time and add hardly any information.
    pub const MAX_OVERLAP: f64 = 0.95;

    /// Checks the settings.
    ///
    /// # Errors
    /// [`EngineError::Setting`] for an empty segment or an overlap outside its limits.
    pub fn check(&self) -> Result<(), EngineError> {
        if self.segment_len == 0 {
            return Err(EngineError::Setting {
                setting: "segment_len",
                found: "0".into(),
                limit: "at least one sample".into(),
            });
        }
        if !(0.0..=Self::MAX_OVERLAP).contains(&self.overlap) {
            return Err(EngineError::Setting {
                setting: "overlap",
                found: self.overlap.to_string(),
                limit: format!("from 0 to {}", Self::MAX_OVERLAP),
            });
        }
        Ok(())
    }

    /// Samples between the starts of neighbouring segments.
    pub fn hop(&self) -> usize {
        let shared = (self.overlap * self.segment_len as f64).floor() as usize;
        (self.segment_len - shared.min(self.segment_len)).max(1)
    }

    /// Whole segments in a run.
    pub fn n_segments(&self, n_samples: usize) -> usize {
        if n_samples < self.segment_len { 0 } else { (n_samples - self.segment_len) / self.hop() + 1 }
    }

    /// Frequency lines, DC included.
    pub fn n_lines(&self) -> usize {
        self.segment_len / 2 + 1
    }

    /// Number of independent segments that gives the same variance as `n_segments` overlapping ones of one
    /// run when the spectrum is white (Welch 1967, eq. 9). It lies between the number of segments that
    /// share no sample and `n_segments`.
    pub fn effective_averages(&self, n_segments: usize) -> f64 {
        let (window, hop) = (hann(self.segment_len), self.hop());
        let power: f64 = window.iter().map(|w| w * w).sum();
        let n = n_segments as f64;
        let mut shared = 0.0;
        for k in (1..n_segments).take_while(|k| k * hop < self.segment_len) {
            let rho: f64 = window.iter().zip(&window[k * hop..]).map(|(a, b)| a * b).sum::<f64>() / power;
            shared += (n - k as f64) * rho * rho;
        }
        if n_segments == 0 { 0.0 } else { n * n / (n + 2.0 * shared) }
    }
}

/// One-sided power spectral densities.
#[derive(Debug, Clone, PartialEq)]
pub struct Psd {
    /// Distance of lines, Hz.
    pub df_hz: f64,
    /// Segments averaged.
    pub n_averages: usize,
    /// Density, unit^2/Hz, `[channel][line]`.
    pub density: Vec<Vec<f64>>,
}

/// Power spectral density of each channel, averaged over the segments of all runs.
///
/// # Errors
/// Settings outside their limits, runs that differ in channels or sample rate, no whole segment,
/// values so large that their square overflows.
pub fn psd(runs: &[&Signal], welch: &Welch) -> Result<Psd, EngineError> {
    welch.check()?;
    let first =
        *runs.first().ok_or(EngineError::TooShort { what: "runs of a spectrum", needed: 1, found: 0 })?;
    for run in runs {
        same_shape("runs of a spectrum", first, run)?;
    }
    let parts: Vec<Vec<&[f64]>> =
        runs.iter().map(|run| run.channels().iter().map(Vec::as_slice).collect()).collect();
    psd_of_parts(&parts, first.sample_rate_hz(), welch)
}

/// The same over parts of runs, `[part][channel]`, at least one part, each with the same channels.
pub(crate) fn psd_of_parts(
    parts: &[Vec<&[f64]>],
    sample_rate_hz: f64,
    welch: &Welch,
) -> Result<Psd, EngineError> {
    welch.check()?;
    let offsets = vec![0.0; parts[0].len()];
    let pairs: Vec<(usize, usize)> = (0..parts[0].len()).map(|c| (c, c)).collect();
    let sums = accumulate(parts, &offsets, welch, sample_rate_hz, &pairs)?;
    Ok(Psd { df_hz: sums.df_hz, n_averages: sums.n_averages, density: sums.re })
}

/// Refuses a second signal with other channels or another sample rate than the first.
pub(crate) fn same_shape(what: &'static str, first: &Signal, other: &Signal) -> Result<(), EngineError> {
    if other.n_channels() != first.n_channels() {
        let (expected, found) = (first.n_channels(), other.n_channels());
        return Err(EngineError::ChannelCount { what, expected, found });
    }
    let (expected_hz, found_hz) = (first.sample_rate_hz(), other.sample_rate_hz());
    if !Signal::same_rate(expected_hz, found_hz) {
        return Err(EngineError::SampleRate { what, expected_hz, found_hz });
    }
    Ok(())
}

/// Periodic Hann window; a single sample is kept as it is.
pub(crate) fn hann(len: usize) -> Vec<f64> {
    if len == 1 {
        return vec![1.0];
    }
    let step = std::f64::consts::TAU / len as f64;
    (0..len).map(|i| 0.5 - 0.5 * (step * i as f64).cos()).collect()
}
