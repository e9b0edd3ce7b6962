//! References: a naive DFT that shares no code with the fast path, and closed forms.

use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};
use realfft::num_complex::Complex64;

use super::cross::{Means, Record};
use super::*;

fn noise(seed: u64, n: usize) -> Vec<f64> {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    (0..n).map(|_| StandardNormal.sample(&mut rng)).collect()
}

/// The definition, term by term: `S_ab` of one channel pair over runs.
fn naive(runs: &[(&[f64], &[f64])], welch: &Welch, fs: f64) -> Vec<Complex64> {
    let n = welch.segment_len;
    let w: Vec<f64> = (0..n).map(|i| (std::f64::consts::PI * i as f64 / n as f64).sin().powi(2)).collect();
    let dft = |segment: &[f64], line: usize| -> Complex64 {
        let mean = match welch.detrend {
            Detrend::None => 0.0,
            Detrend::Constant => segment.iter().sum::<f64>() / n as f64,
        };
        (0..n)
            .map(|t| {
                let angle = -std::f64::consts::TAU * (line * t % n) as f64 / n as f64;
                Complex64::from_polar((segment[t] - mean) * w[t], angle)
            })
            .sum()
    };
    let mut averages = 0;
    let mut sums = vec![Complex64::default(); n / 2 + 1];
    for (a, b) in runs {
        let mut start = 0;
        while start + n <= a.len() {
            for (line, sum) in sums.iter_mut().enumerate() {
                *sum += dft(&a[start..start + n], line) * dft(&b[start..start + n], line).conj();
            }
            averages += 1;
            start += welch.hop();
        }
    }
    let scale = fs * w.iter().map(|w| w * w).sum::<f64>() * f64::from(averages);
    let sides = |line: usize| if line == 0 || 2 * line == n { 1.0 } else { 2.0 };
    sums.iter().enumerate().map(|(line, s)| s * sides(line) / scale).collect()
}

fn assert_close(found: &[Complex64], expected: &[Complex64]) {
    assert_eq!(found.len(), expected.len());
    let largest = expected.iter().map(|z| z.norm()).fold(0.0, f64::max);
    for (line, (f, e)) in found.iter().zip(expected).enumerate() {
        // Double precision over a few hundred terms.
        assert!((f - e).norm() <= 1e-12 * largest, "line {line}: {f} instead of {e}");
    }
}

#[test]
fn the_fast_path_equals_a_naive_dft_for_even_and_odd_segments() {
    let fs = 250.0;
    let (long, short) = (noise(1, 700), noise(2, 333));
    let runs = [Signal::new(fs, vec![long.clone()]).unwrap(), Signal::new(fs, vec![short.clone()]).unwrap()];
    for segment_len in [1, 2, 3, 16, 45, 64, 333] {
        for overlap in [0.0, 0.5, 0.75] {
            for detrend in [Detrend::None, Detrend::Constant] {
                if segment_len < 3 && detrend == Detrend::Constant {
                    continue;
                }
                let welch = Welch { segment_len, overlap, detrend };
                let found = psd(&[&runs[0], &runs[1]], &welch).unwrap();
                let found: Vec<Complex64> = found.density[0].iter().map(|&p| p.into()).collect();
                if segment_len == 1 {
                    // The spectrum of one sample is that sample.
                    let power = long.iter().chain(&short).map(|v| v * v).sum::<f64>() / 1033.0;
                    assert_close(&found, &[(power / fs).into()]);
                } else {
                    assert_close(&found, &naive(&[(&long, &long), (&short, &short)], &welch, fs));
                }
            }
        }
    }
}

#[test]
fn cross_spectra_equal_a_naive_dft_in_every_pair() {
    let fs = 100.0;
    let n = 1500;
    let channels: Vec<Vec<f64>> = (0..5).map(|c| noise(10 + c, n)).collect();
    let welch = Welch { segment_len: 128, overlap: 0.75, detrend: Detrend::None };
    let means = Means { x: vec![0.3, -0.2, 0.0], y: vec![1.0, 0.0] };
    let parts = [0..600, 600..1500];
    let records: Vec<Record<'_>> = parts
        .iter()
        .map(|r| Record {
            x: channels[..3].iter().map(|c| &c[r.clone()]).collect(),
            y: channels[3..].iter().map(|c| &c[r.clone()]).collect(),
        })
        .collect();
    let found = cross_spectra(&records, &means, &welch, fs).unwrap();
    assert_eq!((found.n_lines, found.n_inputs, found.n_outputs), (65, 3, 2));

    let offsets = [0.3, -0.2, 0.0, 1.0, 0.0];
    let centred: Vec<Vec<f64>> =
        channels.iter().zip(offsets).map(|(c, m)| c.iter().map(|v| v - m).collect()).collect();
    let expected = |a: usize, b: usize| {
        let runs = parts.clone().map(|r| (&centred[a][r.clone()], &centred[b][r]));
        naive(&runs, &welch, fs)
    };
    for i in 0..3 {
        for j in 0..3 {
            let sxx: Vec<Complex64> = (0..65).map(|l| found.sxx[(l * 3 + i) * 3 + j]).collect();
            assert_close(&sxx, &expected(i, j));
        }
        for o in 0..2 {
            let syx: Vec<Complex64> = (0..65).map(|l| found.syx[(l * 2 + o) * 3 + i]).collect();
            assert_close(&syx, &expected(3 + o, i));
        }
    }
    for o in 0..2 {
        let syy: Vec<Complex64> = (0..65).map(|l| found.syy[l * 2 + o].into()).collect();
        assert_close(&syy, &expected(3 + o, 3 + o));
    }
}

#[test]
fn a_sine_has_its_power_at_its_line() {
    // Amplitude 3 at line 20 of 256: power 4.5, spread by the Hann window over lines 19, 20, 21.
    let (fs, n) = (512.0, 256);
    let x = (0..4096).map(|t| 3.0 * (std::f64::consts::TAU * 40.0 * t as f64 / fs + 0.4).cos()).collect();
    let welch = Welch { segment_len: n, overlap: 0.5, detrend: Detrend::None };
    let found = psd(&[&Signal::new(fs, vec![x]).unwrap()], &welch).unwrap();
    let (df, density) = (found.df_hz, &found.density[0]);
    assert_eq!(df, 2.0);
    let power: f64 = density[19..=21].iter().sum::<f64>() * df;
    assert!((power - 4.5).abs() < 1e-10, "{power}");
    assert!((density[20] * df - 4.5 / 1.5).abs() < 1e-10);
    let elsewhere: f64 = density[..19].iter().chain(&density[22..]).sum();
    assert!(elsewhere * df < 1e-20, "{elsewhere}");
}

#[test]
fn white_noise_has_the_level_that_its_variance_says() {
    // Variance 1 over 0..fs/2: density 2 / fs. 1,023 averages of 127 lines: 0.4 % standard error.
    let (fs, n) = (1000.0, 256);
    let welch = Welch { segment_len: n, overlap: 0.5, detrend: Detrend::None };
    let found = psd(&[&Signal::new(fs, vec![noise(3, 131_072)]).unwrap()], &welch).unwrap();
    assert_eq!(found.n_averages, 1023);
    let level = found.density[0][1..128].iter().sum::<f64>() / 127.0;
    assert!((level / (2.0 / fs) - 1.0).abs() < 0.015, "{level}");
    // DC and Nyquist are not doubled.
    assert!((found.density[0][128] * fs - 1.0).abs() < 0.15);
}

#[test]
fn parseval_holds_in_every_segment() {
    for segment_len in [100, 101] {
        let x = noise(4, segment_len);
        let welch = Welch { segment_len, overlap: 0.0, detrend: Detrend::None };
        let found = psd(&[&Signal::new(50.0, vec![x.clone()]).unwrap()], &welch).unwrap();
        let w = hann(segment_len);
        let in_time: f64 = x.iter().zip(&w).map(|(v, w)| (v * w).powi(2)).sum::<f64>()
            / w.iter().map(|w| w * w).sum::<f64>();
        let in_lines = found.density[0].iter().sum::<f64>() * found.df_hz;
        assert!((in_time - in_lines).abs() < 1e-12 * in_time);
    }
}

#[test]
fn the_thread_count_changes_no_bit() {
    let signal = Signal::new(1.0, vec![noise(5, 40_000), noise(6, 40_000)]).unwrap();
    let welch = Welch { segment_len: 512, overlap: 0.75, detrend: Detrend::Constant };
    let with = |threads| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| psd(&[&signal], &welch).unwrap())
    };
    let one = with(1);
    assert_eq!(one.density[0].len(), 257);
    assert_eq!(one, with(2));
    assert_eq!(one, with(5));
}

#[test]
fn effective_averages_lie_between_separate_and_all_segments() {
    let at = |overlap| Welch { segment_len: 1024, overlap, detrend: Detrend::None };
    assert_eq!(at(0.0).effective_averages(10), 10.0);
    assert_eq!(at(0.5).effective_averages(1), 1.0);
    assert_eq!(at(0.5).effective_averages(0), 0.0);
    // Hann, half overlap: neighbouring segments correlate by 1/6 (Welch 1967).
    let expected = 100.0 / (1.0 + 2.0 * 0.99 / 36.0);
    assert!((at(0.5).effective_averages(100) - expected).abs() < 1e-6);
    let dense = at(0.75).effective_averages(200);
    assert!(dense > 100.0 && dense < 110.0, "{dense}");
}

#[test]
fn senseless_settings_and_short_runs_are_named() {
    let signal = Signal::new(1.0, vec![vec![0.0; 10]]).unwrap();
    let welch = |segment_len, overlap| Welch { segment_len, overlap, detrend: Detrend::None };
    assert!(matches!(
        psd(&[&signal], &welch(11, 0.5)),
        Err(EngineError::TooShort { needed: 11, found: 10, .. })
    ));
    for (segment_len, overlap, setting) in
        [(0, 0.5, "segment_len"), (4, 1.0, "overlap"), (4, -0.1, "overlap"), (4, f64::NAN, "overlap")]
    {
        match psd(&[&signal], &welch(segment_len, overlap)) {
            Err(EngineError::Setting { setting: found, .. }) => assert_eq!(found, setting),
            other => panic!("{other:?}"),
        }
    }
    assert!(psd(&[], &welch(4, 0.5)).is_err());
    let two = Signal::new(1.0, vec![vec![0.0; 10]; 2]).unwrap();
    assert!(matches!(psd(&[&signal, &two], &welch(4, 0.5)), Err(EngineError::ChannelCount { .. })));
    let huge = Signal::new(1.0, vec![vec![1e200; 10]]).unwrap();
    assert!(matches!(
        psd(&[&huge], &welch(4, 0.5)),
        Err(EngineError::NonFiniteResult { channel: 0, sample: 0, .. })
    ));
}
