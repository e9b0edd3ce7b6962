//! The FRF of a known system is found, and its quality figures say the truth.

use super::super::data::Data;
use super::modal::Modal;
use super::*;
use crate::spectral::cross_spectra;

/// Share of all `H[line, output, input]` between DC and Nyquist within their bounds.
fn share_within(estimate: &FrfEstimate, rig: &Modal, confidence: f64) -> f64 {
    let frf = &estimate.frf;
    let factor = estimate.quality.confidence_factor(confidence).unwrap();
    let bounds: Vec<f64> = estimate.quality.std_error.iter().map(|s| s * factor).collect();
    assert_eq!(bounds.len(), frf.h.len());
    let (mut inside, mut all) = (0, 0);
    for line in 1..frf.n_lines() - 1 {
        for o in 0..frf.n_outputs {
            for i in 0..frf.n_inputs {
                let truth = rig.frf(line as f64 * frf.df_hz(), o, i);
                let bound = bounds[(line * frf.n_outputs + o) * frf.n_inputs + i];
                inside += usize::from((frf.at(line, o, i) - truth).norm() <= bound);
                all += 1;
            }
        }
    }
    f64::from(u32::try_from(inside).unwrap()) / f64::from(u32::try_from(all).unwrap())
}

/// First-order low pass: power falls with 1/f^2 above some hertz.
fn coloured(mut x: Vec<Vec<f64>>) -> Vec<Vec<f64>> {
    for channel in &mut x {
        let mut state = 0.0;
        for v in channel {
            state = 0.8 * state + *v;
            *v = state;
        }
    }
    x
}

/// Every input gets a share of the others.
fn correlated(x: Vec<Vec<f64>>) -> Vec<Vec<f64>> {
    let n = x[0].len();
    let mix = |c: usize| (0..n).map(|t| x[c][t] + 0.9 * x[(c + 1) % 3][t]).collect();
    (0..3).map(mix).collect()
}

/// 400 s of the bench with white noise at the outputs, about half of their deviation.
fn measure(rig: &Modal, x: &[Vec<f64>], seed: u64) -> Vec<Vec<f64>> {
    let mut y = rig.simulate(x);
    for (o, y) in y.iter_mut().enumerate() {
        let deviation = (y.iter().map(|v| v * v).sum::<f64>() / y.len() as f64).sqrt();
        for (y, v) in y.iter_mut().zip(noise(seed + o as u64, x[0].len())) {
            *y += 0.5 * deviation * v;
        }
    }
    y
}

#[test]
fn the_frf_of_a_linear_system_is_recovered_within_its_confidence_bounds() {
    let rig = Modal::bench();
    let n = 80_000;
    for (seed, x) in [
        (1, channels(1, 3, n)),
        (2, coloured(channels(2, 3, n))),
        (3, correlated(channels(3, 3, n))),
        (4, correlated(coloured(channels(4, 3, n)))),
    ] {
        let y = signal(rig.fs, measure(&rig, &x, seed * 1000));
        let x = signal(rig.fs, x);
        for overlap in [0.5, 0.75] {
            let settings = FrfSettings { overlap, ..fixed(1024, 0.0) };
            let estimate = estimate(&[(&x, &y)], &settings, &unwatched).unwrap();
            // 3,066 values; neighbouring lines share data, so a share wanders by about a percent.
            let (s95, s50) = (share_within(&estimate, &rig, 0.95), share_within(&estimate, &rig, 0.5));
            println!("drives {seed}, overlap {overlap}: {s95:.3} within 95 %, {s50:.3} within 50 %");
            assert!((0.93..=0.97).contains(&s95), "drives {seed}, overlap {overlap}: {s95}");
            assert!((0.45..=0.55).contains(&s50), "drives {seed}, overlap {overlap}: {s50}");
            assert_eq!(estimate.frf.usable_hz, [0.0, 100.0]);
            assert_eq!(estimate.warnings, [""; 0]);
        }
    }
}

#[test]
fn without_noise_the_error_is_small_and_coherence_one() {
    let rig = Modal::bench();
    let x = channels(5, 3, 60_000);
    let y = signal(rig.fs, rig.simulate(&x));
    let x = signal(rig.fs, x);
    let found = estimate(&[(&x, &y)], &fixed(2048, 0.0), &unwatched).unwrap();
    let (mut error, mut power) = (0.0, 0.0);
    for line in 0..found.frf.n_lines() {
        for o in 0..2 {
            for i in 0..3 {
                let truth = rig.frf(line as f64 * found.frf.df_hz(), o, i);
                error += (found.frf.at(line, o, i) - truth).norm_sqr();
                power += truth.norm_sqr();
            }
        }
    }
    let error = (error / power).sqrt();
    assert!(error < 0.01, "{error}");
    assert!(found.quality.multiple_coherence.iter().all(|&c| (0.98..=1.0).contains(&c)));
    assert!(found.quality.condition.iter().all(|&c| (1.0..4.0).contains(&c)));
}

#[test]
fn coherence_is_the_share_of_power_that_comes_from_the_inputs() {
    // y = 2 x0 + x1 + noise of variance 5: of 10 shares of power 4 are x0's, 1 is x1's.
    let n = 200_000;
    let x = channels(6, 2, n);
    let e = noise(777, n);
    let y: Vec<f64> = (0..n).map(|t| 2.0 * x[0][t] + x[1][t] + 5.0_f64.sqrt() * e[t]).collect();
    let (x, y) = (signal(100.0, x), signal(100.0, vec![y]));
    let found = estimate(&[(&x, &y)], &fixed(256, 0.0), &unwatched).unwrap();
    let lines = found.frf.n_lines();
    let mean = |values: Vec<f64>| values.iter().sum::<f64>() / lines as f64;
    let multiple = mean(found.quality.multiple_coherence.clone());
    let first = mean(found.quality.coherence.iter().step_by(2).copied().collect());
    let second = mean(found.quality.coherence.iter().skip(1).step_by(2).copied().collect());
    assert!((multiple - 0.5).abs() < 0.01, "{multiple}");
    assert!((first - 0.4).abs() < 0.01, "{first}");
    assert!((second - 0.1).abs() < 0.01, "{second}");
    assert!(found.quality.coherence.iter().all(|c| (0.0..=1.0).contains(c)));
}

#[test]
fn the_ratio_form_is_right_for_independent_drives_and_warns_on_correlated_ones() {
    let rig = Modal::bench();
    let ratio = FrfSettings { estimator: Estimator::Ratio, ..fixed(512, 0.0) };
    let error = |estimate: &FrfEstimate| {
        let frf = &estimate.frf;
        let at = |line| (frf.at(line, 0, 1) - rig.frf(line as f64 * frf.df_hz(), 0, 1)).norm_sqr();
        let truth = |line| rig.frf(line as f64 * frf.df_hz(), 0, 1).norm_sqr();
        let lines = 1..frf.n_lines() - 1;
        (lines.clone().map(at).sum::<f64>() / lines.map(truth).sum::<f64>()).sqrt()
    };
    for (drives, warned) in [(channels(7, 3, 200_000), false), (correlated(channels(7, 3, 200_000)), true)] {
        let y = signal(rig.fs, rig.simulate(&drives));
        let x = signal(rig.fs, drives);
        let by_ratio = estimate(&[(&x, &y)], &ratio, &unwatched).unwrap();
        let by_h1 = estimate(&[(&x, &y)], &fixed(512, 0.0), &unwatched).unwrap();
        // What is left is the bias of short segments at the resonances.
        assert!(error(&by_h1) < 0.03, "{}", error(&by_h1));
        assert_eq!(by_h1.warnings, [""; 0]);
        if warned {
            assert!(error(&by_ratio) > 0.3, "{}", error(&by_ratio));
            assert_eq!(by_ratio.warnings.len(), 3, "{:?}", by_ratio.warnings);
            let first = &by_ratio.warnings[0];
            // Each shares 0.9 of its neighbour: coherence (0.9 / 1.81)^2.
            assert!(first.contains("channels 0 and 1") && first.contains("coherence 0.25"), "{first}");
        } else {
            assert!(error(&by_ratio) < 0.2, "{}", error(&by_ratio));
            assert_eq!(by_ratio.warnings, [""; 0]);
        }
    }
}

#[test]
fn the_estimator_of_the_paper_is_the_ratio_unless_the_drives_correlate_and_then_h1_with_a_warning() {
    let rig = Modal::bench();
    let by = |x: &Signal, y: &Signal, estimator| {
        estimate(&[(x, y)], &FrfSettings { estimator, ..FrfSettings::default() }, &unwatched).unwrap()
    };
    let independent = channels(15, 3, 60_000);
    for (drives, used) in [(independent.clone(), Estimator::Ratio), (correlated(independent), Estimator::H1)]
    {
        let y = signal(rig.fs, rig.simulate(&drives));
        let x = signal(rig.fs, drives);
        let (auto, named) = (by(&x, &y, Estimator::Auto), by(&x, &y, used));
        assert_eq!(auto.quality.settings, named.quality.settings);
        assert_eq!(auto.quality.settings.estimator, used, "the one that was used is stored");
        assert_eq!(auto.frf, named.frf);
        if used == Estimator::Ratio {
            assert_eq!(auto.quality.settings.ridge, Some(0.0), "the ratio of the paper has none");
            assert_eq!(auto.warnings, [""; 0]);
        } else {
            assert_eq!(auto.warnings.len(), 3, "{:?}", auto.warnings);
            let first = &auto.warnings[0];
            for part in ["channels 0 and 1", "coherence 0.25 on average", "limit 0.0", "\"h1\" was used"] {
                assert!(first.contains(part), "{part}: {first}");
            }
        }
    }
    // One drive correlates with no other.
    let x = channels(16, 1, 20_000);
    let y = signal(rig.fs, rig.simulate(&x));
    assert_eq!(by(&signal(rig.fs, x), &y, Estimator::Auto).quality.settings.estimator, Estimator::Ratio);
}

#[test]
fn inputs_of_other_units_give_the_same_frf_in_those_units() {
    let rig = Modal::bench();
    let x = correlated(channels(8, 3, 30_000));
    let y = signal(rig.fs, measure(&rig, &x, 50));
    let scaled: Vec<Vec<f64>> =
        [1.0, 1e6, 1e-6].iter().zip(&x).map(|(s, c)| c.iter().map(|v| s * v).collect()).collect();
    let settings = fixed(512, 1e-2);
    let one = estimate(&[(&signal(rig.fs, x), &y)], &settings, &unwatched).unwrap();
    let two = estimate(&[(&signal(rig.fs, scaled), &y)], &settings, &unwatched).unwrap();
    for line in 0..one.frf.n_lines() {
        for (i, scale) in [1.0, 1e6, 1e-6].into_iter().enumerate() {
            let (a, b) = (one.frf.at(line, 1, i), two.frf.at(line, 1, i) * scale);
            assert!((a - b).norm() < 1e-8, "line {line}, input {i}: {a} {b}");
        }
        assert!((one.quality.condition[line] / two.quality.condition[line] - 1.0).abs() < 1e-8);
    }
}

#[test]
fn lines_that_the_drives_do_not_excite_are_tapered_to_zero() {
    // Drives without power above 50 Hz of 100 Hz, cut by FFT over the whole run.
    let rig = Modal::bench();
    let n = 65_536;
    let mut x = channels(9, 3, n);
    let mut planner = rigcast_numerics::fft::RealFftPlanner::new();
    let (forward, inverse) = (planner.plan_fft_forward(n), planner.plan_fft_inverse(n));
    for channel in &mut x {
        let mut lines = forward.make_output_vec();
        forward.process(channel, &mut lines).unwrap();
        lines[n / 4..].fill(Complex64::default());
        inverse.process(&mut lines, channel).unwrap();
        channel.iter_mut().for_each(|v| *v /= n as f64);
    }
    let y = rig.simulate(&x);
    let (x, y) = (signal(rig.fs, x), signal(rig.fs, y));
    let found = estimate(&[(&x, &y)], &FrfSettings::default(), &unwatched).unwrap();
    let frf = &found.frf;
    assert_eq!(frf.usable_hz[0], 0.0);
    assert!((50.0..52.0).contains(&frf.usable_hz[1]), "{:?}", frf.usable_hz);
    let edge = (frf.usable_hz[1] / frf.df_hz()).round() as usize;
    let size: Vec<f64> = (edge..frf.n_lines()).map(|line| frf.at(line, 0, 0).norm()).collect();
    assert!(size.windows(2).all(|w| w[1] <= w[0]), "not a taper");
    let reach = size.iter().position(|&s| s == 0.0).expect("reaches zero");
    assert!(reach > 4 && reach < edge / 8, "{reach}");
    assert_eq!(found.quality.multiple_coherence[(frf.n_lines() - 1) * 2], 0.0);
    assert_eq!(found.warnings.len(), 1, "{:?}", found.warnings);
    assert!(found.warnings[0].contains("tapered to zero"));
    // The drive itself has no power there, so the prediction loses nothing.
    let predicted = frf.apply(&x).unwrap();
    for o in 0..2 {
        let error = relative_error(y.channel(o), predicted.channel(o));
        assert!(error < 0.005, "{error}");
    }
}

#[test]
fn the_choice_follows_the_ring_down_and_leaves_nothing_open() {
    let mut rig = Modal::bench();
    let mut chosen = Vec::new();
    for slow in [1.0, 20.0] {
        rig.modes.iter_mut().for_each(|m| m.damping /= slow);
        let x = channels(10, 3, 100_000);
        let y = signal(rig.fs, measure(&rig, &x, 60));
        let x = signal(rig.fs, x);
        let found = estimate(&[(&x, &y)], &FrfSettings::default(), &unwatched).unwrap();
        let len = found.quality.settings.segment_len.unwrap();
        assert_eq!(len, found.frf.segment_len);
        assert!(found.quality.settings.ridge.is_some());
        assert!(found.quality.averages >= 12);
        let again = estimate(&[(&x, &y)], &found.quality.settings, &unwatched).unwrap();
        assert_eq!(again, found);
        chosen.push(len);
    }
    assert!(chosen[1] >= 4 * chosen[0], "{chosen:?}");
}

#[test]
fn the_thread_count_changes_no_bit() {
    let rig = Modal::bench();
    let x = channels(11, 3, 20_000);
    let y = signal(rig.fs, measure(&rig, &x, 70));
    let x = signal(rig.fs, x);
    let with = |threads| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| {
            let found = estimate(&[(&x, &y)], &FrfSettings::default(), &unwatched).unwrap();
            let predicted = found.frf.apply(&x).unwrap();
            (found, predicted)
        })
    };
    let one = with(1);
    assert_eq!(one.1.n_samples(), 20_000);
    assert!(one == with(2) && one == with(3));
}

/// White noise behind a notch at a quarter of the sample rate and a low pass.
fn notched(white: &[f64]) -> Vec<f64> {
    let (mut a, mut b) = (0.0, 0.0);
    let mut out = Vec::with_capacity(white.len());
    for (t, &w) in white.iter().enumerate() {
        let before = if t >= 2 { white[t - 2] } else { 0.0 };
        // Zeros near +-j, then two equal real poles.
        a = 0.7 * a + w + 0.9 * before;
        b = 0.7 * b + a;
        out.push(b);
    }
    out
}

#[test]
fn a_ridge_damps_one_drive_where_it_excites_little_and_hardly_where_it_excites_well() {
    let rig = Modal::bench();
    let x = vec![notched(&noise(12, 60_000))];
    let y = signal(rig.fs, rig.simulate(&x));
    let x = signal(rig.fs, x);
    let ridge = 1e-2;
    let runs = [(&x, &y)];
    let plain = estimate(&runs, &fixed(512, 0.0), &unwatched).unwrap();
    assert_eq!(plain.warnings, [""; 0], "every line is excited");
    let plain = plain.frf;
    let damped = estimate(&runs, &fixed(512, ridge), &unwatched).unwrap().frf;

    // The spectra once more, by hand from the same segments.
    let data = Data::check(&[RunPart { x: &x, y: &y, samples: 0..x.n_samples() }]).unwrap();
    let welch = fixed(512, 0.0).welch(512);
    let sxx = cross_spectra(&data.all(), &data.means, &welch, rig.fs).unwrap().sxx;
    let lines = 2..plain.n_lines();
    let level = lines.clone().map(|line| sxx[line].re).sum::<f64>() / lines.len() as f64;
    let (mut weak, mut strong) = (0, 0);
    for line in lines {
        let left = (damped.at(line, 0, 0) / plain.at(line, 0, 0)).norm();
        let expected = 1.0 / (1.0 + ridge * level / sxx[line].re);
        assert!((left - expected).abs() < 1e-9, "line {line}: {left} of H, {expected} by the equation");
        if sxx[line].re > level {
            strong += 1;
            assert!(left > 1.0 - ridge, "line {line}: {left} in band");
        }
        if sxx[line].re < 1e-3 * level {
            weak += 1;
            assert!(left < 0.1, "line {line}: {left} in the notch");
        }
    }
    assert!(weak > 10 && strong > 10, "{weak} lines with little power, {strong} with much");
}

#[test]
fn the_ridge_of_each_drive_is_a_share_of_its_own_level() {
    let rig = Modal::bench();
    let mut x = coloured(channels(13, 2, 40_000));
    x[1] = x[1].iter().zip(noise(14, 40_000)).map(|(a, b)| 30.0 * (0.5 * a + b)).collect();
    let y = signal(rig.fs, rig.simulate(&x));
    let x = signal(rig.fs, x);
    let (runs, ridge) = ([(&x, &y)], 0.05);
    let data = Data::check(&[RunPart { x: &x, y: &y, samples: 0..x.n_samples() }]).unwrap();
    let spectra = cross_spectra(&data.all(), &data.means, &fixed(256, 0.0).welch(256), rig.fs).unwrap();
    let lines = spectra.n_lines;
    let level =
        |i: usize| (2..lines).map(|l| spectra.sxx[l * 4 + i * 3].re).sum::<f64>() / (lines - 2) as f64;
    for estimator in [Estimator::H1, Estimator::Ratio] {
        let settings = FrfSettings { estimator, ..fixed(256, ridge) };
        let frf = estimate(&runs, &settings, &unwatched).unwrap().frf;
        assert_eq!(frf.usable_hz, [0.0, 100.0]);
        for line in 0..lines {
            let s = &spectra.sxx[line * 4..][..4];
            let (a, d) = (s[0] + ridge * level(0), s[3] + ridge * level(1));
            for o in 0..2 {
                let y = &spectra.syx[line * 4 + o * 2..][..2];
                let expected = match estimator {
                    // The inverse of two by two.
                    Estimator::H1 => {
                        let det = a * d - s[1] * s[2];
                        [(y[0] * d - y[1] * s[2]) / det, (y[1] * a - y[0] * s[1]) / det]
                    }
                    _ => [y[0] / a, y[1] / d],
                };
                for (i, expected) in expected.into_iter().enumerate() {
                    let error = (frf.at(line, o, i) - expected).norm();
                    assert!(error < 1e-9 * expected.norm().max(1e-3), "{estimator:?} line {line}: {error:e}");
                }
            }
        }
    }
}
