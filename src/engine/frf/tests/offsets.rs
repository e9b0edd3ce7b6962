//! Means: static preload, runs about different means, drives far from the fit's mean.

use super::modal::Modal;
use super::*;

const PRELOAD: [f64; 2] = [40.0, -7.0];

fn run(rig: &Modal, seed: u64, n: usize, mean: [f64; 3], level: f64) -> (Signal, Signal) {
    // The rig stood at its mean long before the recording.
    let settle = 2000;
    let mut x = channels(seed, 3, n + settle);
    for (x, mean) in x.iter_mut().zip(mean) {
        for (t, v) in x.iter_mut().enumerate() {
            *v = mean + if t < settle / 2 { 0.0 } else { level * *v };
        }
    }
    let mut y = rig.simulate(&x);
    for (y, preload) in y.iter_mut().zip(PRELOAD) {
        y.iter_mut().for_each(|v| *v += preload);
    }
    let cut = |c: Vec<Vec<f64>>| signal(rig.fs, c.into_iter().map(|c| c[settle..].to_vec()).collect());
    (cut(x), cut(y))
}

/// Largest error of the predicted mean, as a share of the change of the mean.
fn static_error(found: &FrfEstimate, rig: &Modal) -> f64 {
    let mean = [30.0, -20.0, 25.0];
    let (x, y) = run(rig, 99, 4000, mean, 1.0);
    let predicted = found.frf.apply(&x).unwrap();
    (0..2)
        .map(|o| {
            let average = |c: &[f64]| c.iter().sum::<f64>() / c.len() as f64;
            let change = average(y.channel(o)) - PRELOAD[o];
            (average(predicted.channel(o)) - average(y.channel(o))).abs() / change.abs()
        })
        .fold(0.0, f64::max)
}

#[test]
fn a_static_preload_and_a_drive_far_from_the_mean_of_one_run_come_out_right() {
    let rig = Modal::bench();
    let (x, y) = run(&rig, 20, 80_000, [5.0, 0.0, -3.0], 1.0);
    let found = estimate(&[(&x, &y)], &FrfSettings::default(), &unwatched).unwrap();
    assert!((found.frf.x_mean[0] - 5.0).abs() < 0.05);
    // The same working point: the preload is a constant of the model.
    let (x, y) = run(&rig, 21, 5000, [5.0, 0.0, -3.0], 1.0);
    let predicted = found.frf.apply(&x).unwrap();
    for o in 0..2 {
        let error = relative_error(y.channel(o), predicted.channel(o));
        assert!(error < 0.01, "output {o}: {error}");
    }
    // Means that 800 averages of noise alone tell to some percent.
    let error = static_error(&found, &rig);
    assert!(error < 0.05, "{error}");
}

#[test]
fn runs_about_different_means_teach_the_static_gain() {
    let rig = Modal::bench();
    let means = [[8.0, -2.0, 1.0], [-6.0, 5.0, 3.0], [2.0, 7.0, -9.0], [-4.0, -8.0, 4.0], [1.0, 3.0, 6.0]];
    let runs: Vec<(Signal, Signal)> =
        means.iter().enumerate().map(|(k, &m)| run(&rig, 30 + k as u64, 12_000, m, 1.0)).collect();
    let pairs: Vec<(&Signal, &Signal)> = runs.iter().map(|(x, y)| (x, y)).collect();
    let found = estimate(&pairs, &FrfSettings::default(), &unwatched).unwrap();
    for i in 0..3 {
        let mean = means.iter().map(|m| m[i]).sum::<f64>() / 5.0;
        assert!((found.frf.x_mean[i] - mean).abs() < 0.05);
        for o in 0..2 {
            let (gain, truth) = (found.frf.at(0, o, i), rig.frf(0.0, o, i).re);
            assert_eq!(gain.im, 0.0);
            assert!((gain.re - truth).abs() < 0.005, "{gain} instead of {truth}");
        }
    }
    let error = static_error(&found, &rig);
    assert!(error < 0.005, "{error}");
    let (x, y) = run(&rig, 40, 6000, [20.0, 20.0, -20.0], 2.0);
    let predicted = found.frf.apply(&x).unwrap();
    for o in 0..2 {
        let error = relative_error(y.channel(o), predicted.channel(o));
        assert!(error < 0.01, "output {o}: {error}");
    }
}

#[test]
fn a_constant_drive_gives_the_static_response_from_its_first_sample() {
    let rig = Modal::bench();
    let (x, y) = run(&rig, 50, 40_000, [1.0, 2.0, 3.0], 1.0);
    let found = estimate(&[(&x, &y)], &fixed(512, 0.0), &unwatched).unwrap();
    for n in [1, 7, 3000] {
        let constant = signal(rig.fs, vec![vec![4.0; n], vec![2.0; n], vec![3.0; n]]);
        let predicted = found.frf.apply(&constant).unwrap();
        let frf = &found.frf;
        for o in 0..2 {
            assert_eq!(predicted.n_samples(), n);
            let change = [4.0, 2.0, 3.0].iter().zip(&frf.x_mean).enumerate();
            let expected: f64 =
                frf.y_mean[o] + change.map(|(i, (x, m))| frf.at(0, o, i).re * (x - m)).sum::<f64>();
            assert!(predicted.channel(o).iter().all(|v| (v - expected).abs() < 1e-9 * expected.abs()));
        }
    }
}

#[test]
fn without_power_at_dc_the_static_gain_is_zero_and_said_to_be() {
    let rig = Modal::bench();
    let n = 60_000;
    let x = channels(60, 3, n);
    // Differences of noise at some distance, twice: no power at DC, little below 1 Hz.
    let high = |c: &Vec<f64>| -> Vec<f64> {
        let mut out = c.clone();
        for _ in 0..4 {
            out = (0..n).map(|t| out[t] - if t > 0 { out[t - 1] } else { 0.0 }).collect();
        }
        out
    };
    let x: Vec<Vec<f64>> = x.iter().map(high).collect();
    let y = signal(rig.fs, rig.simulate(&x));
    let found = estimate(&[(&signal(rig.fs, x), &y)], &fixed(1024, 0.0), &unwatched).unwrap();
    assert!(found.frf.usable_hz[0] > 0.0);
    assert!((0..2).all(|o| (0..3).all(|i| found.frf.at(0, o, i).norm() == 0.0)));
    assert!(found.warnings[0].contains("static gain is unknown"), "{:?}", found.warnings);
}
