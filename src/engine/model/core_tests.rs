//! Hybrids whose network sees an FRF with an adopted effect in place of the FRF.

use std::collections::HashMap;
use std::ops::ControlFlow;
use std::sync::Mutex;
use std::sync::atomic::{AtomicUsize, Ordering};

use super::tests::settings;
use super::*;
use crate::checkpoint::CheckpointStore;
use crate::diagnosis::tests::rig::{RATE, noise_drive, request, respond};
use crate::diagnosis::{Effect, Input, diagnose};
use crate::frf::{FrfSettings, estimate};
use crate::progress::Progress;

/// A cubic spring beside the linear one of 1500 N/mm. The loud runs move by 1.8 mm RMS, where it takes 9 % of the linear
/// force.
fn hardening(x: f64, _: f64) -> f64 {
    40.0 * x * x * x
}

/// A run of the rig whose spring hardens, at this RMS of the drive, with 1 % of sensor noise.
fn run(seconds: f64, level: f64, seed: u64) -> Pair {
    let x = noise_drive(seconds, level, seed);
    let error = noise_drive(seconds, 0.01, seed + 1000);
    let y = respond(&x, hardening).iter().zip(error).map(|(y, e)| y + e).collect();
    let signal = |channel| Signal::new(RATE, vec![channel]).unwrap();
    Pair { x: signal(x), y: signal(y) }
}

/// An FRF of small drives, at which the spring hardly hardens, with the spring that a diagnosis found. Its segments are as
/// long as the rig rings: a poor FRF would be the greater part of what the core leaves.
fn adopted() -> RigModel {
    let small = run(240.0, 0.15, 51);
    let settings = FrfSettings { segment_len: Some(4096), ..FrfSettings::default() };
    let found = estimate(&[(&small.x, &small.y)], &settings, &unwatched).unwrap();
    let input = Input { catalogue: vec![Effect::CubicStiffness], ..request(hardening, 0.01) };
    let augmented = diagnose(&input, &unwatched).unwrap().augmented.swap_remove(0);
    RigModel {
        kind: ModelKind::Frf,
        inputs: vec!["x0".into()],
        outputs: vec!["y0".into()],
        sample_rate_hz: RATE,
        preprocess: Preprocess::default(),
        frf: Some(found.frf),
        frf_quality: Some(found.quality),
        core: Vec::new(),
        lstm: None,
        joint_range: None,
        window_range: Vec::new(),
        range: vec![InputRange { min: -5.0, max: 5.0, max_rate: 1e4, band_hz: None, local: None }],
        band: None,
        effects: vec![AddedEffect { drives: vec![0], augmented }],
    }
}

fn loud() -> FitData {
    FitData::of_training(vec![run(30.0, 1.0, 61), run(30.0, 0.8, 62), run(20.0, 1.0, 63)])
}

fn on(core: Option<&RigModel>, kind: ModelKind, seed: u64) -> FitSettings {
    let mut settings = settings(kind);
    settings.frf.segment_len = None;
    settings.lstm.window_len = Some(128);
    settings.lstm.epochs = Some(15);
    settings.lstm.seeds = Some(vec![seed]);
    FitSettings { core: core.cloned(), ..settings }
}

#[test]
fn a_hybrid_on_an_adopted_core_leaves_far_less_of_unseen_runs_than_the_same_on_an_frf() {
    let core = adopted();
    let data = loud();
    for kind in [ModelKind::Hybrid1, ModelKind::Hybrid2] {
        for seed in [1, 2] {
            let error = |core: Option<&RigModel>| {
                let fitted = fit(&data, &on(core, kind, seed), &unwatched).unwrap();
                fitted.report.validation_rms[0].unwrap()
            };
            let (frf, core) = (error(None), error(Some(&core)));
            assert!(core < 0.3 * frf, "{kind:?}, seed {seed}: {core} on the core, {frf} on the FRF");
        }
    }
}

/// The core as a hybrid 1 whose network adds nothing.
fn silent(core: &RigModel) -> RigModel {
    let fitted = fit(&loud(), &on(Some(core), ModelKind::Hybrid1, 1), &unwatched).unwrap().model;
    let mut part = fitted.lstm.clone().unwrap();
    part.net.fc_weight.fill(0.0);
    part.net.fc_bias.fill(0.0);
    part.y.mean.fill(0.0);
    RigModel { lstm: Some(part), ..fitted }
}

#[test]
fn the_core_is_used_as_it_is_and_the_weights_hold_it() {
    let core = adopted();
    let model = silent(&core);
    assert_eq!(
        (&model.frf, &model.core, model.version_kind()),
        (&core.frf, &core.effects, VersionKind::Hybrid1)
    );
    let x = run(20.0, 1.0, 71).x;
    let (expected, found) = (core.predict(&x).unwrap(), model.predict(&x).unwrap());
    assert_eq!(found, expected);
    let file = to_safetensors(&model);
    let read = from_safetensors(&file).unwrap();
    assert_eq!((&read, to_safetensors(&read)), (&model, file));
    assert_eq!(read.predict(&x).unwrap(), expected, "bit by bit");
    // In pieces: windows of 128 every 64 make pieces of some 130,000 samples.
    let x = Signal::new(RATE, vec![noise_drive(600.0, 1.0, 72)]).unwrap();
    let predictor = Predictor::new(model).unwrap();
    let mut prediction = predictor.begin(x.clone()).unwrap();
    let mut pieces = Vec::new();
    while let Some(piece) = predictor.next(&mut prediction, &unwatched).unwrap() {
        pieces.push(piece.into_channels().remove(0));
    }
    assert!(pieces.len() > 1, "{} pieces", pieces.len());
    assert_eq!(pieces.concat(), core.predict(&x).unwrap().channel(0));
}

#[test]
fn weights_whose_core_does_not_belong_are_refused() {
    let model = silent(&adopted());
    let refused = |model: RigModel| from_safetensors(&to_safetensors(&model)).unwrap_err().to_string();
    let mut effect = model.core[0].clone();
    effect.drives = vec![1];
    let error = refused(RigModel { core: vec![effect], ..model.clone() });
    assert!(error.contains("effect: drives"), "{error}");
    let error = refused(RigModel { core: vec![model.core[0].clone(); 17], ..model.clone() });
    assert!(error.contains("core.effects: 17"), "{error}");
    let error = refused(RigModel { kind: ModelKind::Frf, lstm: None, ..model });
    assert!(error.contains("core: only hybrids have one, this is frf"), "{error}");
}

#[test]
fn a_core_that_does_not_suit_the_fit_is_refused() {
    let core = adopted();
    let data = FitData::of_training(vec![run(10.0, 1.0, 61)]);
    let refused = |settings: &FitSettings| match fit(&data, settings, &unwatched) {
        Err(EngineError::Setting { setting, found, limit }) => (setting, format!("{found}; {limit}")),
        other => panic!("{other:?}"),
    };
    let hybrid = on(Some(&core), ModelKind::Hybrid2, 1);
    let given = |core: RigModel| FitSettings { core: Some(core), ..hybrid.clone() };
    let filter = Preprocess { low_pass_hz: Some(60.0), band_pass_hz: None };
    let cases = [
        (FitSettings { kind: ModelKind::Lstm, ..hybrid.clone() }, "kind lstm"),
        (FitSettings { kind: ModelKind::Frf, ..hybrid.clone() }, "kind frf"),
        (given(RigModel { effects: Vec::new(), ..core.clone() }), "0 effects"),
        (given(RigModel { kind: ModelKind::Hybrid1, ..core.clone() }), "a hybrid1"),
        (given(RigModel { inputs: vec!["z".into()], ..core.clone() }), "z; x0"),
        (given(RigModel { outputs: vec!["z".into()], ..core.clone() }), "z; y0"),
        (given(RigModel { sample_rate_hz: 100.0, ..core.clone() }), "100 Hz; 256 Hz"),
        (given(RigModel { preprocess: filter, ..core.clone() }), "60"),
    ];
    for (settings, expected) in cases {
        let (setting, text) = refused(&settings);
        assert!(setting == "core" && text.contains(expected), "{expected}: {setting}: {text}");
    }
}

/// Keeps every checkpoint.
#[derive(Default)]
struct Kept(Mutex<HashMap<String, Vec<u8>>>);

impl CheckpointStore for Kept {
    fn load(&self, part: &str) -> Option<Vec<u8>> {
        self.0.lock().unwrap().get(part).cloned()
    }

    fn is_due(&self, _: &str, _: bool) -> bool {
        true
    }

    fn save(&self, part: &str, state: Vec<u8>) {
        self.0.lock().unwrap().insert(part.into(), state);
    }
}

#[test]
fn a_fit_on_a_core_that_was_interrupted_ends_as_if_it_had_not_been() {
    let (core, data) = (adopted(), loud());
    let settings = on(Some(&core), ModelKind::Hybrid2, 1);
    let whole = fit(&data, &settings, &unwatched).unwrap();
    let kept = Kept::default();
    let asked = AtomicUsize::new(0);
    let stops = |progress: Progress<'_>| {
        let network = progress.stage.starts_with("LSTM");
        if network && asked.fetch_add(1, Ordering::Relaxed) > 40 {
            return ControlFlow::Break(());
        }
        ControlFlow::Continue(())
    };
    assert_eq!(fit_resumable(&data, &settings, &kept, &stops), Err(EngineError::Cancelled));
    assert!(!kept.0.lock().unwrap().is_empty(), "a part is kept");
    assert_eq!(fit_resumable(&data, &settings, &kept, &unwatched).unwrap(), whole);
}
