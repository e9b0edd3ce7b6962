//! A fit: data and settings in, model and report out.

use std::borrow::Cow;
use std::ops::ControlFlow;
use std::sync::atomic::{AtomicU64, Ordering};

use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use super::start::start;
use super::{FitSettings, InputRange, LstmPart, ModelKind, Preprocess, RigModel, Scaler, network_inputs};
use crate::engine::checkpoint::{Forget, Keeper};
use crate::engine::frf::{self, FrfSettings};
use crate::engine::lstm::{self, LstmSettings, Recombine, RecombineChoice, Stretch, Trained};
use crate::engine::progress::report;
use crate::engine::{EngineError, Progress, Signal, Watch, metrics};

/// One run, split into the model's inputs and outputs; equally long, one sample rate.
#[derive(Debug, Clone, PartialEq)]
pub struct Pair {
    /// Inputs, in the order of the settings.
    pub x: Signal,
    /// Outputs, in the order of the settings.
    pub y: Signal,
}

/// A stretch that models are compared on, with real context before the part that is scored.
#[derive(Debug, Clone, PartialEq)]
pub struct Validation {
    /// Context, then the scored part.
    pub pair: Pair,
    /// First sample that is scored.
    pub score_from: usize,
}

/// The data of a fit. No sample that `validation` scores may be in `training` or `frf`.
#[derive(Debug, Clone, PartialEq)]
pub struct FitData {
    /// What the LSTM (or, without one, the FRF) is trained on.
    pub training: Vec<Pair>,
    /// What the FRF part is estimated on when that is something else.
    pub frf: Option<Vec<Pair>>,
    /// What chooses among models, epochs, seeds and recombinations.
    pub validation: Vec<Validation>,
}

/// First sample of the last 10 % of a run: what a fit without validation runs holds out.
pub fn hold_out_from(n_samples: usize) -> usize {
    n_samples - n_samples / 10
}

/// Context before a held-out stretch: several ring-downs of any rig at its usual sample rate.
const CONTEXT_SAMPLES: usize = 8192;

/// Share of a fit's time that the FRF part is shown to take when an LSTM follows.
const FRF_SHARE: f64 = 0.03;

impl Pair {
    /// Splits off the last 10 %: the training part, in the same memory, and the rest with context
    /// before it.
    pub fn hold_out(self) -> (Pair, Validation) {
        let n = self.x.n_samples();
        let at = hold_out_from(n);
        let context = at.saturating_sub(CONTEXT_SAMPLES);
        let pair = Pair { x: self.x.slice(context..n), y: self.y.slice(context..n) };
        let kept = Pair { x: self.x.truncated(at), y: self.y.truncated(at) };
        (kept, Validation { pair, score_from: at - context })
    }

    fn filtered(&self, preprocess: &Preprocess) -> Result<Pair, EngineError> {
        Ok(Pair { x: preprocess.apply(&self.x)?, y: preprocess.apply(&self.y)? })
    }
}

/// What a fit found; stored and shown with the model. All figures on validation data.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct FitReport {
    /// Filter used.
    pub preprocess: Preprocess,
    /// FRF settings used, none left open.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub frf: Option<FrfSettings>,
    /// LSTM settings used.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub lstm: Option<LstmSettings>,
    /// RMS error per output, in the order of the outputs; `None` where the output is all zero.
    pub validation_rms: Vec<Option<f64>>,
    /// Recombination used.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub recombine: Option<Recombine>,
    /// Each seed's network.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub seeds: Vec<SeedReport>,
    /// Seed whose network was kept.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub best_seed: Option<u64>,
    /// Averages of the FRF estimate.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub frf_averages: Option<usize>,
    /// Seconds of training data.
    pub training_s: f64,
    /// Seconds of validation data that are scored.
    pub validation_s: f64,
    /// What an engineer should know: correlated drives, few averages, dead band.
    pub warnings: Vec<String>,
}

/// One seed's training.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct SeedReport {
    /// Seed.
    pub seed: u64,
    /// Epoch whose weights were kept, from 1; 0 is the start itself.
    pub best_epoch: usize,
    /// Its mean squared error on validation windows, standardised.
    pub validation_mse: f64,
    /// Learning curve: `[epoch, training MSE, validation MSE]`, at most a few hundred points.
    pub curve: Vec<(usize, f64, f64)>,
}

/// A fit's result.
#[derive(Debug, Clone, PartialEq)]
pub struct Fitted {
    /// The model.
    pub model: RigModel,
    /// How it came about.
    pub report: FitReport,
}

/// Fits a model.
///
/// The result depends on data, settings, seeds and the machine's instruction set only, bit for
/// bit, whatever the number of threads.
///
/// # Errors
/// Data that do not fit the settings, dead channels, too few samples, divergence, cancellation.
pub fn fit(data: &FitData, settings: &FitSettings, watch: Watch<'_>) -> Result<Fitted, EngineError> {
    fit_resumable(data, settings, &Forget, watch)
}

/// [`fit`], going on from what an interrupted call with the same data and settings has put by.
///
/// # Errors
/// As [`fit`].
pub fn fit_resumable(
    data: &FitData,
    settings: &FitSettings,
    keeper: &dyn Keeper,
    watch: Watch<'_>,
) -> Result<Fitted, EngineError> {
    let kind = settings.kind;
    check(data, settings)?;
    report(watch, "filter", 0.0)?;
    let data = filtered(data, &settings.preprocess)?;
    refuse_dead_channels(&data.training)?;

    let mut warnings = Vec::new();
    let frf_share = if kind == ModelKind::Frf { 1.0 } else { FRF_SHARE };
    let (frf, frf_settings, frf_averages) = if kind == ModelKind::Lstm {
        (None, None, None)
    } else {
        let runs: Vec<_> = data.frf.as_ref().unwrap_or(&data.training).iter().map(|p| (&p.x, &p.y)).collect();
        let scaled = |p: Progress<'_>| watch(Progress { stage: p.stage, fraction: p.fraction * frf_share });
        let estimate = frf::estimate(&runs, &settings.frf, &scaled)?;
        warnings.extend(estimate.warnings);
        (Some(estimate.frf), Some(estimate.settings), Some(estimate.n_averages))
    };

    let mut model = RigModel {
        kind,
        inputs: settings.inputs.clone(),
        outputs: settings.outputs.clone(),
        sample_rate_hz: data.training[0].x.sample_rate_hz(),
        // The data are filtered already; the model's own filter is set last.
        preprocess: Preprocess::default(),
        frf,
        lstm: None,
        range: input_ranges(&data.training),
        effects: Vec::new(),
    };
    let mut lstm_settings = None;
    let mut seeds = Vec::new();
    if kind != ModelKind::Frf {
        let run_lens: Vec<_> = data.training.iter().map(|p| p.x.n_samples()).collect();
        let resolved = settings.lstm.resolve(settings.preset, kind, &run_lens)?;
        let from = if kind == ModelKind::Lstm { 0.0 } else { FRF_SHARE };
        let (part, reports) = fit_lstm(&data, &model, &resolved, from, keeper, watch)?;
        model.lstm = Some(part);
        seeds = reports;
        lstm_settings = Some(resolved);
    }
    report(watch, "validation", 0.99)?;
    let validation_rms = validation_rms(&model, &data.validation)?;
    model.preprocess = settings.preprocess;
    report(watch, "done", 1.0)?;
    let seconds = |samples: usize| samples as f64 / model.sample_rate_hz;
    Ok(Fitted {
        report: FitReport {
            preprocess: settings.preprocess,
            frf: frf_settings,
            lstm: lstm_settings,
            validation_rms,
            recombine: model.lstm.as_ref().map(|l| l.recombine),
            best_seed: best(&seeds).map(|s| s.seed),
            seeds,
            frf_averages,
            training_s: seconds(data.training.iter().map(|p| p.x.n_samples()).sum()),
            validation_s: seconds(data.validation.iter().map(|v| v.pair.x.n_samples() - v.score_from).sum()),
            warnings,
        },
        model,
    })
}

/// Every run has the settings' channels, one sample rate and equally long halves.
fn check(data: &FitData, settings: &FitSettings) -> Result<(), EngineError> {
    let all = || {
        let frf = data.frf.iter().flatten();
        data.training.iter().chain(frf).chain(data.validation.iter().map(|v| &v.pair))
    };
    let Some(first) = data.training.first() else {
        return Err(EngineError::TooShort { what: "training runs", needed: 1, found: 0 });
    };
    let rate = first.x.sample_rate_hz();
    for pair in all() {
        for (what, signal, names) in
            [("inputs", &pair.x, &settings.inputs), ("outputs", &pair.y, &settings.outputs)]
        {
            if signal.n_channels() != names.len() {
                return Err(EngineError::ChannelCount {
                    what,
                    expected: names.len(),
                    found: signal.n_channels(),
                });
            }
            if !Signal::same_rate(signal.sample_rate_hz(), rate) {
                return Err(EngineError::SampleRate {
                    what,
                    expected_hz: rate,
                    found_hz: signal.sample_rate_hz(),
                });
            }
        }
        if pair.x.n_samples() != pair.y.n_samples() {
            return Err(EngineError::UnequalLength {
                what: "outputs",
                channel: 0,
                expected: pair.x.n_samples(),
                found: pair.y.n_samples(),
            });
        }
    }
    if data.validation.iter().all(|v| v.score_from >= v.pair.x.n_samples()) {
        return Err(EngineError::TooShort { what: "validation data", needed: 1, found: 0 });
    }
    settings.preprocess.check(rate)
}

fn filtered<'a>(data: &'a FitData, preprocess: &Preprocess) -> Result<Cow<'a, FitData>, EngineError> {
    // Hours of data are not copied for nothing.
    if preprocess.is_none() {
        return Ok(Cow::Borrowed(data));
    }
    let all = |pairs: &[Pair]| pairs.iter().map(|p| p.filtered(preprocess)).collect::<Result<_, _>>();
    Ok(Cow::Owned(FitData {
        training: all(&data.training)?,
        frf: data.frf.as_deref().map(all).transpose()?,
        validation: data
            .validation
            .iter()
            .map(|v| Ok(Validation { pair: v.pair.filtered(preprocess)?, score_from: v.score_from }))
            .collect::<Result<_, EngineError>>()?,
    }))
}

/// A fit needs power in every channel, in at least one run.
fn refuse_dead_channels(training: &[Pair]) -> Result<(), EngineError> {
    fn half<'a>(
        training: &'a [Pair],
        what: &'static str,
        of: impl Fn(&'a Pair) -> &'a Signal,
    ) -> Result<(), EngineError> {
        let moves = |samples: &[f64]| {
            let size = samples.iter().fold(0.0_f64, |a, v| a.max(v.abs()));
            samples.iter().any(|v| (v - samples[0]).abs() > 1e-12 * size)
        };
        match (0..of(&training[0]).n_channels())
            .find(|&channel| !training.iter().any(|pair| moves(of(pair).channel(channel))))
        {
            Some(channel) => Err(EngineError::DeadChannel { what, channel }),
            None => Ok(()),
        }
    }
    half(training, "inputs", |pair| &pair.x)?;
    half(training, "outputs", |pair| &pair.y)
}

fn input_ranges(training: &[Pair]) -> Vec<InputRange> {
    let x = &training[0].x;
    (0..x.n_channels())
        .map(|c| InputRange::of(training.iter().map(|p| p.x.channel(c)), x.sample_rate_hz()))
        .collect()
}

/// Trains one network per seed and keeps the best; `model` brings the FRF part.
fn fit_lstm(
    data: &FitData,
    model: &RigModel,
    settings: &LstmSettings,
    from: f64,
    keeper: &dyn Keeper,
    watch: Watch<'_>,
) -> Result<(LstmPart, Vec<SeedReport>), EngineError> {
    let kind = model.kind;
    let linear = |x: &Signal| model.frf.as_ref().map(|frf| frf.apply(x)).transpose();
    let pairs = || data.training.iter().chain(data.validation.iter().map(|v| &v.pair));
    let linear: Vec<Option<Signal>> = pairs().map(|p| linear(&p.x)).collect::<Result<_, _>>()?;
    let targets: Vec<Cow<'_, Signal>> =
        pairs().zip(&linear).map(|(p, l)| target(kind, &p.y, l.as_ref())).collect::<Result<_, _>>()?;

    let n = data.training.len();
    let mut x_scaler = Scaler::of(&data.training.iter().map(|p| &p.x).collect::<Vec<_>>());
    if kind == ModelKind::Hybrid2 {
        let more = Scaler::of(&linear[..n].iter().flatten().collect::<Vec<_>>());
        x_scaler.mean.extend(more.mean);
        x_scaler.std.extend(more.std);
    }
    let y_scaler = Scaler::of(&targets[..n].iter().map(|t| &**t).collect::<Vec<_>>());
    // One run after the other, so that what it is made from goes as soon as it is made.
    let stretches: Vec<Stretch> = pairs()
        .zip(linear.into_iter().zip(targets))
        .enumerate()
        .map(|(i, (pair, (linear, target)))| {
            let linear = linear.as_ref().map(Signal::channels);
            Stretch {
                x: network_inputs(&x_scaler, kind, &pair.x, 0..pair.x.n_samples(), linear),
                y: target.channels().iter().enumerate().map(|(c, y)| y_scaler.standardise(c, y)).collect(),
                score_from: if i < n { 0 } else { data.validation[i - n].score_from },
            }
        })
        .collect();
    let (training, validation) = stretches.split_at(n);

    let trained =
        train_seeds(training, validation, (kind, &x_scaler, &y_scaler), settings, from, keeper, watch)?;
    let reports: Vec<SeedReport> =
        trained.iter().zip(&settings.seeds).map(|(t, &seed)| seed_report(seed, t)).collect();
    drop(stretches);
    let best = best(&reports).and_then(|b| reports.iter().position(|r| r.seed == b.seed)).unwrap_or(0);
    let mut part = LstmPart {
        net: trained[best].net.clone(),
        x: x_scaler,
        y: y_scaler,
        window_len: settings.window_len,
        hop: settings.hop,
        recombine: Recombine::Welch,
    };
    part.recombine = match settings.recombine {
        RecombineChoice::Welch => Recombine::Welch,
        RecombineChoice::Stream => Recombine::Stream,
        RecombineChoice::Auto => better_recombination(data, model, &part)?,
    };
    Ok((part, reports))
}

/// What the network is to produce: the output, for hybrid 1 the FRF's error (section 2.3).
fn target<'a>(
    kind: ModelKind,
    y: &'a Signal,
    linear: Option<&Signal>,
) -> Result<Cow<'a, Signal>, EngineError> {
    match (kind, linear) {
        (ModelKind::Hybrid1, Some(linear)) => {
            let error = |(y, l): (&Vec<f64>, &Vec<f64>)| y.iter().zip(l).map(|(y, l)| y - l).collect();
            let error = y.channels().iter().zip(linear.channels()).map(error).collect();
            Ok(Cow::Owned(Signal::new(y.sample_rate_hz(), error)?))
        }
        _ => Ok(Cow::Borrowed(y)),
    }
}

fn train_seeds(
    training: &[Stretch],
    validation: &[Stretch],
    (kind, x, y): (ModelKind, &Scaler, &Scaler),
    settings: &LstmSettings,
    from: f64,
    keeper: &dyn Keeper,
    watch: Watch<'_>,
) -> Result<Vec<Trained>, EngineError> {
    let n = settings.seeds.len();
    let stage = format!("LSTM {:?}, {n} seed{}", settings.blocks, if n == 1 { "" } else { "s" });
    let done: Vec<AtomicU64> = (0..n).map(|_| AtomicU64::new(0)).collect();
    settings
        .seeds
        .par_iter()
        .enumerate()
        .map(|(i, &seed)| {
            let tell = |p: Progress<'_>| -> ControlFlow<()> {
                done[i].store((p.fraction * 1e6) as u64, Ordering::Relaxed);
                let sum: u64 = done.iter().map(|d| d.load(Ordering::Relaxed)).sum();
                let mean = sum as f64 / (1e6 * n as f64);
                watch(Progress { stage: &stage, fraction: from + (0.98 - from) * mean })
            };
            let start = start(kind, x, y, settings, seed);
            let part = format!("seed {i}");
            lstm::train(training, validation, &start, (settings, seed), (keeper, &part), &tell)
        })
        .collect()
}

/// At most this many points of a learning curve are kept.
const CURVE_POINTS: usize = 300;

fn seed_report(seed: u64, trained: &Trained) -> SeedReport {
    let step = trained.history.len().div_ceil(CURVE_POINTS).max(1);
    SeedReport {
        seed,
        best_epoch: trained.best_epoch,
        validation_mse: trained.validation_mse,
        curve: trained
            .history
            .iter()
            .filter(|e| e.epoch % step == 0 || e.epoch == trained.best_epoch)
            .map(|e| (e.epoch, e.training_mse, e.validation_mse))
            .collect(),
    }
}

/// Lowest validation error; of equals the first.
fn best(seeds: &[SeedReport]) -> Option<&SeedReport> {
    seeds.iter().reduce(|a, b| if b.validation_mse < a.validation_mse { b } else { a })
}

fn better_recombination(data: &FitData, model: &RigModel, part: &LstmPart) -> Result<Recombine, EngineError> {
    let error = |recombine| -> Result<f64, EngineError> {
        let lstm = Some(LstmPart { recombine, ..part.clone() });
        let rms = validation_rms(&RigModel { lstm, ..model.clone() }, &data.validation)?;
        Ok(rms.iter().flatten().sum())
    };
    Ok(if error(Recombine::Stream)? < error(Recombine::Welch)? {
        Recombine::Stream
    } else {
        Recombine::Welch
    })
}

/// RMS error per output over the scored parts of all stretches taken together.
fn validation_rms(model: &RigModel, validation: &[Validation]) -> Result<Vec<Option<f64>>, EngineError> {
    let predicted: Vec<Signal> =
        validation.iter().map(|v| model.predict(&v.pair.x)).collect::<Result<_, _>>()?;
    Ok((0..model.outputs.len())
        .map(|channel| {
            let scored = |of: &dyn Fn(usize) -> Vec<f64>| -> Vec<f64> {
                (0..validation.len())
                    .flat_map(|i| of(i).split_off(validation[i].score_from.min(of(i).len())))
                    .collect()
            };
            let p = scored(&|i| predicted[i].channel(channel).to_vec());
            let m = scored(&|i| validation[i].pair.y.channel(channel).to_vec());
            metrics::rms(&m, &p)
        })
        .collect())
}
