//! Applying an FRF: the slow definition, every length, no wrap-around.

use super::*;

/// An FRF of given taps, lags `-len / 2 .. len / 2`, `[output][input][tap]`.
fn from_taps(taps: &[Vec<Vec<f64>>], x_mean: Vec<f64>, y_mean: Vec<f64>) -> Frf {
    let len = taps[0][0].len();
    let h = (0..=len / 2)
        .flat_map(|line| {
            taps.iter().flatten().map(move |taps| {
                let at = |(k, tap): (usize, &f64)| {
                    let lag = k as f64 - (len / 2) as f64;
                    Complex64::from_polar(*tap, -std::f64::consts::TAU * line as f64 * lag / len as f64)
                };
                taps.iter().enumerate().map(at).sum()
            })
        })
        .collect();
    Frf {
        sample_rate_hz: 10.0,
        segment_len: len,
        n_inputs: x_mean.len(),
        n_outputs: y_mean.len(),
        h,
        usable_hz: [0.0, 5.0],
        x_mean,
        y_mean,
    }
}

/// The definition: a sum over taps, the signal held before its start and after its end.
fn convolve(taps: &[Vec<Vec<f64>>], frf: &Frf, x: &[Vec<f64>]) -> Vec<Vec<f64>> {
    let (n, half) = (x[0].len() as i64, (frf.segment_len / 2) as i64);
    let value = |o: usize, t: i64| {
        let mut sum = frf.y_mean[o];
        for (i, taps) in taps[o].iter().enumerate() {
            for (k, tap) in taps.iter().enumerate() {
                let at = (t - (k as i64 - half)).clamp(0, n - 1) as usize;
                sum += tap * (x[i][at] - frf.x_mean[i]);
            }
        }
        sum
    };
    (0..frf.n_outputs).map(|o| (0..n).map(|t| value(o, t)).collect()).collect()
}

#[test]
fn overlap_save_equals_the_convolution_sum_for_every_length() {
    for len in [2, 16, 30] {
        let taps: Vec<Vec<Vec<f64>>> = (0..2).map(|o| channels(70 + o, 3, len)).collect();
        let frf = from_taps(&taps, vec![0.5, -1.0, 2.0], vec![10.0, -3.0]);
        let filter = frf.filter().unwrap();
        for n in (1..40).chain([48, 49, 50, 97, 98, 99, 500]) {
            let x = channels(80, 3, n);
            let expected = convolve(&taps, &frf, &x);
            let found = filter.apply(&signal(10.0, x)).unwrap();
            assert_eq!((found.n_channels(), found.n_samples()), (2, n));
            for (o, expected) in expected.iter().enumerate() {
                for (t, (f, e)) in found.channel(o).iter().zip(expected).enumerate() {
                    assert!((f - e).abs() < 1e-11, "{len} taps, {n} samples, output {o}, at {t}: {f} {e}");
                }
            }
        }
    }
}

#[test]
fn a_pulse_at_one_end_does_not_reach_the_other() {
    let taps = vec![vec![noise(90, 64)]];
    let frf = from_taps(&taps, vec![0.0], vec![0.0]);
    let mut x = vec![0.0; 1000];
    x[990] = 1.0;
    let y = frf.apply(&signal(10.0, vec![x])).unwrap();
    assert!(y.channel(0)[..958].iter().all(|v| v.abs() < 1e-13));
    assert!(y.channel(0)[958..].iter().any(|v| v.abs() > 0.1));
}

#[test]
fn the_response_is_linear_about_the_working_point() {
    let taps = vec![channels(91, 2, 32)];
    let frf = from_taps(&taps, vec![1.0, 2.0], vec![5.0]);
    let (a, b) = (channels(92, 2, 200), channels(93, 2, 200));
    let mix: Vec<Vec<f64>> = (0..2)
        .map(|c| {
            (0..200)
                .map(|t| frf.x_mean[c] + 2.0 * (a[c][t] - frf.x_mean[c]) - 3.0 * (b[c][t] - frf.x_mean[c]))
                .collect()
        })
        .collect();
    let apply = |x: &Vec<Vec<f64>>| frf.apply(&signal(10.0, x.clone())).unwrap();
    let (ya, yb, y) = (apply(&a), apply(&b), apply(&mix));
    for t in 0..200 {
        let expected = 5.0 + 2.0 * (ya.channel(0)[t] - 5.0) - 3.0 * (yb.channel(0)[t] - 5.0);
        assert!((y.channel(0)[t] - expected).abs() < 1e-11);
    }
}

#[test]
fn signals_that_do_not_fit_are_refused_by_name() {
    let frf = from_taps(&[channels(94, 2, 8)], vec![0.0; 2], vec![0.0]);
    let apply = |fs, x| frf.apply(&signal(fs, x));
    assert!(matches!(
        apply(10.0, vec![vec![0.0]; 3]),
        Err(EngineError::ChannelCount { expected: 2, found: 3, .. })
    ));
    assert!(matches!(
        apply(11.0, vec![vec![0.0]; 2]),
        Err(EngineError::SampleRate { expected_hz: 10.0, found_hz: 11.0, .. })
    ));
    assert!(matches!(apply(10.0, vec![vec![]; 2]), Err(EngineError::TooShort { needed: 1, found: 0, .. })));
    assert!(matches!(
        apply(10.0, vec![vec![1e308, -1e308]; 2]),
        Err(EngineError::NonFiniteResult { channel: 0, .. })
    ));
}

#[test]
fn an_frf_whose_fields_do_not_belong_together_is_refused() {
    let good = from_taps(&[channels(95, 2, 8)], vec![0.0; 2], vec![0.0]);
    good.check().unwrap();
    let broken = |change: &dyn Fn(&mut Frf)| {
        let mut frf = good.clone();
        change(&mut frf);
        let error = frf.check().unwrap_err();
        assert_eq!(frf.filter().unwrap_err(), error);
        error
    };
    let tensor = broken(&|f| f.h.truncate(3));
    assert!(matches!(tensor, EngineError::TensorShape { ref expected, .. } if expected[..] == [5, 1, 2]));
    assert!(matches!(broken(&|f| f.segment_len = 7), EngineError::Setting { .. }));
    assert!(matches!(broken(&|f| f.segment_len = usize::MAX - 1), EngineError::TensorShape { .. }));
    assert!(matches!(broken(&|f| f.x_mean = vec![0.0]), EngineError::ChannelCount { .. }));
    assert!(matches!(broken(&|f| f.y_mean[0] = f64::NAN), EngineError::NonFinite { .. }));
    assert!(matches!(
        broken(&|f| f.h[3].im = f64::INFINITY),
        EngineError::NonFinite { channel: 0, sample: 1, .. }
    ));
    assert!(matches!(broken(&|f| f.sample_rate_hz = 0.0), EngineError::Setting { .. }));
}
