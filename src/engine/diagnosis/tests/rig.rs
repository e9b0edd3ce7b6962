//! Two masses in a row, integrated with Runge and Kutta's fourth-order rule at ten steps a sample.
//! The service's tests take this file in too, and call the engine by its crate's name as this file does.

use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};

use rigcast_engine::diagnosis::{Channel, Effect, Input, Mode, Run};
use rigcast_engine::{Quantity, Signal};

pub const RATE: f64 = 256.0;
const STEPS: usize = 10;

/// A force between ground and the first mass, from its displacement and velocity.
pub type Force = fn(f64, f64) -> f64;

pub fn none(_: f64, _: f64) -> f64 {
    0.0
}

/// A hardening spring, written with a hyperbolic sine instead of a cube.
pub fn hardening(x: f64, _: f64) -> f64 {
    900.0 * ((1.2 * x).sinh() - 1.2 * x)
}

/// Dry friction, written with a root instead of a hyperbolic tangent.
pub fn friction(_: f64, v: f64) -> f64 {
    400.0 * v / (v * v + 1.0).sqrt()
}

/// Displacement of the first mass, unit about 1 RMS for a drive of 1 RMS.
pub fn respond(drive: &[f64], force: Force) -> Vec<f64> {
    let (m1, m2, k1, k2, c1, c2) = (1.0, 0.5, 1500.0, 1800.0, 5.0, 4.0);
    let slope = |s: [f64; 4], u: f64| {
        let [x, z, v, w] = s;
        let between = k2 * (z - x) + c2 * (w - v);
        [v, w, (1500.0 * u - k1 * x - c1 * v + between - force(x, v)) / m1, -between / m2]
    };
    let h = 1.0 / (RATE * STEPS as f64);
    let along = |s: [f64; 4], d: [f64; 4], h: f64| std::array::from_fn(|i| s[i] + h * d[i]);
    let mut s = [0.0; 4];
    drive
        .iter()
        .map(|&u| {
            let y = s[0];
            for _ in 0..STEPS {
                let a = slope(s, u);
                let b = slope(along(s, a, 0.5 * h), u);
                let c = slope(along(s, b, 0.5 * h), u);
                let d = slope(along(s, c, h), u);
                s = std::array::from_fn(|i| s[i] + h / 6.0 * (a[i] + 2.0 * b[i] + 2.0 * c[i] + d[i]));
            }
            y
        })
        .collect()
}

pub fn noise_drive(seconds: f64, level: f64, seed: u64) -> Vec<f64> {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let mut stages = [0.0; 5];
    let mut out: Vec<f64> = (0..(seconds * RATE) as usize)
        .map(|_| {
            let mut x: f64 = StandardNormal.sample(&mut rng);
            for s in &mut stages {
                *s += 0.4 * (x - *s);
                x = *s;
            }
            x
        })
        .collect();
    let rms = (out.iter().map(|x| x * x).sum::<f64>() / out.len() as f64).sqrt();
    out.iter_mut().for_each(|x| *x *= level / rms);
    out
}

pub fn run(name: &str, drive: Vec<f64>, force: Force, noise: f64, seed: u64) -> Run {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let response = respond(&drive, force)
        .iter()
        .map(|y| {
            let e: f64 = StandardNormal.sample(&mut rng);
            y + noise * e
        })
        .collect();
    Run {
        name: name.into(),
        drive: Signal::new(RATE, vec![drive]).unwrap(),
        response: Signal::new(RATE, vec![response]).unwrap(),
        simulated: None,
        added: None,
        started_s: seed as f64 * 100.0,
    }
}

fn channel(name: &str) -> Channel {
    Channel {
        name: name.into(),
        axis: Some("x".into()),
        unit: "mm".into(),
        size: None,
        quantity: Quantity::Displacement,
    }
}

/// A catalogue that is quick to try.
pub fn few() -> Vec<Effect> {
    vec![
        Effect::Gain,
        Effect::LinearChange,
        Effect::CubicStiffness,
        Effect::FreeStiffness,
        Effect::CoulombFriction,
        Effect::QuadraticDamping,
        Effect::SensorSaturation,
    ]
}

/// Two repeats at full level, two at half, on a rig with `force`; the baseline is from before.
pub fn request(force: Force, noise: f64) -> Input {
    let (full, half) = (noise_drive(16.0, 1.0, 1), noise_drive(12.0, 0.5, 2));
    Input {
        drives: vec![channel("drive_x")],
        responses: vec![channel("disp_x")],
        baseline: vec![run("low", noise_drive(25.0, 0.4, 3), none, noise, 10)],
        runs: vec![
            run("a", full.clone(), force, noise, 11),
            run("b", half.clone(), force, noise, 12),
            run("c", half, force, noise, 13),
            run("d", full, force, noise, 14),
        ],
        roles: None,
        repeats: vec![vec![0, 3], vec![1, 2]],
        sim_is_linear: false,
        mode: Mode::External,
        catalogue: Effect::ALL.to_vec(),
        material_gap: 0.01,
        drive_limit: None,
        seed: 5,
    }
}
