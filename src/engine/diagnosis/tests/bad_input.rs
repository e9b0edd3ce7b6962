use std::ops::ControlFlow;

use super::rig::{RATE, hardening, none, request};
use crate::diagnosis::{Input, Role, diagnose};
use crate::progress::unwatched;
use crate::{EngineError, Signal};

fn refused(input: &Input) -> EngineError {
    diagnose(input, &unwatched).unwrap_err()
}

#[test]
fn requests_that_do_not_hold_together_are_refused_by_name() {
    let good = request(none, 0.01);
    let no_runs = Input { runs: Vec::new(), repeats: Vec::new(), ..good.clone() };
    assert!(matches!(refused(&no_runs), EngineError::TooShort { .. }));
    let no_baseline = Input { baseline: Vec::new(), ..good.clone() };
    assert!(matches!(refused(&no_baseline), EngineError::TooShort { what: "baseline runs", .. }));
    let no_catalogue = Input { catalogue: Vec::new(), ..good.clone() };
    assert!(matches!(refused(&no_catalogue), EngineError::Setting { setting: "catalogue", .. }));
    let twice = Input { repeats: vec![vec![0, 0]], ..good.clone() };
    assert!(matches!(refused(&twice), EngineError::Setting { setting: "repeats", .. }));
    let unknown = Input { repeats: vec![vec![0, 9]], ..good.clone() };
    assert!(matches!(refused(&unknown), EngineError::Setting { setting: "repeats", .. }));
    let only_fit = Input { roles: Some(vec![Role::Fit; 4]), ..good.clone() };
    assert!(matches!(refused(&only_fit), EngineError::TooShort { .. }));

    let mut short = good.clone();
    short.runs[1].simulated = Some(Signal::new(RATE, vec![vec![0.0; 10]]).unwrap());
    assert!(matches!(refused(&short), EngineError::UnequalLength { what: "simulated run", .. }));
    let mut other_rate = good.clone();
    other_rate.runs[1].response =
        Signal::new(2.0 * RATE, other_rate.runs[1].response.clone().into_channels()).unwrap();
    assert!(matches!(refused(&other_rate), EngineError::SampleRate { .. }));
}

#[test]
fn channels_without_power_are_refused() {
    let mut still = request(none, 0.01);
    let n = still.baseline[0].drive.n_samples();
    still.baseline[0].drive = Signal::new(RATE, vec![vec![1.0; n]]).unwrap();
    assert!(matches!(refused(&still), EngineError::DeadChannel { .. }));
    let mut constant = request(none, 0.01);
    constant.baseline[0].response = Signal::new(RATE, vec![vec![1.0; n]]).unwrap();
    assert!(matches!(refused(&constant), EngineError::DeadChannel { .. }));
}

#[test]
fn runs_too_short_for_the_core_are_refused() {
    let mut short = request(none, 0.01);
    let cut = |s: &Signal| s.slice(0..20);
    short.baseline[0].drive = cut(&short.baseline[0].drive);
    short.baseline[0].response = cut(&short.baseline[0].response);
    assert!(matches!(refused(&short), EngineError::TooShort { .. }));
}

#[test]
fn repeats_whose_drives_differ_are_told_apart_with_a_warning() {
    let mut wrong = request(none, 0.01);
    wrong.runs[3] = super::rig::run("d", super::rig::noise_drive(16.0, 1.0, 99), none, 0.01, 14);
    let found = diagnose(&wrong, &unwatched).unwrap();
    assert!(
        found.report.warnings.iter().any(|w| w == "repeat_drive_differs: d"),
        "{:?}",
        found.report.warnings
    );
}

#[test]
fn a_wish_to_cancel_is_heard_between_candidates() {
    let stop = |p: crate::Progress<'_>| {
        if p.stage == "coulomb_friction" { ControlFlow::Break(()) } else { ControlFlow::Continue(()) }
    };
    assert_eq!(diagnose(&request(hardening, 0.01), &stop).unwrap_err(), EngineError::Cancelled);
}
