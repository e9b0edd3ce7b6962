//! Training against known systems, against the reference, and with wrong arguments.

use std::collections::BTreeMap;
use std::sync::Mutex;
use std::sync::atomic::{AtomicUsize, Ordering};

use super::super::predict::predict_on;
use super::super::samples::{noise, settings};
use super::super::settings::{Optimizer, Recombine, Schedule};
use super::*;
use crate::checkpoint::NoCheckpoints;
use crate::progress::unwatched;

/// [`super::train`] without checkpoints.
fn train(
    training: &[Segment],
    validation: &[Segment],
    start: &LstmNet,
    settings: &LstmSettings,
    seed: u64,
    watch: Watch<'_>,
) -> Result<Trained, EngineError> {
    super::train(training, Until::Best(validation), start, (settings, seed), (&NoCheckpoints, ""), watch)
}

/// [`super::train_on`] without checkpoints.
fn train_on(
    isa: Isa,
    training: &[Segment],
    validation: &[Segment],
    start: &LstmNet,
    settings: &LstmSettings,
    seed: u64,
    watch: Watch<'_>,
) -> Result<Trained, EngineError> {
    super::train_on(
        isa,
        training,
        Until::Best(validation),
        start,
        (settings, seed),
        (&NoCheckpoints, ""),
        watch,
    )
}

/// A first-order lag after a saturation, `y' = 0.7 y + 0.5 tanh(1.5 x)`: it rings down in some 13
/// samples, within the burn-in of 16. The second of two outputs has the opposite sign and lags by one sample.
fn lag(samples: usize, seed: u64, score_from: usize) -> Segment {
    let x = noise(1, samples, seed);
    let mut y = vec![Vec::new(), Vec::new()];
    let mut state = 0.0_f32;
    for &x in &x[0] {
        y[1].push(-state);
        state = 0.7 * state + 0.5 * (1.5 * x).tanh();
        y[0].push(state);
    }
    Segment { x, y, score_from }
}

#[test]
fn a_known_system_is_learnt_to_three_per_cent_by_both_optimisers() {
    let (training, validation) = ([lag(6000, 1, 0), lag(3000, 2, 0)], [lag(2000, 3, 100)]);
    let test = lag(3000, 4, 0);
    for (optimizer, rate) in [(Optimizer::Adam, 1e-2), (Optimizer::Rmsprop, 5e-3)] {
        let mut settings = settings();
        (settings.optimizer, settings.learning_rate) = (optimizer, rate);
        (settings.epochs, settings.batch_size) = (80, 16);
        let trained = train(&training, &validation, &begin(1, 2), &settings, 1, &unwatched).unwrap();
        let y = predict(&trained.net, &test.x);
        for (y, wanted) in y.iter().zip(&test.y) {
            let pairs = || y.iter().zip(wanted).skip(200);
            let error: f32 = pairs().map(|(a, b)| (a - b).powi(2)).sum();
            let power: f32 = pairs().map(|(_, b)| b * b).sum();
            let nrms = (error / power).sqrt();
            println!("{optimizer:?}: NRMS {nrms:.4}, best epoch {}", trained.best_epoch);
            assert!(nrms < 0.03, "{optimizer:?}: {nrms}");
        }
        let best = trained.history.iter().min_by(|a, b| a.validation_mse.total_cmp(&b.validation_mse));
        assert_eq!(best.unwrap().validation_mse, trained.validation_mse);
        assert!(trained.history[0].training_mse > 10.0 * trained.history.last().unwrap().training_mse);
    }
}

/// A network of the test settings' shape to start from.
fn begin(inputs: usize, outputs: usize) -> LstmNet {
    sized(inputs, &settings().blocks, outputs)
}

fn sized(inputs: usize, blocks: &[usize], outputs: usize) -> LstmNet {
    LstmNet::init(inputs, blocks, outputs, 1.0, &mut ChaCha8Rng::seed_from_u64(1))
}

fn predict(net: &LstmNet, x: &[Vec<f32>]) -> Vec<Vec<f32>> {
    super::super::predict(net, x, 64, 32, Recombine::Stream).unwrap()
}

#[test]
fn training_gives_the_same_bits_on_any_number_of_threads() {
    let (training, validation) = ([lag(2000, 1, 0)], [lag(700, 2, 100)]);
    for isa in Isa::ALL {
        if !isa.is_available() {
            println!("skipped {}: not on this machine", isa.name());
            continue;
        }
        let on = |threads, seed| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            pool.install(|| {
                train_on(isa, &training, &validation, &begin(1, 2), &settings(), seed, &unwatched).unwrap()
            })
        };
        let one = on(1, 7);
        assert_eq!(one, on(2, 7));
        assert_eq!(one, on(3, 7));
        assert_ne!(one.history, on(1, 8).history);
    }
}

#[test]
fn the_validation_error_is_that_of_the_windows_with_context() {
    let (training, validation) = ([lag(600, 1, 0)], [lag(500, 2, 137), lag(40, 3, 0), lag(90, 4, 0)]);
    let settings = settings();
    for isa in Isa::ALL.into_iter().filter(|i| i.is_available()) {
        let trained = train_on(isa, &training, &validation, &begin(1, 2), &settings, 3, &unwatched).unwrap();
        // Window by window: 16 samples of context, 48 scored; a segment scored from its start
        // loses its first 16.
        let (mut sum, mut count) = (0.0, 0);
        for (segment, from) in validation.iter().zip([137, 16, 16]) {
            let n = segment.x[0].len();
            for first in (from..n).step_by(48) {
                let x = [segment.x[0][first - 16..n.min(first + 48)].to_vec()];
                // One window from a zero state: a stream cannot leave out its pre-roll, so the
                // reference computes it.
                let twin = super::super::reference::Twin::of(&trained.net);
                let y = twin.forward(&x[0].iter().map(|&x| vec![f64::from(x)]).collect::<Vec<_>>());
                for (t, y) in y.iter().enumerate().skip(16) {
                    for (y, wanted) in y.iter().zip(&segment.y) {
                        sum += (y - f64::from(wanted[first - 16 + t])).powi(2);
                        count += 1;
                    }
                }
            }
        }
        let expected = sum / f64::from(count);
        assert!((trained.validation_mse - expected).abs() < 1e-5 * expected, "{}", isa.name());
    }
}

#[test]
fn cancelling_stops_within_one_mini_batch() {
    let calls = AtomicUsize::new(0);
    let watch = |_: Progress<'_>| {
        if calls.fetch_add(1, Ordering::Relaxed) == 4 {
            ControlFlow::Break(())
        } else {
            ControlFlow::Continue(())
        }
    };
    let error =
        train(&[lag(2000, 1, 0)], &[lag(300, 2, 0)], &begin(1, 2), &settings(), 1, &watch).unwrap_err();
    assert_eq!(error, EngineError::Cancelled);
    assert_eq!(calls.load(Ordering::Relaxed), 5);
}

#[test]
fn progress_never_falls_and_ends_at_one() {
    let seen = std::sync::Mutex::new(vec![0.0]);
    let watch = |p: Progress<'_>| {
        seen.lock().unwrap().push(p.fraction);
        ControlFlow::Continue(())
    };
    train(&[lag(700, 1, 0)], &[lag(300, 2, 0)], &begin(1, 2), &settings(), 1, &watch).unwrap();
    let seen = seen.into_inner().unwrap();
    assert!(seen.windows(2).all(|w| w[0] <= w[1]), "{seen:?}");
    assert_eq!(seen.last(), Some(&1.0));
}

#[test]
fn a_runaway_is_an_error_that_names_the_epoch() {
    let mut settings = settings();
    (settings.learning_rate, settings.clip_norm) = (1e30, None);
    settings.schedule = Schedule::Constant;
    settings.warmup_steps = 0;
    for isa in Isa::ALL.into_iter().filter(|i| i.is_available()) {
        let error =
            train_on(isa, &[lag(700, 1, 0)], &[lag(300, 2, 0)], &begin(1, 2), &settings, 1, &unwatched)
                .unwrap_err();
        assert!(matches!(error, EngineError::Diverged { epoch: 1.. }), "{}: {error}", isa.name());
    }
}

#[test]
fn data_and_settings_that_cannot_be_trained_on_are_refused_by_name() {
    let settings = settings();
    let go = |training: &[Segment], validation: &[Segment]| {
        train(training, validation, &begin(1, 2), &settings, 1, &unwatched).unwrap_err()
    };
    let good = lag(200, 1, 0);
    assert!(matches!(
        go(&[good.clone(), lag(63, 2, 0)], std::slice::from_ref(&good)),
        EngineError::TooShort { what, needed: 64, found: 63 } if what.contains("lstm.window_len")
    ));
    assert!(matches!(go(&[], std::slice::from_ref(&good)), EngineError::TooShort { found: 0, .. }));
    assert!(matches!(go(std::slice::from_ref(&good), &[]), EngineError::TooShort { found: 0, .. }));
    assert!(matches!(
        go(std::slice::from_ref(&good), &[lag(50, 1, 50)]),
        EngineError::TooShort { found: 0, .. }
    ));
    let mut bad = good.clone();
    bad.y[1][17] = f32::NAN;
    assert!(matches!(
        go(&[good.clone(), bad], std::slice::from_ref(&good)),
        EngineError::NonFinite { what: "LSTM output", channel: 1, sample: 17 }
    ));
    let mut bad = good.clone();
    bad.y.iter_mut().for_each(|y| y.truncate(150));
    assert!(matches!(
        go(&[bad], std::slice::from_ref(&good)),
        EngineError::UnequalLength { expected: 200, found: 150, .. }
    ));
    let mut large = settings.clone();
    (large.blocks, large.batch_size, large.window_len) = (vec![512; 8], 4096, 16_000);
    let long = lag(16_000, 1, 0);
    assert!(matches!(
        train(&[long], &[good], &sized(1, &large.blocks, 2), &large, 1, &unwatched),
        Err(EngineError::Setting { setting: "lstm.batch_size", .. })
    ));
}

#[test]
fn a_network_that_was_trained_predicts_the_same_on_every_instruction_set() {
    let trained =
        train(&[lag(900, 1, 0)], &[lag(300, 2, 0)], &begin(1, 2), &settings(), 1, &unwatched).unwrap();
    let x = noise(1, 500, 5);
    let expected = predict_on(Isa::Portable, &trained.net, &x, 64, 32, Recombine::Welch, &unwatched).unwrap();
    for isa in Isa::ALL.into_iter().filter(|i| i.is_available()) {
        let found = predict_on(isa, &trained.net, &x, 64, 32, Recombine::Welch, &unwatched).unwrap();
        for (f, e) in found.iter().flatten().zip(expected.iter().flatten()) {
            assert!((f - e).abs() < 1e-5, "{}", isa.name());
        }
    }
}

/// `cargo test --release --lib lstm::train::tests::speed -- --ignored --nocapture`
#[test]
#[ignore = "measures, does not judge"]
fn speed() {
    let (x, y) = (noise(9, 300_000, 1), noise(6, 300_000, 2));
    let training = [Segment { x, y, score_from: 0 }];
    let validation = [Segment { x: noise(9, 400, 3), y: noise(6, 400, 4), score_from: 0 }];
    for batch_size in [32, 128] {
        let settings =
            LstmSettings { blocks: vec![39], window_len: 256, hop: 128, batch_size, epochs: 4, ..settings() };
        let net = sized(9, &settings.blocks, 6);
        let begin = std::time::Instant::now();
        train(&training, &validation, &net, &settings, 1, &unwatched).unwrap();
        let s = begin.elapsed().as_secs_f64();
        println!("batch {batch_size}: {:.0} windows/s", (settings.epochs * 2342) as f64 / s);
    }
}

/// Keeps checkpoints in memory; one is due after every `every`-th mini-batch.
struct Memory {
    every: usize,
    asked: AtomicUsize,
    kept: Mutex<BTreeMap<String, Vec<u8>>>,
}

impl Memory {
    fn new(every: usize) -> Self {
        Self { every, asked: AtomicUsize::new(0), kept: Mutex::default() }
    }
}

impl CheckpointStore for Memory {
    fn load(&self, part: &str) -> Option<Vec<u8>> {
        self.kept.lock().unwrap().get(part).cloned()
    }

    fn is_due(&self, _: &str, done: bool) -> bool {
        done || (self.asked.fetch_add(1, Ordering::Relaxed) + 1).is_multiple_of(self.every)
    }

    fn save(&self, part: &str, state: Vec<u8>) {
        self.kept.lock().unwrap().insert(part.to_owned(), state);
    }
}

#[test]
fn a_training_that_was_interrupted_anywhere_ends_as_one_that_was_not() {
    let (training, validation) = ([lag(2000, 1, 0), lag(900, 2, 0)], [lag(300, 3, 50)]);
    for optimizer in [Optimizer::Adam, Optimizer::Rmsprop] {
        let settings = LstmSettings { optimizer, batch_size: 20, epochs: 3, ..settings() };
        let start = begin(1, 2);
        let whole = train(&training, &validation, &start, &settings, 7, &unwatched).unwrap();
        let steps = AtomicUsize::new(0);
        let count = |_: Progress<'_>| {
            steps.fetch_add(1, Ordering::Relaxed);
            ControlFlow::Continue(())
        };
        train(&training, &validation, &start, &settings, 7, &count).unwrap();
        let steps = steps.into_inner();
        assert!(steps > 10, "several mini-batches an epoch: {steps}");
        // Stopped after each mini-batch in turn, the last of an epoch and of the training among them.
        for stop_at in 1..steps {
            let memory = Memory::new(usize::MAX);
            let seen = AtomicUsize::new(0);
            let stop = |_: Progress<'_>| match seen.fetch_add(1, Ordering::Relaxed) + 1 == stop_at {
                true => ControlFlow::Break(()),
                false => ControlFlow::Continue(()),
            };
            let kept = (&memory as &dyn CheckpointStore, "seed");
            let stopped =
                super::train(&training, Until::Best(&validation), &start, (&settings, 7), kept, &stop);
            assert_eq!(stopped.unwrap_err(), EngineError::Cancelled);
            let resumed =
                super::train(&training, Until::Best(&validation), &start, (&settings, 7), kept, &unwatched);
            assert_eq!(resumed.unwrap(), whole, "stopped after mini-batch {stop_at}");
            let again =
                super::train(&training, Until::Best(&validation), &start, (&settings, 7), kept, &unwatched);
            assert_eq!(again.unwrap(), whole, "the end is kept too");
        }
    }
}

#[test]
fn a_training_that_died_goes_on_from_its_last_checkpoint() {
    let (training, validation) = ([lag(2000, 1, 0)], [lag(300, 3, 50)]);
    let (settings, start) = (settings(), begin(1, 2));
    let whole = train(&training, &validation, &start, &settings, 7, &unwatched).unwrap();
    let memory = Memory::new(3);
    let seen = AtomicUsize::new(0);
    let kept = (&memory as &dyn CheckpointStore, "seed");
    let batches = |progress: Progress<'_>| usize::from(progress.loss.is_none());
    let die = |progress: Progress<'_>| {
        assert!(seen.fetch_add(batches(progress), Ordering::Relaxed) < 4, "as good as dead");
        ControlFlow::Continue(())
    };
    let died = std::panic::catch_unwind(std::panic::AssertUnwindSafe(|| {
        super::train(&training, Until::Best(&validation), &start, (&settings, 7), kept, &die)
    }));
    assert!(died.is_err());
    let steps = AtomicUsize::new(0);
    let count = |progress: Progress<'_>| {
        steps.fetch_add(batches(progress), Ordering::Relaxed);
        ControlFlow::Continue(())
    };
    let resumed = super::train(&training, Until::Best(&validation), &start, (&settings, 7), kept, &count);
    assert_eq!(resumed.unwrap(), whole);
    let resumed = steps.swap(0, Ordering::Relaxed);
    train(&training, &validation, &start, &settings, 7, &count).unwrap();
    assert_eq!(steps.into_inner() - resumed, 3, "three mini-batches were not done again");
}

#[test]
fn a_state_of_another_training_is_not_used() {
    let (training, validation) = ([lag(2000, 1, 0)], [lag(300, 3, 50)]);
    let (settings, start) = (settings(), begin(1, 2));
    let whole = train(&training, &validation, &start, &settings, 7, &unwatched).unwrap();
    let other = LstmSettings { blocks: vec![5], ..settings.clone() };
    let memory = Memory::new(1);
    let kept = (&memory as &dyn CheckpointStore, "seed");
    super::train(&training, Until::Best(&validation), &sized(1, &[5], 2), (&other, 7), kept, &unwatched)
        .unwrap();
    let trained = super::train(&training, Until::Best(&validation), &start, (&settings, 7), kept, &unwatched);
    assert_eq!(trained.unwrap(), whole, "of other sizes");
    memory.save("seed", b"{".to_vec());
    let trained = super::train(&training, Until::Best(&validation), &start, (&settings, 7), kept, &unwatched);
    assert_eq!(trained.unwrap(), whole, "no state at all");
}

#[test]
fn the_errors_of_each_epoch_are_told_as_the_curve_keeps_them() {
    let (training, validation) = ([lag(1500, 1, 0)], [lag(400, 2, 0)]);
    let settings = LstmSettings { epochs: 6, validate_every: Some(2), ..settings() };
    let start = begin(1, 2);
    let told = Mutex::new(Vec::new());
    let listen = |progress: Progress<'_>| {
        told.lock().unwrap().extend(progress.loss);
        ControlFlow::Continue(())
    };
    let trained = train(&training, &validation, &start, &settings, 7, &listen).unwrap();
    let expected: Vec<Loss> = trained
        .history
        .iter()
        .map(|e| Loss { seed: 7, epoch: e.epoch, training: e.training_mse, stopping: Some(e.validation_mse) })
        .collect();
    assert_eq!(std::mem::take(&mut *told.lock().unwrap()), expected);
    assert_eq!(expected.iter().map(|loss| loss.epoch).collect::<Vec<_>>(), [2, 4, 6]);

    let kept = (&NoCheckpoints as &dyn CheckpointStore, "");
    super::train(&training, Until::Epoch(3), &start, (&settings, 7), kept, &listen).unwrap();
    let told: Vec<_> = told.into_inner().unwrap().iter().map(|loss| (loss.epoch, loss.stopping)).collect();
    assert_eq!(told, [(2, None), (3, None)], "nothing stops it; the last epoch is told");
}
