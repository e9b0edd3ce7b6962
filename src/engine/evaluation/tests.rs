//! Figures of signals whose errors follow from how they are made.

use std::f64::consts::TAU;

use super::*;
use crate::Signal;
use crate::fatigue::{DamageGroup, DamageSettings};

const SETTINGS: CompareSettings = CompareSettings {
    damage: DamageSettings {
        slope: 5.0,
        constant: 1e7,
        residue: crate::fatigue::Residue::Repeated,
        directions: 50,
    },
    span_s: 1.0,
};

fn sine(hz: f64, scale: f64) -> Vec<f64> {
    (0..10_000).map(|t| scale * (TAU * hz * f64::from(t) / 1000.0).sin()).collect()
}

fn signal(channels: Vec<Vec<f64>>) -> Signal {
    Signal::new(1000.0, channels).unwrap()
}

fn names(names: &[&str]) -> Vec<String> {
    names.iter().map(|name| (*name).to_owned()).collect()
}

/// Figures of channels `x`, `y`, `z` that are predicted `scale` times too large.
fn scaled(scale: f64) -> RunFigures {
    let groups = [DamageGroup { name: "force", channels: [0, 1, 2] }];
    let waves = |scale: f64| signal(vec![sine(5.0, scale), sine(5.0, 2.0 * scale), sine(5.0, 3.0 * scale)]);
    compare(&names(&["x", "y", "z"]), &groups, &waves(1.0), &waves(scale), &SETTINGS).unwrap().figures
}

fn force() -> [ChannelGroup; 1] {
    [ChannelGroup { name: "force".into(), channels: names(&["x", "y", "z"]) }]
}

#[track_caller]
fn near(found: Option<f64>, expected: f64) {
    let found = found.expect("a figure");
    assert!((found - expected).abs() < 1e-9 * expected.abs().max(1.0), "{found} for {expected}");
}

#[test]
fn an_amplitude_error_has_its_power_in_damage_and_multi_rain() {
    let found = scaled(1.1);
    for name in ["x", "y", "z"] {
        near(found.channels[name].errors.rms, 0.1);
        near(found.channels[name].damage.ratio.ratio, 1.1_f64.powi(5));
    }
    near(found.groups["force"].ratio.ratio, 1.1_f64.powi(5));
}

#[test]
fn errors_are_averaged_arithmetically_and_ratios_geometrically_over_runs_then_channels() {
    let (high, low) = (scaled(1.1), scaled(1.0 / 1.1));
    let found = average(&[&high, &low], &force());
    let expected = (0.1 + (1.0 - 1.0 / 1.1)) / 2.0;
    near(found.channels["y"].rms, expected);
    near(found.groups["force"].rms, expected);
    near(found.channels["y"].damage_ratio, 1.0);
    near(found.groups["force"].damage_ratio, 1.0);
    near(found.groups["force"].multi_rain, 1.0);
    assert!(found.groups["force"].reasons.is_empty());

    let baseline = average(&[&high, &high], &force());
    let found = difference(&found, &baseline);
    near(found.channels["x"].rms, expected - 0.1);
    near(found.groups["force"].multi_rain, 1.1_f64.powi(-5));
    near(found.groups["force"].errors.damage_ratio, 1.1_f64.powi(-5));
}

#[test]
fn a_figure_that_cannot_be_given_is_absent_with_its_reason() {
    let still = signal(vec![vec![0.0; 500], vec![3.0; 500], (0..500).map(|i| f64::from(i % 7)).collect()]);
    let predicted = signal(vec![vec![0.1; 500], vec![3.0; 500], vec![3.0; 500]]);
    let found = compare(&names(&["x", "y", "z"]), &[], &still, &predicted, &SETTINGS).unwrap().figures;
    let found = average(&[&found], &force());
    let reason = |channel: &str, figure: &str| found.channels[channel].reasons.get(figure).copied();
    assert_eq!((found.channels["x"].rms, reason("x", "rms")), (None, Some(NoAverage::MeasuredStill)));
    assert_eq!(reason("x", "damage_ratio"), Some(NoAverage::TargetDamageZero));
    assert_eq!((found.channels["y"].rms, found.channels["y"].psd_rms), (Some(0.0), None));
    assert_eq!(reason("z", "damage_ratio"), Some(NoAverage::PredictedDamageZero));
    assert_eq!(found.groups["force"].reasons["multi_rain"], NoAverage::NotAVector);
    assert_eq!(found.groups["force"].reasons["damage_ratio"], NoAverage::TargetDamageZero);
    let none = average(&[], &force());
    assert_eq!(none.channels["x"].reasons["rms"], NoAverage::NoRun);
    assert_eq!(none.groups["force"].reasons["multi_rain"], NoAverage::NoRun);
    let json = serde_json::to_string(&none).unwrap();
    assert_eq!(serde_json::from_str::<ClassAverage>(&json).unwrap(), none);
}

#[test]
fn a_run_without_a_channel_is_left_out_of_that_channels_average_only() {
    let (whole, mut part) = (scaled(1.1), scaled(1.3));
    part.channels.remove("y");
    part.groups.clear();
    let found = average(&[&whole, &part], &force());
    near(found.channels["x"].rms, 0.2);
    near(found.channels["y"].rms, 0.1);
    near(found.groups["force"].multi_rain, 1.1_f64.powi(5));
}

#[test]
fn the_worst_span_is_where_and_on_which_channel_the_error_is() {
    let measured = signal(vec![sine(5.0, 1.0), sine(5.0, 1.0)]);
    let mut wrong = sine(5.0, 1.0);
    wrong[4_600..4_900].iter_mut().for_each(|v| *v += 2.0);
    let predicted = signal(vec![sine(5.0, 1.01), wrong]);
    let found = compare(&names(&["a", "b"]), &[], &measured, &predicted, &SETTINGS).unwrap().figures;
    let worst = found.worst_span.unwrap();
    assert_eq!((worst.channel.as_str(), worst.from_s, worst.to_s), ("b", 4.0, 5.0));
    // 0.3 s of 2 in a second, relative to a sine's RMS.
    near(Some(worst.rms), (0.3 * 4.0_f64).sqrt() / 0.5_f64.sqrt());

    let long = CompareSettings { span_s: 99.0, ..SETTINGS };
    let whole = compare(&names(&["a", "b"]), &[], &measured, &predicted, &long).unwrap().figures;
    let whole = whole.worst_span.unwrap();
    assert_eq!((whole.from_s, whole.to_s), (0.0, 10.0));
    let zero = signal(vec![vec![0.0; 10]]);
    let none = compare(&names(&["a"]), &[], &zero, &zero, &SETTINGS).unwrap().figures;
    assert_eq!(none.worst_span, None);
}

#[test]
fn a_tone_has_its_power_in_the_spectra_of_a_class() {
    let (measured, predicted) = (signal(vec![sine(50.0, 2.0)]), signal(vec![sine(50.0, 4.0)]));
    let found = compare(&names(&["a"]), &[], &measured, &predicted, &SETTINGS).unwrap();
    let mut mean = MeanSpectra::default();
    mean.add(&names(&["a"]), found.segment_len, &found.measured, &found.predicted);
    let spectra = mean.finish().unwrap();
    let a = &spectra.channels["a"];
    let top = (0..a.target.len()).max_by(|i, j| a.target[*i].total_cmp(&a.target[*j])).unwrap();
    assert!((spectra.freq_hz[top] - 50.0).abs() < 1.0, "{}", spectra.freq_hz[top]);
    assert!((a.predicted[top] / a.target[top] - 4.0).abs() < 0.01);
}
