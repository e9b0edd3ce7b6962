//! How far a prediction is from the measurement, per channel.

use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use super::spectral::{Detrend, Psd, Welch, psd, same_shape};
use super::{EngineError, Signal};

/// The settings behind every error figure, echoed with it.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ErrorSettings {
    /// PSD of `psd_rms`, one-sided, Hann window.
    pub psd: Welch,
    /// The window's name.
    pub window: Window,
}

/// Windows of a PSD.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Window {
    /// Hann, periodic.
    Hann,
}

impl ErrorSettings {
    /// Samples per segment of a signal long enough for it.
    pub const SEGMENT_LEN: usize = 4096;

    /// Half overlap, each segment's mean removed (as SciPy's `welch` does), 4096 samples or the whole
    /// signal if that is shorter.
    pub fn for_length(n_samples: usize) -> Self {
        let segment_len = n_samples.clamp(1, Self::SEGMENT_LEN);
        let psd = Welch { segment_len, overlap: 0.5, detrend: Detrend::Constant };
        Self { psd, window: Window::Hann }
    }
}

/// Why a figure is absent.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum NoFigure {
    /// The measured channel is zero throughout: there is nothing to relate an error to.
    MeasuredZero,
    /// The measured channel, or the part of it that the spectrum's segments cover, does not move:
    /// there is nothing to relate an error about its mean to.
    MeasuredConstant,
}

/// Errors of one channel. A preload that both signals share makes `rms` small whatever the motion
/// does; `rms_ac` and `psd_rms` leave it out, and `mean` says how far it is off.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct ChannelErrors {
    /// [`rms`] of the samples: the mean counts.
    pub rms: Option<f64>,
    /// [`rms`] of the samples about their own means, relative to the measured standard deviation.
    pub rms_ac: Option<f64>,
    /// Mean predicted less mean measured, relative to the measured standard deviation.
    pub mean: Option<f64>,
    /// [`rms`] of the power spectral densities, from which each segment's mean is removed.
    pub psd_rms: Option<f64>,
    /// Why a figure is absent.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub reason: Option<NoFigure>,
}

/// Errors of a signal with the settings they were found with.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Errors {
    /// Settings used.
    pub settings: ErrorSettings,
    /// One entry a channel, in the signals' order.
    pub channels: Vec<ChannelErrors>,
}

/// The errors of each channel.
///
/// # Errors
/// Signals that differ in channels, length or sample rate, no samples, values whose square
/// overflows.
pub fn errors(measured: &Signal, predicted: &Signal) -> Result<Errors, EngineError> {
    errors_with_spectra(measured, predicted).map(|(errors, _)| errors)
}

/// The errors of each channel, and the spectra behind `psd_rms`: measured, predicted.
///
/// # Errors
/// As [`errors`].
pub fn errors_with_spectra(measured: &Signal, predicted: &Signal) -> Result<(Errors, [Psd; 2]), EngineError> {
    const WHAT: &str = "predicted signal";
    same_shape(WHAT, measured, predicted)?;
    let (expected, found) = (measured.n_samples(), predicted.n_samples());
    if expected != found {
        return Err(EngineError::UnequalLength { what: WHAT, channel: 0, expected, found });
    }
    let settings = ErrorSettings::for_length(expected);
    let measured_psd = psd(&[measured], &settings.psd)?;
    let predicted_psd = psd(&[predicted], &settings.psd)?;
    let channels: Vec<Result<ChannelErrors, EngineError>> = (0..measured.n_channels())
        .into_par_iter()
        .map(|channel| {
            let (m, p) = (measured.channel(channel), predicted.channel(channel));
            let about_mean = about_mean(m, p);
            let (density, predicted) = (&measured_psd.density[channel], &predicted_psd.density[channel]);
            let power = measured_psd.df_hz * density.iter().sum::<f64>();
            let found = ChannelErrors {
                rms: rms(m, p),
                rms_ac: about_mean.map(|(rms_ac, _)| rms_ac),
                mean: about_mean.map(|(_, mean)| mean),
                psd_rms: if power > negligible(m) { rms(density, predicted) } else { None },
                reason: None,
            };
            let reason = match (found.rms, found.rms_ac.and(found.psd_rms)) {
                (None, _) => Some(NoFigure::MeasuredZero),
                (_, None) => Some(NoFigure::MeasuredConstant),
                _ => None,
            };
            let figures = [found.rms, found.rms_ac, found.mean, found.psd_rms];
            if figures.into_iter().flatten().all(f64::is_finite) {
                Ok(ChannelErrors { reason, ..found })
            } else {
                Err(EngineError::NonFiniteResult { what: "error", channel, sample: 0 })
            }
        })
        .collect();
    let channels = channels.into_iter().collect::<Result<_, _>>()?;
    Ok((Errors { settings, channels }, [measured_psd, predicted_psd]))
}

/// `rms_ac` and `mean` of [`ChannelErrors`]; `None` when `measured` is constant.
fn about_mean(measured: &[f64], predicted: &[f64]) -> Option<(f64, f64)> {
    let (m_mean, p_mean) = (mean(measured), mean(predicted));
    let spread = spread(measured)?;
    let error: f64 = measured.iter().zip(predicted).map(|(m, p)| ((m - m_mean) - (p - p_mean)).powi(2)).sum();
    let deviation = (spread / measured.len() as f64).sqrt();
    Some(((error / spread).sqrt(), (p_mean - m_mean) / deviation))
}

/// `sqrt(sum (y - y*)^2 / sum y^2)`, `y` measured and `y*` predicted (Heindel et al., section
/// 3.2); the mean counts. `None` when `measured` is zero throughout, NaN when its squares overflow.
///
/// # Panics
/// If the lengths differ: callers pass channels of signals that they compared.
pub fn rms(measured: &[f64], predicted: &[f64]) -> Option<f64> {
    let power: f64 = measured.iter().map(|v| v * v).sum();
    let error = square_error(measured, predicted);
    let share = if power.is_finite() { error / power } else { f64::NAN };
    (power > 0.0).then(|| share.sqrt())
}

/// Root of the mean square error, in the channel's unit. `None` without samples.
///
/// # Panics
/// As [`rms`].
pub fn rmse(measured: &[f64], predicted: &[f64]) -> Option<f64> {
    let n = measured.len();
    let error = square_error(measured, predicted);
    (n > 0).then(|| (error / n as f64).sqrt())
}

/// [`rmse`] / standard deviation of `measured`. `None` when `measured` is constant.
///
/// # Panics
/// As [`rms`].
pub fn nrmse(measured: &[f64], predicted: &[f64]) -> Option<f64> {
    spread(measured).map(|spread| (square_error(measured, predicted) / spread).sqrt())
}

/// Geometric mean: the average of ratios. `None` without ratios, and unless all are above zero.
pub fn geometric_mean(ratios: &[f64]) -> Option<f64> {
    let logarithms: f64 = ratios.iter().map(|ratio| ratio.ln()).sum();
    let mean = (logarithms / ratios.len() as f64).exp();
    (!ratios.is_empty() && ratios.iter().all(|ratio| *ratio > 0.0)).then_some(mean)
}

fn mean(samples: &[f64]) -> f64 {
    samples.iter().sum::<f64>() / samples.len().max(1) as f64
}

/// Sum of the squares about the mean; `None` when the samples are constant but for rounding.
fn spread(samples: &[f64]) -> Option<f64> {
    let mean = mean(samples);
    let spread: f64 = samples.iter().map(|v| (v - mean).powi(2)).sum();
    (spread > negligible(samples) * samples.len() as f64).then_some(spread)
}

/// Mean square that rounding leaves of a constant as large as the samples.
fn negligible(samples: &[f64]) -> f64 {
    let largest = samples.iter().fold(0.0_f64, |m, v| m.max(v.abs()));
    (1e-12 * largest).powi(2)
}

fn square_error(measured: &[f64], predicted: &[f64]) -> f64 {
    assert_eq!(measured.len(), predicted.len(), "lengths are compared by the caller");
    measured.iter().zip(predicted).map(|(m, p)| (m - p).powi(2)).sum()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn signal(channels: Vec<Vec<f64>>) -> Signal {
        Signal::new(1000.0, channels).unwrap()
    }

    fn sine(hz: f64, n: usize) -> Vec<f64> {
        (0..n).map(|t| (std::f64::consts::TAU * hz * t as f64 / 1000.0).sin()).collect()
    }

    #[test]
    fn figures_by_hand() {
        let (measured, predicted) = ([3.0, 4.0, 0.0, 0.0], [3.0, 4.0, 1.0, -2.0]);
        assert_eq!(rms(&measured, &predicted), Some((5.0_f64 / 25.0).sqrt()));
        assert_eq!(rmse(&measured, &predicted), Some((5.0_f64 / 4.0).sqrt()));
        // Mean 1.75, squares about it: 25 - 4 * 1.75^2 = 12.75.
        assert!((nrmse(&measured, &predicted).unwrap() - (5.0_f64 / 12.75).sqrt()).abs() < 1e-15);
        assert_eq!(rms(&[0.0, 0.0], &[1.0, 1.0]), None);
        assert_eq!(rmse(&[0.0, 0.0], &[1.0, 1.0]), Some(1.0));
        assert_eq!(nrmse(&[0.1; 7], &[0.2; 7]), None);
        assert_eq!((rms(&[], &[]), rmse(&[], &[]), nrmse(&[], &[])), (None, None, None));
    }

    #[test]
    fn an_amplitude_error_counts_once_in_rms_and_squared_in_psd_rms() {
        let y = sine(20.0, 20_000);
        let scaled = y.iter().map(|v| 1.1 * v).collect();
        let found = errors(&signal(vec![y]), &signal(vec![scaled])).unwrap();
        assert_eq!(found.channels.len(), 1);
        assert!((found.channels[0].rms.unwrap() - 0.1).abs() < 1e-12);
        assert!((found.channels[0].psd_rms.unwrap() - 0.21).abs() < 1e-12);
        assert_eq!(found.channels[0].reason, None);
    }

    #[test]
    fn a_time_shift_counts_in_rms_and_not_in_psd_rms() {
        let y = sine(20.0, 20_000);
        let (early, late) = (y[..19_000].to_vec(), y[1000 - 25..20_000 - 25].to_vec());
        let found = errors(&signal(vec![early]), &signal(vec![late])).unwrap().channels[0];
        assert!((found.rms.unwrap() - 2.0).abs() < 1e-6);
        assert!(found.psd_rms.unwrap() < 1e-6);
    }

    #[test]
    fn a_preload_hides_an_error_from_rms_alone() {
        let y = sine(20.0, 20_000);
        let on = |preload: f64, scale: f64| y.iter().map(|v| preload + scale * v).collect::<Vec<f64>>();
        let found = errors(&signal(vec![on(50.0, 1.0)]), &signal(vec![on(50.0, 1.1)])).unwrap().channels[0];
        assert!(found.rms.unwrap() < 0.002, "{found:?}");
        assert!((found.rms_ac.unwrap() - 0.1).abs() < 1e-12, "{found:?}");
        assert!((found.psd_rms.unwrap() - 0.21).abs() < 1e-12, "{found:?}");
        assert!(found.mean.unwrap().abs() < 1e-12, "{found:?}");
        // A preload that is off by one standard deviation and nothing else.
        let off = 0.5_f64.sqrt();
        let found =
            errors(&signal(vec![on(50.0, 1.0)]), &signal(vec![on(50.0 - off, 1.0)])).unwrap().channels[0];
        assert!((found.mean.unwrap() + 1.0).abs() < 1e-9, "{found:?}");
        assert!(found.rms_ac.unwrap() < 1e-10 && found.psd_rms.unwrap() < 1e-10, "{found:?}");
    }

    /// The generator of `scripts/scipy_vectors.py`.
    fn noise(n: usize, seed: u64) -> Vec<f64> {
        let mut state = seed.wrapping_mul(2_862_933_555_777_941_757).wrapping_add(3_037_000_493);
        (0..n)
            .map(|_| {
                state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
                (state >> 11) as f64 / (1u64 << 52) as f64 - 1.0
            })
            .collect()
    }

    #[test]
    fn figures_are_those_of_scipy() {
        let file = format!("{}/../../tests/vectors/errors.json", env!("CARGO_MANIFEST_DIR"));
        let cases: Vec<serde_json::Value> =
            serde_json::from_str(&std::fs::read_to_string(file).unwrap()).unwrap();
        assert!(cases.len() >= 5);
        for case in cases {
            let number = |key: &str| case[key].as_f64().unwrap();
            let n = case["samples"].as_u64().unwrap() as usize;
            let wave = |t: usize, late: f64| {
                let turn = std::f64::consts::TAU * (t as f64 / 1000.0 - late);
                (7.3 * turn).sin() + 0.4 * (31.0 * turn).sin()
            };
            let made = |mean: f64, scale: f64, late: f64, seed: u64| -> Vec<f64> {
                let noise = noise(n, seed).into_iter().enumerate();
                noise.map(|(t, noise)| mean + scale * wave(t, late) + 0.2 * noise).collect()
            };
            let measured = made(number("measured_mean"), 1.0, 0.0, 1);
            let predicted = made(number("predicted_mean"), 1.06, 0.002, 2);
            let found = errors(&signal(vec![measured]), &signal(vec![predicted])).unwrap().channels[0];
            for (name, figure) in [
                ("rms", found.rms),
                ("rms_ac", found.rms_ac),
                ("mean", found.mean),
                ("psd_rms", found.psd_rms),
            ] {
                let (figure, expected) = (figure.unwrap(), number(name));
                assert!((figure / expected - 1.0).abs() < 1e-8, "{n} samples, {name}: {figure} {expected}");
            }
        }
    }

    #[test]
    fn ratios_are_averaged_geometrically() {
        assert!((geometric_mean(&[0.5, 2.0]).unwrap() - 1.0).abs() < 1e-15);
        assert!((geometric_mean(&[1.0, 10.0, 100.0]).unwrap() - 10.0).abs() < 1e-12);
        assert_eq!((geometric_mean(&[]), geometric_mean(&[1.0, 0.0])), (None, None));
        assert_eq!(geometric_mean(&[1.0, f64::NAN]), None);
    }

    #[test]
    fn short_signals_are_one_segment_and_the_settings_say_so() {
        for n in [2, 3, 100, 4096, 5000] {
            let y: Vec<f64> = (0..n).map(|t| 1.0 + (t as f64).sin()).collect();
            let found = errors(&signal(vec![y.clone()]), &signal(vec![y])).unwrap();
            assert_eq!(found.settings.psd.segment_len, n.min(4096));
            let same = ChannelErrors {
                rms: Some(0.0),
                rms_ac: Some(0.0),
                mean: Some(0.0),
                psd_rms: Some(0.0),
                reason: None,
            };
            assert_eq!(found.channels, [same], "{n} samples");
        }
        let json = serde_json::to_value(ErrorSettings::for_length(9000)).unwrap();
        assert_eq!(
            json,
            serde_json::json!({
                "psd": {"segment_len": 4096, "overlap": 0.5, "detrend": "constant"}, "window": "hann"
            })
        );
    }

    #[test]
    fn a_channel_that_is_zero_or_constant_has_no_such_figure_but_a_reason() {
        let measured = signal(vec![vec![0.0; 50], sine(20.0, 50), vec![0.1; 50]]);
        let predicted = signal(vec![vec![1.0; 50], sine(20.0, 50), vec![0.2; 50]]);
        let found = errors(&measured, &predicted).unwrap();
        let json = |channel: usize| serde_json::to_value(found.channels[channel]).unwrap();
        assert_eq!(
            json(0),
            serde_json::json!({
                "rms": null, "rms_ac": null, "mean": null, "psd_rms": null, "reason": "measured_zero"
            })
        );
        assert_eq!(found.channels[1].rms, Some(0.0));
        assert_eq!(
            json(2),
            serde_json::json!({
                "rms": 1.0, "rms_ac": null, "mean": null, "psd_rms": null, "reason": "measured_constant"
            })
        );
        // It moves only behind the last whole segment.
        let mut late = vec![5.0; 5000];
        late[4999] = 6.0;
        let late = signal(vec![late]);
        let found = errors(&late, &late).unwrap().channels[0];
        assert_eq!((found.rms_ac, found.mean, found.psd_rms), (Some(0.0), Some(0.0), None));
        assert_eq!(found.reason, Some(NoFigure::MeasuredConstant));
    }

    #[test]
    fn signals_that_do_not_belong_together_are_refused() {
        let one = signal(vec![vec![1.0; 10]]);
        assert!(matches!(
            errors(&one, &signal(vec![vec![1.0; 10]; 2])),
            Err(EngineError::ChannelCount { .. })
        ));
        assert!(matches!(errors(&one, &signal(vec![vec![1.0; 9]])), Err(EngineError::UnequalLength { .. })));
        let other = Signal::new(999.0, vec![vec![1.0; 10]]).unwrap();
        assert!(matches!(errors(&one, &other), Err(EngineError::SampleRate { .. })));
        let none = signal(vec![vec![]]);
        assert!(matches!(errors(&none, &none), Err(EngineError::TooShort { .. })));
        let huge = signal(vec![vec![1e200; 10]]);
        assert!(matches!(errors(&huge, &huge), Err(EngineError::NonFiniteResult { .. })));
    }
}
