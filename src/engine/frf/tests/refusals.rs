//! Data and settings that cannot give an FRF are named, doubtful ones are warned of.

use std::ops::ControlFlow;
use std::sync::atomic::{AtomicUsize, Ordering};

use super::*;
use crate::Progress;

/// `y = x0 + ... ` of white noise inputs.
fn sum_rig(n_inputs: u64, n: usize) -> (Signal, Signal) {
    let x = channels(7, n_inputs, n);
    let y = (0..n).map(|t| x.iter().map(|c| c[t]).sum()).collect();
    (signal(100.0, x), signal(100.0, vec![y]))
}

fn fit(x: &Signal, y: &Signal, settings: &FrfSettings) -> Result<FrfEstimate, EngineError> {
    estimate(&[(x, y)], settings, &unwatched)
}

#[test]
fn as_many_averages_as_drives_are_refused() {
    // Segments of 64 every 16 samples: 3 in 96 samples, 4 in 112.
    let (x, y) = sum_rig(3, 96);
    assert_eq!(fit(&x, &y, &fixed(64, 0.0)), Err(EngineError::TooFewAverages { averages: 3, drives: 3 }));
    let (x, y) = sum_rig(3, 112);
    let found = fit(&x, &y, &fixed(64, 0.0)).unwrap();
    assert_eq!(found.quality.averages, 4);
    assert!(found.warnings[0].starts_with("4 averages"), "{:?}", found.warnings);
    // The shortest segment that there is, and not even that.
    let (x, y) = sum_rig(3, 20);
    let found = fit(&x, &y, &FrfSettings::default()).unwrap();
    assert_eq!((found.quality.settings.segment_len, found.quality.settings.ridge), (Some(8), Some(1e-4)));
    assert!(found.warnings[0].starts_with("too few samples to compare"), "{:?}", found.warnings);
    let (x, y) = sum_rig(3, 10);
    assert_eq!(
        fit(&x, &y, &FrfSettings::default()),
        Err(EngineError::TooFewAverages { averages: 2, drives: 3 })
    );
    assert_eq!(fit(&x, &y, &fixed(1024, 0.0)), Err(EngineError::TooFewAverages { averages: 0, drives: 3 }));
}

#[test]
fn enough_averages_are_not_warned_of() {
    let (x, y) = sum_rig(2, 10_000);
    assert_eq!(fit(&x, &y, &fixed(64, 0.0)).unwrap().warnings, [""; 0]);
}

#[test]
fn a_dead_channel_is_named() {
    let (x, y) = sum_rig(2, 2000);
    let dead = |value: f64| signal(100.0, vec![x.channel(0).to_vec(), vec![value; 2000]]);
    for value in [0.0, 0.1, -1e6] {
        assert_eq!(
            fit(&dead(value), &y, &FrfSettings::default()),
            Err(EngineError::DeadChannel { what: "frf inputs", channel: 1 })
        );
    }
    let flat = signal(100.0, vec![vec![0.7; 2000]]);
    assert_eq!(
        fit(&x, &flat, &FrfSettings::default()),
        Err(EngineError::DeadChannel { what: "frf outputs", channel: 0 })
    );
    // Offsets that differ from run to run are no movement.
    let (one, two) = (dead(1.0), dead(2.0));
    assert_eq!(
        estimate(&[(&one, &y), (&two, &y)], &FrfSettings::default(), &unwatched),
        Err(EngineError::DeadChannel { what: "frf inputs", channel: 1 })
    );
}

#[test]
fn runs_that_do_not_fit_each_other_are_refused() {
    let (x, y) = sum_rig(2, 500);
    let (x3, y3) = sum_rig(3, 500);
    let (_, short) = sum_rig(2, 499);
    let other_rate = |s: &Signal| signal(101.0, s.channels().to_vec());
    let all = |runs: &[(&Signal, &Signal)]| estimate(runs, &FrfSettings::default(), &unwatched).unwrap_err();
    assert!(matches!(all(&[]), EngineError::TooShort { .. }));
    assert!(matches!(all(&[(&x, &y), (&x3, &y3)]), EngineError::ChannelCount { expected: 2, found: 3, .. }));
    assert!(matches!(all(&[(&x, &short)]), EngineError::UnequalLength { expected: 500, found: 499, .. }));
    assert!(matches!(all(&[(&x, &other_rate(&y))]), EngineError::SampleRate { .. }));
    let second = (other_rate(&x), other_rate(&y));
    assert!(matches!(all(&[(&x, &y), (&second.0, &second.1)]), EngineError::SampleRate { .. }));
}

#[test]
fn settings_outside_their_limits_are_named() {
    let (x, y) = sum_rig(1, 500);
    let default = FrfSettings::default();
    for (settings, name) in [
        (FrfSettings { segment_len: Some(100), ..default.clone() }, "frf.segment_len"),
        (FrfSettings { segment_len: Some(0), ..default.clone() }, "frf.segment_len"),
        (FrfSettings { segment_len: Some(4), ..default.clone() }, "frf.segment_len"),
        (FrfSettings { overlap: 1.0, ..default.clone() }, "frf.overlap"),
        (FrfSettings { overlap: f64::NAN, ..default.clone() }, "frf.overlap"),
        (FrfSettings { ridge: Some(-1e-3), ..default.clone() }, "frf.ridge"),
        (FrfSettings { ridge: Some(f64::INFINITY), ..default.clone() }, "frf.ridge"),
    ] {
        match fit(&x, &y, &settings) {
            Err(EngineError::Setting { setting, .. }) => assert_eq!(setting, name),
            other => panic!("{settings:?}: {other:?}"),
        }
    }
    let found = fit(&x, &y, &default).unwrap();
    for confidence in [0.0, 1.0, f64::NAN] {
        assert!(matches!(found.quality.confidence_factor(confidence), Err(EngineError::Setting { .. })));
    }
}

#[test]
fn dependent_inputs_are_refused_without_a_ridge_and_shared_out_with_one() {
    let (one, y) = sum_rig(1, 5000);
    let x = one.channel(0).to_vec();
    let double = x.iter().map(|v| 2.0 * v).collect();
    let x = signal(100.0, vec![x, noise(55, 5000), double]);
    match fit(&x, &y, &fixed(128, 0.0)) {
        Err(EngineError::DependentInputs { channel }) => assert!(channel == 0 || channel == 2),
        other => panic!("{other:?}"),
    }
    for settings in [fixed(128, 1e-6), FrfSettings::default()] {
        let found = fit(&x, &y, &settings).unwrap();
        assert!(found.quality.settings.ridge.unwrap() > 0.0);
        assert!(found.warnings.iter().any(|w| w.contains("linearly dependent")), "{:?}", found.warnings);
        let predicted = found.frf.apply(&x).unwrap();
        let error = relative_error(y.channel(0), predicted.channel(0));
        assert!(error < 0.02, "{error}");
    }
}

#[test]
fn progress_never_falls_and_a_break_cancels() {
    let (x, y) = sum_rig(2, 20_000);
    let fractions = std::sync::Mutex::new(Vec::new());
    let watch = |p: Progress<'_>| {
        fractions.lock().unwrap().push(p.fraction);
        ControlFlow::Continue(())
    };
    estimate(&[(&x, &y)], &FrfSettings::default(), &watch).unwrap();
    let seen = fractions.into_inner().unwrap();
    assert!(seen.len() > 5 && seen.windows(2).all(|w| w[1] >= w[0]), "{seen:?}");
    assert_eq!((seen[0], seen[seen.len() - 1]), (0.0, 1.0));
    for at in 0..seen.len() {
        let count = AtomicUsize::new(0);
        let stop = |_: Progress<'_>| {
            let calls = count.fetch_add(1, Ordering::Relaxed);
            if calls == at { ControlFlow::Break(()) } else { ControlFlow::Continue(()) }
        };
        let found = estimate(&[(&x, &y)], &FrfSettings::default(), &stop);
        assert_eq!(found, Err(EngineError::Cancelled));
    }
}
