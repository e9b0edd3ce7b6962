//! Properties of every simulation: determinism, rest, bounds, convergence, and switched effects.

use super::*;

#[test]
fn a_seed_means_one_bench_and_one_response() {
    let drive = mixed(5.0, 1);
    let first = VirtualRig::draw(7).simulate(&drive, 3).unwrap();
    assert_eq!(first, VirtualRig::draw(7).simulate(&drive, 3).unwrap());
    assert!(difference(&VirtualRig::draw(8).simulate(&drive, 3).unwrap(), &first) > 0.01);
}

#[test]
fn a_repeat_differs_by_white_noise_of_the_stated_level_and_nothing_else() {
    let rig = VirtualRig::draw(2);
    let drive = mixed(20.0, 1);
    let (a, b) = (rig.simulate(&drive, 1).unwrap(), rig.simulate(&drive, 2).unwrap());
    for channel in 0..6 {
        let axis = &rig.axes()[channel % 3];
        let stated = if channel < 3 { axis.displacement_noise_um * 1e-3 } else { axis.force_noise_n * 1e-3 };
        let gap: Vec<f64> = a.channel(channel).iter().zip(b.channel(channel)).map(|(a, b)| a - b).collect();
        let n = gap.len() as f64;
        let deviation = (gap.iter().map(|v| v * v).sum::<f64>() / n / 2.0).sqrt();
        // 20,000 samples: the deviation's own standard error is 0.5 %, a correlation's 0.7 %.
        assert!((deviation / stated - 1.0).abs() < 0.03, "channel {channel}: {deviation} for {stated}");
        let lag: f64 = gap.windows(2).map(|w| w[0] * w[1]).sum::<f64>() / (2.0 * n * deviation * deviation);
        assert!(lag.abs() < 0.04, "channel {channel}: correlation {lag} between neighbours");
    }
}

#[test]
fn a_bench_under_constant_drive_stays_at_rest() {
    for seed in 0..5 {
        let rig = quiet(&VirtualRig::draw(seed));
        let drive = Signal::new(1000.0, vec![vec![4.5; 500], vec![-5.0; 500], vec![3.0; 500]]).unwrap();
        let response = rig.simulate(&drive, 0).unwrap();
        for channel in 0..6 {
            let samples = response.channel(channel);
            let drift = samples.iter().map(|v| (v - samples[0]).abs()).fold(0.0, f64::max);
            assert!(drift < 1e-9, "seed {seed}, channel {channel} moves by {drift}");
        }
        for (axis, command) in [4.5, -5.0, 3.0].into_iter().enumerate() {
            assert!(
                (response.channel(3 + axis)[0] - command).abs() < 1e-9,
                "integral action leaves no error"
            );
        }
    }
}

#[test]
fn after_a_kick_the_bench_comes_to_rest() {
    for seed in 0..5 {
        let rig = quiet(&VirtualRig::draw(seed));
        let kick = |level: f64| {
            let mut samples = vec![level; 100];
            samples.resize(8000, 0.0);
            samples
        };
        let drive = Signal::new(1000.0, vec![kick(5.0), kick(-5.0), kick(5.0)]).unwrap();
        let response = rig.simulate(&drive, 0).unwrap();
        for channel in 0..6 {
            let tail = &response.channel(channel)[7500..];
            let motion = tail.iter().map(|v| (v - tail[0]).abs()).fold(0.0, f64::max);
            assert!(motion < 1e-6, "seed {seed}, channel {channel} still moves by {motion}");
        }
    }
}

#[test]
fn the_step_size_does_not_show_in_the_response() {
    let drive = mixed(10.0, 3);
    let rig = VirtualRig::draw(4);
    let fine = rig.simulate_exact(&drive, 8 * SUBSTEPS).unwrap();
    let errors = [SUBSTEPS, 2 * SUBSTEPS].map(|substeps| {
        let coarse = rig.simulate_exact(&drive, substeps).unwrap();
        (0..6).map(|c| fit::rms_error(&coarse[c], &fine[c])).fold(0.0, f64::max)
    });
    // Sensor noise is 1e-3; kinks of friction and stops make the order two where it would be four.
    assert!(errors[0] < 2e-6, "{errors:?}");
    assert!(errors[1] < 0.5 * errors[0], "{errors:?}");
}

#[test]
fn each_effect_changes_the_response_and_more_of_it_changes_more() {
    let rig = quiet(&VirtualRig::draw(1));
    let drive = mixed(15.0, 2);
    let full = rig.simulate(&drive, 5).unwrap();
    let on = rig.effects();
    type Set = fn(&mut Effects, f64);
    let switches: [(&str, Set, f64); 7] = [
        ("progressive stiffness", |e, v| e.progressive_stiffness = v, 0.1),
        ("friction", |e, v| e.friction = v, 0.01),
        ("oil damping", |e, v| e.oil_damping = v, 0.01),
        ("pendulum", |e, v| e.pendulum = v, 0.01),
        ("valve", |e, v| e.valve = v, 0.005),
        ("sensor noise", |e, v| e.sensor_noise = v, 0.001),
        ("preload", |e, v| e.preload = v, 0.01),
    ];
    for (name, set, at_least) in switches {
        let with = |strength: f64| {
            let mut effects = on;
            set(&mut effects, strength);
            rig.with_effects(effects).unwrap().simulate(&drive, 5).unwrap()
        };
        let base = with(0.0);
        let whole = difference(&with(1.0), &base);
        assert!(whole > at_least, "{name} changes the response by {whole} only");
        let half = difference(&with(0.5), &base);
        assert!(half < whole, "{name}: {half} at half strength, {whole} at full");
    }
    assert_eq!(full, rig.with_effects(on).unwrap().simulate(&drive, 5).unwrap());
}

#[test]
fn drives_that_the_bench_cannot_take_are_refused_by_name() {
    let rig = VirtualRig::draw(0);
    let of = |channels| Signal::new(1000.0, channels).unwrap();
    assert!(matches!(
        rig.simulate(&of(vec![vec![0.0]; 2]), 0),
        Err(EngineError::ChannelCount { expected: 3, found: 2, .. })
    ));
    assert!(matches!(rig.simulate(&of(vec![vec![]; 3]), 0), Err(EngineError::TooShort { needed: 1, .. })));
    assert!(matches!(
        rig.simulate(&Signal::new(500.0, vec![vec![0.0]; 3]).unwrap(), 0),
        Err(EngineError::SampleRate { found_hz: 500.0, .. })
    ));
    assert!(matches!(
        rig.simulate(&of(vec![vec![0.0; 3], vec![0.0, -10.5, 0.0], vec![0.0; 3]]), 0),
        Err(EngineError::OutOfRange { channel: 1, sample: 1, found: -10.5, limit: 10.0, .. })
    ));
    let one = rig.simulate(&of(vec![vec![1.0]; 3]), 0).unwrap();
    assert_eq!((one.n_channels(), one.n_samples()), (6, 1));
    for strength in [-0.1, 3.1, f64::NAN] {
        let effects = Effects { friction: strength, ..Effects::default() };
        assert!(matches!(
            rig.with_effects(effects),
            Err(EngineError::Setting { setting: "effects.friction", .. })
        ));
    }
}

#[test]
fn the_hardest_drives_stay_in_bounds_at_the_largest_strengths() {
    let effects = Effects {
        progressive_stiffness: 2.0,
        friction: 3.0,
        oil_damping: 3.0,
        pendulum: 3.0,
        valve: 1.5,
        sensor_noise: 1.0,
        preload: 3.0,
    };
    let boundary = MixedNoise { duration_s: 10.0, stretch_s: 5.0, region: NoiseRegion::Boundary };
    for seed in 0..5 {
        let rig = VirtualRig::draw(seed).with_effects(effects).unwrap();
        let response = rig.simulate(&mixed_noise(&boundary, seed).unwrap(), 0).unwrap();
        for axis in 0..3 {
            assert!(largest(response.channel(axis)) < 20.0, "seed {seed}: travel");
            assert!(largest(response.channel(3 + axis)) < 12.0, "seed {seed}: force");
        }
    }
}

#[test]
fn parameters_lie_in_their_ranges_and_are_listed_with_unit_and_source() {
    for seed in 0..20 {
        let list = VirtualRig::draw(seed).parameters();
        assert_eq!(list.len(), 3 + 3 * 30);
        let mut names: Vec<_> = list.iter().map(|p| p.name.clone()).collect();
        names.sort();
        names.dedup();
        assert_eq!(names.len(), list.len());
        for p in &list {
            assert!((p.low..=p.high).contains(&p.value), "{} = {}", p.name, p.value);
            assert!(p.low < p.nominal && p.nominal < p.high, "{}", p.name);
            assert!(!p.unit.is_empty() && !p.source.is_empty() && !p.meaning.is_empty(), "{}", p.name);
        }
    }
    assert!(VirtualRig::nominal().parameters().iter().all(|p| p.value == p.nominal));
    assert_ne!(VirtualRig::draw(1).parameters(), VirtualRig::draw(2).parameters());
}

#[test]
fn channels_read_as_the_contract_writes_them() {
    let rig = VirtualRig::draw(0);
    let json = serde_json::to_value(rig.channels()).unwrap();
    assert_eq!(
        json[0],
        serde_json::json!({"name": "drive_x", "unit": "kN", "role": "drive", "quantity": "force", "axis": "x"})
    );
    assert_eq!(
        json[8],
        serde_json::json!({"name": "force_z", "unit": "kN", "role": "response", "quantity": "force", "axis": "z", "group": "force"})
    );
    let groups: Vec<_> = rig.channels().iter().filter_map(|c| c.group.map(|g| (g, c.axis))).collect();
    let expected: Vec<_> = ["displacement", "force"].into_iter().flat_map(|g| AXES.map(|a| (g, a))).collect();
    assert_eq!(groups, expected);
}
