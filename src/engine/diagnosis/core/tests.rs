use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};
use realfft::num_complex::Complex64;

use super::*;
use crate::diagnosis::numerics::ar::Ar;

/// Two masses in a row, integrated with Runge and Kutta's fourth-order rule at eight steps a
/// sample, drives held: shares nothing with the core.
fn two_masses(force: &[f64], fs: f64) -> Vec<f64> {
    let derivative = |s: [f64; 4], f: f64| {
        let (k1, k2, c1, c2, m1, m2) = (4000.0, 2500.0, 6.0, 3.0, 1.0, 0.6);
        let between = k2 * (s[1] - s[0]) + c2 * (s[3] - s[2]);
        [s[2], s[3], (f - k1 * s[0] - c1 * s[2] + between) / m1, -between / m2]
    };
    let h = 1.0 / (8.0 * fs);
    let mut s = [0.0; 4];
    let add = |s: [f64; 4], d: [f64; 4], h: f64| std::array::from_fn(|i| s[i] + h * d[i]);
    force
        .iter()
        .map(|&f| {
            let y = s[0];
            for _ in 0..8 {
                let a = derivative(s, f);
                let b = derivative(add(s, a, h / 2.0), f);
                let c = derivative(add(s, b, h / 2.0), f);
                let d = derivative(add(s, c, h), f);
                s = std::array::from_fn(|i| s[i] + h / 6.0 * (a[i] + 2.0 * b[i] + 2.0 * c[i] + d[i]));
            }
            y
        })
        .collect()
}

fn low_passed(n: usize, cutoff: f64, seed: u64) -> Vec<f64> {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let mut stages = [0.0; 6];
    (0..n)
        .map(|_| {
            let mut x: f64 = StandardNormal.sample(&mut rng);
            for s in &mut stages {
                *s += cutoff * (x - *s);
                x = *s;
            }
            x
        })
        .collect()
}

#[test]
fn a_two_mass_rig_is_recovered_with_its_frequencies_through_noise() {
    let fs = 512.0;
    let force = low_passed(12_000, 0.5, 1);
    let clean = two_masses(&force, fs);
    let level = (clean.iter().map(|y| y * y).sum::<f64>() / clean.len() as f64).sqrt();
    let mut rng = ChaCha8Rng::seed_from_u64(2);
    let noisy: Vec<f64> = clean
        .iter()
        .map(|y| {
            let e: f64 = StandardNormal.sample(&mut rng);
            y + 0.01 * level * e + 0.3
        })
        .collect();
    let band = drive_band(&[vec![&force]]).unwrap();
    let found =
        fit(&[Stretch { drives: vec![&force], response: &noisy }], fs, band, true, &Ar::white(1.0)).unwrap();

    // Eigenfrequencies of the two masses, from the characteristic polynomial of K - w^2 M.
    let (a, b, c) = (0.6, -(0.6 * 6500.0 + 2500.0), 6500.0 * 2500.0 - 2500.0 * 2500.0);
    let root = |sign: f64| {
        let square: f64 = (-b + sign * f64::sqrt(b * b - 4.0 * a * c)) / (2.0 * a);
        square.sqrt() / std::f64::consts::TAU
    };
    let natural = found.core.natural();
    for expected in [root(-1.0), root(1.0)] {
        assert!(natural.iter().any(|(f, _)| (f / expected - 1.0).abs() < 0.01), "{expected} in {natural:?}");
    }

    let other = low_passed(6000, 0.5, 3);
    let truth = two_masses(&other, fs);
    let predicted = found.core.simulate(&[other]);
    let error: f64 = truth.iter().zip(&predicted).map(|(t, p)| (t + 0.3 - p).powi(2)).sum::<f64>();
    let relative = (error / truth.iter().map(|t| t * t).sum::<f64>()).sqrt();
    assert!(relative < 0.003, "{relative}");
    let power: f64 = (0..500).map(|i| found.noise.power(f64::from(i) * 0.001)).sum::<f64>() / 500.0;
    assert!((power.sqrt() / (0.01 * level) - 1.0).abs() < 0.05);
}

#[test]
fn an_integral_is_counted_in_what_was_measured() {
    let fs = 512.0;
    let force = low_passed(12_000, 0.3, 5);
    let clean = two_masses(&force, fs);
    let level = (clean.iter().map(|y| y * y).sum::<f64>() / clean.len() as f64).sqrt();
    // White noise of an acceleration: integrated twice it is as large as the displacement.
    let summed = Ar::integrated(1.0, 2);
    let mut rng = ChaCha8Rng::seed_from_u64(6);
    let mut noise = vec![0.0; clean.len()];
    for k in 2..noise.len() {
        let e: f64 = StandardNormal.sample(&mut rng);
        let before: f64 = summed.coefficients.iter().zip(1..).map(|(a, i)| a * noise[k - i]).sum();
        noise[k] = 3e-4 * level * e - before;
    }
    let noisy: Vec<f64> = clean.iter().zip(&noise).map(|(y, e)| y + e).collect();
    let band = drive_band(&[vec![&force]]).unwrap();
    let found = fit(&[Stretch { drives: vec![&force], response: &noisy }], fs, band, true, &summed).unwrap();
    let deviation = found.noise.mean_power_over(&summed, band).sqrt();
    assert!((deviation / (3e-4 * level) - 1.0).abs() < 0.1, "{deviation} of {}", 3e-4 * level);
    let natural = found.core.natural();
    for expected in [6.940, 14.901] {
        assert!(natural.iter().any(|(f, _)| (f / expected - 1.0).abs() < 0.02), "{expected} in {natural:?}");
    }
}

/// Three modes of two drives, the third of them weak.
fn weak_third_mode(drives: &[Vec<f64>], fs: f64) -> Vec<f64> {
    let modes = [(5.19, 0.015, [1.0, 0.3]), (14.16, 0.041, [-0.3, 0.21]), (21.6, 0.1, [-0.0042, 0.0084])];
    let mut out = vec![0.0; drives[0].len()];
    for (frequency, damping, gains) in modes {
        let w: f64 = std::f64::consts::TAU * frequency / fs;
        let pole = Complex64::from_polar((-damping * w).exp(), w * f64::sqrt(1.0 - damping * damping));
        let mut state = Complex64::new(0.0, 0.0);
        for (k, out) in out.iter_mut().enumerate() {
            *out += state.im;
            state = pole * state + w * (gains[0] * drives[0][k] + gains[1] * drives[1][k]);
        }
    }
    out
}

#[test]
fn a_weak_mode_that_the_search_of_the_order_found_is_not_lost_in_the_last_fit() {
    let fs = 512.0;
    let drives = [71, 1071].map(|seed| low_passed(8000, 0.6, seed)).to_vec();
    let clean = weak_third_mode(&drives, fs);
    let level = (clean.iter().map(|y| y * y).sum::<f64>() / clean.len() as f64).sqrt();
    let mut rng = ChaCha8Rng::seed_from_u64(571);
    let mut noise = || -> f64 { StandardNormal.sample(&mut rng) };
    let noisy: Vec<f64> = clean.iter().map(|y| y + 0.012 * level * noise()).collect();
    let measured: Vec<&[f64]> = drives.iter().map(Vec::as_slice).collect();
    let band = drive_band(std::slice::from_ref(&measured)).unwrap();
    let found =
        fit(&[Stretch { drives: measured, response: &noisy }], fs, band, true, &Ar::white(1.0)).unwrap();
    let natural = found.core.natural();
    assert!(natural.iter().any(|(f, _)| (f / 21.6 - 1.0).abs() < 0.03), "{natural:?}");
    let predicted = found.core.simulate(&drives);
    let error: f64 = clean.iter().zip(&predicted).map(|(y, p)| (y - p).powi(2)).sum::<f64>();
    let relative = (error / clean.iter().map(|y| y * y).sum::<f64>()).sqrt();
    assert!(relative < 0.004, "{relative}");
}

#[test]
fn the_band_holds_a_band_limited_drive() {
    let drive: Vec<f64> = (0..20_000)
        .map(|i| [0.05, 0.06, 0.08, 0.1].iter().map(|f| (6.3 * f * f64::from(i)).sin()).sum())
        .collect();
    let band = drive_band(&[vec![&drive]]).unwrap();
    assert!(band[0] > 0.04 && band[0] < 0.051 && band[1] > 0.099 && band[1] < 0.11, "{band:?}");
    assert!(drive_band(&[vec![&[0.0; 100]]]).is_none());
}

#[test]
fn stretches_too_short_for_any_core_are_refused() {
    let drive = low_passed(12, 0.5, 4);
    let stretch = Stretch { drives: vec![&drive], response: &drive };
    let refused = fit(&[stretch], 100.0, [0.0, 0.1], true, &Ar::white(1.0)).unwrap_err();
    assert!(matches!(refused, crate::EngineError::TooShort { .. }));
}
