//! Drive-file iteration on a model: the drive whose predicted response is the target.
//!
//! `u <- u + G H^+ (target - predicted(u))` (De Cuyper, "Linear feedback control for durability test rigs", 2006,
//! chapter 2), with `H^+` the regularised inverse of the model's linear part and `G` a gain for each target and
//! line. A correction that makes the weighted error grow is taken back and tried again with less gain where the
//! error grew, so the best drive so far is never lost. Where that leads no further, a model with a network goes on by
//! its own gradient.

mod correction;
mod gradient;
mod limits;
mod linear;
mod outside;
mod settings;
#[cfg(test)]
mod tests;

use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use super::fatigue::{DamageRatio, damage};
use super::metrics::rms;
use super::model::{InputRange, Predictor};
use super::progress::{Progress, Watch, report};
use super::{EngineError, Signal};
use correction::Correction;
use gradient::Descent;
use limits::hold;
use linear::Linear;
use outside::{excess, taken_back};

pub use linear::LinearPart;
pub use settings::{DriveLimit, GainBand, IterationSettings, MAX_ITERATIONS, Outside, StopAt};

/// Stage of the work before the first iteration.
const LINEAR_PART: &str = "linear part";

/// Relative fall of the weighted error below which an iteration gained nothing.
const NOTHING_GAINED: f64 = 1e-3;

/// Iterations in a row without gain after which the search ends.
const PATIENCE: usize = 4;

/// Growth of the error above which attempts that all made it worse are called divergence.
const GREW: f64 = 1.1;

/// A target and the model that shall reproduce it.
#[derive(Debug, Clone, Copy)]
pub struct Problem<'a> {
    /// The model. Its inputs are the drives.
    pub predictor: &'a Predictor,
    /// Outputs of the model that have a target, in the target's order.
    pub outputs: &'a [usize],
    /// The wanted response, `[target][sample]`, as measured.
    pub target: &'a Signal,
    /// Weight of each target's error, above 0.
    pub weights: &'a [f64],
    /// Factor on the gain of each target's correction, 0..=2.
    pub gains: &'a [f64],
    /// Limits of each drive.
    pub limits: &'a [DriveLimit],
}

/// Where the search begins.
#[derive(Debug, Clone, PartialEq)]
pub enum Start {
    /// No drive.
    Zero,
    /// The drive that the linear part alone would take.
    Inverse,
    /// This drive, `[drive][sample]`, as long as the target.
    Drive(Signal),
}

/// One iteration: a drive and what the model says to it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Step {
    /// 0 is the start drive.
    pub iteration: usize,
    /// How this drive was found.
    pub kind: StepKind,
    /// RMS error of each target, relative to its RMS; none where a target is zero.
    pub error: Vec<Option<f64>>,
    /// Weighted root mean square over the targets of these errors.
    pub total_error: f64,
    /// Predicted over target damage of each target.
    pub damage: Vec<DamageRatio>,
    /// Share of the samples at which all drives are inside what the model was fitted on.
    pub inside: f64,
    /// Largest magnitude of each drive.
    pub drive_peak: Vec<f64>,
    /// Share of each drive's samples that its limits changed.
    pub limited: Vec<f64>,
    /// Mean factor on the gains asked for with which this drive was found; 1 for the start. Of a step by gradient, its
    /// length: 1 is the linear correction where the model is its FRF.
    pub gain: f64,
    /// Whether it is better than all before.
    pub better: bool,
}

/// How a drive was found.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum StepKind {
    /// The search began with it.
    Start,
    /// By the inverse FRF of the best one's error.
    Linear,
    /// By the model's own gradient at the best one.
    Gradient,
}

/// Why a search ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Stopped {
    /// The error is as small as was asked for.
    Error,
    /// The damage ratios are as was asked for.
    DamageRatio,
    /// As many iterations as were asked for.
    Iterations,
    /// The last iterations gained next to nothing.
    Settled,
    /// The last iterations made it worse, whatever the gain.
    Diverged,
}

/// The best drive and the way to it.
#[derive(Debug, Clone, PartialEq)]
pub struct Found {
    /// The best drive, `[drive][sample]`.
    pub drive: Signal,
    /// What the model says to it, all its outputs.
    pub response: Signal,
    /// All iterations, in order.
    pub steps: Vec<Step>,
    /// The best of them.
    pub best: usize,
    /// Why there is no further one.
    pub stopped: Stopped,
    /// First and last frequency of the corrections, Hz; none where nothing is corrected.
    pub band_hz: Option<[f64; 2]>,
    /// Share of each target's power that the corrections do not reach, 0..=1.
    pub out_of_reach: Vec<f64>,
    /// Where the FRF of the corrections is from.
    pub linear: LinearPart,
}

/// Finds the drive for a target.
///
/// # Errors
/// Settings outside their limits, a target that is zero throughout, a start drive of another shape, an FRF that
/// reaches no frequency, a prediction that is not finite at the start, [`EngineError::Cancelled`].
///
/// # Panics
/// If outputs, weights, gains or limits are not one a channel.
pub fn iterate(
    problem: &Problem<'_>,
    start: &Start,
    settings: &IterationSettings,
    watch: Watch<'_>,
) -> Result<Found, EngineError> {
    settings.check()?;
    report(watch, LINEAR_PART, 0.0)?;
    let model = problem.predictor.model();
    assert_eq!(problem.limits.len(), model.inputs.len(), "one limit a drive");
    let n_targets = problem.outputs.len();
    assert!(problem.weights.len() == n_targets && problem.gains.len() == n_targets, "one a target");
    let target = model.preprocess.apply(problem.target)?;
    let scale = Scale::of(&target, problem.weights)?;
    // Parts of the work only ask whether to go on.
    let first = |_: Progress<'_>| watch(Progress::new(LINEAR_PART, 0.0));
    let linear = Linear::of(problem.predictor, problem.outputs, &first)?;
    let mut correction = Correction::new(&linear, problem, settings)?;
    let band_hz = correction.band_hz();
    if band_hz.is_none() {
        return Err(EngineError::Setting {
            setting: "band_hz",
            found: "a band in which the FRF is not reliable at any line".into(),
            limit: "a band with lines of coherence above min_coherence".into(),
        });
    }
    let out_of_reach = out_of_reach(&correction, &target)?;
    let target_damage =
        target.channels().iter().map(|t| damage(t, &settings.damage)).collect::<Result<_, _>>()?;
    let taper = taper(settings, &target);
    let ranges = counted(&model.range, settings.outside);
    let search = Search { problem, settings, target: &target, target_damage, scale, taper, ranges };
    let drive = match start {
        Start::Zero => {
            Signal::new(model.sample_rate_hz, vec![vec![0.0; target.n_samples()]; model.inputs.len()])?
        }
        Start::Inverse => correction.start(&target)?,
        Start::Drive(drive) => drive.clone(),
    };
    let mut best = search.look((0, StepKind::Start, 1.0), drive, &first)?;
    best.step.better = true;
    let mut power = correction.powers(&best.error)?;
    let mut steps = vec![best.step.clone()];
    let (mut idle, mut worse) = (0, 0);
    // Error of the first of the last attempts that made it worse, relative to the best.
    let mut grew = 1.0_f64;
    let mut descent: Option<Descent> = None;
    // The best iteration when linear corrections diverged.
    let mut diverged_at = None;
    let stopped = loop {
        let k = steps.len();
        if let Some(reached) = reached(&best.step, &settings.stop) {
            break reached;
        }
        if k > settings.iterations {
            break Stopped::Iterations;
        }
        if worse == PATIENCE || idle == PATIENCE {
            if descent.is_none() && worse == PATIENCE && grew > GREW {
                diverged_at = Some(best.step.iteration);
            }
            let next = if descent.is_none() { search.descent(&correction)? } else { None };
            if next.is_none() {
                break stalled(diverged_at, &best.step);
            }
            (descent, idle, worse) = (next, 0, 0);
        }
        let stage = format!("iteration {k}, error {:.2} %", 100.0 * best.step.total_error);
        let fraction = k as f64 / (settings.iterations + 1) as f64;
        report(watch, &stage, fraction)?;
        let go_on = |_: Progress<'_>| watch(Progress::new(&stage, fraction));
        let (kind, drive, gain) = match &mut descent {
            None => (StepKind::Linear, search.corrected(&best, &correction)?, correction.mean_factor()),
            Some(descent) => {
                if descent.needs_gradient() && !descent.aim(search.gradient(&best, &go_on)?, best.square)? {
                    break stalled(diverged_at, &best.step);
                }
                (StepKind::Gradient, descent.step(&best.drive)?, descent.length())
            }
        };
        let mut tried = match search.look((k, kind, gain), drive, &go_on) {
            Ok(tried) => tried,
            // A drive so large that the model leaves all numbers; the best one is still there.
            Err(EngineError::NonFiniteResult { .. }) => {
                match &mut descent {
                    None => correction.lower(),
                    Some(descent) => descent.shorten(),
                }
                (worse, grew) = (worse + 1, f64::INFINITY);
                continue;
            }
            Err(error) => return Err(error),
        };
        let after = correction.powers(&tried.error)?;
        tried.step.better = tried.score < best.score;
        match &mut descent {
            Some(descent) => descent.learn(best.square, tried.square, tried.step.better),
            None => {
                correction.learn(&power, &after, tried.step.better);
                if !tried.step.better {
                    correction.lower();
                }
            }
        }
        steps.push(tried.step.clone());
        if tried.step.better {
            idle = if tried.score > (1.0 - NOTHING_GAINED) * best.score { idle + 1 } else { 0 };
            (worse, best, power) = (0, tried, after);
        } else {
            if worse == 0 {
                grew = tried.step.total_error / best.step.total_error;
            }
            worse += 1;
        }
    };
    let Tried { drive, response, step, .. } = best;
    let best = step.iteration;
    Ok(Found { drive, response, steps, best, stopped, band_hz, out_of_reach, linear: linear.part })
}

/// The reason to stop where no further step gains anything: the best drive may be the one at which the linear
/// corrections diverged.
fn stalled(diverged_at: Option<usize>, best: &Step) -> Stopped {
    if diverged_at == Some(best.iteration) { Stopped::Diverged } else { Stopped::Settled }
}

/// What of the training's ranges counts: nothing, the values alone, or all of it.
fn counted(ranges: &[InputRange], outside: Outside) -> Vec<InputRange> {
    match outside {
        Outside::Allowed => Vec::new(),
        Outside::Penalised => {
            ranges.iter().map(|range| InputRange { max_rate: f64::INFINITY, ..*range }).collect()
        }
        Outside::Strict => ranges.to_vec(),
    }
}

/// How errors are weighed against each other.
struct Scale {
    /// Sum of squares of each target; of a target that is zero, the largest of the others'.
    power: Vec<f64>,
    /// Weights, their sum 1.
    weight: Vec<f64>,
}

impl Scale {
    fn of(target: &Signal, weights: &[f64]) -> Result<Self, EngineError> {
        let squares = |samples: &Vec<f64>| samples.iter().map(|v| v * v).sum::<f64>();
        let mut power: Vec<f64> = target.channels().iter().map(squares).collect();
        let largest = power.iter().copied().fold(0.0, f64::max);
        if largest <= 0.0 {
            return Err(EngineError::DeadChannel { what: "target", channel: 0 });
        }
        power.iter_mut().filter(|power| **power <= 0.0).for_each(|power| *power = largest);
        let all: f64 = weights.iter().map(|weight| weight * weight).sum();
        let weight = weights.iter().map(|weight| weight * weight / all).collect();
        Ok(Self { power, weight })
    }

    /// Weight of each target's sum of squares in the weighted mean square error.
    fn of_squares(&self) -> Vec<f64> {
        self.weight.iter().zip(&self.power).map(|(weight, power)| weight / power).collect()
    }

    /// Weighted mean square error.
    fn square(&self, error: &Signal) -> f64 {
        let each = error.channels().iter().zip(&self.power).zip(&self.weight);
        each.map(|((error, power), weight)| weight * error.iter().map(|v| v * v).sum::<f64>() / power).sum()
    }
}

/// A drive with what the model says to it.
struct Tried {
    drive: Signal,
    response: Signal,
    /// Target minus response, `[target][sample]`.
    error: Signal,
    /// The weighted mean square error.
    square: f64,
    /// What the search makes small: the weighted mean square error and what the drive leaves of the training.
    score: f64,
    step: Step,
}

struct Search<'a> {
    problem: &'a Problem<'a>,
    settings: &'a IterationSettings,
    target: &'a Signal,
    target_damage: Vec<f64>,
    scale: Scale,
    /// Factors on the corrections, sample by sample.
    taper: Vec<f64>,
    /// What of the training's range of each drive counts; nothing of drives beyond these.
    ranges: Vec<InputRange>,
}

impl Search<'_> {
    /// Takes drives back towards what the model was fitted on, where that is asked for, and holds each within its limits;
    /// shares of the samples that the limits changed.
    fn hold(&self, drive: Signal) -> Result<(Signal, Vec<f64>), EngineError> {
        let predictor = self.problem.predictor;
        let excursions = if self.settings.outside == Outside::Strict {
            predictor.excursions(&predictor.begin(drive.clone())?)
        } else {
            Vec::new()
        };
        let drive = match self.settings.outside {
            Outside::Allowed => drive,
            Outside::Penalised | Outside::Strict => {
                let back = taken_back(drive.clone(), &self.ranges, &excursions)?;
                self.changed(&drive, |channel, t| back.channel(channel)[t] - drive.channel(channel)[t])?
            }
        };
        let rate = drive.sample_rate_hz();
        let mut channels = drive.into_channels();
        let held = channels.iter_mut().zip(self.problem.limits);
        let limited = held.map(|(samples, limit)| hold(samples, rate, limit)).collect();
        Ok((Signal::new(rate, channels)?, limited))
    }

    /// A drive changed by `by(drive, sample)` as far as the taper allows.
    fn changed(&self, drive: &Signal, by: impl Fn(usize, usize) -> f64) -> Result<Signal, EngineError> {
        let of = |(channel, samples): (usize, &Vec<f64>)| {
            let each = samples.iter().zip(&self.taper).enumerate();
            each.map(|(t, (u, taper))| u + by(channel, t) * taper).collect()
        };
        let channels = drive.channels().iter().enumerate().map(of).collect();
        Signal::new(drive.sample_rate_hz(), channels)
    }

    /// The next drive before its limits.
    fn corrected(&self, best: &Tried, correction: &Correction) -> Result<Signal, EngineError> {
        let step = correction.of(&best.error)?;
        self.changed(&best.drive, |channel, t| step.channel(channel)[t])
    }

    /// The search by gradient; none where it is not asked for, and for a model that is linear or has effects.
    fn descent(&self, correction: &Correction) -> Result<Option<Descent>, EngineError> {
        let predictor = self.problem.predictor;
        if !self.settings.gradient || predictor.model().lstm.is_none() || !predictor.has_adjoint() {
            return Ok(None);
        }
        let reachable = correction.reachable(&self.scale.of_squares())?;
        Ok(Some(Descent::new(reachable, self.taper.clone())))
    }

    /// Gradient of the weighted mean square error by the drive, `[drive, sample]`.
    fn gradient(&self, at: &Tried, watch: Watch<'_>) -> Result<Signal, EngineError> {
        let mut weights = vec![vec![0.0; at.drive.n_samples()]; at.response.n_channels()];
        for ((output, error), square) in
            self.problem.outputs.iter().zip(at.error.channels()).zip(self.scale.of_squares())
        {
            let of_sample = weights[*output].iter_mut().zip(error);
            of_sample.for_each(|(weight, error)| *weight = -2.0 * square * error);
        }
        let weights = Signal::new(at.drive.sample_rate_hz(), weights)?;
        self.problem.predictor.adjoint(&at.drive, &weights, watch)
    }

    /// What the model says to a drive: that of an iteration, how it was found, and with which gain.
    fn look(
        &self,
        (iteration, kind, gain): (usize, StepKind, f64),
        drive: Signal,
        watch: Watch<'_>,
    ) -> Result<Tried, EngineError> {
        let (drive, limited) = self.hold(drive)?;
        let predictor = self.problem.predictor;
        let mut prediction = predictor.begin(drive.clone())?;
        let inside = predictor.trust(&prediction).inside;
        let response = predictor.rest(&mut prediction, watch)?;
        let predicted = response.select(self.problem.outputs);
        let difference = |(t, y): (&Vec<f64>, &Vec<f64>)| t.iter().zip(y).map(|(t, y)| t - y).collect();
        let error = self.target.channels().iter().zip(predicted.channels()).map(difference).collect();
        let error = Signal::new(drive.sample_rate_hz(), error)?;
        let square = self.scale.square(&error);
        if !square.is_finite() {
            return Err(EngineError::NonFiniteResult { what: "error", channel: 0, sample: 0 });
        }
        let excursions = if self.settings.outside == Outside::Strict {
            predictor.excursions(&prediction)
        } else {
            Vec::new()
        };
        let beyond = excess(&drive, &self.ranges, &excursions);
        let each = self.target.channels().iter().zip(predicted.channels());
        let errors = each.clone().map(|(t, y)| rms(t, y)).collect();
        let ratios = predicted
            .channels()
            .par_iter()
            .zip(&self.target_damage)
            .enumerate()
            .map(|(channel, (y, target))| {
                let found = DamageRatio::of(damage(y, &self.settings.damage)?, *target);
                match found.ratio {
                    Some(ratio) if !ratio.is_finite() => {
                        Err(EngineError::NonFiniteResult { what: "damage ratio", channel, sample: 0 })
                    }
                    _ => Ok(found),
                }
            })
            .collect::<Result<_, EngineError>>()?;
        let peak = |samples: &Vec<f64>| samples.iter().fold(0.0_f64, |peak, v| peak.max(v.abs()));
        let step = Step {
            iteration,
            kind,
            error: errors,
            total_error: square.sqrt(),
            damage: ratios,
            inside,
            drive_peak: drive.channels().iter().map(peak).collect(),
            limited,
            gain,
            better: false,
        };
        Ok(Tried { drive, response, error, square, score: square + beyond, step })
    }
}

/// The reason to stop at a drive, if it is as good as was asked for.
fn reached(step: &Step, stop: &StopAt) -> Option<Stopped> {
    if stop.error.is_some_and(|most| step.error.iter().flatten().all(|error| *error <= most)) {
        return Some(Stopped::Error);
    }
    let [low, high] = stop.damage_ratio?;
    let within = |damage: &DamageRatio| damage.ratio.is_none_or(|ratio| (low..=high).contains(&ratio));
    step.damage.iter().all(within).then_some(Stopped::DamageRatio)
}

/// Factors on the corrections: half a cosine from 0 at either end over the time of the settings.
fn taper(settings: &IterationSettings, target: &Signal) -> Vec<f64> {
    let n = target.n_samples();
    let long = ((settings.taper_s * target.sample_rate_hz()) as usize).min(n / 2);
    (0..n)
        .map(|i| {
            let from_end = i.min(n - 1 - i);
            if from_end >= long {
                return 1.0;
            }
            0.5 - 0.5 * (std::f64::consts::PI * from_end as f64 / long as f64).cos()
        })
        .collect()
}

/// Share of each target's power that the corrections do not reach.
fn out_of_reach(correction: &Correction, target: &Signal) -> Result<Vec<f64>, EngineError> {
    let density = correction.density(target)?;
    let share = |(density, reach): (&Vec<f64>, &Vec<f64>)| {
        let all: f64 = density.iter().sum();
        let missed: f64 = density.iter().zip(reach).map(|(d, reach)| d * (1.0 - reach).max(0.0)).sum();
        if all > 0.0 { (missed / all).clamp(0.0, 1.0) } else { 0.0 }
    };
    Ok(density.iter().zip(&correction.reach).map(share).collect())
}
