//! Sine and sweep.

use std::f64::consts::PI;

use super::{check, samples, smooth_step};
use crate::virtual_rig::{DRIVE_LIMIT_KN, SAMPLE_RATE_HZ};
use crate::{EngineError, Signal};

/// Time in which a tone grows from its mean and falls back to it.
const RAMP_S: f64 = 0.5;
/// Highest frequency of a tone: above, a drive that runs straight between samples is a poor sine.
const MAX_HZ: f64 = 100.0;

/// One sine per axis.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Sine {
    /// Length, s.
    pub duration_s: f64,
    /// Frequency per axis.
    pub frequency_hz: [f64; 3],
    /// Amplitude (half the range) per axis, kN.
    pub amplitude_kn: [f64; 3],
    /// Mean per axis, kN.
    pub mean_kn: [f64; 3],
    /// Phase at the start per axis, rad.
    pub phase_rad: [f64; 3],
}

/// Sines that start and end at their mean, with ramps of half a second.
///
/// # Errors
/// Length, frequency, amplitude or mean out of range.
pub fn sine(settings: &Sine) -> Result<Signal, EngineError> {
    let n = samples(settings.duration_s)?;
    let mut channels = Vec::with_capacity(3);
    for axis in 0..3 {
        let (frequency, amplitude, mean) =
            (settings.frequency_hz[axis], settings.amplitude_kn[axis], settings.mean_kn[axis]);
        check_tone(frequency, amplitude, mean)?;
        check("phase_rad", settings.phase_rad[axis], -2.0 * PI, 2.0 * PI)?;
        let value = |k: usize| {
            let t = k as f64 / SAMPLE_RATE_HZ;
            mean + amplitude * ramps(k, n) * (2.0 * PI * frequency * t + settings.phase_rad[axis]).sin()
        };
        channels.push((0..n).map(value).collect());
    }
    Signal::new(SAMPLE_RATE_HZ, channels)
}

/// A sweep of each axis in turn.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Sweep {
    /// Length of all three, s.
    pub duration_s: f64,
    /// Frequency at the start of each axis' third.
    pub from_hz: f64,
    /// Frequency at its end.
    pub to_hz: f64,
    /// Amplitude (half the range), kN.
    pub amplitude_kn: f64,
    /// Mean per axis, kN.
    pub mean_kn: [f64; 3],
}

/// Logarithmic sweeps, x then y then z, a third of the time each; the other axes hold their mean.
///
/// # Errors
/// Length (each third as a drive of its own), frequency, amplitude or mean out of range.
pub fn sweep(settings: &Sweep) -> Result<Signal, EngineError> {
    let third = samples(settings.duration_s / 3.0)?;
    let n = samples(settings.duration_s)?.max(3 * third);
    check_tone(settings.to_hz, settings.amplitude_kn, 0.0)?;
    let octaves = (settings.to_hz / settings.from_hz).ln();
    let length_s = third as f64 / SAMPLE_RATE_HZ;
    let mut channels = Vec::with_capacity(3);
    for axis in 0..3 {
        let mean = settings.mean_kn[axis];
        check_tone(settings.from_hz, settings.amplitude_kn, mean)?;
        let mut channel = vec![mean; n];
        for k in 0..third {
            let t = k as f64 / SAMPLE_RATE_HZ;
            // Instantaneous frequency from (to/from)^(t/T); its integral, which for equal ends is a sine's.
            let cycles = if octaves.abs() < 1e-9 {
                settings.from_hz * t
            } else {
                settings.from_hz * length_s / octaves * ((octaves * t / length_s).exp() - 1.0)
            };
            channel[axis * third + k] += settings.amplitude_kn * ramps(k, third) * (2.0 * PI * cycles).sin();
        }
        channels.push(channel);
    }
    Signal::new(SAMPLE_RATE_HZ, channels)
}

/// Envelope 0..1 at sample `k` of `n`.
fn ramps(k: usize, n: usize) -> f64 {
    let from_end = (n - 1 - k) as f64 / SAMPLE_RATE_HZ;
    smooth_step(k as f64 / SAMPLE_RATE_HZ, RAMP_S) * smooth_step(from_end, RAMP_S)
}

fn check_tone(frequency_hz: f64, amplitude_kn: f64, mean_kn: f64) -> Result<(), EngineError> {
    check("frequency_hz", frequency_hz, 0.01, MAX_HZ)?;
    check("amplitude_kn", amplitude_kn, 0.0, DRIVE_LIMIT_KN)?;
    check("mean_kn", mean_kn, -DRIVE_LIMIT_KN, DRIVE_LIMIT_KN)
}
