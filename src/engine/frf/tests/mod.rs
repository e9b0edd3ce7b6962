//! Truth from outside: a linear system of known modes, a slow convolution, measured data.

mod application;
mod estimation;
mod inverse;
mod modal;
mod offsets;
mod quality;
mod real_data;
mod refusals;
mod warnings;

use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};

use super::*;
use crate::progress::unwatched;
use crate::{EngineError, Signal};

/// White Gaussian noise of variance 1.
fn noise(seed: u64, n: usize) -> Vec<f64> {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    (0..n).map(|_| StandardNormal.sample(&mut rng)).collect()
}

fn channels(seed: u64, n_channels: u64, n: usize) -> Vec<Vec<f64>> {
    (0..n_channels).map(|c| noise(seed * 100 + c, n)).collect()
}

fn signal(fs: f64, channels: Vec<Vec<f64>>) -> Signal {
    Signal::new(fs, channels).unwrap()
}

fn fixed(segment_len: usize, ridge: f64) -> FrfSettings {
    FrfSettings { segment_len: Some(segment_len), ridge: Some(ridge), ..FrfSettings::default() }
}

/// Root mean square of the difference over that of the measured deviation from its mean. The ends
/// are left out: what a cut signal did before and after is not in it.
fn relative_error(measured: &[f64], predicted: &[f64]) -> f64 {
    assert_eq!(measured.len(), predicted.len());
    let inside = 200..measured.len() - 200;
    let (measured, predicted) = (&measured[inside.clone()], &predicted[inside]);
    let mean = measured.iter().sum::<f64>() / measured.len() as f64;
    let error: f64 = measured.iter().zip(predicted).map(|(m, p)| (m - p).powi(2)).sum();
    (error / measured.iter().map(|m| (m - mean).powi(2)).sum::<f64>()).sqrt()
}

/// What a signal has between two shares of its Nyquist frequency, cut by FFT over the whole of it.
fn band_limited(samples: &[f64], from: f64, to: f64) -> Vec<f64> {
    let n = samples.len();
    let mut planner = rigcast_numerics::fft::RealFftPlanner::new();
    let (forward, inverse) = (planner.plan_fft_forward(n), planner.plan_fft_inverse(n));
    let mut lines = forward.make_output_vec();
    forward.process(&mut samples.to_vec(), &mut lines).unwrap();
    let nyquist = (n / 2) as f64;
    for (line, z) in lines.iter_mut().enumerate() {
        if !(from * nyquist..to * nyquist).contains(&(line as f64)) {
            *z = Complex64::default();
        }
    }
    let mut out = inverse.make_output_vec();
    inverse.process(&mut lines, &mut out).unwrap();
    out.iter_mut().for_each(|v| *v /= n as f64);
    out
}
