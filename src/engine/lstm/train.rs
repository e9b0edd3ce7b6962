//! Training: mini-batches of windows, best epoch by validation.

use rand::seq::SliceRandom;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rayon::prelude::*;

use super::bptt::{Backprop, Group, TrainWeights};
use super::isa::Isa;
use super::net::LstmNet;
use super::optimizer::{Descent, clip, relative_rate};
use super::params::{Shape, flatten, unflatten};
use super::predict::check_channels;
use super::settings::LstmSettings;
use super::simd::{LANES, dispatch};
use super::validate::Scored;
use crate::engine::progress::report;
use crate::engine::{EngineError, Watch};

/// Standardised inputs and outputs of one run, planar `[channel][sample]`.
#[derive(Debug, Clone, PartialEq)]
pub struct Stretch {
    /// Inputs.
    pub x: Vec<Vec<f32>>,
    /// Outputs, as long as the inputs.
    pub y: Vec<Vec<f32>>,
    /// First sample that validation scores; what is before is context. Training takes all.
    pub score_from: usize,
}

/// What training found.
#[derive(Debug, Clone, PartialEq)]
pub struct Trained {
    /// The network of the best epoch.
    pub net: LstmNet,
    /// Its epoch, from 1; 0 is the start itself.
    pub best_epoch: usize,
    /// Its mean squared error on validation data, standardised.
    pub validation_mse: f64,
    /// Every epoch that was validated.
    pub history: Vec<EpochRecord>,
}

/// One validated epoch.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct EpochRecord {
    /// From 1.
    pub epoch: usize,
    /// Mean over the mini-batches of this epoch, each before its step; standardised.
    pub training_mse: f64,
    /// Mean over the scored samples and outputs after this epoch; standardised.
    pub validation_mse: f64,
}

/// A fit is validated at least this often, or every epoch if it has fewer.
const VALIDATIONS: usize = 100;

/// Memory that one training may take for its mini-batch.
const MEMORY_LIMIT: usize = 4 << 30;

/// Trains a network from `start` (Heindel et al., section 2.2); `seed` draws the order of windows: windows of `window_len` every `hop`
/// samples, reshuffled each epoch and shifted by a drawn offset below one hop, the mean squared error
/// after the burn-in, the optimiser and schedule of the settings; keeps the weights of the epoch with
/// the lowest validation error.
///
/// A last incomplete window is left out. The result depends on the arguments and the instruction set
/// only, bit for bit, whatever the number of threads. `watch` is called after every mini-batch.
///
/// # Errors
/// Settings outside their limits; data whose channels do not belong together or are not finite;
/// [`EngineError::TooShort`] for a training stretch shorter than a window and for validation without
/// a sample; [`EngineError::Diverged`]; [`EngineError::Cancelled`].
pub fn train(
    training: &[Stretch],
    validation: &[Stretch],
    start: &LstmNet,
    settings: &LstmSettings,
    seed: u64,
    watch: Watch<'_>,
) -> Result<Trained, EngineError> {
    train_on(Isa::of_process()?, training, validation, start, settings, seed, watch)
}

/// [`train`] on a given instruction set.
///
/// # Errors
/// As [`train`].
pub(super) fn train_on(
    isa: Isa,
    training: &[Stretch],
    validation: &[Stretch],
    start: &LstmNet,
    settings: &LstmSettings,
    seed: u64,
    watch: Watch<'_>,
) -> Result<Trained, EngineError> {
    settings.check()?;
    start.check()?;
    check_stretches(training, start.inputs(), start.outputs)?;
    check_stretches(validation, start.inputs(), start.outputs)?;
    let needed = settings.window_len;
    let shortest = training.iter().map(|s| s.x[0].len()).min().unwrap_or(0);
    if shortest < needed {
        return Err(EngineError::TooShort {
            what: "training run for lstm.window_len",
            needed,
            found: shortest,
        });
    }
    let shape = Shape::of(start);
    let groups = settings.batch_size.div_ceil(LANES);
    if groups * Group::bytes(&shape, needed) > MEMORY_LIMIT {
        return Err(EngineError::Setting {
            setting: "lstm.batch_size",
            found: settings.batch_size.to_string(),
            limit: format!(
                "mini-batch, window_len and blocks that fit into {} GiB together",
                MEMORY_LIMIT >> 30
            ),
        });
    }
    let job = Job { isa, shape, training, scored: Scored::new(validation, settings)?, settings, watch };
    let row = flatten(start);
    if isa == Isa::Avx512 { job.run::<16, true>(row, seed) } else { job.run::<4, false>(row, seed) }
}

/// Channels, lengths and finiteness of all stretches.
fn check_stretches(stretches: &[Stretch], inputs: usize, outputs: usize) -> Result<(), EngineError> {
    for stretch in stretches {
        let samples = check_channels("LSTM input", &stretch.x, inputs)?;
        let found = check_channels("LSTM output", &stretch.y, outputs)?;
        if found != samples {
            return Err(EngineError::UnequalLength {
                what: "LSTM output",
                channel: 0,
                expected: samples,
                found,
            });
        }
    }
    Ok(())
}

/// Everything that a training reads.
struct Job<'a> {
    isa: Isa,
    shape: Shape,
    training: &'a [Stretch],
    scored: Scored<'a>,
    settings: &'a LstmSettings,
    watch: Watch<'a>,
}

impl Job<'_> {
    fn run<const R: usize, const WIDE: bool>(
        &self,
        mut row: Vec<f32>,
        seed: u64,
    ) -> Result<Trained, EngineError> {
        let settings = self.settings;
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let mut weights = TrainWeights::<R>::new(&self.shape, &row);
        let burn_in = settings.burn_in_samples();
        let mut groups: Vec<Group> = (0..settings.batch_size.div_ceil(LANES))
            .map(|_| Group::new(&self.shape, settings.window_len, burn_in))
            .collect();
        let mut descent = Descent::new(settings.optimizer, row.len());
        let mut gradient = vec![0.0; row.len()];
        let per_window = ((settings.window_len - burn_in) * self.shape.outputs) as f64;
        let validate_every = (settings.epochs / VALIDATIONS).max(1);
        // A start may be good already (a hybrid starts as its FRF): it is the one to beat.
        let start_mse = self.scored.mse(self.isa, &weights.forward);
        if !start_mse.is_finite() {
            return Err(EngineError::Diverged { epoch: 0 });
        }
        let mut best = (0, start_mse, row.clone());
        let mut history = Vec::new();
        let mut step = 0;

        for epoch in 1..=settings.epochs {
            let windows = self.windows(&mut rng);
            let mut squared_error = 0.0;
            for (batch, first) in windows.chunks(settings.batch_size).zip((0..).step_by(settings.batch_size))
            {
                let scale = (2.0 / (batch.len() as f64 * per_window)) as f32;
                let used = &mut groups[..batch.len().div_ceil(LANES)];
                used.par_iter_mut().zip(batch.par_chunks(LANES)).for_each(|(group, windows)| {
                    group.set_windows(windows.iter().map(|&(stretch, start)| {
                        let stretch = &self.training[stretch];
                        (&stretch.x[..], &stretch.y[..], start)
                    }));
                    dispatch(self.isa, Backprop::<R, WIDE> { weights: &weights, group, scale });
                });
                // Always in the order of the groups, whatever thread was first.
                gradient.fill(0.0);
                for group in used.iter() {
                    gradient.iter_mut().zip(&group.gradient).for_each(|(sum, g)| *sum += g);
                    squared_error += group.squared_error;
                }
                let norm = clip(&mut gradient, settings.clip_norm);
                if !(norm.is_finite() && squared_error.is_finite()) {
                    return Err(EngineError::Diverged { epoch });
                }
                let done =
                    ((epoch - 1) as f64 + first as f64 / windows.len() as f64) / settings.epochs as f64;
                let rate = settings.learning_rate
                    * relative_rate(settings.schedule, settings.warmup_steps, step, done);
                descent.step(&mut row, &gradient, rate);
                weights.set(&row);
                step += 1;
                report(self.watch, "LSTM", done)?;
            }
            if epoch % validate_every != 0 && epoch != settings.epochs {
                continue;
            }
            let record = EpochRecord {
                epoch,
                training_mse: squared_error / (windows.len() as f64 * per_window),
                validation_mse: self.scored.mse(self.isa, &weights.forward),
            };
            if !record.validation_mse.is_finite() || row.iter().any(|w| !w.is_finite()) {
                return Err(EngineError::Diverged { epoch });
            }
            history.push(record);
            if record.validation_mse < best.1 {
                (best.0, best.1) = (epoch, record.validation_mse);
                best.2.copy_from_slice(&row);
            }
        }
        report(self.watch, "LSTM", 1.0)?;
        let (best_epoch, validation_mse, kept) = best;
        Ok(Trained { net: unflatten(&self.shape, &kept), best_epoch, validation_mse, history })
    }

    /// The windows of an epoch, `(stretch, first sample)`, in the order in which they are used.
    fn windows(&self, rng: &mut ChaCha8Rng) -> Vec<(usize, usize)> {
        let (len, hop) = (self.settings.window_len, self.settings.hop);
        let mut windows = Vec::new();
        for (index, stretch) in self.training.iter().enumerate() {
            let last = stretch.x[0].len() - len;
            let offset = rng.random_range(0..=last.min(hop - 1) as u64) as usize;
            windows.extend((offset..=last).step_by(hop).map(|start| (index, start)));
        }
        windows.shuffle(rng);
        windows
    }
}

#[cfg(test)]
mod tests {
    use std::ops::ControlFlow;
    use std::sync::atomic::{AtomicUsize, Ordering};

    use super::super::predict::predict_on;
    use super::super::samples::{noise, settings};
    use super::super::settings::{Optimizer, Recombine, Schedule};
    use super::*;
    use crate::engine::Progress;
    use crate::engine::progress::unwatched;

    /// A first-order lag behind a saturation, `y' = 0.7 y + 0.5 tanh(1.5 x)`: ring-down some 13
    /// samples, within the burn-in of 16. Two outputs, the second with the opposite sign and delayed by one sample.
    fn lag(samples: usize, seed: u64, score_from: usize) -> Stretch {
        let x = noise(1, samples, seed);
        let mut y = vec![Vec::new(), Vec::new()];
        let mut state = 0.0_f32;
        for &x in &x[0] {
            y[1].push(-state);
            state = 0.7 * state + 0.5 * (1.5 * x).tanh();
            y[0].push(state);
        }
        Stretch { x, y, score_from }
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

    /// A net of the test settings' shape.
    fn begin(inputs: usize, outputs: usize) -> LstmNet {
        LstmNet::init(inputs, &settings().blocks, outputs, 1.0, &mut ChaCha8Rng::seed_from_u64(1))
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
                    train_on(isa, &training, &validation, &begin(1, 2), &settings(), seed, &unwatched)
                        .unwrap()
                })
            };
            let one = on(1, 7);
            assert_eq!(one, on(2, 7));
            assert_eq!(one, on(3, 7));
            assert_ne!(one.net, on(1, 8).net);
        }
    }

    #[test]
    fn the_validation_error_is_that_of_the_windows_with_context() {
        let (training, validation) = ([lag(600, 1, 0)], [lag(500, 2, 137), lag(40, 3, 0), lag(90, 4, 0)]);
        let settings = settings();
        for isa in Isa::ALL.into_iter().filter(|i| i.is_available()) {
            let trained =
                train_on(isa, &training, &validation, &begin(1, 2), &settings, 3, &unwatched).unwrap();
            // Window by window: 16 samples of context, 48 scored; a stretch scored from its start
            // loses its first 16.
            let (mut sum, mut count) = (0.0, 0);
            for (stretch, from) in validation.iter().zip([137, 16, 16]) {
                let n = stretch.x[0].len();
                for first in (from..n).step_by(48) {
                    let x = vec![stretch.x[0][first - 16..n.min(first + 48)].to_vec()];
                    // One window from a zero state: a stream whose pre-roll cannot be had, so the
                    // twin.
                    let twin = super::super::reference::Twin::of(&trained.net);
                    let y = twin.forward(&x[0].iter().map(|&x| vec![f64::from(x)]).collect::<Vec<_>>());
                    for (t, y) in y.iter().enumerate().skip(16) {
                        for (y, wanted) in y.iter().zip(&stretch.y) {
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
        let go = |training: &[Stretch], validation: &[Stretch]| {
            train(training, validation, &begin(1, 2), &settings, 1, &unwatched).unwrap_err()
        };
        let good = lag(200, 1, 0);
        assert!(matches!(
            go(&[good.clone(), lag(63, 2, 0)], &[good.clone()]),
            EngineError::TooShort { what, needed: 64, found: 63 } if what.contains("lstm.window_len")
        ));
        assert!(matches!(go(&[], &[good.clone()]), EngineError::TooShort { found: 0, .. }));
        assert!(matches!(go(&[good.clone()], &[]), EngineError::TooShort { found: 0, .. }));
        assert!(matches!(go(&[good.clone()], &[lag(50, 1, 50)]), EngineError::TooShort { found: 0, .. }));
        let mut bad = good.clone();
        bad.y[1][17] = f32::NAN;
        assert!(matches!(
            go(&[good.clone(), bad], &[good.clone()]),
            EngineError::NonFinite { what: "LSTM output", channel: 1, sample: 17 }
        ));
        let mut bad = good.clone();
        bad.y.iter_mut().for_each(|y| y.truncate(150));
        assert!(matches!(
            go(&[bad], &[good.clone()]),
            EngineError::UnequalLength { expected: 200, found: 150, .. }
        ));
        let mut large = settings.clone();
        (large.blocks, large.batch_size, large.window_len) = (vec![512; 8], 4096, 16_000);
        let long = lag(16_000, 1, 0);
        assert!(matches!(
            train(&[long], &[good], &begin(1, 2), &large, 1, &unwatched),
            Err(EngineError::Setting { setting: "lstm.batch_size", .. })
        ));
    }

    #[test]
    fn a_network_that_was_trained_predicts_the_same_on_every_instruction_set() {
        let trained =
            train(&[lag(900, 1, 0)], &[lag(300, 2, 0)], &begin(1, 2), &settings(), 1, &unwatched).unwrap();
        let x = noise(1, 500, 5);
        let expected = predict_on(Isa::Portable, &trained.net, &x, 64, 32, Recombine::Welch).unwrap();
        for isa in Isa::ALL.into_iter().filter(|i| i.is_available()) {
            let found = predict_on(isa, &trained.net, &x, 64, 32, Recombine::Welch).unwrap();
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
        let training = [Stretch { x, y, score_from: 0 }];
        let validation = [Stretch { x: noise(9, 400, 3), y: noise(6, 400, 4), score_from: 0 }];
        for batch_size in [32, 128] {
            let settings = LstmSettings {
                blocks: vec![39],
                window_len: 256,
                hop: 128,
                batch_size,
                epochs: 4,
                ..settings()
            };
            let net = begin(9, 6);
            let started = std::time::Instant::now();
            train(&training, &validation, &net, &settings, 1, &unwatched).unwrap();
            let s = started.elapsed().as_secs_f64();
            println!("batch {batch_size}: {:.0} windows/s", (settings.epochs * 2342) as f64 / s);
        }
    }
}
