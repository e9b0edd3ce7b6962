//! Whole models: prediction, weight files, fits of a small known system.

use std::ops::ControlFlow;
use std::sync::atomic::{AtomicUsize, Ordering};

use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};
use realfft::num_complex::Complex64;

use super::*;
use crate::frf::{FrfQuality, FrfSettings};
use crate::lstm;
use crate::progress::{Progress, unwatched};

const FS: f64 = 100.0;

fn names(prefix: &str, n: usize) -> Vec<String> {
    (0..n).map(|i| format!("{prefix}{i}")).collect()
}

fn noise(n: usize, seed: u64) -> Vec<f64> {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let mut state = 0.0;
    (0..n)
        .map(|_| {
            let white: f64 = StandardNormal.sample(&mut rng);
            state = 0.7 * state + white;
            state
        })
        .collect()
}

/// `y' = 10 (x - y - 0.3 y^3)` by explicit steps: a lag whose stiffness rises with deflection.
fn lag(x: &[f64]) -> Vec<f64> {
    let mut y = 0.0;
    x.iter()
        .map(|x| {
            y += 0.1 * (x - y - 0.3 * y * y * y);
            y
        })
        .collect()
}

pub(super) fn pair(n: usize, seed: u64) -> Pair {
    let x = noise(n, seed);
    let y = lag(&x);
    Pair { x: Signal::new(FS, vec![x]).unwrap(), y: Signal::new(FS, vec![y]).unwrap() }
}

pub(super) fn data() -> FitData {
    FitData::of_training(vec![pair(12_000, 1)])
}

pub(super) fn settings(kind: ModelKind) -> FitSettings {
    FitSettings {
        kind,
        task: Task::Forward,
        inputs: names("x", 1),
        outputs: names("y", 1),
        preprocess: Preprocess::default(),
        frf: FrfSettings { segment_len: Some(256), ..FrfSettings::default() },
        lstm: LstmOptions {
            blocks: Some(vec![8]),
            window_len: Some(64),
            epochs: Some(20),
            seeds: Some(vec![1, 2]),
            ..LstmOptions::default()
        },
        preset: Preset::Default,
        start: None,
        core: None,
    }
}

/// A model with made-up numbers in every tensor.
pub(super) fn made_up(kind: ModelKind) -> RigModel {
    let mut rng = ChaCha8Rng::seed_from_u64(7);
    let mut draw = |n: usize| -> Vec<f64> { (0..n).map(|_| StandardNormal.sample(&mut rng)).collect() };
    let (inputs, outputs, segment_len) = (2, 3, 16);
    let lines = segment_len / 2 + 1;
    let frf = Frf {
        sample_rate_hz: FS,
        segment_len,
        n_inputs: inputs,
        n_outputs: outputs,
        h: (0..lines * outputs * inputs)
            .map(|i| {
                // The first and last line of a real impulse response are real.
                let real = i < outputs * inputs || i >= (lines - 1) * outputs * inputs;
                let v = draw(2);
                Complex64::new(v[0], if real { 0.0 } else { v[1] })
            })
            .collect(),
        usable_hz: [0.5, 40.0],
        x_mean: draw(inputs),
        y_mean: draw(outputs),
    };
    let pairs = lines * outputs * inputs;
    let quality = FrfQuality {
        settings: FrfSettings { segment_len: Some(segment_len), ridge: Some(1e-4), ..FrfSettings::default() },
        averages: 12,
        effective_averages: 7.25,
        excited: vec![[0, 2], [4, 7]],
        input_hz: vec![[0.5, 40.0], [0.0, 49.5]],
        coherence: (0..pairs).map(|i| i as f64 / pairs as f64).collect(),
        multiple_coherence: (0..lines * outputs).map(|i| 1.0 / (1.0 + i as f64)).collect(),
        condition: (0..lines).map(|line| 10.0_f64.powi(line as i32)).collect(),
        std_error: (0..pairs).map(|i| 0.01 * i as f64).collect(),
    };
    let net_inputs = inputs + if kind == ModelKind::Hybrid2 { outputs } else { 0 };
    let mut net_rng = ChaCha8Rng::seed_from_u64(8);
    let positive = |v: Vec<f64>| v.into_iter().map(|v| v.abs() + 0.1).collect();
    let lstm = LstmPart {
        net: LstmNet::init(net_inputs, &[5, 4], outputs, 1.0, &mut net_rng),
        x: Scaler { mean: draw(net_inputs), std: positive(draw(net_inputs)) },
        y: Scaler { mean: draw(outputs), std: positive(draw(outputs)) },
        window_len: 20,
        hop: 7,
        recombine: Recombine::Stream,
    };
    RigModel {
        kind,
        inputs: names("x", inputs),
        outputs: names("y", outputs),
        sample_rate_hz: FS,
        preprocess: Preprocess { low_pass_hz: Some(30.0), band_pass_hz: None },
        frf: (kind != ModelKind::Lstm).then_some(frf),
        frf_quality: (kind != ModelKind::Lstm).then_some(quality),
        core: Vec::new(),
        lstm: (kind != ModelKind::Frf).then_some(lstm),
        joint_range: None,
        window_range: Vec::new(),
        range: vec![InputRange { min: -1.0, max: 2.0, max_rate: 3.0, band_hz: None, local: None }; inputs],
        band: None,
        effects: Vec::new(),
    }
}

const KINDS: [ModelKind; 4] = [ModelKind::Frf, ModelKind::Lstm, ModelKind::Hybrid1, ModelKind::Hybrid2];

#[test]
fn a_model_survives_its_weight_file_and_the_file_is_always_the_same() {
    for kind in KINDS {
        let model = made_up(kind);
        let bytes = to_safetensors(&model);
        assert_eq!(from_safetensors(&bytes).unwrap(), model, "{kind:?}");
        assert_eq!(to_safetensors(&model), bytes);
    }
}

#[test]
fn a_truncated_weight_file_is_refused_at_every_length() {
    let bytes = to_safetensors(&made_up(ModelKind::Hybrid2));
    for len in (0..bytes.len()).step_by(97) {
        assert!(matches!(from_safetensors(&bytes[..len]), Err(EngineError::Weights(_))), "{len} bytes");
    }
}

#[test]
fn a_tensor_of_the_wrong_shape_is_named() {
    let mut model = made_up(ModelKind::Lstm);
    let lstm = model.lstm.as_mut().unwrap();
    lstm.x.mean.push(0.0);
    lstm.x.std.push(1.0);
    let error = from_safetensors(&to_safetensors(&model)).unwrap_err();
    let EngineError::TensorShape { tensor, expected, found } = error else { panic!("{error}") };
    assert_eq!((tensor.as_str(), expected, found), ("x.mean", vec![2], vec![3]));
}

#[test]
fn a_tensor_that_the_kind_does_not_have_is_named() {
    let mut model = made_up(ModelKind::Hybrid1);
    model.kind = ModelKind::Lstm;
    let error = from_safetensors(&to_safetensors(&model)).unwrap_err().to_string();
    assert!(error.contains("frf."), "{error}");
    model.kind = ModelKind::Hybrid1;
    model.frf = None;
    let error = from_safetensors(&to_safetensors(&model)).unwrap_err().to_string();
    assert!(error.contains("frf.freq_hz is missing"), "{error}");
}

#[test]
fn weights_that_are_not_finite_are_refused() {
    let mut model = made_up(ModelKind::Lstm);
    model.lstm.as_mut().unwrap().net.fc_bias[1] = f32::NAN;
    let error = from_safetensors(&to_safetensors(&model)).unwrap_err().to_string();
    assert!(error.contains("fc.bias: value 1"), "{error}");
}

#[test]
fn the_parts_combine_as_the_kind_says() {
    let x = Signal::new(FS, vec![noise(300, 1), noise(300, 2)]).unwrap();
    let model = RigModel { preprocess: Preprocess::default(), ..made_up(ModelKind::Hybrid1) };
    let alone = |kind| {
        let mut part = model.clone();
        part.kind = kind;
        match kind {
            ModelKind::Frf => part.lstm = None,
            _ => part.frf = None,
        }
        part.predict(&x).unwrap()
    };
    let (frf, lstm, both) = (alone(ModelKind::Frf), alone(ModelKind::Lstm), model.predict(&x).unwrap());
    for channel in 0..3 {
        for t in 0..300 {
            let sum = frf.channel(channel)[t] + lstm.channel(channel)[t];
            assert!((both.channel(channel)[t] - sum).abs() <= 1e-12 * sum.abs().max(1.0));
        }
    }
}

#[test]
fn predictions_are_as_long_as_the_drive_from_one_sample_on() {
    for kind in KINDS {
        let model = made_up(kind);
        for n in [1, 2, 19, 20, 21, 133] {
            let x = Signal::new(FS, vec![noise(n, 1), noise(n, 2)]).unwrap();
            assert_eq!(model.predict(&x).unwrap().n_samples(), n, "{kind:?}");
        }
    }
}

/// What a model says of `x` when nothing is cut: the FRF's response of the whole signal, then the
/// network's.
fn in_one_go(model: &RigModel, x: &Signal) -> Vec<Vec<f64>> {
    let x = model.preprocess.apply(x).unwrap();
    let linear = model.frf.as_ref().map(|frf| frf.apply(&x).unwrap());
    let Some(part) = &model.lstm else { return linear.unwrap().into_channels() };
    let channels = linear.as_ref().map(Signal::channels);
    let z = network_inputs(&part.x, model.kind, &x, 0..x.n_samples(), channels);
    let y = lstm::predict(&part.net, &z, part.window_len, part.hop, part.recombine).unwrap();
    let mut y: Vec<Vec<f64>> = y.iter().enumerate().map(|(c, z)| part.y.restore(c, z)).collect();
    if let (ModelKind::Hybrid1, Some(linear)) = (model.kind, linear) {
        for (y, linear) in y.iter_mut().flatten().zip(linear.channels().iter().flatten()) {
            *y += linear;
        }
    }
    y
}

#[test]
fn pieces_make_the_same_response_as_the_whole_drive() {
    // 2,048 windows a piece: with a hop of 2 some 4,000 samples, with 7 some 14,000.
    for (kind, hop, n) in [
        (ModelKind::Lstm, 2, 4100),
        (ModelKind::Hybrid1, 2, 12_345),
        (ModelKind::Hybrid2, 2, 9000),
        (ModelKind::Hybrid2, 7, 30_000),
    ] {
        for recombine in [Recombine::Welch, Recombine::Stream] {
            let mut model = made_up(kind);
            let part = model.lstm.as_mut().unwrap();
            (part.hop, part.recombine) = (hop, recombine);
            let std = part.y.std.clone();
            let x = Signal::new(FS, vec![noise(n, 1), noise(n, 2)]).unwrap();
            let expected = in_one_go(&model, &x);
            let predictor = Predictor::new(model.clone()).unwrap();
            let mut prediction = predictor.begin(x.clone()).unwrap();
            let (mut found, mut pieces) = (vec![Vec::new(); 3], 0);
            while let Some(piece) = predictor.next(&mut prediction, &unwatched).unwrap() {
                pieces += 1;
                for (found, piece) in found.iter_mut().zip(piece.channels()) {
                    found.extend_from_slice(piece);
                }
            }
            assert!(pieces >= 2, "{kind:?} hop {hop}: {pieces} pieces of {n} samples");
            for ((found, expected), std) in found.iter().zip(&expected).zip(std) {
                assert_eq!(found.len(), n);
                for (t, (found, expected)) in found.iter().zip(expected).enumerate() {
                    let error = (found - expected).abs();
                    assert!(error <= 1e-5 * std, "{kind:?} {recombine:?} hop {hop} sample {t}: {error:e}");
                }
            }
            assert_eq!(model.predict(&x).unwrap().channels(), found, "one input has one result");
            assert_eq!(predictor.predict(x).unwrap().channels(), found);
        }
    }
}

#[test]
fn an_frf_in_pieces_is_the_frf_of_the_whole_drive() {
    let model = made_up(ModelKind::Frf);
    let n = (1 << 18) + 1000;
    let x = Signal::new(FS, vec![noise(n, 3), noise(n, 4)]).unwrap();
    let (found, expected) = (model.predict(&x).unwrap(), in_one_go(&model, &x));
    for (found, expected) in found.channels().iter().flatten().zip(expected.iter().flatten()) {
        assert!((found - expected).abs() < 1e-12, "{found} {expected}");
    }
}

#[test]
fn a_result_that_is_not_finite_has_its_place_in_the_whole_drive() {
    let mut model = RigModel { preprocess: Preprocess::default(), ..made_up(ModelKind::Hybrid1) };
    model.lstm.as_mut().unwrap().hop = 2;
    let n = 12_000;
    let mut samples = noise(n, 1);
    // The FRF multiplies what is nearly the largest number there is.
    samples[11_000] = f64::MAX;
    let error = model.predict(&Signal::new(FS, vec![samples, noise(n, 2)]).unwrap()).unwrap_err();
    let EngineError::NonFiniteResult { sample, .. } = error else { panic!("{error}") };
    assert!((8_000..12_000).contains(&sample), "{sample}");
}

#[test]
fn a_quality_that_cannot_be_one_is_refused_by_name() {
    let refused = |change: fn(&mut FrfQuality)| {
        let mut model = made_up(ModelKind::Frf);
        change(model.frf_quality.as_mut().unwrap());
        from_safetensors(&to_safetensors(&model)).unwrap_err().to_string()
    };
    for (change, named) in [
        ((|q| q.coherence[3] = 1.5) as fn(&mut FrfQuality), "frf.coherence: value 3"),
        (|q| q.multiple_coherence[0] = -0.1, "frf.multiple_coherence: value 0"),
        (|q| q.condition[1] = 0.5, "frf.condition: value 1"),
        (|q| q.std_error[5] = f64::NAN, "frf.std_error: value 5"),
        (|q| q.averages = 0, "frf.averages"),
        (|q| q.effective_averages = 13.0, "frf.effective_averages"),
        (|q| q.excited = vec![[0, 9]], "frf.excited"),
        (|q| q.excited = vec![[3, 5], [5, 6]], "frf.excited"),
        (|q| q.input_hz.truncate(1), "frf.input_hz"),
        (|q| q.input_hz[0] = [10.0, 50.1], "frf.input_hz"),
        (|q| q.settings.ridge = Some(-1.0), "frf.ridge"),
    ] {
        let found = refused(change);
        assert!(found.contains(named), "{named}: {found}");
    }
    // The tensors without the block that says how they came about.
    let whole = to_safetensors(&made_up(ModelKind::Frf));
    let header = usize::try_from(u64::from_le_bytes(*whole.first_chunk().unwrap())).unwrap();
    let text = std::str::from_utf8(&whole[8..8 + header]).unwrap();
    let cut = text.replacen(r#"\"frf\":{"#, r#"\"fra\":{"#, 1);
    assert_ne!(cut, text);
    let file = [&whole[..8], cut.as_bytes(), &whole[8 + header..]].concat();
    assert!(from_safetensors(&file).unwrap_err().to_string().contains("fra"));
    let mut bare = made_up(ModelKind::Frf);
    bare.frf_quality = None;
    let bytes = to_safetensors(&bare);
    assert!(bytes.len() < whole.len());
    assert_eq!(from_safetensors(&bytes).unwrap(), bare, "weights without it stay as they were");
}

#[test]
fn a_fit_keeps_what_its_frf_is_worth_and_tells_of_low_coherence_by_name() {
    let mut data = data();
    // The lag's response drowns in noise.
    for pair in &mut data.training {
        let n = pair.y.n_samples();
        let y = pair.y.channel(0).iter().zip(noise(n, 99)).map(|(y, e)| y + 2.0 * e).collect();
        pair.y = Signal::new(FS, vec![y]).unwrap();
    }
    let fitted = fit(&data, &settings(ModelKind::Frf), &unwatched).unwrap();
    let output = &settings(ModelKind::Frf).outputs[0];
    let told: Vec<&String> =
        fitted.report.warnings.iter().filter(|w| w.contains("multiple coherence below")).collect();
    assert!(told.len() == 1 && told[0].starts_with(output.as_str()), "{:?}", fitted.report.warnings);
    let again = from_safetensors(&to_safetensors(&fitted.model)).unwrap();
    assert_eq!(again, fitted.model);
    let summary = again.frf_summary().unwrap().measured.unwrap();
    assert_eq!(Some(summary.averages), fitted.report.frf_averages);
    assert!(summary.outputs[0].coherence_median < 0.8, "{summary:?}");
    assert_eq!(made_up(ModelKind::Lstm).frf_summary(), None);
}

#[test]
fn senseless_drives_are_refused_by_name() {
    let model = made_up(ModelKind::Hybrid2);
    let channels = |n: usize, c: usize| vec![vec![0.0; n]; c];
    assert!(matches!(
        model.predict(&Signal::new(FS, channels(9, 3)).unwrap()),
        Err(EngineError::ChannelCount { expected: 2, found: 3, .. })
    ));
    assert!(matches!(
        model.predict(&Signal::new(FS * 1.001, channels(9, 2)).unwrap()),
        Err(EngineError::SampleRate { .. })
    ));
    assert!(matches!(
        model.predict(&Signal::new(FS, channels(0, 2)).unwrap()),
        Err(EngineError::TooShort { .. })
    ));
}

#[test]
fn networks_beat_the_linear_model_on_a_nonlinear_lag() {
    let rms = |kind| {
        let mut settings = settings(kind);
        settings.lstm.epochs = Some(200);
        let fitted = fit(&data(), &settings, &unwatched).unwrap();
        assert_eq!(fitted.model.kind, kind);
        fitted.report.validation_rms[0].unwrap()
    };
    let frf = rms(ModelKind::Frf);
    assert!(frf > 0.05 && frf < 0.5, "the lag is clearly nonlinear: {frf}");
    for kind in [ModelKind::Lstm, ModelKind::Hybrid1, ModelKind::Hybrid2] {
        let error = rms(kind);
        assert!(error < 0.5 * frf, "{kind:?}: {error}, FRF {frf}");
    }
}

#[test]
fn a_training_that_begins_at_a_model_is_never_worse_than_it_on_the_data_that_stop_it() {
    for kind in [ModelKind::Lstm, ModelKind::Hybrid1, ModelKind::Hybrid2] {
        let mut settings = settings(kind);
        settings.lstm.seeds = Some(vec![1]);
        let cold = fit(&data(), &settings, &unwatched).unwrap();
        settings.start = cold.model.lstm.clone();
        // Steps that lead nowhere leave the start as it is: the same data have the same scalers.
        settings.lstm.epochs = Some(1);
        settings.lstm.learning_rate = Some(1.0);
        settings.lstm.warmup_steps = Some(0);
        let warm = fit(&data(), &settings, &unwatched).unwrap();
        let (before, after) = (&cold.report.seeds[0], &warm.report.seeds[0]);
        assert_eq!(after.best_epoch, 0, "{kind:?}");
        assert_eq!(after.validation_mse, before.validation_mse, "{kind:?}");
        assert_eq!(warm.model, cold.model, "{kind:?}");
        // A few good ones are kept, even if they gain little.
        settings.lstm.epochs = Some(4);
        settings.lstm.learning_rate = Some(1e-3);
        let warm = fit(&data(), &settings, &unwatched).unwrap();
        let after = &warm.report.seeds[0];
        assert!(after.best_epoch > 0 && after.validation_mse < before.validation_mse, "{kind:?}: {after:?}");
    }
}

#[test]
fn a_start_of_other_shapes_is_refused() {
    let refused = |kind, change: fn(&mut LstmPart)| {
        let mut part = LstmPart {
            net: LstmNet::init(1, &[8], 1, 1.0, &mut ChaCha8Rng::seed_from_u64(1)),
            x: Scaler { mean: vec![0.0], std: vec![1.0] },
            y: Scaler { mean: vec![0.0], std: vec![1.0] },
            window_len: 64,
            hop: 32,
            recombine: Recombine::Stream,
        };
        change(&mut part);
        let settings = FitSettings { start: Some(part), ..settings(kind) };
        match fit(&data(), &settings, &unwatched) {
            Err(EngineError::Setting { setting, .. }) => setting == "start",
            Err(EngineError::Weights(_) | EngineError::TensorShape { .. }) => true,
            other => panic!("{other:?}"),
        }
    };
    assert!(refused(ModelKind::Frf, |_| {}), "no network");
    assert!(refused(ModelKind::Hybrid2, |_| {}), "the network of another kind");
    assert!(refused(ModelKind::Lstm, |part| {
        part.net = LstmNet::init(1, &[8, 8], 1, 1.0, &mut ChaCha8Rng::seed_from_u64(1));
    }));
    assert!(refused(ModelKind::Lstm, |part| part.x.mean.push(0.0)));
    assert!(refused(ModelKind::Lstm, |part| part.net.fc_bias.clear()));
}

#[test]
fn a_fit_is_the_same_bit_for_bit_whatever_the_thread_count() {
    let mut settings = settings(ModelKind::Hybrid2);
    settings.lstm.epochs = Some(3);
    let weights = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| to_safetensors(&fit(&data(), &settings, &unwatched).unwrap().model))
    };
    let one = weights(1);
    assert!(weights(2) == one, "two threads");
    assert!(weights(3) == one, "three threads");
}

#[test]
fn what_was_reported_is_what_the_model_does() {
    let data = data();
    let fitted = fit(&data, &settings(ModelKind::Hybrid2), &unwatched).unwrap();
    let again = from_safetensors(&to_safetensors(&fitted.model)).unwrap();
    // The last tenth, after real context.
    let scored = 10_800..12_000;
    let known = with_context(&scored);
    let y = again.predict(&data.training[0].x.slice(known.clone())).unwrap();
    let (p, m) = (&y.channel(0)[scored.start - known.start..], &data.training[0].y.channel(0)[scored]);
    let square = |v: f64| v * v;
    let error: f64 = p.iter().zip(m).map(|(p, m)| square(p - m)).sum();
    let rms = (error / m.iter().map(|m| square(*m)).sum::<f64>()).sqrt();
    assert!((rms - fitted.report.validation_rms[0].unwrap()).abs() < 1e-9);
}

#[test]
fn the_frf_part_may_have_runs_of_its_own() {
    let mut data = data();
    let small = Pair {
        x: Signal::new(FS, vec![noise(6000, 5).iter().map(|v| 0.05 * v).collect()]).unwrap(),
        y: Signal::new(FS, vec![lag(&noise(6000, 5).iter().map(|v| 0.05 * v).collect::<Vec<_>>())]).unwrap(),
    };
    let gain = |data: &FitData| {
        let fitted = fit(data, &settings(ModelKind::Frf), &unwatched).unwrap();
        fitted.model.frf.unwrap().h[3].norm()
    };
    let all = gain(&data);
    data = data.with_frf_runs(vec![small]);
    assert!(gain(&data) > 1.08 * all, "the rig is softer at small level");
}

#[test]
fn dead_channels_and_missing_data_are_refused() {
    let dead = |x: Vec<f64>, y: Vec<f64>| FitData {
        training: vec![Pair { x: Signal::new(FS, vec![x]).unwrap(), y: Signal::new(FS, vec![y]).unwrap() }],
        ..data()
    };
    for kind in KINDS {
        let refused = |data: FitData| fit(&data, &settings(kind), &unwatched).unwrap_err();
        assert!(matches!(
            refused(dead(vec![3.0; 5000], noise(5000, 1))),
            EngineError::DeadChannel { what: "inputs", channel: 0 }
        ));
        assert!(matches!(
            refused(dead(noise(5000, 1), vec![0.0; 5000])),
            EngineError::DeadChannel { what: "outputs", channel: 0 }
        ));
        assert!(matches!(
            refused(dead(noise(5000, 1), noise(4999, 1))),
            EngineError::UnequalLength { expected: 5000, found: 4999, .. }
        ));
        assert!(matches!(
            refused(FitData { training: vec![], ..data() }),
            EngineError::TooShort { what: "training runs", .. }
        ));
        assert!(matches!(
            refused(FitData { split: FitSplit::ValidationHalves, ..data() }),
            EngineError::TooShort { what: "validation data", .. }
        ));
    }
}

#[test]
fn a_fit_can_be_cancelled_and_its_progress_never_falls() {
    let calls = AtomicUsize::new(0);
    let highest = std::sync::Mutex::new(0.0);
    let watch = |p: Progress<'_>| {
        let mut highest = highest.lock().unwrap();
        assert!(p.fraction >= *highest - 0.02 && p.fraction <= 1.0, "{} after {}", p.fraction, *highest);
        *highest = f64::max(*highest, p.fraction);
        if calls.fetch_add(1, Ordering::Relaxed) < 30 {
            ControlFlow::Continue(())
        } else {
            ControlFlow::Break(())
        }
    };
    let result = fit(&data(), &settings(ModelKind::Hybrid1), &watch);
    assert_eq!(result.unwrap_err(), EngineError::Cancelled);
}

#[test]
fn a_linear_fit_leaves_the_working_point_where_it_is() {
    let shift = |p: Pair, dx: f64, dy: f64| Pair {
        x: Signal::new(FS, vec![p.x.channel(0).iter().map(|v| v + dx).collect()]).unwrap(),
        y: Signal::new(FS, vec![p.y.channel(0).iter().map(|v| v + dy).collect()]).unwrap(),
    };
    let data = FitData::of_training(vec![shift(pair(12_000, 1), 50.0, -20.0)]);
    let model = fit(&data, &settings(ModelKind::Frf), &unwatched).unwrap().model;
    let y = model.predict(&Signal::new(FS, vec![vec![50.0; 400]]).unwrap()).unwrap();
    assert!(y.channel(0).iter().all(|v| (v + 20.0).abs() < 0.3), "{:?}", &y.channel(0)[..3]);
}

/// Two runs, of which the second is left out.
fn two_runs() -> FitData {
    FitData::of_training(vec![pair(12_000, 1), pair(9_000, 2)])
}

#[test]
fn the_scores_are_those_of_a_model_that_has_not_seen_the_run_and_the_model_has_seen_it() {
    let data = two_runs();
    let mut settings = settings(ModelKind::Hybrid2);
    settings.lstm.epochs = Some(60);
    let fitted = fit(&data, &settings, &unwatched).unwrap();
    let comparison = fitted.report.comparison.as_ref().unwrap();
    assert_eq!((comparison.rule, comparison.refitted), (SplitRule::LeftOutRuns, true));
    assert_eq!(comparison.scores.len(), 1);
    assert_eq!(fitted.report.validation_rms[0], comparison.scores[0].outputs[0].rms());
    assert!((fitted.report.training_s - 210.0).abs() < 1e-9, "both runs, whole");
    assert!((fitted.report.validation_s - 90.0).abs() < 1e-9);

    // The model has seen it, the scores have not.
    let predicted = fitted.model.predict(&data.training[1].x).unwrap();
    let after = Squares::of(predicted.channel(0), data.training[1].y.channel(0));
    assert!(after.rms() <= Some(1.1 * fitted.report.validation_rms[0].unwrap()));
    assert_ne!(Some(after), comparison.scores[0].outputs.first().copied());
}

#[test]
fn what_compares_is_scored_with_and_without_the_filter() {
    let data = two_runs();
    let mut settings = settings(ModelKind::Frf);
    settings.preprocess = Preprocess { low_pass_hz: Some(5.0), band_pass_hz: None };
    let fitted = fit(&data, &settings, &unwatched).unwrap();
    let score = &fitted.report.comparison.unwrap().scores[0];
    let (filtered, recorded) = (score.outputs[0], score.recorded.as_ref().unwrap()[0]);
    assert!(recorded.measured > filtered.measured && recorded.error > filtered.error);
    assert_eq!(fitted.report.validation_rms[0], filtered.rms());
}
