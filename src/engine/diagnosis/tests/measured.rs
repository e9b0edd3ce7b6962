//! Default requests on measured systems of `../shared/data`, where the folder is there.

use crate::diagnosis::{
    Channel, Effect, Family, Input, Mode, NoiseSource, Report, Run, VerdictKind, diagnose,
};
use crate::measured::shared_data;
use crate::progress::unwatched;
use crate::{Quantity, Signal};

use super::recorded;

/// The runs of a set whose first channel is the drive: what they are fitted to is what is asked about.
fn asked(set: &str, files: &[&str], rate_hz: f64, quantities: &[Quantity], samples: usize) -> Option<Report> {
    let folder = shared_data(set)?;
    let read = |file: &&str| {
        let mut run = recorded::channels(&folder.join(file));
        run.iter_mut().for_each(|c| c.truncate(samples));
        let response = Signal::new(rate_hz, run.split_off(1)).unwrap();
        Run {
            name: (*file).into(),
            drive: Signal::new(rate_hz, run).unwrap(),
            response,
            simulated: None,
            added: None,
            started_s: 0.0,
        }
    };
    let runs: Vec<Run> = files.iter().map(read).collect();
    let channel = |(i, quantity): (usize, &Quantity)| Channel {
        name: format!("channel_{i}"),
        axis: None,
        unit: "1".into(),
        size: None,
        quantity: *quantity,
    };
    let mut drives: Vec<Channel> = quantities.iter().enumerate().map(channel).collect();
    let responses = drives.split_off(1);
    let input = Input {
        drives,
        responses,
        baseline: runs.clone(),
        runs,
        roles: None,
        repeats: Vec::new(),
        sim_is_linear: true,
        mode: Mode::InSitu,
        catalogue: Effect::ALL.to_vec(),
        material_gap: 0.02,
        drive_limit: None,
        seed: 1,
    };
    let report = diagnose(&input, &unwatched).unwrap().report;
    let text = serde_json::to_string(&report).unwrap();
    assert_eq!(serde_json::from_str::<Report>(&text).unwrap().verdict, report.verdict, "finite numbers");
    Some(report)
}

#[test]
fn silverbox_is_identified_from_its_training_run_alone() {
    let Some(found) = asked("silverbox", &["train.csv"], 610.351_562_5, &[Quantity::Other; 2], 26_000) else {
        return;
    };
    assert_eq!(found.verdict.effect, Some(Effect::CubicStiffness), "{:?}", found.verdict);
    assert_eq!(found.verdict.kind, VerdictKind::Identified);
    assert!(found.hypotheses[0].held_out.closure > 0.97, "{:?}", found.hypotheses[0].held_out);
}

#[test]
fn periods_of_one_drive_are_found_and_leave_the_cause_of_a_joints_gap_undecided() {
    let quantities =
        [Quantity::Force, Quantity::Acceleration, Quantity::Acceleration, Quantity::Acceleration];
    let Some(found) = asked("f16", &["full_level5.npy"], 400.0, &quantities, usize::MAX) else { return };
    assert_eq!(found.noise_floor_source, NoiseSource::FoundRepeats);
    assert_eq!(found.verdict.kind, VerdictKind::Undecided, "{:?}", found.verdict);
    assert!(found.gap.systematic_at_least > 0.1 && found.gap.noise_rms_rel < 0.05, "{:?}", found.gap);
}

#[test]
fn short_records_get_a_report_that_does_not_reassure() {
    let quantities = [Quantity::Other; 2];
    let drives = ["prbs_05.csv", "prbs_10.csv", "prbs_15.csv"];
    let tanks = ["train.csv", "test.csv"];
    let reports = [
        asked("coupled_drives", &drives, 50.0, &quantities, usize::MAX),
        asked("cascaded_tanks", &tanks, 0.25, &quantities, usize::MAX),
    ];
    for found in reports.into_iter().flatten() {
        assert_ne!(found.verdict.kind, VerdictKind::NoMaterialGap, "{:?}", found.verdict);
        assert!(found.verdict.probability < 0.95 || !found.verdict.kind.blames(), "{:?}", found.verdict);
        assert_ne!(found.verdict.family, Some(Family::TimeVariance));
    }
}
