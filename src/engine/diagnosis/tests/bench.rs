//! The virtual rig, whose rubber wears: friction that a hybrid 2 from before the wear does not know.

use crate::diagnosis::{Channel, Effect, Family, Input, Mode, Run, diagnose};
use crate::model::{
    FitData, FitSettings, FitSplit, LstmOptions, ModelKind, Pair, Predictor, Preset, Task, fit,
};
use crate::progress::unwatched;
use crate::virtual_rig::drives::{ServiceLoad, ServiceShape, linear_noise, service_load};
use crate::virtual_rig::{Effects, VirtualRig};
use crate::{Quantity, Signal};

/// Drive and displacement along x of one run.
fn pair(rig: &VirtualRig, drive: Signal, sensor_seed: u64) -> Pair {
    let measured = rig.simulate(&drive, sensor_seed).unwrap();
    let x = Signal::new(measured.sample_rate_hz(), vec![measured.channel(0).to_vec()]).unwrap();
    Pair { x: drive, y: x }
}

fn noise(seconds: f64, scale: f64, seed: u64) -> Signal {
    let drive = linear_noise(seconds, seed).unwrap();
    let scaled = drive.channels().iter().map(|d| d.iter().map(|u| scale * u).collect());
    Signal::new(drive.sample_rate_hz(), scaled.collect()).unwrap()
}

/// Root mean square error over root mean square.
fn error(predicted: &Signal, measured: &Signal) -> f64 {
    let (p, m) = (predicted.channel(0), measured.channel(0));
    let wrong: f64 = p.iter().zip(m).map(|(p, m)| (p - m).powi(2)).sum();
    (wrong / m.iter().map(|m| m * m).sum::<f64>()).sqrt()
}

#[test]
fn adopting_the_effect_lowers_the_error_of_a_hybrid_2_on_a_load_nobody_saw() {
    let before = VirtualRig::linear(3);
    let worn = before.with_effects(Effects { friction: 1.0, ..before.effects() }).unwrap();
    let names = |list: [&str; 3]| list.map(str::to_owned).to_vec();
    let settings = FitSettings {
        kind: ModelKind::Hybrid2,
        task: Task::Forward,
        inputs: names(["drive_x", "drive_y", "drive_z"]),
        outputs: vec!["disp_x".into()],
        preprocess: Default::default(),
        frf: Default::default(),
        lstm: LstmOptions {
            blocks: Some(vec![10]),
            epochs: Some(12),
            seeds: Some(vec![1]),
            ..Default::default()
        },
        preset: Preset::Default,
        start: None,
        core: None,
    };
    let data = FitData::with_validation(
        vec![pair(&before, noise(60.0, 1.0, 1), 1), pair(&before, noise(30.0, 0.6, 2), 2)],
        vec![pair(&before, noise(20.0, 0.9, 3), 3)],
        FitSplit::ValidationStops,
    );
    let sim = Predictor::new(fit(&data, &settings, &unwatched).unwrap().model).unwrap();

    let run = |name: &str, pair: Pair, started_s: f64, simulated: bool| Run {
        name: name.into(),
        simulated: simulated.then(|| sim.predict(pair.x.clone()).unwrap()),
        added: None,
        drive: pair.x,
        response: pair.y,
        started_s,
    };
    let (full, half) = (noise(20.0, 1.0, 4), noise(16.0, 0.5, 5));
    let channel = |name: &str, unit: &str, quantity| Channel {
        name: name.into(),
        axis: Some(name[name.len() - 1..].into()),
        unit: unit.into(),
        size: None,
        quantity,
    };
    let input = Input {
        drives: settings.inputs.iter().map(|n| channel(n, "kN", Quantity::Force)).collect(),
        responses: vec![channel("disp_x", "mm", Quantity::Displacement)],
        baseline: vec![run("low", pair(&before, noise(40.0, 0.8, 6), 6), 0.0, false)],
        runs: vec![
            run("a", pair(&worn, full.clone(), 7), 100.0, true),
            run("b", pair(&worn, half.clone(), 8), 200.0, true),
            run("c", pair(&worn, half, 9), 300.0, true),
            run("d", pair(&worn, full, 10), 400.0, true),
        ],
        roles: None,
        repeats: vec![vec![0, 3], vec![1, 2]],
        sim_is_linear: false,
        mode: Mode::External,
        catalogue: vec![
            Effect::LinearChange,
            Effect::CubicStiffness,
            Effect::CoulombFriction,
            Effect::BoucWenHysteresis,
            Effect::QuadraticDamping,
            Effect::DriveSaturation,
        ],
        material_gap: 0.01,
        drive_limit: None,
        seed: 1,
    };
    let found = diagnose(&input, &unwatched).unwrap();
    let verdict = &found.report.verdict;
    assert_eq!(verdict.family, Some(Family::FrictionHysteresis), "{verdict:?}");

    let load =
        ServiceLoad { shape: ServiceShape::HandlingCourse, duration_s: 30.0, scale: 0.4, offset_kn: 0.0 };
    let unseen = pair(&worn, service_load(&load, 11).unwrap(), 11);
    let simulated = sim.predict(unseen.x.clone()).unwrap();
    let adopted = found.augmented[0].apply(&unseen.x, &simulated, None).unwrap();
    let (without, with) = (error(&simulated, &unseen.y), error(&adopted, &unseen.y));
    assert!(with < 0.7 * without, "{without} {with}");
}
