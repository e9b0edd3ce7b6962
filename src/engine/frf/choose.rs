//! Segment length and ridge by how well a held-out stretch is predicted.

use std::ops::Range;

use super::data::{Data, means};
use super::estimate::{Means, solve};
use super::lines::Lines;
use super::{Estimator, FrfFilter, FrfSettings};
use crate::engine::progress::{Watch, report};
use crate::engine::spectral::cross_spectra;
use crate::engine::{EngineError, Signal};

/// Ridges tried when none is given.
const RIDGES: [f64; 6] = [0.0, 1e-6, 1e-5, 1e-4, 1e-3, 1e-2];
/// Ridge when there is too little data to hold any out.
const CAUTIOUS_RIDGE: f64 = 1e-4;
/// Averages per input below which coherence and confidence mean little.
pub(super) const ENOUGH_AVERAGES: usize = 4;
/// Shortest segment tried.
const SHORTEST: usize = 32;
/// Spectral matrices of one estimate may take this much when the length is ours to choose.
const MAX_BYTES: usize = 1 << 29;
/// Held out is one part in so many of each run: the last one, or
const FOLDS: usize = 8;
/// each in turn when all runs together have no more samples than this. One eighth of two seconds
/// says little, and short data cost little.
const SHORT_DATA: usize = 100_000;

/// Settings without gaps.
pub(super) struct Choice {
    pub segment_len: usize,
    pub ridge: f64,
    pub warnings: Vec<String>,
}

/// One part of a run.
fn fold_range(fold: usize, n_samples: usize) -> Range<usize> {
    fold * n_samples / FOLDS..(fold + 1) * n_samples / FOLDS
}

/// Fills what `settings` leave open.
///
/// # Errors
/// [`EngineError::TooFewAverages`] when no segment length leaves more averages than inputs.
pub(super) fn choose(
    data: &Data<'_>,
    settings: &FrfSettings,
    watch: Watch<'_>,
) -> Result<Choice, EngineError> {
    let averages = |len: usize| data.n_averages(&settings.welch(len));
    let lengths: Vec<usize> = match settings.segment_len {
        Some(len) => vec![len],
        None => candidates(data, settings),
    };
    let ridges: &[f64] = match &settings.ridge {
        Some(ridge) => std::slice::from_ref(ridge),
        None if settings.estimator == Estimator::Ratio => &RIDGES[..1],
        None => &RIDGES,
    };
    let n_samples: usize = data.runs.iter().map(|(x, _)| x.n_samples()).sum();
    let folds = if n_samples <= SHORT_DATA { 0..FOLDS } else { FOLDS - 1..FOLDS };
    let held_out: Vec<HeldOut<'_>> = folds.map(|fold| HeldOut::new(data, fold)).collect();
    let comparable: Vec<usize> = lengths
        .iter()
        .copied()
        .filter(|&len| held_out.iter().all(|h| h.leaves_enough(settings, len)))
        .collect();
    let comparisons = comparable.len() * ridges.len();
    if comparisons == 0 {
        let segment_len = match settings.segment_len {
            Some(len) => len,
            None => longest(data, settings).unwrap_or(FrfSettings::MIN_SEGMENT_LEN),
        };
        if averages(segment_len) <= data.n_inputs {
            let (averages, drives) = (averages(segment_len), data.n_inputs);
            return Err(EngineError::TooFewAverages { averages, drives });
        }
        let (ridge, warnings) = match (settings.ridge, settings.estimator) {
            (Some(ridge), _) => (ridge, Vec::new()),
            (None, Estimator::Ratio) => (0.0, Vec::new()),
            (None, Estimator::H1) => (
                CAUTIOUS_RIDGE,
                vec![format!("too few samples to hold a stretch out: frf.ridge set to {CAUTIOUS_RIDGE:e}")],
            ),
        };
        return Ok(Choice { segment_len, ridge, warnings });
    }
    if comparisons == 1 {
        return Ok(Choice { segment_len: comparable[0], ridge: ridges[0], warnings: Vec::new() });
    }

    let (longest, n_folds) = (comparable[comparable.len() - 1], held_out.len() as f64);
    let mut best: Option<(f64, usize, f64)> = None;
    for (done, &len) in comparable.iter().enumerate() {
        let mut scores = vec![Some(Score::new(data.n_outputs)); ridges.len()];
        for (fold, held_out) in held_out.iter().enumerate() {
            let part = done as f64 + fold as f64 / n_folds;
            report(watch, "FRF", 0.9 * part / comparable.len() as f64)?;
            held_out.score(settings, len, longest, ridges, &mut scores)?;
        }
        for (score, &ridge) in scores.iter().zip(ridges) {
            let Some(error) = score.as_ref().map(Score::error) else { continue };
            // Ties go to the shorter segment and the smaller ridge.
            if best.is_none_or(|(least, ..)| error < least) {
                best = Some((error, len, ridge));
            }
        }
    }
    // Nothing to compare when no ridge is allowed that dependent inputs need: the estimate says so.
    let (_, segment_len, ridge) = best.unwrap_or((0.0, comparable[0], ridges[0]));
    Ok(Choice { segment_len, ridge, warnings: Vec::new() })
}

/// Powers of two that leave [`ENOUGH_AVERAGES`] a drive and fit into memory.
fn candidates(data: &Data<'_>, settings: &FrfSettings) -> Vec<usize> {
    let per_line = data.n_inputs * (data.n_inputs + 2 * data.n_outputs) + data.n_outputs;
    (0..usize::BITS - 1)
        .map(|bit| 1_usize << bit)
        .skip_while(|&len| len < SHORTEST)
        .take_while(|&len| {
            data.n_averages(&settings.welch(len)) >= ENOUGH_AVERAGES * data.n_inputs
                && (len / 2 + 1).saturating_mul(16 * per_line) <= MAX_BYTES
        })
        .collect()
}

/// Longest power of two that leaves more averages than drives.
fn longest(data: &Data<'_>, settings: &FrfSettings) -> Option<usize> {
    (0..usize::BITS - 1)
        .map(|bit| 1_usize << bit)
        .skip_while(|&len| len < FrfSettings::MIN_SEGMENT_LEN)
        .take_while(|&len| data.n_averages(&settings.welch(len)) > data.n_inputs)
        .last()
}

/// Sums of squares per output over the held-out stretches of all runs.
#[derive(Clone)]
struct Score {
    error: Vec<f64>,
    /// About the working point.
    power: Vec<f64>,
}

impl Score {
    fn new(n_outputs: usize) -> Self {
        Self { error: vec![0.0; n_outputs], power: vec![0.0; n_outputs] }
    }

    /// Mean logarithm of the relative error: a percent less counts the same at each output.
    fn error(&self) -> f64 {
        let relative = |(error, power): (&f64, &f64)| (error / power).max(f64::MIN_POSITIVE).ln();
        let moving = self.error.iter().zip(&self.power).filter(|(_, power)| **power > 0.0);
        let (sum, n) = moving.fold((0.0, 0_usize), |(sum, n), pair| (sum + relative(pair), n + 1));
        sum / n.max(1) as f64
    }
}

/// One part of each run, and the working point of the rest.
struct HeldOut<'a> {
    data: &'a Data<'a>,
    fold: usize,
    means: Means,
}

impl<'a> HeldOut<'a> {
    fn new(data: &'a Data<'a>, fold: usize) -> Self {
        Self { data, fold, means: means(&data.without(|n| fold_range(fold, n))) }
    }

    /// Whether the rest gives more averages than inputs.
    fn leaves_enough(&self, settings: &FrfSettings, len: usize) -> bool {
        let (welch, rest) = (settings.welch(len), self.data.without(|n| fold_range(self.fold, n)));
        let averages: usize = rest.iter().map(|s| welch.n_segments(s.x[0].len())).sum();
        averages > self.data.n_inputs
    }

    /// Estimates on the rest, predicts this part, and adds to the score of each ridge; `None` where
    /// a ridge cannot separate the inputs. The spectra of one segment length serve all ridges.
    fn score(
        &self,
        settings: &FrfSettings,
        len: usize,
        longest: usize,
        ridges: &[f64],
        scores: &mut [Option<Score>],
    ) -> Result<(), EngineError> {
        let data = self.data;
        let rest = data.without(|n| fold_range(self.fold, n));
        let spectra = cross_spectra(&rest, &self.means, &settings.welch(len), data.sample_rate_hz)?;
        let lines = Lines::new(&spectra, &data.x_scale)?;
        for (&ridge, score) in ridges.iter().zip(scores) {
            let frf = match solve(data, &lines, &self.means, settings.estimator, ridge, len) {
                Ok((frf, _)) => frf,
                // A larger ridge may tell them apart.
                Err(EngineError::DependentInputs { .. }) => {
                    *score = None;
                    continue;
                }
                Err(error) => return Err(error),
            };
            let Some(score) = score else { continue };
            let filter = frf.filter()?;
            for run in data.runs {
                self.add(&filter, run, longest, score)?;
            }
        }
        Ok(())
    }

    /// Adds one run. Where the part begins or ends with the run, half of the longest candidate is
    /// not scored (but no more than a quarter of the part): there a prediction is judged by the
    /// values held beyond the ends, a long segment more than a short one.
    fn add(
        &self,
        filter: &FrfFilter,
        (x, y): &(&Signal, &Signal),
        longest: usize,
        score: &mut Score,
    ) -> Result<(), EngineError> {
        let n = x.n_samples();
        let Range { start, end } = fold_range(self.fold, n);
        let margin = (longest / 2).min((end - start) / 4);
        let scored = start + if start == 0 { margin } else { 0 }..end - if end == n { margin } else { 0 };
        if scored.is_empty() {
            return Ok(());
        }
        let known = start.saturating_sub(longest)..n.min(end + longest);
        let predicted = filter.apply(&x.slice(known.clone()))?;
        for (o, mean) in self.means.y.iter().enumerate() {
            let measured = &y.channel(o)[scored.clone()];
            let found = &predicted.channel(o)[scored.start - known.start..scored.end - known.start];
            score.error[o] += measured.iter().zip(found).map(|(m, f)| (m - f).powi(2)).sum::<f64>();
            score.power[o] += measured.iter().map(|m| (m - mean).powi(2)).sum::<f64>();
        }
        Ok(())
    }
}
