//! Service loads of a suspension mount on the road, in three independent shapes.
//!
//! A shape is the sum of road roughness (falling PSD with an axle-hop hump, its level wandering with
//! the road's quality), single events (potholes: short, decaying bursts on all axes) and manoeuvres
//! (braking, cornering: plateaus of seconds with load transfer), the classes of load that durability
//! tracks combine (Johannesson & Speckert, Guide to Load Analysis for Durability in Vehicle Engineering,
//! 2014). The three shapes differ in the class that dominates.

use std::f64::consts::PI;

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rand_distr::StandardNormal;
use realfft::num_complex::Complex64;
use rigcast_numerics::fft::RealFftPlanner;

use super::{NOISE_END_HZ, check, from_lines, rms, samples, smooth_step};
use crate::virtual_rig::SAMPLE_RATE_HZ;
use crate::{EngineError, Signal};

/// Largest magnitude on each axis at scale 1 without offset, kN; inside the span of training noise.
pub const SERVICE_PEAK_KN: f64 = 5.0;
/// Offset of SL+ and SL- on every axis, kN: their drive stays in the rising stiffness.
pub const SERVICE_OFFSET_KN: f64 = 3.2;

/// Time in which a service load leaves its offset and comes back to it.
const RAMP_S: f64 = 1.0;
/// Axle hop of passenger cars, and the width of its hump.
const HOP_HZ: f64 = 12.0;
const HOP_WIDTH_HZ: f64 = 3.0;
/// Roughness falls from here on (body bounce).
const BODY_HZ: f64 = 1.5;

/// The three shapes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ServiceShape {
    /// Country road: roughness with some events and bends.
    CountryRoad,
    /// Rough road: high, wandering roughness with many potholes.
    RoughRoad,
    /// Handling course: braking and cornering over a moderate road.
    HandlingCourse,
}

impl ServiceShape {
    /// All three; two for validation, the last for testing.
    pub const ALL: [Self; 3] = [Self::CountryRoad, Self::RoughRoad, Self::HandlingCourse];

    /// Name for runs and tags.
    pub fn name(self) -> &'static str {
        match self {
            Self::CountryRoad => "country-road",
            Self::RoughRoad => "rough-road",
            Self::HandlingCourse => "handling-course",
        }
    }

    fn character(self) -> Character {
        match self {
            Self::CountryRoad => Character {
                roughness: 0.8,
                quality_spread: 0.5,
                events_per_min: 6.0,
                manoeuvres_per_min: 4.0,
            },
            Self::RoughRoad => Character {
                roughness: 1.2,
                quality_spread: 0.7,
                events_per_min: 15.0,
                manoeuvres_per_min: 2.0,
            },
            Self::HandlingCourse => Character {
                roughness: 0.6,
                quality_spread: 0.4,
                events_per_min: 8.0,
                manoeuvres_per_min: 9.0,
            },
        }
    }
}

/// How a shape is mixed; levels are relative, since the peaks are scaled at the end.
struct Character {
    /// Standard deviation of the roughness on an average road.
    roughness: f64,
    /// Standard deviation of the logarithm of the road's level.
    quality_spread: f64,
    events_per_min: f64,
    manoeuvres_per_min: f64,
}

/// One service load.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ServiceLoad {
    /// Which shape.
    pub shape: ServiceShape,
    /// Length, s.
    pub duration_s: f64,
    /// Factor on the shape, 0..=1.5; the programme uses 0.3 to 1.
    pub scale: f64,
    /// Added to every axis, kN.
    pub offset_kn: f64,
}

/// The service load; with the same seed and length, scale and offset change nothing else.
///
/// It starts and ends at its offset and has no content above [`NOISE_END_HZ`].
///
/// # Errors
/// Length, scale or offset out of range.
pub fn service_load(settings: &ServiceLoad, seed: u64) -> Result<Signal, EngineError> {
    let n = samples(settings.duration_s)?;
    check("scale", settings.scale, 0.0, 1.5)?;
    check("offset_kn", settings.offset_kn, -5.0, 5.0)?;
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    rng.set_stream(settings.shape as u64);
    let character = settings.shape.character();

    let mut axes = roughness(n, &character, &mut rng);
    add_events(&mut axes, &character, &mut rng);
    add_manoeuvres(&mut axes, &character, &mut rng);
    for axis in &mut axes {
        band_limit(axis);
        for (k, value) in axis.iter_mut().enumerate() {
            let nearest_end = k.min(n - 1 - k) as f64 / SAMPLE_RATE_HZ;
            *value *= smooth_step(nearest_end, RAMP_S);
        }
        let peak = axis.iter().fold(0.0_f64, |peak, v| peak.max(v.abs()));
        let factor = settings.scale * SERVICE_PEAK_KN / peak;
        axis.iter_mut().for_each(|v| *v = settings.offset_kn + *v * factor);
    }
    Signal::new(SAMPLE_RATE_HZ, axes.into())
}

/// Road roughness: the axes share part of it, as wheel loads do.
fn roughness(n: usize, character: &Character, rng: &mut ChaCha8Rng) -> [Vec<f64>; 3] {
    let gaussian = |rng: &mut ChaCha8Rng, psd: &dyn Fn(f64) -> f64| {
        let mut signal = from_lines(n, |f| {
            let draw = Complex64::new(rng.sample(StandardNormal), rng.sample(StandardNormal));
            draw * psd(f).sqrt()
        });
        // A drive too short for any line of the band stays flat.
        let deviation = rms(&signal);
        if deviation > 0.0 {
            signal.iter_mut().for_each(|v| *v /= deviation);
        }
        signal
    };
    let road = |f: f64| {
        let hop = 0.15 / (1.0 + ((f - HOP_HZ) / HOP_WIDTH_HZ).powi(2));
        1.0 / (1.0 + (f / BODY_HZ).powi(2)) + hop * (1.0 / (1.0 + (f / 30.0).powi(4)))
    };
    // Road quality changes over 5 to 50 s.
    let quality = gaussian(rng, &|f| if (0.02..=0.2).contains(&f) { 1.0 } else { 0.0 });
    let shared = gaussian(rng, &road);
    // Share of the common part: the vertical axis and, behind it, the longitudinal one feel the same bump.
    [0.5, 0.2, 0.7].map(|common: f64| {
        let own = gaussian(rng, &road);
        (0..n)
            .map(|k| {
                let level = character.roughness * (character.quality_spread * quality[k]).exp();
                level * (common * shared[k] + (1.0 - common * common).sqrt() * own[k])
            })
            .collect()
    })
}

/// Potholes and kerbs: decaying bursts near axle hop, strongest on z, then x.
fn add_events(axes: &mut [Vec<f64>; 3], character: &Character, rng: &mut ChaCha8Rng) {
    let n = axes[0].len();
    for _ in 0..count(n, character.events_per_min) {
        let start = rng.random_range(0..n);
        let frequency = rng.random_range(6.0..14.0);
        let decay_s = rng.random_range(0.08..0.2);
        let size = 2.5 * (0.3 * rng.sample::<f64, _>(StandardNormal)).exp();
        for (axis, weight) in axes.iter_mut().zip([0.8, 0.4, 1.0]) {
            let sign = if rng.random_bool(0.5) { 1.0 } else { -1.0 };
            let peak = sign * weight * size * rng.random_range(0.7..1.0);
            for (k, value) in axis.iter_mut().enumerate().skip(start).take((1.5 * SAMPLE_RATE_HZ) as usize) {
                let t = (k - start) as f64 / SAMPLE_RATE_HZ;
                *value += peak * (2.0 * PI * frequency * t).sin() * (-t / decay_s).exp();
            }
        }
    }
}

/// Braking and accelerating (x), cornering (y), both with load transfer on z: plateaus of seconds.
fn add_manoeuvres(axes: &mut [Vec<f64>; 3], character: &Character, rng: &mut ChaCha8Rng) {
    let n = axes[0].len();
    for _ in 0..count(n, character.manoeuvres_per_min) {
        let start = rng.random_range(0..n);
        let hold_s = rng.random_range(1.0..4.0);
        let rise_s = rng.random_range(0.3..0.7);
        let size = rng.random_range(1.0..2.2);
        let sign = if rng.random_bool(0.5) { 1.0 } else { -1.0 };
        let weights = if rng.random_bool(0.5) {
            [sign, 0.1 * sign, 0.5 * sign]
        } else {
            [0.1 * sign, sign, 0.6 * sign]
        };
        let length_s = hold_s + 2.0 * rise_s;
        for (axis, weight) in axes.iter_mut().zip(weights) {
            for (k, value) in
                axis.iter_mut().enumerate().skip(start).take((length_s * SAMPLE_RATE_HZ) as usize)
            {
                let t = (k - start) as f64 / SAMPLE_RATE_HZ;
                *value += weight * size * smooth_step(t, rise_s) * smooth_step(length_s - t, rise_s);
            }
        }
    }
}

/// Number of events in `n` samples; at least one, so that a short load has its character.
fn count(n: usize, per_min: f64) -> usize {
    ((n as f64 / SAMPLE_RATE_HZ / 60.0 * per_min).round() as usize).max(1)
}

/// Removes the mean and, with a tapered edge, everything above the band of noise.
fn band_limit(signal: &mut [f64]) {
    let n = signal.len();
    let mut planner = RealFftPlanner::new();
    let (forward, inverse) = (planner.plan_fft_forward(n), planner.plan_fft_inverse(n));
    let mut spectrum = forward.make_output_vec();
    let proof = "buffers come from the plans, and the lines at zero and half the sample rate stay real";
    forward.process(signal, &mut spectrum).expect(proof);
    let df = SAMPLE_RATE_HZ / n as f64;
    for (k, line) in spectrum.iter_mut().enumerate() {
        let f = k as f64 * df;
        *line *= if k == 0 { 0.0 } else { smooth_step(NOISE_END_HZ - f, 5.0) / n as f64 };
    }
    inverse.process(&mut spectrum, signal).expect(proof);
}
