//! White-pink noise with a mean, as in the paper's linear study (arXiv 2107.03645, sec. 3.5).

use rand::seq::SliceRandom;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use realfft::num_complex::Complex64;

use super::{check, from_lines, rms, samples, smooth_step};
use crate::virtual_rig::{DRIVE_LIMIT_KN, SAMPLE_RATE_HZ};
use crate::{EngineError, Signal};

/// The PSD is white up to here, then falls as 1/f.
pub const NOISE_CORNER_HZ: f64 = 20.0;
/// Above, the PSD is zero.
pub const NOISE_END_HZ: f64 = 50.0;
/// Training noise draws its mean from -4..4 kN.
pub const NOISE_MEAN_KN: f64 = 4.0;
/// Training noise draws its amplitude (three standard deviations) from here, kN.
pub const NOISE_AMPLITUDE_KN: [f64; 2] = [0.5, 2.0];
/// Boundary noise draws the size of its mean from here, kN; its sign is drawn per axis.
pub const BOUNDARY_MEAN_KN: [f64; 2] = [4.0, 5.5];

/// Amplitude of linear noise on every axis, kN; its peaks stay below the load at which any stop engages.
const LINEAR_AMPLITUDE_KN: f64 = 1.0;
/// Time in which noise grows from its mean, or passes from one mean to the next.
const RAMP_S: f64 = 1.0;

/// Noise of one mean and level per axis.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Noise {
    /// Length, s.
    pub duration_s: f64,
    /// Mean per axis, kN.
    pub mean_kn: [f64; 3],
    /// Three standard deviations per axis, kN.
    pub amplitude_kn: [f64; 3],
}

/// Noise that starts at its mean and reaches its level within a second; axes are uncorrelated.
///
/// # Errors
/// Length, mean or amplitude out of range.
pub fn noise(settings: &Noise, seed: u64) -> Result<Signal, EngineError> {
    stitched(settings.duration_s, &[(settings.mean_kn, settings.amplitude_kn)], seed)
}

/// Small, centred noise from the region where the bench is nearly linear, to fit an FRF.
///
/// # Errors
/// Length out of range.
pub fn linear_noise(duration_s: f64, seed: u64) -> Result<Signal, EngineError> {
    noise(&Noise { duration_s, mean_kn: [0.0; 3], amplitude_kn: [LINEAR_AMPLITUDE_KN; 3] }, seed)
}

/// The region from which mixed noise draws its means.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum NoiseRegion {
    /// Up to [`NOISE_MEAN_KN`] either way: training noise, and N1.
    Interior,
    /// [`BOUNDARY_MEAN_KN`]: N2, a region that training leaves out.
    Boundary,
}

/// Noise whose mean and level change from stretch to stretch.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct MixedNoise {
    /// Length, s.
    pub duration_s: f64,
    /// Length of a stretch of one mean and level, s; the last one may be longer.
    pub stretch_s: f64,
    /// The region of the means.
    pub region: NoiseRegion,
}

/// Noise through several drawn means and levels. Per axis they are a Latin hypercube (McKay, Beckman,
/// Conover 1979): each of n equal parts of the range is used once, so that few stretches cover it evenly.
///
/// # Errors
/// Length of drive or stretch out of range.
pub fn mixed_noise(settings: &MixedNoise, seed: u64) -> Result<Signal, EngineError> {
    check("duration_s", settings.duration_s, super::MIN_DURATION_S, super::MAX_DURATION_S)?;
    check("stretch_s", settings.stretch_s, super::MIN_DURATION_S, super::MAX_DURATION_S)?;
    let n = ((settings.duration_s / settings.stretch_s).floor() as usize).max(1);
    stitched(settings.duration_s, &draw_stretches(n, settings.region, seed), seed)
}

/// Mean and amplitude per axis, kN.
pub(in crate::virtual_rig) type NoiseLevel = ([f64; 3], [f64; 3]);

/// `n` stretches that cover a region evenly per axis.
pub(in crate::virtual_rig) fn draw_stretches(n: usize, region: NoiseRegion, seed: u64) -> Vec<NoiseLevel> {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    rng.set_stream(1);
    let mut stretches = vec![([0.0; 3], [0.0; 3]); n];
    for axis in 0..3 {
        let means = latin_column(n, &mut rng);
        let levels = latin_column(n, &mut rng);
        for (stretch, (mean, level)) in stretches.iter_mut().zip(means.into_iter().zip(levels)) {
            let [low, high] = BOUNDARY_MEAN_KN;
            stretch.0[axis] = match region {
                NoiseRegion::Interior => NOISE_MEAN_KN * (2.0 * mean - 1.0),
                // Both signs share the unit interval: its halves are the two boundaries.
                NoiseRegion::Boundary => {
                    (low + (high - low) * (2.0 * mean).fract()) * if mean < 0.5 { -1.0 } else { 1.0 }
                }
            };
            let [low, high] = NOISE_AMPLITUDE_KN;
            stretch.1[axis] = low + (high - low) * level;
        }
    }
    stretches
}

/// One value from each of `n` equal parts of 0..1, in drawn order.
fn latin_column(n: usize, rng: &mut ChaCha8Rng) -> Vec<f64> {
    let mut column: Vec<f64> = (0..n).map(|i| (i as f64 + rng.random::<f64>()) / n as f64).collect();
    column.shuffle(rng);
    column
}

/// Noise through equally long stretches; the first starts at its mean.
pub(in crate::virtual_rig) fn stitched(
    duration_s: f64,
    stretches: &[NoiseLevel],
    seed: u64,
) -> Result<Signal, EngineError> {
    let n = samples(duration_s)?;
    for (means, amplitudes) in stretches {
        for axis in 0..3 {
            check("mean_kn", means[axis], -DRIVE_LIMIT_KN, DRIVE_LIMIT_KN)?;
            check("amplitude_kn", amplitudes[axis], 0.0, DRIVE_LIMIT_KN)?;
        }
    }
    let stretch_len = n / stretches.len();
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let channels = (0..3)
        .map(|axis| {
            let unit = unit_noise(n, &mut rng);
            let mut channel = Vec::with_capacity(n);
            for (t, value) in unit.into_iter().enumerate() {
                let index = (t / stretch_len).min(stretches.len() - 1);
                let share = smooth_step((t - index * stretch_len) as f64 / SAMPLE_RATE_HZ, RAMP_S);
                let (to_mean, to_level) = (stretches[index].0[axis], stretches[index].1[axis]);
                let (from_mean, from_level) = match index {
                    0 => (to_mean, 0.0),
                    _ => (stretches[index - 1].0[axis], stretches[index - 1].1[axis]),
                };
                let mean = from_mean + (to_mean - from_mean) * share;
                let level = from_level + (to_level - from_level) * share;
                channel.push(mean + level / 3.0 * value);
            }
            channel
        })
        .collect();
    Signal::new(SAMPLE_RATE_HZ, channels)
}

/// White-pink noise of standard deviation 1: given line amplitudes, drawn phases.
fn unit_noise(n: usize, rng: &mut ChaCha8Rng) -> Vec<f64> {
    let mut signal = from_lines(n, |f| {
        let psd = match f {
            f if f <= NOISE_CORNER_HZ => 1.0,
            f if f <= NOISE_END_HZ => NOISE_CORNER_HZ / f,
            _ => return Complex64::ZERO,
        };
        Complex64::from_polar(psd.sqrt(), rng.random_range(0.0..2.0 * std::f64::consts::PI))
    });
    let scale = 1.0 / rms(&signal);
    signal.iter_mut().for_each(|v| *v *= scale);
    signal
}
