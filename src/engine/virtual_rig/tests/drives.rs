//! Spectra, levels and shapes of the drives.

use rigcast_numerics::fft::RealFftPlanner;

use super::*;

/// Mean square per frequency line (1 Hz wide), Hann, half overlap.
fn psd(samples: &[f64]) -> Vec<f64> {
    let segment = 1000;
    let plan = RealFftPlanner::new().plan_fft_forward(segment);
    let mean = fit::mean(samples);
    let mut sum = vec![0.0; segment / 2 + 1];
    let starts: Vec<usize> = (0..=samples.len() - segment).step_by(segment / 2).collect();
    for &start in &starts {
        let mut input: Vec<f64> = (0..segment)
            .map(|k| {
                let hann = 0.5 - 0.5 * (std::f64::consts::TAU * k as f64 / segment as f64).cos();
                (samples[start + k] - mean) * hann
            })
            .collect();
        let mut output = plan.make_output_vec();
        plan.process(&mut input, &mut output).unwrap();
        sum.iter_mut().zip(&output).for_each(|(s, o)| *s += o.norm_sqr() / starts.len() as f64);
    }
    sum
}

fn level(psd: &[f64], lines: std::ops::RangeInclusive<usize>) -> f64 {
    let n = lines.clone().count() as f64;
    psd[lines].iter().sum::<f64>() / n
}

#[test]
fn noise_is_white_then_pink_then_nothing() {
    let settings = Noise { duration_s: 120.0, mean_kn: [3.0, -2.0, 0.5], amplitude_kn: [0.5, 1.0, 2.0] };
    let drive = noise(&settings, 11).unwrap();
    assert_eq!(drive, noise(&settings, 11).unwrap());
    assert_ne!(drive, noise(&settings, 12).unwrap());
    for axis in 0..3 {
        let samples = drive.channel(axis);
        assert_eq!(samples[0], settings.mean_kn[axis]);
        let mean = fit::mean(samples);
        let deviation =
            (samples.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / samples.len() as f64).sqrt();
        assert!((mean - settings.mean_kn[axis]).abs() < 0.02, "axis {axis}: mean {mean}");
        // The ramp of a second takes half a per cent of the power.
        assert!(
            (3.0 * deviation / settings.amplitude_kn[axis] - 1.0).abs() < 0.02,
            "axis {axis}: {deviation}"
        );
        let psd = psd(samples);
        let white = level(&psd, 2..=19);
        for band in [2..=7, 8..=13, 14..=19] {
            // 240 half-overlapping segments, six lines: about 3 % standard error.
            assert!((level(&psd, band.clone()) / white - 1.0).abs() < 0.12, "axis {axis}: {band:?}");
        }
        for f in [25usize, 32, 40, 47] {
            let pink = level(&psd, f - 2..=f + 2) * f as f64 / 20.0;
            assert!((pink / white - 1.0).abs() < 0.15, "axis {axis}: {pink} for {white} at {f} Hz");
        }
        assert!(level(&psd, 55..=500) < 1e-6 * white, "axis {axis}: power above the band");
    }
    let correlation = |a: &[f64], b: &[f64]| {
        let (ma, mb) = (fit::mean(a), fit::mean(b));
        let product = |x: &[f64], mx: f64, y: &[f64], my: f64| -> f64 {
            x.iter().zip(y).map(|(x, y)| (x - mx) * (y - my)).sum()
        };
        product(a, ma, b, mb) / (product(a, ma, a, ma) * product(b, mb, b, mb)).sqrt()
    };
    for (i, j) in [(0, 1), (0, 2), (1, 2)] {
        // 120 s of 40 Hz bandwidth: standard error 1 %.
        assert!(correlation(drive.channel(i), drive.channel(j)).abs() < 0.05, "axes {i} and {j}");
    }
}

#[test]
fn mixed_noise_covers_its_region_evenly() {
    let duration_s = 160.0;
    for (region, low, high) in [
        (NoiseRegion::Interior, 0.0, NOISE_MEAN_KN),
        (NoiseRegion::Boundary, BOUNDARY_MEAN_KN[0], BOUNDARY_MEAN_KN[1]),
    ] {
        let drive = mixed_noise(&MixedNoise { duration_s, stretch_s: 10.0, region }, 4).unwrap();
        for axis in 0..3 {
            // The middle of each stretch of 10 s, past its ramp.
            let mut means: Vec<f64> = (0..16)
                .map(|s| fit::mean(&drive.channel(axis)[s * 10_000 + 1500..(s + 1) * 10_000]))
                .collect();
            means.sort_by(f64::total_cmp);
            assert!(means.iter().all(|m| (low - 0.05..=high + 0.05).contains(&m.abs())), "{means:?}");
            assert_eq!(means.iter().filter(|m| **m < 0.0).count(), 8, "half of the means on each side");
            // A Latin hypercube of 16: one mean in each sixteenth, so neighbours are at most two apart.
            if region == NoiseRegion::Interior {
                assert!(means.windows(2).all(|w| w[1] - w[0] < 2.0 * 8.0 / 16.0 + 0.1), "{means:?}");
            }
        }
    }
}

#[test]
fn linear_noise_stays_below_the_stops() {
    let drive = linear_noise(60.0, 1).unwrap();
    for seed in 0..20 {
        for (axis, parameters) in VirtualRig::draw(seed).axes().iter().enumerate() {
            let stop = parameters.stop_load_plus_kn.min(parameters.stop_load_minus_kn);
            assert!(largest(drive.channel(axis)) < stop);
        }
    }
}

#[test]
fn service_loads_scale_to_their_peak_and_stay_in_band() {
    let load = |shape, scale, offset_kn| {
        service_load(&ServiceLoad { shape, duration_s: 40.0, scale, offset_kn }, 6).unwrap()
    };
    for shape in ServiceShape::ALL {
        let whole = load(shape, 1.0, 0.0);
        let part = load(shape, 0.5, SERVICE_OFFSET_KN);
        for axis in 0..3 {
            let samples = whole.channel(axis);
            assert!((largest(samples) - SERVICE_PEAK_KN).abs() < 1e-9);
            assert_eq!((samples[0], samples[samples.len() - 1]), (0.0, 0.0));
            for (half, one) in part.channel(axis).iter().zip(samples) {
                assert!((half - SERVICE_OFFSET_KN - 0.5 * one).abs() < 1e-12);
            }
            let psd = psd(samples);
            assert!(level(&psd, 55..=500) < 1e-6 * level(&psd, 1..=20), "power above the band of noise");
            // Crest factor: service loads are burstier than Gaussian noise of the same length.
            let deviation = (samples.iter().map(|v| v * v).sum::<f64>() / samples.len() as f64).sqrt();
            assert!(largest(samples) / deviation > 3.0, "{} axis {axis}", shape.name());
        }
    }
    let [a, b, c] = ServiceShape::ALL.map(|shape| load(shape, 1.0, 0.0));
    assert!(difference(&a, &b) > 0.5 && difference(&b, &c) > 0.5 && difference(&a, &c) > 0.5);
}

#[test]
fn training_noise_covers_what_service_loads_use() {
    let training =
        mixed_noise(&MixedNoise { duration_s: 600.0, stretch_s: 15.0, region: NoiseRegion::Interior }, 2)
            .unwrap();
    for shape in ServiceShape::ALL {
        for (scale, offset_kn) in [(1.0, 0.0), (0.5, SERVICE_OFFSET_KN), (0.5, -SERVICE_OFFSET_KN)] {
            let load = service_load(&ServiceLoad { shape, duration_s: 60.0, scale, offset_kn }, 3).unwrap();
            for axis in 0..3 {
                let reached = largest(training.channel(axis));
                let outside = load.channel(axis).iter().filter(|v| v.abs() > reached).count();
                assert!((outside as f64) < 1e-3 * load.n_samples() as f64, "{} axis {axis}", shape.name());
            }
        }
    }
}

#[test]
fn a_sine_is_a_sine_and_a_sweep_passes_its_frequencies_axis_by_axis() {
    let drive = sine(&Sine {
        duration_s: 10.0,
        frequency_hz: [2.0, 5.0, 10.0],
        amplitude_kn: [1.0, 2.0, 3.0],
        mean_kn: [0.5, 0.0, -1.0],
        phase_rad: [0.0; 3],
    })
    .unwrap();
    for (axis, (frequency, amplitude, mean)) in
        [(2.0, 1.0, 0.5), (5.0, 2.0, 0.0), (10.0, 3.0, -1.0)].into_iter().enumerate()
    {
        assert_eq!(drive.channel(axis)[0], mean);
        for k in 1000..9000 {
            let t = k as f64 / 1000.0;
            let expected = mean + amplitude * (std::f64::consts::TAU * frequency * t).sin();
            assert!((drive.channel(axis)[k] - expected).abs() < 1e-12);
        }
    }
    let drive =
        sweep(&Sweep { duration_s: 60.0, from_hz: 1.0, to_hz: 40.0, amplitude_kn: 1.5, mean_kn: [1.0; 3] })
            .unwrap();
    for axis in 0..3 {
        let samples = drive.channel(axis);
        for (k, v) in samples.iter().enumerate() {
            assert!(k / 20_000 == axis || *v == 1.0, "axis {axis} moves at {k}");
        }
        let crossings = |from: usize, to: usize| {
            samples[from..to].windows(2).filter(|w| (w[0] < 1.0) != (w[1] < 1.0)).count() as f64 / 2.0
        };
        let begin = axis * 20_000;
        // Cycles in the second and the last second, from the integral of the logarithmic law.
        let cycles = |t: f64| 20.0 / 40.0_f64.ln() * ((40.0_f64.ln() * t / 20.0).exp() - 1.0);
        for t in [1.0, 18.0] {
            let counted = crossings(begin + (t * 1e3) as usize, begin + ((t + 1.0) * 1e3) as usize);
            let expected = cycles(t + 1.0) - cycles(t);
            assert!((counted - expected).abs() <= 1.0, "axis {axis}: {counted} cycles, {expected} expected");
        }
    }
}

#[test]
fn settings_out_of_range_are_refused_by_name() {
    let setting = |result: Result<Signal, EngineError>| match result {
        Err(EngineError::Setting { setting, .. }) => setting,
        other => panic!("expected a refused setting, got {other:?}"),
    };
    let good = Noise { duration_s: 5.0, mean_kn: [0.0; 3], amplitude_kn: [1.0; 3] };
    assert_eq!(setting(noise(&Noise { duration_s: 1.0, ..good }, 0)), "duration_s");
    assert_eq!(setting(noise(&Noise { duration_s: f64::NAN, ..good }, 0)), "duration_s");
    assert_eq!(setting(noise(&Noise { mean_kn: [0.0, f64::INFINITY, 0.0], ..good }, 0)), "mean_kn");
    assert_eq!(setting(noise(&Noise { amplitude_kn: [1.0, 1.0, -1.0], ..good }, 0)), "amplitude_kn");
    let load = ServiceLoad { shape: ServiceShape::RoughRoad, duration_s: 5.0, scale: 1.0, offset_kn: 0.0 };
    assert_eq!(setting(service_load(&ServiceLoad { scale: f64::NAN, ..load }, 0)), "scale");
    assert_eq!(setting(service_load(&ServiceLoad { offset_kn: 6.0, ..load }, 0)), "offset_kn");
    let tones = Sweep { duration_s: 9.0, from_hz: 0.0, to_hz: 40.0, amplitude_kn: 1.0, mean_kn: [0.0; 3] };
    assert_eq!(setting(sweep(&tones)), "frequency_hz");
    let mixed = MixedNoise { duration_s: 9.0, stretch_s: 0.0, region: NoiseRegion::Interior };
    assert_eq!(setting(mixed_noise(&mixed, 0)), "stretch_s");
}
