//! Sound runs of many kinds and seeds give no warning about a fault. What they are made of is written down here, so
//! that every warning would be a false one.

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rand_distr::StandardNormal;

use super::{Quality, Role};
use crate::engine::Signal;
use crate::engine::virtual_rig::drives::{
    MixedNoise, NoiseRegion, ServiceLoad, ServiceShape, Sine, Sweep, linear_noise, mixed_noise, service_load,
    sine, sweep,
};
use crate::engine::virtual_rig::{CHANNELS, VirtualRig};

const RATE_HZ: f64 = 1000.0;

pub(super) fn gaussian(n: usize, seed: u64) -> Vec<f64> {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    (0..n).map(|_| rng.sample(StandardNormal)).collect()
}

/// The response of a single mode to `u`, by the exact recursion of its poles; gain 1 at rest.
pub(super) fn mode(u: &[f64], f_hz: f64, damping: f64) -> Vec<f64> {
    let w = std::f64::consts::TAU * f_hz / RATE_HZ;
    let (r, turn) = ((-damping * w).exp(), w * (1.0 - damping * damping).sqrt());
    let (a1, a2) = (2.0 * r * turn.cos(), -r * r);
    let gain = 1.0 - a1 - a2;
    let (mut y1, mut y2) = (0.0, 0.0);
    u.iter()
        .map(|u| {
            let y = gain * u + a1 * y1 + a2 * y2;
            (y2, y1) = (y1, y);
            y
        })
        .collect()
}

/// Figures of one drive and one response.
pub(super) fn assess(u: Vec<f64>, y: Vec<f64>) -> Quality {
    let names = ["u".to_owned(), "y".to_owned()];
    let mut signal = Signal::new(RATE_HZ, vec![u, y]).unwrap();
    Quality::assess(&names, &[Role::Drive, Role::Response], &mut signal).unwrap()
}

/// Warnings of the faults; flat tops of square waves and pauses are told as clipping, which is no part of it.
pub(super) fn faults(quality: &Quality) -> Vec<&String> {
    let told_before = |w: &&String| {
        w.contains("probably clipped")
            || w.contains("its mean is")
            || w.contains("is constant")
            || w.contains("repeats u")
    };
    quality.warnings.iter().filter(|w| !told_before(w)).collect()
}

#[test]
fn sound_runs_of_one_drive_give_no_warning_over_200_seeds_of_each_kind() {
    let n = 34_000;
    let mut false_alarms = Vec::new();
    for seed in 0..200 {
        let mut rng = ChaCha8Rng::seed_from_u64(1_000_000 + seed);
        let noise = gaussian(n, seed);
        let small = gaussian(n, 5_000 + seed);
        let time = |i: usize| i as f64 / RATE_HZ;
        let f_hz = rng.random_range(0.5..120.0);
        let tone = |i: usize| (std::f64::consts::TAU * f_hz * time(i)).sin();
        let period = rng.random_range(20..3300);
        let square = |i: usize| if (i / period).is_multiple_of(2) { 1.0 } else { -1.0 };
        // A binary sequence whose bits last from one sample on.
        let bit = rng.random_range(1..50);
        let bits: Vec<f64> =
            (0..n / bit + 1).map(|_| if rng.random::<bool>() { 0.5 } else { -0.5 }).collect();
        let sweep = |i: usize| {
            let t = time(i) / time(n);
            (std::f64::consts::TAU * (time(n) / 200f64.ln()) * ((200f64.ln() * t).exp() - 1.0)).sin()
        };
        // Bursts of noise with rests, as in burst random excitation.
        let burst = |i: usize| if i % 8192 < 6000 { noise[i] } else { 0.0 };
        let kinds: [(&str, Vec<f64>); 9] = [
            ("white noise", noise.clone()),
            ("noise in a band", mode(&mode(&noise, 40.0, 0.7), 40.0, 0.7)),
            ("narrow noise", mode(&noise, 8.0, 0.02)),
            ("sine", (0..n).map(tone).collect()),
            ("triangle", (0..n).map(|i| ((i % (2 * period)) as f64 / period as f64 - 1.0).abs()).collect()),
            ("square wave", (0..n).map(square).collect()),
            ("binary sequence", (0..n).map(|i| bits[i / bit]).collect()),
            ("sweep", (0..n).map(sweep).collect()),
            ("burst noise", (0..n).map(burst).collect()),
        ];
        for (kind, u) in kinds {
            // A mode, sometimes at 50 Hz and with hardly any damping. Each kind meets each response over the seeds.
            let f_hz = if seed.is_multiple_of(2) { 50.0 } else { rng.random_range(5.0..100.0) };
            let driven = mode(&u, f_hz, [0.003, 0.02, 0.1][seed as usize % 3]);
            let rms = (driven.iter().map(|v| v * v).sum::<f64>() / n as f64).sqrt();
            let noisy = driven.iter().zip(&small).map(|(y, e)| y + 0.01 * rms * e);
            let (made, y): (_, Vec<f64>) = match (seed / 3) % 6 {
                0 => ("a mode", driven),
                1 => ("itself", u.clone()),
                2 => ("a noisy mode", noisy.collect()),
                3 => ("a mode in steps", noisy.map(|y| (y / (0.01 * rms)).round() * 0.01 * rms).collect()),
                4 => (
                    "a mode in singles about an offset",
                    noisy.map(|y| f64::from((y + 100.0 * rms) as f32)).collect(),
                ),
                _ => {
                    let bends = driven.windows(3).map(|w| w[0] - 2.0 * w[1] + w[2]);
                    ("its acceleration", bends.chain([0.0, 0.0]).collect())
                }
            };
            let quality = assess(u, y);
            for warning in faults(&quality) {
                false_alarms.push(format!("{kind} {seed}, {made}: {warning}"));
            }
        }
    }
    assert!(
        false_alarms.is_empty(),
        "{} of 1,800 runs: {:#?}",
        false_alarms.len(),
        &false_alarms[..false_alarms.len().min(40)]
    );
}

#[test]
fn the_drives_and_responses_of_the_virtual_rig_give_no_warning() {
    let names: Vec<String> = CHANNELS.iter().map(|c| c.name.to_owned()).collect();
    let roles: Vec<Role> = (0..9).map(|c| if c < 3 { Role::Drive } else { Role::Response }).collect();
    let mut false_alarms = Vec::new();
    for seed in 0..30u64 {
        let load = ServiceLoad {
            shape: ServiceShape::ALL[seed as usize % 3],
            duration_s: 36.0,
            scale: 0.3 + 0.7 * (seed % 8) as f64 / 7.0,
            offset_kn: if seed.is_multiple_of(5) { 1.0 } else { 0.0 },
        };
        let mixed = MixedNoise { duration_s: 36.0, stretch_s: 10.0, region: NoiseRegion::Interior };
        let tones = Sine {
            duration_s: 36.0,
            frequency_hz: [2.0 + seed as f64 / 4.0, 3.0, 5.0],
            amplitude_kn: [1.0; 3],
            mean_kn: [0.0; 3],
            phase_rad: [0.0; 3],
        };
        let swept = Sweep {
            duration_s: 36.0,
            from_hz: 0.5,
            to_hz: 50.0 + seed as f64 / 4.0,
            amplitude_kn: 1.0,
            mean_kn: [0.0; 3],
        };
        let (kind, drive) = match seed % 5 {
            0 => ("noise", linear_noise(36.0, seed)),
            1 => ("mixed noise", mixed_noise(&mixed, seed)),
            2 => ("service load", service_load(&load, seed)),
            3 => ("sine", sine(&tones)),
            _ => ("sweep", sweep(&swept)),
        };
        let drive = drive.unwrap();
        let response = VirtualRig::draw(seed).simulate(&drive, seed).unwrap();
        let channels = drive.channels().iter().chain(response.channels()).cloned().collect();
        let quality = Quality::assess(&names, &roles, &mut Signal::new(RATE_HZ, channels).unwrap()).unwrap();
        false_alarms.extend(faults(&quality).into_iter().map(|w| format!("{kind} {seed}: {w}")));
    }
    assert!(
        false_alarms.is_empty(),
        "{}: {:#?}",
        false_alarms.len(),
        &false_alarms[..false_alarms.len().min(40)]
    );
}
