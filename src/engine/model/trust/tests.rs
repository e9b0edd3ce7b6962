//! Trust of made-up ranges, and of the virtual rig's drives.

use super::*;
use crate::frf::FrfSettings;
use crate::model::tests::made_up;
use crate::model::{
    FitData, FitSettings, FitSplit, LstmOptions, ModelKind, Pair, Preprocess, Preset, RigModel, Task, fit,
};
use crate::progress::unwatched;
use crate::virtual_rig::{ProgrammeRun, ProgrammeSettings, programme};
use crate::{RunKind, Split};

fn range(min: f64, max: f64, max_rate: f64) -> Vec<InputRange> {
    vec![InputRange { min, max, max_rate, band_hz: None, local: None }]
}

fn of(range: &[InputRange], rate: f64, samples: Vec<f64>) -> Trust {
    let model = RigModel { inputs: vec!["d".into()], range: range.to_vec(), ..made_up(ModelKind::Frf) };
    trust(&model, None, &Signal::new(rate, vec![samples]).unwrap())
}

#[test]
fn the_training_signal_itself_is_wholly_inside() {
    let range = InputRange::of_training(&[vec![&[0.0, 1.0, 2.0]]], 10.0).unwrap();
    assert_eq!(of(&range, 10.0, vec![0.0, 1.0, 2.0]), Trust { inside: 1.0, spans: vec![] });
}

#[test]
fn each_way_out_is_a_span_with_a_length_and_its_limit() {
    let t = of(&range(-1.0, 2.0 + 1e-12, 10.0), 10.0, vec![0.0, 1.0, 2.0, 2.5, 2.0, 1.0, 0.0, -2.0]);
    assert_eq!(t.inside, 6.0 / 8.0);
    let seen: Vec<_> = t.spans.iter().map(|s| (s.from_s, s.to_s, s.reason.as_str())).collect();
    assert_eq!(
        seen,
        [
            (0.3, 0.4, "value above the training maximum 2"),
            (0.7, 0.8, "value below the training minimum -1"),
            (0.7, 0.8, "rate above the training maximum 10 per second"),
        ]
    );
}

#[test]
fn excursions_close_together_are_one_span() {
    let mut samples = vec![0.0; 100];
    for at in [10, 15, 60, 99] {
        samples[at] = 3.0;
    }
    let t = of(&range(-1.0, 1.0, 1e9), 100.0, samples);
    let seen: Vec<_> = t.spans.iter().map(|s| (s.from_s, s.to_s)).collect();
    assert_eq!(seen, [(0.1, 0.16), (0.6, 0.61), (0.99, 1.0)]);
    assert_eq!(t.inside, 0.96);
}

/// The drives of a programme of ten minutes of training noise.
fn drives() -> Vec<ProgrammeRun> {
    programme(&ProgrammeSettings::of_minutes(10.0), 7).unwrap()
}

/// An FRF fitted to the training noise; the trust asks for its inputs alone, so that the responses may
/// be the drives.
fn fitted(runs: &[ProgrammeRun]) -> RigModel {
    let pair = |run: &ProgrammeRun| Pair { x: run.drive.clone(), y: run.drive.clone() };
    let of = |split| runs.iter().filter(move |run| run.split == split && run.kind == RunKind::Noise);
    let (training, validation) = (of(Split::Training).map(pair), of(Split::Validation).map(pair));
    let data = FitData::with_validation(training.collect(), validation.collect(), FitSplit::ValidationHalves);
    let names = |prefix: &str| (0..3).map(|i| format!("{prefix}{i}")).collect();
    let settings = FitSettings {
        kind: ModelKind::Frf,
        inputs: names("drive_"),
        outputs: names("response_"),
        preprocess: Preprocess::default(),
        frf: FrfSettings { segment_len: Some(1024), ..FrfSettings::default() },
        lstm: LstmOptions::default(),
        preset: Preset::Default,
        start: None,
        core: None,
        task: Task::Forward,
    };
    fit(&data, &settings, &unwatched).unwrap().model
}

fn trust_of(model: &RigModel, x: &Signal) -> Trust {
    trust(model, SpectrumWatch::new(model).as_ref(), x)
}

fn sine(hz: f64, amplitude: f64, n: usize) -> Vec<f64> {
    (0..n).map(|t| amplitude * (std::f64::consts::TAU * hz * t as f64 / 1000.0).sin()).collect()
}

#[test]
fn a_small_sine_beyond_the_band_of_the_training_is_outside() {
    let frf = fitted(&drives());
    let lstm = RigModel { frf: None, ..frf.clone() };
    let imported = RigModel { range: range(-9.0, 9.0, 1e9).repeat(3), ..frf.clone() };
    let n = 10_000;
    let x = Signal::new(1000.0, vec![sine(80.0, 0.3, n), vec![0.0; n], vec![0.0; n]]).unwrap();
    for (kind, model) in [("frf", &frf), ("lstm", &lstm), ("usable_hz alone", &imported)] {
        let t = trust_of(model, &x);
        assert_eq!(t.inside, 0.0, "{kind}: {t:?}");
        let [span, faster @ ..] = &t.spans[..] else { panic!("{kind}: {t:?}") };
        // An FRF passes nothing beyond its band; without one the drive itself is also a faster tone than any before.
        let reasons: Vec<&str> = faster.iter().map(|span| &span.reason[..32]).collect();
        let tone = ["RMS of the rate of a single tone"];
        assert_eq!(reasons, if kind == "lstm" { &tone[..] } else { &[] }, "{kind}: {t:?}");
        assert_eq!((span.from_s, span.to_s, span.channel.as_str()), (0.0, 10.0, "drive_0"), "{kind}");
        assert!(span.reason.starts_with("100 % of the power lies outside 0 to 5"), "{kind}: {}", span.reason);
        assert!(span.reason.contains("Hz"), "{kind}: {}", span.reason);
    }
    // The same for a second and a half of a drive that is inside otherwise.
    let mut burst = vec![sine(10.0, 1.0, 60_000), vec![0.0; 60_000], sine(20.0, 0.5, 60_000)];
    burst[2][30_000..31_500].iter_mut().zip(sine(80.0, 0.3, 1500)).for_each(|(v, b)| *v += b);
    let t = trust_of(&frf, &Signal::new(1000.0, burst).unwrap());
    let [span] = &t.spans[..] else { panic!("{t:?}") };
    assert!(span.channel == "drive_2" && span.from_s <= 30.0 && span.to_s > 31.4, "{t:?}");
    assert!((0.95..0.98).contains(&t.inside), "{t:?}");
}

#[test]
fn means_that_the_training_left_out_are_outside_though_most_values_are_inside() {
    let runs = drives();
    let model = fitted(&runs);
    let without = RigModel {
        range: model.range.iter().map(|range| InputRange { local: None, ..*range }).collect(),
        joint_range: None,
        window_range: Vec::new(),
        ..model.clone()
    };
    for run in runs.iter().filter(|run| run.tags.contains(&"n2")) {
        let (values, all) = (trust_of(&without, &run.drive), trust_of(&model, &run.drive));
        assert!(values.inside > 0.6, "{}: {} inside by values", run.name, values.inside);
        assert!(all.inside < 0.1, "{}: {} inside", run.name, all.inside);
        assert!(all.spans.iter().any(|span| span.reason.starts_with("mean over windows")), "{:?}", all.spans);
    }
    // A steady tone at the amplitude of the training's peaks.
    let n = 20_000;
    let peak = 0.9 * model.range[0].max;
    let tone = Signal::new(1000.0, vec![sine(12.0, peak, n), vec![0.0; n], vec![0.0; n]]).unwrap();
    assert_eq!((trust_of(&without, &tone).inside, trust_of(&model, &tone).inside), (1.0, 0.0));
}

#[test]
fn withheld_drives_in_the_band_are_inside() {
    let runs = drives();
    let model = fitted(&runs);
    // The boundary region lies beyond the training's values on purpose; noise has no tone as strong as a sine, and is not
    // as fast as the end of the sweep.
    let withheld = runs.iter().filter(|run| {
        let like = matches!(run.kind, RunKind::Noise | RunKind::Service);
        like && run.split != Split::Training && !run.tags.contains(&"n2")
    });
    let (mut seen, mut inside) = (0, 0.0);
    for run in withheld {
        let t = trust_of(&model, &run.drive);
        assert!(t.inside >= 0.96, "{}: {} inside, {:?}", run.name, t.inside, t.spans);
        inside += t.inside;
        assert!(t.spans.iter().all(|span| span.from_s < span.to_s), "{}: {:?}", run.name, t.spans);
        assert!(!t.spans.iter().any(|span| span.reason.contains("power")), "{}: {:?}", run.name, t.spans);
        seen += 1;
    }
    assert!(seen > 10, "{seen} drives");
    assert!(inside / f64::from(seen) > 0.99, "{inside} of {seen} drives");
}
