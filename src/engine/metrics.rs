//! How far a prediction is from the measurement, per channel.

use serde::{Deserialize, Serialize};

use super::spectral::{Detrend, Welch, psd, same_shape};
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

    /// Half overlap, the mean kept, 4096 samples or the whole signal if that is shorter.
    pub fn for_length(n_samples: usize) -> Self {
        let segment_len = n_samples.clamp(1, Self::SEGMENT_LEN);
        Self { psd: Welch { segment_len, overlap: 0.5, detrend: Detrend::None }, window: Window::Hann }
    }
}

/// Why a figure is absent.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum NoFigure {
    /// The measured channel is zero throughout: there is nothing to relate an error to.
    MeasuredZero,
}

/// Errors of one channel.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct ChannelErrors {
    /// [`rms`] of the samples.
    pub rms: Option<f64>,
    /// [`rms`] of the power spectral densities.
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

/// RMS and PSD RMS error of each channel.
///
/// # Errors
/// Signals that differ in channels, length or sample rate, no samples, values whose square
/// overflows.
pub fn errors(measured: &Signal, predicted: &Signal) -> Result<Errors, EngineError> {
    const WHAT: &str = "predicted signal";
    same_shape(WHAT, measured, predicted)?;
    let (expected, found) = (measured.n_samples(), predicted.n_samples());
    if expected != found {
        return Err(EngineError::UnequalLength { what: WHAT, channel: 0, expected, found });
    }
    let settings = ErrorSettings::for_length(expected);
    let measured_psd = psd(&[measured], &settings.psd)?;
    let predicted_psd = psd(&[predicted], &settings.psd)?;
    let mut channels = Vec::with_capacity(measured.n_channels());
    for channel in 0..measured.n_channels() {
        let figure = |m: &[f64], p: &[f64]| match rms(m, p) {
            Some(value) if !value.is_finite() => {
                Err(EngineError::NonFiniteResult { what: "error", channel, sample: 0 })
            }
            value => Ok(value),
        };
        let rms = figure(measured.channel(channel), predicted.channel(channel))?;
        let psd_rms = figure(&measured_psd.density[channel], &predicted_psd.density[channel])?;
        let reason = (rms.is_none() || psd_rms.is_none()).then_some(NoFigure::MeasuredZero);
        channels.push(ChannelErrors { rms, psd_rms, reason });
    }
    Ok(Errors { settings, channels })
}

/// `sqrt(sum (y - y*)^2 / sum y^2)`, `y` measured and `y*` predicted (Heindel et al., section
/// 3.2); the mean counts. `None` when `measured` is zero throughout.
///
/// # Panics
/// If the lengths differ: callers pass channels of signals that they compared.
pub fn rms(measured: &[f64], predicted: &[f64]) -> Option<f64> {
    let power: f64 = measured.iter().map(|v| v * v).sum();
    (power > 0.0).then(|| (square_error(measured, predicted) / power).sqrt())
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
    let mean = measured.iter().sum::<f64>() / measured.len().max(1) as f64;
    let spread: f64 = measured.iter().map(|v| (v - mean).powi(2)).sum();
    let largest = measured.iter().fold(0.0_f64, |m, v| m.max(v.abs()));
    // What rounding leaves of a constant is no spread.
    let constant = spread <= (1e-12 * largest).powi(2) * measured.len() as f64;
    (!constant).then(|| (square_error(measured, predicted) / spread).sqrt())
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
    fn short_signals_are_one_segment_and_the_settings_say_so() {
        for n in [1, 2, 3, 100, 4096, 5000] {
            let y: Vec<f64> = (0..n).map(|t| 1.0 + (t as f64).sin()).collect();
            let found = errors(&signal(vec![y.clone()]), &signal(vec![y])).unwrap();
            assert_eq!(found.settings.psd.segment_len, n.min(4096));
            assert_eq!((found.channels[0].rms, found.channels[0].psd_rms), (Some(0.0), Some(0.0)));
        }
        let json = serde_json::to_value(ErrorSettings::for_length(9000)).unwrap();
        assert_eq!(
            json,
            serde_json::json!({
                "psd": {"segment_len": 4096, "overlap": 0.5, "detrend": "none"}, "window": "hann"
            })
        );
    }

    #[test]
    fn a_channel_that_is_zero_has_no_figure_but_a_reason() {
        let measured = signal(vec![vec![0.0; 50], sine(20.0, 50)]);
        let predicted = signal(vec![vec![1.0; 50], sine(20.0, 50)]);
        let found = errors(&measured, &predicted).unwrap();
        let zero = serde_json::to_value(found.channels[0]).unwrap();
        assert_eq!(zero, serde_json::json!({"rms": null, "psd_rms": null, "reason": "measured_zero"}));
        assert_eq!(found.channels[1].rms, Some(0.0));
        // One sample at the window's zero: power in the samples, none in the spectrum.
        let edge = signal(vec![vec![5.0, 0.0, 0.0, 0.0]]);
        let found = errors(&edge, &edge).unwrap().channels[0];
        assert_eq!((found.rms, found.psd_rms), (Some(0.0), None));
        assert_eq!(found.reason, Some(NoFigure::MeasuredZero));
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
