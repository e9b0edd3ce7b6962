//! Without its non-linear effects the bench is linear; with them it is nearly so in the middle only.

use rigcast_numerics::fft::RealFftPlanner;

use super::*;

fn bare(seed: u64) -> VirtualRig {
    VirtualRig::draw(seed).with_effects(Effects::none()).unwrap()
}

#[test]
fn without_effects_responses_superpose() {
    let rig = bare(3);
    let (a, b) = (mixed(10.0, 1), mixed(10.0, 2));
    let sum = (0..3)
        .map(|c| a.channel(c).iter().zip(b.channel(c)).map(|(a, b)| 0.7 * a - 0.4 * b).collect())
        .collect();
    let of_sum = rig.simulate(&Signal::new(1000.0, sum).unwrap(), 0).unwrap();
    let (ya, yb) = (rig.simulate(&a, 0).unwrap(), rig.simulate(&b, 0).unwrap());
    let summed = (0..6)
        .map(|c| ya.channel(c).iter().zip(yb.channel(c)).map(|(a, b)| 0.7 * a - 0.4 * b).collect())
        .collect();
    let gap = difference(&of_sum, &Signal::new(1000.0, summed).unwrap());
    assert!(gap < 1e-9, "superposition fails by {gap}");
}

#[test]
fn with_any_one_non_linear_effect_they_do_not() {
    let (a, b) = (mixed(4.0, 1), mixed(4.0, 2));
    let sum =
        (0..3).map(|c| a.channel(c).iter().zip(b.channel(c)).map(|(a, b)| 0.5 * (a + b)).collect()).collect();
    let sum = Signal::new(1000.0, sum).unwrap();
    let none = Effects::none();
    for effects in [
        Effects { progressive_stiffness: 1.0, ..none },
        Effects { friction: 1.0, ..none },
        Effects { oil_damping: 1.0, ..none },
        Effects { pendulum: 1.0, ..none },
        Effects { valve: 1.0, ..none },
    ] {
        assert!(!effects.is_linear());
        let rig = VirtualRig::draw(3).with_effects(effects).unwrap();
        let [of_sum, ya, yb] = [&sum, &a, &b].map(|drive| rig.simulate(drive, 0).unwrap());
        let summed = (0..6)
            .map(|c| ya.channel(c).iter().zip(yb.channel(c)).map(|(a, b)| 0.5 * (a + b)).collect())
            .collect();
        let gap = difference(&of_sum, &Signal::new(1000.0, summed).unwrap());
        assert!(gap > 1e-3, "{effects:?}: superposition fails by {gap} only");
    }
}

#[test]
fn a_later_drive_gives_a_later_response() {
    let rig = quiet(&VirtualRig::draw(5));
    let drive = mixed(4.0, 1);
    let delay = 137;
    let later = (0..3)
        .map(|c| {
            let mut samples = vec![drive.channel(c)[0]; delay];
            samples.extend_from_slice(drive.channel(c));
            samples
        })
        .collect();
    let now = rig.simulate(&drive, 0).unwrap();
    let then = rig.simulate(&Signal::new(1000.0, later).unwrap(), 0).unwrap();
    // Rest is exact to rounding, which friction and stops neither damp nor amplify much.
    let gap = difference(&then.slice(delay..delay + now.n_samples()), &now);
    assert!(gap < 1e-9, "{gap}");
}

#[test]
fn the_linear_bench_answers_a_periodic_drive_with_its_linear_response() {
    let period = 4000;
    for seed in 0..3 {
        let rig = VirtualRig::linear(seed);
        assert!(rig.effects().is_linear());
        let rig = rig.with_effects(Effects { sensor_noise: 0.0, ..rig.effects() }).unwrap();
        // Lines of 0.25 Hz; after four periods of 4 s nothing of the start is left.
        let one = noise(&Noise { duration_s: 4.0, mean_kn: [0.0; 3], amplitude_kn: [1.0; 3] }, seed).unwrap();
        let repeated: Vec<Vec<f64>> = one.channels().iter().map(|c| c.repeat(5)).collect();
        let drive = Signal::new(1000.0, repeated).unwrap();
        let response = rig.simulate(&drive, 0).unwrap();
        let plan = RealFftPlanner::new().plan_fft_forward(period);
        let spectrum = |samples: &[f64]| {
            let mut input = samples[4 * period..].to_vec();
            let mut output = plan.make_output_vec();
            plan.process(&mut input, &mut output).unwrap();
            output
        };
        let x: Vec<_> = drive.channels().iter().map(|c| spectrum(c)).collect();
        let y: Vec<_> = response.channels().iter().map(|c| spectrum(c)).collect();
        let lines: Vec<usize> = (1..200).step_by(7).collect();
        let freq_hz: Vec<f64> = lines.iter().map(|&k| k as f64 * 0.25).collect();
        for (line, h) in lines.into_iter().zip(rig.linear_response(&freq_hz)) {
            for channel in 0..6 {
                let predicted: realfft::num_complex::Complex64 =
                    (0..3).map(|d| h[channel][d] * x[d][line]).sum();
                let gap = (predicted - y[channel][line]).norm() / y[channel][line].norm();
                assert!(gap < 1e-6, "seed {seed}, line {line}, channel {channel}: {gap}");
            }
        }
    }
}

#[test]
fn the_linear_response_is_that_of_a_force_controlled_bench() {
    for seed in 0..5 {
        let rig = VirtualRig::draw(seed);
        let h = rig.linear_response(&[0.0, 5.0, 60.0, 80.0, 400.0]);
        for axis in 0..3 {
            let static_travel = 1e3 / rig.axes()[axis].stiffness_n_per_mm;
            assert!((h[0][3 + axis][axis].norm() - 1.0).abs() < 1e-6, "force follows slowly");
            // Tilt and the compensating chamber make a few per cent.
            assert!((h[0][axis][axis].norm() / static_travel - 1.0).abs() < 0.05);
            // The controllable range ends between 60 and 80 Hz and a little above.
            assert!((0.8..1.1).contains(&h[1][3 + axis][axis].norm()), "seed {seed}: 5 Hz");
            assert!((0.45..0.9).contains(&h[2][3 + axis][axis].norm()), "seed {seed}: 60 Hz");
            assert!((0.3..0.75).contains(&h[3][3 + axis][axis].norm()), "seed {seed}: 80 Hz");
            assert!(h[4][3 + axis][axis].norm() < 0.1, "seed {seed}: 400 Hz");
        }
    }
}

/// The paper's world: linear in the middle, wrong by tens of per cent in travel under an offset.
#[test]
fn a_linear_model_is_good_in_the_middle_and_poor_under_an_offset() {
    let mean_error =
        |model: &fit::Fit, drive: &Signal, response: &Signal, channels: std::ops::Range<usize>| {
            let predicted = model.predict(drive);
            let n = channels.len() as f64;
            channels.map(|c| fit::rms_error(&predicted[c], response.channel(c))).sum::<f64>() / n
        };
    for seed in 1..=5 {
        let rig = VirtualRig::draw(seed);
        let runs: Vec<_> = (0..2)
            .map(|k| {
                let drive = linear_noise(60.0, 100 + k).unwrap();
                let response = rig.simulate(&drive, k).unwrap();
                (drive, response)
            })
            .collect();
        let model = fit::h1(&runs);
        let small = linear_noise(30.0, 200).unwrap();
        let small_error = mean_error(&model, &small, &rig.simulate(&small, 9).unwrap(), 0..6);
        assert!(small_error < 0.05, "seed {seed}: {small_error} on small centred noise");
        for sign in [-1.0, 1.0] {
            let load = ServiceLoad {
                shape: ServiceShape::HandlingCourse,
                duration_s: 30.0,
                scale: 0.5,
                offset_kn: sign * SERVICE_OFFSET_KN,
            };
            let offset = service_load(&load, 1).unwrap();
            let travel_error = mean_error(&model, &offset, &rig.simulate(&offset, 9).unwrap(), 0..3);
            assert!((0.1..0.4).contains(&travel_error), "seed {seed}: {travel_error} in travel under offset");
        }
    }
}
