//! A row of axes, each with a drive and a displacement, of which one bends.

use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};

use super::rig::{RATE, few, noise_drive};
use crate::diagnosis::{Channel, Effect, Input, Mode, Run, diagnose};
use crate::progress::unwatched;
use crate::{Quantity, Signal};

const STEPS: usize = 4;
/// Stiffness between neighbours.
const COUPLING: f64 = 25.0;

/// Displacements, `[axis][sample]`, where the spring of axis `at` stiffens by `cubic` of its stiffness at a unit of motion.
fn respond(drives: &[Vec<f64>], at: usize, cubic: f64) -> Vec<Vec<f64>> {
    let count = drives.len();
    let stiffness = |axis: usize| 700.0 + 1500.0 * axis as f64 / count as f64;
    let (mut x, mut v): (Vec<f64>, Vec<f64>) = (vec![0.0; count], vec![0.0; count]);
    let mut out = vec![Vec::new(); count];
    let h = 1.0 / (RATE * STEPS as f64);
    for k in 0..drives[0].len() {
        let u: Vec<f64> = drives.iter().map(|drive| drive[k]).collect();
        out.iter_mut().zip(&x).for_each(|(out, x)| out.push(*x));
        for _ in 0..STEPS {
            let force = |a: usize| -> f64 {
                let bent = if a == at { cubic * x[a] * x[a] * x[a] } else { 0.0 };
                let beside = [a.checked_sub(1), Some(a + 1).filter(|n| *n < count)];
                let pull: f64 = beside.into_iter().flatten().map(|n| COUPLING * (x[n] - x[a])).sum();
                stiffness(a) * (u[a] - x[a] - bent) - 8.0 * v[a] + pull
            };
            // Velocity first, then displacement with it (semi-implicit Euler): stable, and the same for rig and sim.
            let forces: Vec<f64> = (0..count).map(force).collect();
            v.iter_mut().zip(forces).for_each(|(v, f)| *v += h * f);
            x.iter_mut().zip(&v).for_each(|(x, v)| *x += h * v);
        }
    }
    out
}

fn run(axes: usize, seconds: f64, seeds: [u64; 2], at: usize, cubic: f64) -> Run {
    let drives: Vec<Vec<f64>> =
        (0..axes).map(|a| noise_drive(seconds, 1.0, 1000 * seeds[0] + a as u64)).collect();
    let mut rng = ChaCha8Rng::seed_from_u64(seeds[1]);
    let mut noisy = respond(&drives, at, cubic);
    for y in noisy.iter_mut().flatten() {
        let e: f64 = StandardNormal.sample(&mut rng);
        *y += 0.004 * e;
    }
    let simulated = respond(&drives, at, 0.0);
    Run {
        name: format!("run {}", seeds[1]),
        drive: Signal::new(RATE, drives).unwrap(),
        response: Signal::new(RATE, noisy).unwrap(),
        simulated: Some(Signal::new(RATE, simulated).unwrap()),
        added: None,
        started_s: 100.0 * seeds[1] as f64,
    }
}

/// Two drives, each run twice, on a row of `axes` of which axis `at` has begun to stiffen; the sim is of before.
pub fn request(axes: usize, at: usize, cubic: f64) -> Input {
    let channel = |kind: &str, a: usize| Channel {
        name: format!("{kind} {a}"),
        axis: None,
        unit: "mm".into(),
        size: None,
        quantity: Quantity::Displacement,
    };
    Input {
        drives: (0..axes).map(|a| channel("drive", a)).collect(),
        responses: (0..axes).map(|a| channel("response", a)).collect(),
        baseline: vec![run(axes, 40.0, [1, 1], at, 0.0)],
        runs: [[2, 2], [2, 3], [3, 4], [3, 5]].map(|seeds| run(axes, 16.0, seeds, at, cubic)).into(),
        roles: None,
        repeats: vec![vec![0, 1], vec![2, 3]],
        sim_is_linear: true,
        mode: Mode::External,
        catalogue: few(),
        material_gap: 0.02,
        drive_limit: None,
        seed: 5,
    }
}

#[test]
fn of_many_responses_the_one_that_bends_is_named_and_its_law_runs_on_all() {
    let input = request(12, 3, 0.012);
    let found = diagnose(&input, &unwatched).unwrap();
    let verdict = &found.report.verdict;
    assert_eq!(verdict.effect, Some(Effect::CubicStiffness), "{verdict:?}");
    assert_eq!(verdict.at.as_deref(), Some("response 3"));
    assert!(
        found.report.warnings.contains(&"responses_left_out: 9".to_owned()),
        "{:?}",
        found.report.warnings
    );
    let augmented = &found.augmented[0];
    assert_eq!(augmented.response(), 3);
    let run = &input.runs[0];
    let sim = run.simulated.as_ref().unwrap();
    let with = augmented.apply(&run.drive, sim, None).unwrap();
    let left = |sim: &Signal, r: usize| -> f64 {
        let pairs = sim.channel(r).iter().zip(run.response.channel(r)).skip(1000);
        pairs.map(|(sim, y)| (sim - y) * (sim - y)).sum()
    };
    assert!(left(&with, 3) < 0.05 * left(sim, 3), "{} of {}", left(&with, 3), left(sim, 3));
    assert!(left(&with, 2) < 0.5 * left(sim, 2), "{} of {}", left(&with, 2), left(sim, 2));
    assert_eq!(with.channel(9), sim.channel(9));
}
