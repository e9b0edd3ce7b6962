//! Frequency response functions: estimated from noise runs, applied to drives of any length.
//!
//! Means. One working point, the mean over all fitted runs, is subtracted from every run, and no
//! segment is detrended: offsets that differ from run to run are then excitation at DC, and line 0
//! holds the static gain. [`Frf::apply`] gives `y = y_mean + H * (x - x_mean)`, so a preload that
//! is always there comes out as the constant it is, and a drive with another mean is answered by
//! the static gain.

mod apply;
mod band;
mod choose;
mod data;
mod estimate;
mod inverse;
mod lines;
mod quality;
mod settings;
mod summary;
#[cfg(test)]
mod tests;
mod warnings;

use realfft::num_complex::Complex64;

use super::EngineError;

pub use apply::FrfFilter;
pub use choose::estimate_bytes;
pub use data::RunPart;
pub use estimate::{FrfEstimate, estimate, estimate_parts};
pub use inverse::{DEFAULT_RIDGE, FrfInverse};
pub use quality::{FrfQuality, MAX_CONDITION};
pub use settings::{Estimator, FrfSettings};
pub use summary::{FrfSummary, InputSummary, MeasuredSummary, OutputSummary};
pub use warnings::{LARGE_ERROR, LOW_COHERENCE, LOW_SHARE, low_coherence};

/// A frequency response function `H[line, output, input]` with `exp(+j w t)`.
///
/// Lines lie at `line * sample_rate_hz / segment_len` for `line = 0..=segment_len / 2`.
/// Applied as `y = y_mean + H * (x - x_mean)`, so that a static preload comes out right.
#[derive(Debug, Clone, PartialEq)]
pub struct Frf {
    /// Sample rate of inputs and outputs.
    pub sample_rate_hz: f64,
    /// Samples per segment, even; there are `segment_len / 2 + 1` lines.
    pub segment_len: usize,
    /// Input channels.
    pub n_inputs: usize,
    /// Output channels.
    pub n_outputs: usize,
    /// Response per input, output unit / input unit, `[line, output, input]`.
    pub h: Vec<Complex64>,
    /// First and last frequency that the inputs excited; outside, `h` is tapered to zero.
    pub usable_hz: [f64; 2],
    /// Working point: mean of each input over the fitted runs.
    pub x_mean: Vec<f64>,
    /// Working point: mean of each output over the fitted runs.
    pub y_mean: Vec<f64>,
}

impl Frf {
    /// Frequency lines, DC and Nyquist included.
    pub fn n_lines(&self) -> usize {
        self.segment_len / 2 + 1
    }

    /// Distance of lines, Hz.
    pub fn df_hz(&self) -> f64 {
        self.sample_rate_hz / self.segment_len as f64
    }

    /// `H` of one pair at one line, output unit / input unit.
    ///
    /// # Panics
    /// If there is no such line, output or input.
    pub fn at(&self, line: usize, output: usize, input: usize) -> Complex64 {
        assert!(output < self.n_outputs && input < self.n_inputs, "no such channel");
        self.h[(line * self.n_outputs + output) * self.n_inputs + input]
    }

    /// Checks that the fields belong together; an estimate always passes, an import may not.
    ///
    /// # Errors
    /// A segment length that is odd or zero, arrays of another size than the counts say, a rate
    /// that is not positive, NaN or infinity.
    pub fn check(&self) -> Result<(), EngineError> {
        if self.segment_len < 2 || !self.segment_len.is_multiple_of(2) {
            return Err(EngineError::Setting {
                setting: "frf.segment_len",
                found: self.segment_len.to_string(),
                limit: "even, at least 2".into(),
            });
        }
        if !(self.sample_rate_hz.is_finite() && self.sample_rate_hz > 0.0) {
            return Err(EngineError::Setting {
                setting: "sample_rate_hz",
                found: self.sample_rate_hz.to_string(),
                limit: "a positive, finite number of hertz".into(),
            });
        }
        for (what, count, mean) in
            [("frf inputs", self.n_inputs, &self.x_mean), ("frf outputs", self.n_outputs, &self.y_mean)]
        {
            if count == 0 || mean.len() != count {
                return Err(EngineError::ChannelCount { what, expected: count.max(1), found: mean.len() });
            }
            if let Some(channel) = mean.iter().position(|v| !v.is_finite()) {
                return Err(EngineError::NonFinite { what, channel, sample: 0 });
            }
        }
        let expected = vec![self.n_lines(), self.n_outputs, self.n_inputs];
        if expected.iter().try_fold(1_usize, |n, &d| n.checked_mul(d)) != Some(self.h.len()) {
            return Err(EngineError::TensorShape {
                tensor: "frf.h".into(),
                expected,
                found: vec![self.h.len()],
            });
        }
        if let Some(at) = self.h.iter().position(|z| !(z.re.is_finite() && z.im.is_finite())) {
            let (channel, sample) =
                (at / self.n_inputs % self.n_outputs, at / (self.n_inputs * self.n_outputs));
            return Err(EngineError::NonFinite { what: "frf line", channel, sample });
        }
        Ok(())
    }
}
