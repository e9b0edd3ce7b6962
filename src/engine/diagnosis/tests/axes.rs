//! Three axes with a stiff coupling, each with a displacement and a force: which axis has the effect?

use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};

use super::rig::{RATE, few, noise_drive};
use crate::diagnosis::{Augmented, Channel, Effect, Family, Input, Mode, Run, VerdictKind, diagnose};
use crate::progress::unwatched;
use crate::{Quantity, Signal};

const STEPS: usize = 10;
const STIFFNESS: [f64; 3] = [900.0, 1600.0, 2500.0];
/// Stiffness between neighbouring axes.
const COUPLING: f64 = 150.0;
const NO_CLIP: [f64; 3] = [f64::INFINITY; 3];

/// A force on one axis from its displacement and velocity.
type Force = fn(f64, f64) -> f64;

fn hardening(x: f64, _: f64) -> f64 {
    800.0 * ((0.4 * x).sinh() - 0.4 * x)
}

fn friction(_: f64, v: f64) -> f64 {
    90.0 * v / (v * v + 1.0).sqrt()
}

/// `[response][sample]`: displacements, then the forces that the springs and the effect take up.
fn respond(drives: &[Vec<f64>], effects: &[(usize, Force)], clip: [f64; 3]) -> Vec<Vec<f64>> {
    let force = |axis: usize, x: f64, v: f64| -> f64 {
        effects.iter().filter(|(at, _)| *at == axis).map(|(_, force)| force(x, v)).sum()
    };
    let held = |x: &[f64; 3], v: &[f64; 3]| -> [f64; 3] {
        std::array::from_fn(|a| STIFFNESS[a] * x[a] + 4.0 * v[a] + force(a, x[a], v[a]))
    };
    let slope = |x: [f64; 3], v: [f64; 3], u: [f64; 3]| -> [f64; 3] {
        let held = held(&x, &v);
        std::array::from_fn(|a| {
            let (next, last) = ((a + 1) % 3, (a + 2) % 3);
            STIFFNESS[a] * u[a] - held[a] + COUPLING * (x[next] + x[last] - 2.0 * x[a])
        })
    };
    let h = 1.0 / (RATE * STEPS as f64);
    let along = |p: [f64; 3], d: [f64; 3], h: f64| -> [f64; 3] { std::array::from_fn(|i| p[i] + h * d[i]) };
    let (mut x, mut v) = ([0.0; 3], [0.0; 3]);
    let mut out = vec![Vec::new(); 6];
    let command = |k: usize| -> [f64; 3] { std::array::from_fn(|a| drives[a][k].clamp(-clip[a], clip[a])) };
    for k in 0..drives[0].len() {
        let u = command(k);
        let f = held(&x, &v);
        for (out, y) in out.iter_mut().zip(x.into_iter().chain(f.map(|f| 1e-3 * f))) {
            out.push(y);
        }
        for _ in 0..STEPS {
            let a1 = slope(x, v, u);
            let (x2, v2) = (along(x, v, 0.5 * h), along(v, a1, 0.5 * h));
            let a2 = slope(x2, v2, u);
            let (x3, v3) = (along(x, v2, 0.5 * h), along(v, a2, 0.5 * h));
            let a3 = slope(x3, v3, u);
            let (x4, v4) = (along(x, v3, h), along(v, a3, h));
            let a4 = slope(x4, v4, u);
            x = std::array::from_fn(|i| x[i] + h / 6.0 * (v[i] + 2.0 * v2[i] + 2.0 * v3[i] + v4[i]));
            v = std::array::from_fn(|i| v[i] + h / 6.0 * (a1[i] + 2.0 * a2[i] + 2.0 * a3[i] + a4[i]));
        }
    }
    out
}

fn drives(seconds: f64, level: f64, seed: u64) -> Vec<Vec<f64>> {
    (0..3).map(|a| noise_drive(seconds, level, 100 * seed + a)).collect()
}

fn run(name: &str, drives: &[Vec<f64>], response: Vec<Vec<f64>>, seed: u64) -> Run {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let noisy = response
        .into_iter()
        .map(|y| {
            let sigma = 0.006 * (y.iter().map(|y| y * y).sum::<f64>() / y.len() as f64).sqrt();
            y.iter()
                .map(|y| {
                    let e: f64 = StandardNormal.sample(&mut rng);
                    y + sigma * e
                })
                .collect()
        })
        .collect();
    Run {
        name: name.into(),
        drive: Signal::new(RATE, drives.to_vec()).unwrap(),
        response: Signal::new(RATE, noisy).unwrap(),
        simulated: None,
        added: None,
        started_s: seed as f64 * 100.0,
    }
}

fn request(effects: &[(usize, Force)], clip: [f64; 3], catalogue: Vec<Effect>) -> Input {
    let channel = |name: &str, axis: &str, unit: &str, quantity| Channel {
        name: format!("{name}_{axis}"),
        axis: Some(axis.into()),
        unit: unit.into(),
        size: None,
        quantity,
    };
    let axes = ["x", "y", "z"];
    let full = drives(16.0, 1.0, 1);
    let half = drives(12.0, 0.5, 2);
    let low = drives(40.0, 0.4, 3);
    let measured =
        |name: &str, drives: &[Vec<f64>], seed| run(name, drives, respond(drives, effects, clip), seed);
    Input {
        drives: axes.map(|a| channel("drive", a, "mm", Quantity::Displacement)).to_vec(),
        responses: axes
            .iter()
            .map(|a| channel("disp", a, "mm", Quantity::Displacement))
            .chain(axes.iter().map(|a| channel("force", a, "kN", Quantity::Force)))
            .collect(),
        baseline: vec![run("low", &low, respond(&low, &[], NO_CLIP), 10)],
        runs: vec![
            measured("a", &full, 11),
            measured("b", &half, 12),
            measured("c", &half, 13),
            measured("d", &full, 14),
        ],
        roles: None,
        repeats: vec![vec![0, 3], vec![1, 2]],
        sim_is_linear: false,
        mode: Mode::External,
        catalogue,
        material_gap: 0.01,
        drive_limit: None,
        seed: 5,
    }
}

/// Checks that an effect leaves less than a tenth of the gap of these responses to a drive that it was not fitted to.
fn closes_a_fresh_drive(augmented: &Augmented, effects: &[(usize, Force)], responses: [usize; 2]) {
    let drive = drives(10.0, 0.9, 9);
    let truth = respond(&drive, effects, NO_CLIP);
    let linear = respond(&drive, &[], NO_CLIP);
    let signal = |channels: &[Vec<f64>]| Signal::new(RATE, channels.to_vec()).unwrap();
    let predicted = augmented.apply(&signal(&drive), &signal(&linear), None).unwrap();
    for r in responses {
        let error = |y: &[f64]| -> f64 { truth[r].iter().zip(y).map(|(t, y)| (t - y).powi(2)).sum() };
        let (before, after) = (error(&linear[r]), error(predicted.channel(r)));
        assert!(after < 0.1 * before, "response {r}: {before} {after}");
    }
}

#[test]
fn the_axis_with_the_effect_is_named_and_the_forces_follow_its_motion() {
    for (axis, force, family) in
        [(1, hardening as Force, Family::Stiffness), (2, friction, Family::FrictionHysteresis)]
    {
        let found = diagnose(&request(&[(axis, force)], NO_CLIP, few()), &unwatched).unwrap();
        let verdict = &found.report.verdict;
        assert_eq!(verdict.family, Some(family), "{verdict:?}");
        assert_eq!(verdict.axis.as_deref(), Some(["x", "y", "z"][axis]), "{verdict:?}");
        let best = &found.report.hypotheses[0];
        let force = format!("force_{}", ["x", "y", "z"][axis]);
        let at_force = best.responses.iter().find(|r| r.channel == force).unwrap();
        assert!(at_force.held_out.closure > 0.9, "{at_force:?}");
        assert!(at_force.held_out.damage_ratio_after.is_some());
    }
}

#[test]
fn the_effect_is_simulated_at_every_response_that_feels_it() {
    let found = diagnose(&request(&[(0, hardening)], NO_CLIP, few()), &unwatched).unwrap();
    // A hyperbolic sine is no law of the catalogue, which may say no more than its family.
    let verdict = &found.report.verdict;
    assert!(matches!(verdict.kind, VerdictKind::Identified | VerdictKind::FamilyOnly), "{verdict:?}");
    assert_eq!((verdict.family, verdict.axis.as_deref()), (Some(Family::Stiffness), Some("x")));
    closes_a_fresh_drive(&found.augmented[0], &[(0, hardening)], [0, 3]);
}

#[test]
fn a_clipped_drive_is_named_by_its_axis() {
    let mut catalogue = few();
    catalogue.push(Effect::DriveSaturation);
    let clip = [f64::INFINITY, 1.4, f64::INFINITY];
    let found = diagnose(&request(&[], clip, catalogue), &unwatched).unwrap();
    let verdict = &found.report.verdict;
    assert_eq!(verdict.effect, Some(Effect::DriveSaturation), "{verdict:?}");
    assert_eq!(verdict.axis.as_deref(), Some("y"));
    let limits: Vec<f64> = found.report.hypotheses[0].parameters.iter().map(|p| p.value.abs()).collect();
    assert!(limits.iter().all(|l| (l - 1.4).abs() < 0.05), "{limits:?}");
}

#[test]
fn effects_on_two_axes_are_one_hypothesis_and_are_simulated_together() {
    let effects = [(0, hardening as Force), (1, friction)];
    let found = diagnose(&request(&effects, NO_CLIP, few()), &unwatched).unwrap();
    let (verdict, best) = (&found.report.verdict, &found.report.hypotheses[0]);
    let on = |axis: &str| best.effects.iter().find(|e| e.axis.as_deref() == Some(axis)).map(|e| e.family);
    assert_eq!(on("x"), Some(Family::Stiffness), "{verdict:?} {:?}", best.effects);
    assert_eq!(on("y"), Some(Family::FrictionHysteresis), "{verdict:?} {:?}", best.effects);
    closes_a_fresh_drive(&found.augmented[0], &effects, [0, 1]);
    let mut adopted = found.augmented[0].effects();
    adopted.sort_by_key(|(_, response)| *response);
    assert_eq!(
        adopted.iter().map(|(effect, r)| (effect.family(), *r)).collect::<Vec<_>>(),
        [(Family::Stiffness, 0), (Family::FrictionHysteresis, 1),]
    );
    assert!(found.augmented[0].check(3, 6, RATE).is_ok());
}

#[test]
fn a_clip_and_friction_on_two_axes_are_both_named() {
    let mut catalogue = few();
    catalogue.extend([Effect::DriveSaturation, Effect::CrossAxisKinematic, Effect::BoucWenHysteresis]);
    let clip = [f64::INFINITY, f64::INFINITY, 1.4];
    let found = diagnose(&request(&[(1, friction)], clip, catalogue), &unwatched).unwrap();
    let named: Vec<_> =
        found.report.verdict.effects.iter().map(|e| (e.family, e.axis.as_deref().unwrap())).collect();
    assert_eq!(named.len(), 2, "{:?}", found.report.verdict);
    for of in [(Family::FrictionHysteresis, "y"), (Family::Actuator, "z")] {
        assert!(named.contains(&of), "{:?}", found.report.verdict);
    }
}

#[test]
fn a_force_sensor_that_drifts_is_found_beside_what_explains_all_motion() {
    let mut catalogue = few();
    catalogue.extend([Effect::DriveSaturation, Effect::OffsetDrift]);
    let mut input = request(&[], [1.4, f64::INFINITY, f64::INFINITY], catalogue);
    for run in &mut input.runs {
        let mut channels = run.response.channels().to_vec();
        channels[5].iter_mut().for_each(|y| *y += 4e-4 * (run.started_s - 1000.0));
        run.response = Signal::new(RATE, channels).unwrap();
    }
    let verdict = diagnose(&input, &unwatched).unwrap().report.verdict;
    let mut named: Vec<_> =
        verdict.effects.iter().map(|e| (e.effect, e.at.as_deref().unwrap_or(""))).collect();
    named.sort_unstable();
    assert_eq!(
        named,
        [(Effect::DriveSaturation, "drive_x"), (Effect::OffsetDrift, "force_z")],
        "{verdict:?}"
    );
}
