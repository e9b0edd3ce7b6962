//! The virtual rig's test programme, recorded, and a fit to it.

use rayon::prelude::*;
use rigcast::engine::model::{
    FitData, FitSettings, FitSplit, Fitted, LstmOptions, ModelKind, Pair, Preprocess, Preset, Task, fit,
};
use rigcast::engine::virtual_rig::{ProgrammeRun, ProgrammeSettings, VirtualRig, programme};
use rigcast::engine::{EngineError, Split, Watch};

/// A recorded run.
pub struct Recorded {
    pub run: ProgrammeRun,
    pub pair: Pair,
}

/// The programme with so many minutes of training noise, recorded on the rig of this seed.
pub fn record(minutes: f64, seed: u64) -> Result<Vec<Recorded>, EngineError> {
    record_on(&VirtualRig::draw(seed), minutes, seed)
}

/// The same on a rig.
pub fn record_on(rig: &VirtualRig, minutes: f64, seed: u64) -> Result<Vec<Recorded>, EngineError> {
    programme(&ProgrammeSettings::of_minutes(minutes), seed)?
        .into_par_iter()
        .enumerate()
        .map(|(index, run)| {
            let y = rig.simulate(&run.drive, seed.wrapping_mul(1_000_003).wrapping_add(index as u64))?;
            let pair = Pair { x: run.drive.clone(), y };
            Ok(Recorded { run, pair })
        })
        .collect()
}

/// The networks learn from the mixed noise, the FRF from the small centred noise.
pub fn fit_data(runs: &[Recorded]) -> FitData {
    let of = |split: Split, tag: &str| -> Vec<Pair> {
        runs.iter()
            .filter(|r| r.run.split == split && r.run.tags.contains(&tag))
            .map(|r| r.pair.clone())
            .collect()
    };
    let validation =
        runs.iter().filter(|r| r.run.split == Split::Validation).map(|r| r.pair.clone()).collect();
    FitData::with_validation(of(Split::Training, "mixed"), validation, FitSplit::ValidationStops)
        .with_frf_runs(of(Split::Training, "linear"))
}

/// A model of the rig: of three displacements and three forces from three drives, or of the forces from the displacements.
pub fn fitted(
    task: Task,
    kind: ModelKind,
    preset: Preset,
    lstm: LstmOptions,
    data: &FitData,
    watch: Watch<'_>,
) -> Result<Fitted, EngineError> {
    fit(data, &settings(task, kind, preset, lstm), watch)
}

/// Settings of [`fitted`].
pub fn settings(task: Task, kind: ModelKind, preset: Preset, lstm: LstmOptions) -> FitSettings {
    let names = |channels: std::ops::Range<usize>| channels.map(|c| format!("channel_{c}")).collect();
    let (inputs, outputs) = match task {
        Task::Forward => (0..3, 3..9),
        Task::VirtualSensing => (3..6, 6..9),
    };
    FitSettings {
        kind,
        task,
        inputs: names(inputs),
        outputs: names(outputs),
        preprocess: Preprocess::default(),
        frf: preset.frf(),
        lstm,
        preset,
        start: None,
        core: None,
    }
}
