//! Frequency response functions: estimated from noise runs, applied to drives of any length.

mod settings;

use realfft::num_complex::Complex64;

pub use settings::{Estimator, FrfSettings};

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
