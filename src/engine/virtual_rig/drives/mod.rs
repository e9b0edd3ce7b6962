//! Drives for the bench: noise, service loads, sine and sweep; every one seeded, three channels, kN.
//!
//! *Amplitude* of noise is three standard deviations: the level that the peaks of a short stretch
//! reach. Level and mean are per axis. Lengths are in seconds, at least [`MIN_DURATION_S`].

mod noise;
mod service;
mod tones;

pub use noise::{
    BOUNDARY_MEAN_KN, MixedNoise, NOISE_AMPLITUDE_KN, NOISE_CORNER_HZ, NOISE_END_HZ, NOISE_MEAN_KN, Noise,
    NoiseRegion, linear_noise, mixed_noise, noise,
};
pub(super) use noise::{draw_stretches, stitched};
pub use service::{SERVICE_OFFSET_KN, SERVICE_PEAK_KN, ServiceLoad, ServiceShape, service_load};
pub use tones::{Sine, Sweep, sine, sweep};

use realfft::num_complex::Complex64;
use rigcast_numerics::fft::RealFftPlanner;

use super::SAMPLE_RATE_HZ;
use crate::EngineError;

/// Shortest drive: below two seconds its ramps would fill it.
pub const MIN_DURATION_S: f64 = 2.0;
/// Longest single drive: an hour is longer than any run of the programme.
pub const MAX_DURATION_S: f64 = 3600.0;

/// Samples of a drive of `duration_s`.
fn samples(duration_s: f64) -> Result<usize, EngineError> {
    if !(MIN_DURATION_S..=MAX_DURATION_S).contains(&duration_s) {
        return Err(EngineError::Setting {
            setting: "duration_s",
            found: duration_s.to_string(),
            limit: format!("{MIN_DURATION_S} to {MAX_DURATION_S} seconds"),
        });
    }
    Ok((duration_s * SAMPLE_RATE_HZ).round() as usize)
}

/// Refuses a level or mean that is not a finite number from `low` to `high`.
pub(super) fn check(setting: &'static str, value: f64, low: f64, high: f64) -> Result<(), EngineError> {
    if (low..=high).contains(&value) {
        return Ok(());
    }
    Err(EngineError::Setting { setting, found: value.to_string(), limit: format!("{low} to {high}") })
}

/// Raised cosine from 0 (at `t` <= 0) to 1 (at `t` >= `rise`).
fn smooth_step(t: f64, rise: f64) -> f64 {
    0.5 - 0.5 * (std::f64::consts::PI * (t / rise).clamp(0.0, 1.0)).cos()
}

/// Real signal of `n` samples whose spectral line k at frequency f is `line(f)`; the mean is zero.
fn from_lines(n: usize, mut line: impl FnMut(f64) -> Complex64) -> Vec<f64> {
    let inverse = RealFftPlanner::new().plan_fft_inverse(n);
    let mut spectrum = inverse.make_input_vec();
    let df = SAMPLE_RATE_HZ / n as f64;
    // The last line of an even length must be real; it is half the sample rate, far above any drive.
    let inner = 1..n.div_ceil(2);
    for k in inner {
        spectrum[k] = line(k as f64 * df);
    }
    let mut signal = inverse.make_output_vec();
    inverse
        .process(&mut spectrum, &mut signal)
        .expect("buffers come from the plan, and the lines at zero and half the sample rate are zero");
    signal
}

/// Standard deviation about zero.
fn rms(signal: &[f64]) -> f64 {
    (signal.iter().map(|v| v * v).sum::<f64>() / signal.len() as f64).sqrt()
}
