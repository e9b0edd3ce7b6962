//! Cases: a rig, a flaw, its strength, drives, repeats and sensor noise, all from one seed.

use rand::{Rng, RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};

use super::rig::{Flaw, RATE, Rig, rms};

/// What the diagnosis may see of a run.
#[derive(Debug, Clone)]
pub struct Record {
    pub drives: Vec<Vec<f64>>,
    pub response: Vec<f64>,
    pub started_s: f64,
}

/// A case and its label.
#[derive(Debug, Clone)]
pub struct Case {
    pub baseline: Vec<Record>,
    pub runs: Vec<Record>,
    pub repeats: Vec<Vec<usize>>,
    pub label: &'static str,
    pub gap: f64,
    pub noise: f64,
}

/// Kinds of cases.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Suite {
    Catalogue,
    Nothing,
    Outside,
    OtherEquation,
}

/// One flaw of a suite with its label; `index` walks through the list evenly.
fn flaw(suite: Suite, index: usize, rng: &mut impl Rng) -> (Flaw, &'static str) {
    let sign = if rng.random_bool(0.5) { 1.0 } else { -1.0 };
    let gap = rng.random_range(0.6..1.8);
    let catalogue: Vec<(Flaw, &'static str)> = vec![
        (Flaw::Gain, "gain"),
        (Flaw::Delay, "delay"),
        (Flaw::ExtraPole, "extra_pole"),
        (Flaw::LinearChange { stiffness: sign, damping: rng.random_range(-0.5..1.0) }, "linear_change"),
        (Flaw::CubicStiffness { bend: rng.random_range(0.0..0.1) }, "cubic_stiffness"),
        (Flaw::QuadraticStiffness, "quadratic_stiffness"),
        (Flaw::BumpStop { gap }, "bump_stop"),
        (Flaw::OneSidedStop { gap, side: sign }, "one_sided_stop"),
        (Flaw::Clearance { gap: rng.random_range(0.2..1.2) }, "clearance"),
        (Flaw::Coulomb { smooth: rng.random_range(0.01..0.08) }, "coulomb_friction"),
        (
            Flaw::Stribeck {
                smooth: rng.random_range(0.02..0.06),
                peak: rng.random_range(0.5..1.5),
                decay: rng.random_range(0.2..0.6),
            },
            "stribeck_friction",
        ),
        (
            Flaw::BoucWen { yielding: rng.random_range(0.2..1.0), sharpness: rng.random_range(1.0..2.0) },
            "bouc_wen_hysteresis",
        ),
        (Flaw::QuadraticDamping, "quadratic_damping"),
        (Flaw::DriveSaturation { skew: rng.random_range(0.6..1.6) }, "drive_saturation"),
        (
            Flaw::DrivePolynomial { even: rng.random_range(-1.0..1.0), odd: rng.random_range(-0.5..0.3) },
            "drive_polynomial",
        ),
        (Flaw::RateLimit, "rate_limit"),
        (Flaw::ValveFlow, "valve_flow"),
        (Flaw::DeadZone, "dead_zone"),
        (Flaw::Backlash, "backlash"),
        (Flaw::CrossLinear, "cross_axis_linear"),
        (Flaw::CrossKinematic { mixed: rng.random_range(-1.0..1.0) }, "cross_axis_kinematic"),
        (Flaw::StiffnessDrift, "stiffness_drift"),
        (Flaw::OffsetDrift, "offset_drift"),
        (Flaw::Offset, "offset"),
        (Flaw::SensorGain, "sensor_gain"),
        (Flaw::SensorSaturation { skew: rng.random_range(0.6..1.6) }, "sensor_saturation"),
        (
            Flaw::SensorNonlinearity { even: rng.random_range(-1.0..1.0), odd: rng.random_range(-0.3..0.3) },
            "sensor_nonlinearity",
        ),
        (Flaw::Sandwich { odd: rng.random_bool(0.5) }, "sandwich"),
    ];
    let list: Vec<(Flaw, &'static str)> = match suite {
        Suite::Catalogue => catalogue,
        Suite::Nothing => vec![
            (Flaw::Nothing, "nothing"),
            (Flaw::RaisedNoise, "raised_noise"),
            (Flaw::Hum { hz: [50.0, 60.0, 16.7, 33.0][rng.random_range(0..4)] }, "periodic_disturbance"),
            (Flaw::Quantisation, "quantisation"),
        ],
        Suite::Outside => vec![
            (Flaw::Cogging { pitch: rng.random_range(0.4..1.2) }, "outside"),
            (Flaw::DropOuts, "outside"),
            (Flaw::UnmeasuredForce, "outside"),
            (Flaw::Parametric { hz: rng.random_range(0.7..4.0) }, "outside"),
            (Flaw::NegativeDamping { width: rng.random_range(0.3..0.8) }, "outside"),
        ],
        Suite::OtherEquation => vec![
            (Flaw::Quintic, "cubic_stiffness"),
            (Flaw::LuGre { smooth: rng.random_range(0.05..0.3) }, "coulomb_friction"),
            (Flaw::TwoStageStop { gap: gap * 0.7 }, "bump_stop"),
            (Flaw::SoftSaturation, "drive_saturation"),
            (Flaw::LeakingFlow { leak: rng.random_range(0.1..0.5) }, "valve_flow"),
        ],
    };
    list[index % list.len()]
}

/// Band-limited noise of RMS 1.
fn noise_drive(n: usize, high_hz: f64, rng: &mut impl Rng) -> Vec<f64> {
    let share = 1.0 - (-std::f64::consts::TAU * high_hz / RATE).exp();
    let mut stages = [0.0; 6];
    let mut slow = 0.0;
    let mut out: Vec<f64> = (0..n + 500)
        .map(|_| {
            let mut x: f64 = StandardNormal.sample(rng);
            for s in &mut stages {
                *s += share * (x - *s);
                x = *s;
            }
            slow += 0.003 * (x - slow);
            x - slow
        })
        .skip(500)
        .collect();
    let level = rms(&out);
    out.iter_mut().for_each(|x| *x /= level);
    out
}

/// Makes the case of one seed.
pub fn case(suite: Suite, index: usize, seed: u64, in_situ: bool) -> Case {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let high_hz = rng.random_range(25.0..45.0);
    let n = |s: f64| (s * RATE) as usize;
    let long = [noise_drive(n(20.0), high_hz, &mut rng), noise_drive(n(20.0), high_hz, &mut rng)];
    let half: Vec<Vec<f64>> =
        (0..2).map(|_| noise_drive(n(15.0), high_hz, &mut rng).iter().map(|u| 0.5 * u).collect()).collect();
    let low: Vec<Vec<f64>> =
        (0..2).map(|_| noise_drive(n(40.0), high_hz, &mut rng).iter().map(|u| 0.5 * u).collect()).collect();
    let (flaw, label) = flaw(suite, index, &mut rng);
    let rig = Rig::draw(&mut rng, &long, flaw);
    let noise = (0.004_f64.ln() + rng.random_range(0.0..1.0) * (5.0_f64).ln()).exp();
    let lowest = (1.2 * noise).max(0.012);
    let wanted = (lowest.ln() + rng.random_range(0.0..1.0) * (0.45 / lowest).ln()).exp();
    let hours = 3600.0;
    let total = 4.0 * hours;
    let starts = [0.2 * hours, 1.4 * hours, 2.6 * hours, 3.9 * hours];
    let times = |k: usize| [starts[k] / total, 1.0 / (RATE * total)];

    let linear = rig.respond(&long, Flaw::Nothing, 0.0, times(3));
    let gap = |s: f64| {
        let y = rig.respond(&long, flaw, s, times(3));
        let difference: Vec<f64> = y.iter().zip(&linear).map(|(a, b)| a - b).collect();
        let gap = rms(&difference) / rms(&y);
        if gap.is_finite() { gap } else { f64::INFINITY }
    };
    let of_recording =
        matches!(flaw, Flaw::Nothing | Flaw::RaisedNoise | Flaw::Hum { .. } | Flaw::Quantisation);
    let (mut low_s, mut high_s) = (1e-4, 3.0);
    if !of_recording {
        for _ in 0..14 {
            let mid = f64::sqrt(low_s * high_s);
            if gap(mid) > wanted { high_s = mid } else { low_s = mid }
        }
    }
    let strength = if of_recording { 0.0 } else { low_s };
    let reached = if of_recording { 0.0 } else { gap(strength) };

    let mut record = |drives: &[Vec<f64>], flaw: Flaw, strength: f64, k: Option<usize>| {
        let time = k.map_or([0.0, 0.0], times);
        let mut response = rig.respond(drives, flaw, strength, time);
        let sigma = noise * if flaw == Flaw::RaisedNoise { 3.0 } else { 1.0 };
        let phase = rng.random_range(0.0..std::f64::consts::TAU);
        for (i, y) in response.iter_mut().enumerate() {
            let e: f64 = StandardNormal.sample(&mut rng);
            *y += sigma * e;
            if let Flaw::Hum { hz } = flaw {
                *y += 2.5 * noise * (std::f64::consts::TAU * hz * i as f64 / RATE + phase).sin();
            }
            if flaw == Flaw::Quantisation {
                let q = 8.0 * noise;
                *y = (*y / q).round() * q;
            }
        }
        Record { drives: drives.to_vec(), response, started_s: k.map_or(0.0, |k| starts[k]) }
    };
    let baseline_flaw = if in_situ { (flaw, strength) } else { (Flaw::Nothing, 0.0) };
    let baseline = vec![record(&low, baseline_flaw.0, baseline_flaw.1, None)];
    let runs = vec![
        record(&long, flaw, strength, Some(0)),
        record(&half, flaw, strength, Some(1)),
        record(&half, flaw, strength, Some(2)),
        record(&long, flaw, strength, Some(3)),
    ];
    Case { baseline, runs, repeats: vec![vec![0, 3], vec![1, 2]], label, gap: reached, noise }
}
