//! Searches on models whose answer is known.

use std::ops::ControlFlow;

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rand_distr::StandardNormal;
use realfft::num_complex::Complex64;

use super::*;
use crate::frf::Frf;
use crate::lstm::{LstmBlock, LstmNet, Recombine};
use crate::model::{
    InputRange, JointRange, LocalRange, LstmPart, ModelKind, Preprocess, RigModel, Scaler, WindowRange,
};
use crate::progress::unwatched;

const FS: f64 = 200.0;
const SAMPLES: usize = 4000;

/// Static gains of two responses to two drives.
const GAINS: [[f64; 2]; 2] = [[1.0, 0.3], [0.2, 2.0]];

/// Two coupled resonators at 15 Hz, known up to 40 Hz.
fn linear() -> RigModel {
    let segment_len = 512;
    let lines = segment_len / 2 + 1;
    let h = (0..lines)
        .flat_map(|line| {
            let hz = line as f64 * FS / segment_len as f64;
            let ratio = hz / 15.0;
            let mode = 1.0 / Complex64::new(1.0 - ratio * ratio, 0.2 * ratio);
            let known = if hz <= 40.0 { 1.0 } else { 0.0 };
            GAINS.into_iter().flatten().map(move |gain| mode * gain * known)
        })
        .collect();
    let frf = Frf {
        sample_rate_hz: FS,
        segment_len,
        n_inputs: 2,
        n_outputs: 2,
        h,
        usable_hz: [0.0, 40.0],
        x_mean: vec![0.5, 0.0],
        y_mean: vec![-1.0, 2.0],
    };
    RigModel {
        kind: ModelKind::Frf,
        inputs: vec!["u".into(), "v".into()],
        outputs: vec!["y".into(), "z".into()],
        sample_rate_hz: FS,
        preprocess: Preprocess::default(),
        frf: Some(frf),
        frf_quality: None,
        core: Vec::new(),
        lstm: None,
        joint_range: None,
        window_range: Vec::new(),
        range: vec![
            InputRange { min: -3.0, max: 3.0, max_rate: 1e4, band_hz: Some([0.0, 40.0]), local: None };
            2
        ],
        band: None,
        effects: Vec::new(),
    }
}

/// Gaussian noise up to `last_hz` with a standard deviation of about 0.5.
fn noise(seed: u64, last_hz: f64) -> Vec<f64> {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let white = (0..SAMPLES).map(|_| rng.sample::<f64, _>(StandardNormal)).collect();
    let filter = Preprocess { low_pass_hz: Some(last_hz), ..Preprocess::default() };
    let limited = filter.apply_to(Signal::new(FS, vec![white]).unwrap()).unwrap();
    limited.channel(0).iter().map(|v| 0.5 * v * (FS / (2.0 * last_hz)).sqrt()).collect()
}

fn drive() -> Signal {
    Signal::new(FS, vec![noise(1, 25.0), noise(2, 25.0)]).unwrap()
}

struct Case {
    predictor: Predictor,
    target: Signal,
    outputs: Vec<usize>,
    gains: Vec<f64>,
    limits: [DriveLimit; 2],
}

impl Case {
    fn of(model: RigModel, target: Signal) -> Self {
        let predictor = Predictor::new(model).unwrap();
        Self {
            predictor,
            target,
            outputs: vec![0, 1],
            gains: vec![1.0; 2],
            limits: [DriveLimit::default(); 2],
        }
    }

    fn linear() -> Self {
        let target = Predictor::new(linear()).unwrap().predict(drive()).unwrap();
        Self::of(linear(), target)
    }

    fn search(&self, start: &Start, settings: &IterationSettings) -> Result<Found, EngineError> {
        let weights = vec![1.0; self.outputs.len()];
        let problem = Problem {
            predictor: &self.predictor,
            outputs: &self.outputs,
            target: &self.target,
            weights: &weights,
            gains: &self.gains,
            limits: &self.limits,
        };
        iterate(&problem, start, settings, &unwatched)
    }
}

fn apart(a: &[f64], b: &[f64]) -> f64 {
    rms(a, b).unwrap()
}

#[test]
fn a_drive_of_a_linear_model_is_found_again_from_any_start() {
    let case = Case::linear();
    let near: Vec<Vec<f64>> =
        drive().channels().iter().map(|u| u.iter().map(|v| 0.8 * v).collect()).collect();
    for start in [Start::Zero, Start::Inverse, Start::Drive(Signal::new(FS, near).unwrap())] {
        let found = case.search(&start, &IterationSettings::default()).unwrap();
        let best = &found.steps[found.best];
        assert!(best.total_error < 1e-3, "{start:?}: {}", best.total_error);
        assert!(best.damage.iter().all(|d| (d.ratio.unwrap() - 1.0).abs() < 0.01), "{:?}", best.damage);
        let inner = |u: &Vec<f64>| u[200..SAMPLES - 200].to_vec();
        for (wanted, found) in drive().channels().iter().zip(found.drive.channels()) {
            assert!(apart(&inner(wanted), &inner(found)) < 0.02, "{start:?}");
        }
        assert_eq!(found.response, case.predictor.predict(found.drive.clone()).unwrap());
        assert_eq!(found.linear, LinearPart::Model);
        let [first, last] = found.band_hz.unwrap();
        assert!(first == 0.0 && (38.0..43.0).contains(&last), "{first} to {last}");
        assert!(found.out_of_reach.iter().all(|share| *share < 1e-3), "{:?}", found.out_of_reach);
        let totals: Vec<f64> = found.steps.iter().filter(|s| s.better).map(|s| s.total_error).collect();
        assert!(totals.is_sorted_by(|a, b| a > b), "{totals:?}");
    }
}

#[test]
fn it_stops_where_it_was_told_to() {
    let case = Case::linear();
    let stop = StopAt { error: Some(0.05), damage_ratio: None };
    let settings = IterationSettings { gain: 0.5, stop, ..IterationSettings::default() };
    let found = case.search(&Start::Zero, &settings).unwrap();
    assert_eq!(found.stopped, Stopped::Error);
    let all = |step: &Step| step.error.iter().all(|error| error.unwrap() <= 0.05);
    assert!(all(&found.steps[found.best]) && !all(&found.steps[found.best - 1]));
    let stop = StopAt { error: None, damage_ratio: Some([0.9, 1.1]) };
    let found = case.search(&Start::Zero, &IterationSettings { stop, ..settings.clone() }).unwrap();
    assert_eq!(found.stopped, Stopped::DamageRatio);
    let settings = IterationSettings { iterations: 2, stop: StopAt::default(), ..settings };
    let found = case.search(&Start::Zero, &settings).unwrap();
    assert_eq!((found.stopped, found.steps.len()), (Stopped::Iterations, 3));
    let settled = case.search(&Start::Inverse, &IterationSettings { iterations: 200, ..settings }).unwrap();
    assert_eq!(settled.stopped, Stopped::Settled);
}

#[test]
fn a_gain_that_is_too_large_is_lowered_and_no_good_drive_is_lost() {
    let mut case = Case::linear();
    case.gains = vec![2.0; 2];
    let settings = IterationSettings { gain: 2.0, iterations: 40, ..IterationSettings::default() };
    let found = case.search(&Start::Zero, &settings).unwrap();
    assert!(found.steps.iter().any(|step| !step.better), "a gain of 4 makes it worse");
    let best = &found.steps[found.best];
    assert!(best.total_error < 0.01, "{}", best.total_error);
    assert!(found.steps.iter().all(|step| step.total_error >= best.total_error));
}

#[test]
fn limits_hold_and_tell_what_they_changed() {
    let mut case = Case::linear();
    let peak = drive().channel(0).iter().fold(0.0_f64, |peak, v| peak.max(v.abs()));
    case.limits[0].peak = Some(0.5 * peak);
    let found = case.search(&Start::Inverse, &IterationSettings::default()).unwrap();
    let best = &found.steps[found.best];
    assert!(
        best.drive_peak[0] <= 0.5 * peak && best.limited[0] > 0.001 && best.limited[1] == 0.0,
        "{best:?}"
    );
    assert!(best.total_error > 0.02, "the target needs more");
    assert!(found.drive.channel(0).iter().all(|v| v.abs() <= 0.5 * peak));
}

#[test]
fn what_the_corrections_do_not_reach_is_told() {
    let mut case = Case::linear();
    let (y, high) = (case.target.channel(0).to_vec(), noise(5, 90.0));
    let power = |x: &[f64]| x.iter().map(|v| v * v).sum::<f64>();
    let share = 5.0 / 9.0 * power(&high) / (power(&y) + power(&high));
    let both = y.iter().zip(&high).map(|(a, b)| a + b).collect();
    case.target = Signal::new(FS, vec![both, case.target.channel(1).to_vec()]).unwrap();
    let found = case.search(&Start::Inverse, &IterationSettings::default()).unwrap();
    assert!((found.out_of_reach[0] / share - 1.0).abs() < 0.2, "{:?} {share}", found.out_of_reach);
    assert!(found.out_of_reach[1] < 1e-3);
    let narrow = IterationSettings { band_hz: Some([0.0, 10.0]), ..IterationSettings::default() };
    let found = case.search(&Start::Inverse, &narrow).unwrap();
    assert!(found.out_of_reach[1] > 0.1 && found.band_hz.unwrap()[1] < 12.0, "{:?}", found.out_of_reach);
    // A gain that differs by frequency reaches as far.
    let bands = vec![GainBand { from_hz: 1.0, to_hz: 5.0, gain: 2.0 }];
    let uneven = IterationSettings { gain: 0.5, gain_bands: bands, ..IterationSettings::default() };
    let found = case.search(&Start::Inverse, &uneven).unwrap();
    assert!(found.out_of_reach[1] < 1e-3, "{:?}", found.out_of_reach);
    let start = found.steps[0].total_error;
    let even = case.search(&Start::Inverse, &IterationSettings::default()).unwrap();
    assert_eq!(start, even.steps[0].total_error, "the start does not depend on the gain");
    let empty = IterationSettings { band_hz: Some([60.0, 80.0]), ..IterationSettings::default() };
    let refused = case.search(&Start::Inverse, &empty);
    assert!(matches!(refused, Err(EngineError::Setting { setting: "band_hz", .. })), "{refused:?}");
}

#[test]
fn drives_are_drawn_towards_what_the_model_was_fitted_on() {
    let mut model = linear();
    model.range[0].max = 0.5;
    let case = Case::of(model, Case::linear().target);
    let beyond = |outside: Outside| {
        let settings = IterationSettings { outside, ..IterationSettings::default() };
        let found = case.search(&Start::Inverse, &settings).unwrap();
        let most = found.drive.channel(0).iter().copied().fold(f64::NEG_INFINITY, f64::max);
        (most, found.steps[found.best].total_error)
    };
    let ((held, error), (free, least)) = (beyond(Outside::Penalised), beyond(Outside::Allowed));
    assert!(held < 0.8 * free && error > 2.0 * least, "{held} {free} {error} {least}");
}

fn mean(samples: &[f64]) -> f64 {
    samples.iter().sum::<f64>() / samples.len() as f64
}

fn about_mean(samples: &[f64]) -> f64 {
    let mean = mean(samples);
    (samples.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / samples.len() as f64).sqrt()
}

/// The largest change from sample to sample, per second.
fn fastest(samples: &[f64]) -> f64 {
    samples.windows(2).fold(0.0_f64, |most, pair| most.max((pair[1] - pair[0]).abs() * FS))
}

/// RMS above 12 Hz.
fn fast_part(samples: &[f64]) -> f64 {
    let filter = Preprocess { low_pass_hz: Some(12.0), ..Preprocess::default() };
    let slow = filter.apply_to(Signal::new(FS, vec![samples.to_vec()]).unwrap()).unwrap();
    about_mean(&samples.iter().zip(slow.channel(0)).map(|(v, slow)| v - slow).collect::<Vec<_>>())
}

#[test]
fn every_way_of_the_trust_draws_drives_back() {
    let wide =
        WindowRange { window: 256, mean: [-9.0, 9.0], max_rms: 9.0, max_rate: 1e9, max_tone_rate: Some(1e9) };
    type Way = (&'static str, fn(&mut RigModel, WindowRange), fn(&[f64]) -> f64);
    let ways: [Way; 6] = [
        ("rate", |model, _| model.range[0].max_rate = 30.0, fastest),
        (
            "level of a drive",
            |model, _| {
                model.range[0].local = Some(LocalRange { window: 400, mean: [-1.0, 1.0], max_rms: 0.1 });
            },
            about_mean,
        ),
        (
            "mean of a drive",
            |model, _| {
                model.range[0].local = Some(LocalRange { window: 400, mean: [0.8, 1.0], max_rms: 9.0 });
            },
            |u| (0.8 - mean(u)).abs(),
        ),
        ("spectrum", |model, _| model.range[0].band_hz = Some([0.0, 8.0]), fast_part),
        (
            "linear response",
            |model, wide| {
                let narrow = WindowRange { mean: [-2.0, -1.0], max_rms: 0.2, ..wide };
                model.window_range = vec![narrow, wide];
            },
            about_mean,
        ),
        (
            "all means together",
            |model, _| {
                model.joint_range = Some(JointRange {
                    window: 256,
                    middle: vec![0.5, 0.0],
                    covariance: vec![vec![0.01, 0.0], vec![0.0, 0.01]],
                    max_distance: 1.0,
                });
            },
            |u| (0.5 - mean(u)).abs(),
        ),
    ];
    for (name, narrow, measure) in ways {
        let mut model = linear();
        narrow(&mut model, wide);
        let case = Case::of(model, Case::linear().target);
        let search = |outside: Outside| {
            let settings = IterationSettings { outside, ..IterationSettings::default() };
            let found = case.search(&Start::Inverse, &settings).unwrap();
            let best = &found.steps[found.best];
            (measure(found.drive.channel(0)), best.total_error, best.inside)
        };
        let ((held, error, inside), (free, least, outside)) =
            (search(Outside::Strict), search(Outside::Allowed));
        assert!(
            outside < 0.9 && held < 0.9 * free && error > 2.0 * least,
            "{name}: {held} {free} {error} {least}"
        );
        assert!(inside >= outside, "{name}: {inside} {outside}");
    }
}

#[test]
fn a_network_without_an_frf_is_asked_for_one() {
    let mut rng = ChaCha8Rng::seed_from_u64(3);
    let net = LstmNet::init(2, &[8], 2, 1.0, &mut rng);
    let unit = Scaler { mean: vec![0.0; 2], std: vec![1.0; 2] };
    let mut model = linear();
    model.kind = ModelKind::Lstm;
    model.frf = None;
    model.lstm = Some(LstmPart {
        net,
        x: unit.clone(),
        y: unit,
        window_len: 64,
        hop: 32,
        recombine: Recombine::Stream,
    });
    let target = Predictor::new(model.clone()).unwrap().predict(drive()).unwrap();
    let case = Case::of(model.clone(), target.clone());
    let found = case.search(&Start::Zero, &IterationSettings::default()).unwrap();
    assert_eq!(found.linear, LinearPart::Estimated);
    let (first, best) = (&found.steps[0], &found.steps[found.best]);
    assert!(best.total_error < 0.3 * first.total_error, "{} {}", best.total_error, first.total_error);
    model.range.clear();
    let refused = Case::of(model, target).search(&Start::Zero, &IterationSettings::default());
    assert!(matches!(refused, Err(EngineError::Setting { setting: "model", .. })), "{refused:?}");
}

/// The FRF says 1 of both channels. By the model as a whole those that are `wrong` have about -2, so that every linear
/// correction of theirs goes the wrong way.
fn contrary(wrong: [bool; 2], kind: ModelKind) -> RigModel {
    let inputs = if kind == ModelKind::Hybrid2 { 4 } else { 2 };
    let weight_ih = (0..8 * inputs).map(|at| {
        // Gates i, f, g, o: only the cell's own gate sees its input.
        let (row, input) = (at / inputs, at % inputs);
        if (4..6).contains(&row) && input == row - 4 { 0.1 } else { 0.0 }
    });
    let block = LstmBlock {
        inputs,
        cells: 2,
        weight_ih: weight_ih.collect(),
        weight_hh: vec![0.0; 16],
        bias: vec![0.0, 0.0, -20.0, -20.0, 0.0, 0.0, 0.0, 0.0],
    };
    // A cell gives 0.5 tanh(0.5 tanh(0.1 x)), about 0.025 x. A hybrid 1 adds the FRF to it, a hybrid 2 does not.
    let [right_way, wrong_way] = if kind == ModelKind::Hybrid2 { [40.0, -80.0] } else { [0.0, -120.0] };
    let of = |wrong: bool| if wrong { wrong_way } else { right_way };
    let fc_weight = vec![of(wrong[0]), 0.0, 0.0, of(wrong[1])];
    let net = LstmNet { blocks: vec![block], outputs: 2, fc_weight, fc_bias: vec![0.0; 2] };
    let unit = |n: usize| Scaler { mean: vec![0.0; n], std: vec![1.0; n] };
    let mut model = linear();
    model.kind = kind;
    let frf = model.frf.as_mut().unwrap();
    (frf.x_mean, frf.y_mean) = (vec![0.0; 2], vec![0.0; 2]);
    for (at, h) in frf.h.iter_mut().enumerate() {
        *h = Complex64::new(if h.norm() > 0.0 && (at % 4 == 0 || at % 4 == 3) { 1.0 } else { 0.0 }, 0.0);
    }
    model.lstm = Some(LstmPart {
        net,
        x: unit(inputs),
        y: unit(2),
        window_len: 64,
        hop: 32,
        recombine: Recombine::Stream,
    });
    model
}

fn linear_only() -> IterationSettings {
    IterationSettings { gradient: false, iterations: 60, ..IterationSettings::default() }
}

#[test]
fn a_search_that_diverges_keeps_its_start_and_says_so() {
    let case = Case::of(contrary([true, true], ModelKind::Hybrid1), drive());
    let found = case.search(&Start::Zero, &linear_only()).unwrap();
    assert_eq!((found.stopped, found.best, found.steps.len()), (Stopped::Diverged, 0, 5));
    assert!(found.drive.channels().iter().flatten().all(|v| *v == 0.0));
    assert!(found.steps[1].total_error > 2.0 && found.steps[4].gain < 0.2, "{:?}", found.steps);
}

#[test]
fn the_gradient_goes_on_where_the_linear_step_stalls() {
    for (wrong, stalled) in [([true, true], Stopped::Diverged), ([false, true], Stopped::Settled)] {
        for (kind, recombine) in
            [(ModelKind::Hybrid1, Recombine::Stream), (ModelKind::Hybrid2, Recombine::Welch)]
        {
            let mut model = contrary(wrong, kind);
            model.lstm.as_mut().unwrap().recombine = recombine;
            let case = Case::of(model, drive());
            let linear = case.search(&Start::Zero, &linear_only()).unwrap();
            let left = linear.steps[linear.best].total_error;
            assert!(
                linear.stopped == stalled && left > 0.5,
                "{wrong:?} {kind:?}: {:?} {left}",
                linear.stopped
            );
            assert!(linear.steps[1..].iter().all(|step| step.kind == StepKind::Linear));

            let stop = StopAt { error: Some(0.01), damage_ratio: None };
            let further = IterationSettings { gradient: true, stop, ..linear_only() };
            let found = case.search(&Start::Zero, &further).unwrap();
            assert_eq!(found.stopped, Stopped::Error, "{wrong:?} {kind:?}: {:?}", found.steps);
            assert_eq!(found.steps[0].kind, StepKind::Start);
            let (before, after) = found.steps.split_at(linear.steps.len());
            assert_eq!(before, linear.steps, "it begins where the linear step stalls");
            assert!(after.iter().all(|step| step.kind == StepKind::Gradient));
            assert_eq!(found.response, case.predictor.predict(found.drive.clone()).unwrap());
        }
    }
}

#[test]
fn a_gradient_that_leads_no_further_ends_the_search() {
    let mut case = Case::of(contrary([true, true], ModelKind::Hybrid1), drive());
    case.limits = [DriveLimit { peak: Some(1e-9), ..DriveLimit::default() }; 2];
    let settings = IterationSettings { gradient: true, iterations: 60, ..linear_only() };
    let found = case.search(&Start::Zero, &settings).unwrap();
    assert!(found.stopped == Stopped::Settled && found.steps.len() < 60, "{:?}", found.stopped);
    assert!(found.steps.iter().any(|step| step.kind == StepKind::Gradient));
}

#[test]
fn a_search_by_gradient_has_the_same_bits_on_any_number_of_threads() {
    let case = Case::of(contrary([true, true], ModelKind::Hybrid2), drive());
    let on = |threads| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        let settings = IterationSettings { iterations: 8, ..IterationSettings::default() };
        pool.install(|| case.search(&Start::Zero, &settings).unwrap())
    };
    let one = on(1);
    assert_eq!(one.steps[8].kind, StepKind::Gradient);
    assert_eq!(one, on(3));
}

/// What a whole search makes small, along a direction: its gradient is that of predictions.
#[test]
fn the_gradient_of_the_error_equals_differences_of_it() {
    let case = Case::of(contrary([false, true], ModelKind::Hybrid2), drive());
    let (weights, settings) = (vec![1.0, 3.0], IterationSettings::default());
    let problem = Problem {
        predictor: &case.predictor,
        outputs: &[1, 0],
        target: &case.target.select(&[1, 0]),
        weights: &weights,
        gains: &case.gains,
        limits: &case.limits,
    };
    let search = Search {
        problem: &problem,
        settings: &settings,
        target: problem.target,
        target_damage: vec![1.0; 2],
        scale: Scale::of(problem.target, &weights).unwrap(),
        taper: vec![1.0; SAMPLES],
        ranges: counted(&case.predictor.model().range, settings.outside),
    };
    let at = Signal::new(FS, vec![noise(7, 20.0), noise(8, 20.0)]).unwrap();
    let along = [noise(9, 20.0), noise(10, 20.0)];
    let look = |by: f64| {
        let of = |(u, d): (&Vec<f64>, &Vec<f64>)| u.iter().zip(d).map(|(u, d)| u + by * d).collect();
        let drive = Signal::new(FS, at.channels().iter().zip(&along).map(of).collect()).unwrap();
        search.look((0, StepKind::Start, 1.0), drive, &unwatched).unwrap()
    };
    let gradient = search.gradient(&look(0.0), &unwatched).unwrap();
    let of = |(g, d): (&Vec<f64>, &Vec<f64>)| g.iter().zip(d).map(|(g, d)| g * d).sum::<f64>();
    let found: f64 = gradient.channels().iter().zip(&along).map(of).sum();
    let slope = (look(1e-2).square - look(-1e-2).square) / 2e-2;
    assert!((found / slope - 1.0).abs() < 1e-3, "{found} {slope}");
}

#[test]
fn one_target_of_two_and_tapers() {
    let mut case = Case::linear();
    case.outputs = vec![1];
    case.gains = vec![1.0];
    case.target = case.target.select(&[1]);
    let settings = IterationSettings { taper_s: 1.0, ..IterationSettings::default() };
    let found = case.search(&Start::Zero, &settings).unwrap();
    assert_eq!(found.response.n_channels(), 2);
    assert!(found.drive.channels().iter().all(|u| u[0] == 0.0 && u[SAMPLES - 1] == 0.0));
    let inner = |u: &[f64]| u[400..SAMPLES - 400].to_vec();
    assert!(apart(&inner(case.target.channel(0)), &inner(found.response.channel(1))) < 0.01);
}

#[test]
fn a_target_of_zeros_and_bad_settings_are_refused_and_a_search_is_cancelled() {
    let mut case = Case::linear();
    let bad = [
        IterationSettings { iterations: 0, ..IterationSettings::default() },
        IterationSettings { gain: f64::NAN, ..IterationSettings::default() },
        IterationSettings { band_hz: Some([5.0, 5.0]), ..IterationSettings::default() },
        IterationSettings { ridge: -1.0, ..IterationSettings::default() },
        IterationSettings { taper_s: f64::INFINITY, ..IterationSettings::default() },
        IterationSettings {
            gain_bands: vec![GainBand { from_hz: 1.0, to_hz: 2.0, gain: 3.0 }],
            ..IterationSettings::default()
        },
        IterationSettings {
            stop: StopAt { error: None, damage_ratio: Some([1.1, 1.2]) },
            ..IterationSettings::default()
        },
    ];
    for settings in bad {
        let refused = case.search(&Start::Zero, &settings);
        assert!(matches!(refused, Err(EngineError::Setting { .. })), "{settings:?}");
    }
    let weights = [1.0; 2];
    let problem = Problem {
        predictor: &case.predictor,
        outputs: &case.outputs,
        target: &case.target,
        weights: &weights,
        gains: &case.gains,
        limits: &case.limits,
    };
    let stop =
        |p: Progress<'_>| if p.fraction > 0.1 { ControlFlow::Break(()) } else { ControlFlow::Continue(()) };
    let cancelled = iterate(&problem, &Start::Zero, &IterationSettings::default(), &stop);
    assert!(matches!(cancelled, Err(EngineError::Cancelled)));
    case.target = Signal::new(FS, vec![vec![0.0; SAMPLES]; 2]).unwrap();
    let refused = case.search(&Start::Zero, &IterationSettings::default());
    assert!(matches!(refused, Err(EngineError::DeadChannel { what: "target", .. })));
}
