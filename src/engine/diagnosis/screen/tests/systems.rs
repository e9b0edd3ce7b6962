//! Small rigs, integrated by the classical Runge-Kutta method without any code of the screen.

use crate::diagnosis::screen::{Channel, Record, Recording};
use crate::{Quantity, Signal};

/// Samples a second of every rig here.
pub const RATE_HZ: f64 = 100.0;
const STEPS: usize = 6;
/// Natural frequency and damping of the oscillator, rad/s and 1/s.
const OMEGA: f64 = 25.0;
const DAMPING: f64 = 2.0;

/// Noise below some 10 Hz of unit deviation, from a seed.
pub fn noise(n: usize, seed: u64) -> Vec<f64> {
    let mut white = white(seed);
    let (mut a, mut b) = (0.0, 0.0);
    let x: Vec<f64> = (0..n)
        .map(|_| {
            a += 0.45 * (white() - a);
            b += 0.45 * (a - b);
            b
        })
        .collect();
    let level = (x.iter().map(|x| x * x).sum::<f64>() / n as f64).sqrt();
    x.iter().map(|x| x / level).collect()
}

/// Uniform numbers of zero mean.
pub fn white(seed: u64) -> impl FnMut() -> f64 {
    let mut state = seed.wrapping_mul(0x9E37_79B9_7F4A_7C15) + 1;
    move || {
        state ^= state << 13;
        state ^= state >> 7;
        state ^= state << 17;
        (state >> 11) as f64 / (1_u64 << 52) as f64 - 1.0
    }
}

/// Displacement and velocity of `y'' + 2 y' + 625 (y + force(y, y')) = 625 u`, `u` straight between samples.
pub fn oscillator(u: &[f64], force: impl Fn(f64, f64) -> f64) -> Vec<f64> {
    let rate = |q: [f64; 2], u: f64| [q[1], OMEGA * OMEGA * (u - q[0] - force(q[0], q[1])) - DAMPING * q[1]];
    states(u, rate).into_iter().map(|q| q[0]).collect()
}

/// The displacement of an oscillator on a spring and a hysteresis in the words of Bouc and Wen, which stiffens as it is
/// loaded and is unloaded steeply.
pub fn hysteretic(u: &[f64]) -> Vec<f64> {
    let rate = |[y, v, z]: [f64; 3], u: f64| {
        let force = 0.5 * y + 0.8 * z;
        [v, OMEGA * OMEGA * (u - force) - DAMPING * v, v - 0.9 * v.abs() * z + 1.2 * v * z.abs()]
    };
    states(u, rate).into_iter().map(|q| q[0]).collect()
}

/// States at every sample of `q' = rate(q, u)` from rest, `u` straight between samples.
fn states<const N: usize>(u: &[f64], rate: impl Fn([f64; N], f64) -> [f64; N]) -> Vec<[f64; N]> {
    let h = 1.0 / (RATE_HZ * STEPS as f64);
    let mut q = [0.0; N];
    let mut out = vec![q];
    for w in u.windows(2) {
        for step in 0..STEPS {
            let at = |part: f64| w[0] + (w[1] - w[0]) * (step as f64 + part) / STEPS as f64;
            let moved = |k: [f64; N], by: f64| std::array::from_fn(|i| q[i] + by * k[i]);
            let k1 = rate(q, at(0.0));
            let k2 = rate(moved(k1, 0.5 * h), at(0.5));
            let k3 = rate(moved(k2, 0.5 * h), at(0.5));
            let k4 = rate(moved(k3, h), at(1.0));
            for i in 0..N {
                q[i] += h / 6.0 * (k1[i] + 2.0 * k2[i] + 2.0 * k3[i] + k4[i]);
            }
        }
        out.push(q);
    }
    out
}

/// Displacements of two masses in a row, the first on a spring to ground and driven by `u`, with a further `force`
/// between them that depends on how far the second is from the first, and how fast it goes from it.
pub fn pair(u: &[f64], force: impl Fn(f64, f64) -> f64) -> [Vec<f64>; 2] {
    let rate = |q: [f64; 4], u: f64| {
        let (d, v) = (q[1] - q[0], q[3] - q[2]);
        let joint = 900.0 * (d + force(d, v)) + 1.5 * v;
        [q[2], q[3], 400.0 * (u - q[0]) - 1.5 * q[2] + joint, -joint]
    };
    let states = states(u, rate);
    [0, 1].map(|mass| states.iter().map(|q| q[mass]).collect())
}

/// The position of a servo axis, `y' = q` with `q' = 40 (15 flow(u - y) - q)`. Without a lag behind the valve its dead
/// zone would be dry friction.
pub fn servo(u: &[f64], flow: impl Fn(f64) -> f64) -> Vec<f64> {
    let rate = |[y, q]: [f64; 2], u: f64| [q, 40.0 * (15.0 * flow(u - y) - q)];
    states(u, rate).into_iter().map(|[y, _]| y).collect()
}

/// The acceleration of a displacement.
pub fn acceleration(y: &[f64]) -> Vec<f64> {
    let at = |k: usize| y[k.min(y.len() - 1)];
    let second = |k: usize| (at(k + 1) - 2.0 * y[k] + at(k.saturating_sub(1))) * RATE_HZ * RATE_HZ;
    (0..y.len()).map(second).collect()
}

/// Drives and responses of one run, `[channel][sample]`.
type Run = (Vec<Vec<f64>>, Vec<Vec<f64>>);

/// Runs with noise of 0.3 % on every response.
pub fn recording(drives: &[Quantity], responses: &[Quantity], runs: Vec<Run>) -> Recording {
    let channels = |name: &str, of: &[Quantity]| -> Vec<Channel> {
        let channel = |(i, quantity): (usize, &Quantity)| Channel {
            name: format!("{name}_{i}"),
            quantity: *quantity,
            size: None,
        };
        of.iter().enumerate().map(channel).collect()
    };
    let records = runs
        .into_iter()
        .enumerate()
        .map(|(i, (drive, mut response))| {
            for (c, y) in response.iter_mut().enumerate() {
                let level = (y.iter().map(|y| y * y).sum::<f64>() / y.len() as f64).sqrt();
                let mut white = white(1000 + 10 * i as u64 + c as u64);
                y.iter_mut().for_each(|y| *y += 0.003 * 3.0_f64.sqrt() * level * white());
            }
            Record {
                drive: Signal::new(RATE_HZ, drive).unwrap(),
                response: Signal::new(RATE_HZ, response).unwrap(),
                added: None,
                started_s: 100.0 * i as f64,
            }
        })
        .collect();
    Recording { drives: channels("drive", drives), responses: channels("response", responses), records }
}

/// One run of the oscillator, driven by a force of deviation `level`.
pub fn run(n: usize, level: f64, force: impl Fn(f64, f64) -> f64) -> Recording {
    let u: Vec<f64> = noise(n, 7).iter().map(|u| level * u).collect();
    let y = oscillator(&u, force);
    recording(&[Quantity::Force], &[Quantity::Displacement], vec![(vec![u], vec![y])])
}
