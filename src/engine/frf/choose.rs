//! Segment length and ridge by how well a held-out stretch is predicted.

use rayon::prelude::*;

use super::data::{Data, means};
use super::estimate::{Means, solve};
use super::lines::Lines;
use super::{Estimator, FrfSettings};
use crate::engine::progress::{Watch, report};
use crate::engine::spectral::cross_spectra;
use crate::engine::{EngineError, Signal};

/// Ridges tried when none is given.
const RIDGES: [f64; 4] = [0.0, 1e-6, 1e-4, 1e-2];
/// Ridge when there is too little data to hold any out.
const CAUTIOUS_RIDGE: f64 = 1e-4;
/// Averages per input below which coherence and confidence mean little.
pub(super) const ENOUGH_AVERAGES: usize = 4;
/// Shortest segment tried.
const SHORTEST: usize = 32;
/// Spectral matrices of one estimate may take this much when the length is ours to choose.
const MAX_BYTES: usize = 1 << 29;
/// The last eighth of each run is held out.
const HELD_OUT_SHARE: usize = 8;

/// Settings without gaps.
pub(super) struct Choice {
    pub segment_len: usize,
    pub ridge: f64,
    pub warnings: Vec<String>,
}

/// Samples of a run that stay in the estimate while settings are compared.
fn kept(n_samples: usize) -> usize {
    n_samples - n_samples / HELD_OUT_SHARE
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
    let all = |n: usize| n;
    let averages = |len: usize| data.n_averages(&settings.welch(len), all);
    let lengths: Vec<usize> = match settings.segment_len {
        Some(len) => vec![len],
        None => candidates(data, settings),
    };
    let ridges: &[f64] = match &settings.ridge {
        Some(ridge) => std::slice::from_ref(ridge),
        None if settings.estimator == Estimator::Ratio => &RIDGES[..1],
        None => &RIDGES,
    };
    let open = |len: usize| data.n_averages(&settings.welch(len), kept) > data.n_inputs;
    let comparable: Vec<usize> = lengths.iter().copied().filter(|&len| open(len)).collect();
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

    let held_out = HeldOut::new(data, comparable[comparable.len() - 1]);
    let mut best: Option<(f64, usize, f64)> = None;
    for (done, &len) in comparable.iter().enumerate() {
        report(watch, "FRF", 0.9 * done as f64 / comparable.len() as f64)?;
        for (ridge, error) in held_out.errors(settings, len, ridges)? {
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
            data.n_averages(&settings.welch(len), |n| n) >= ENOUGH_AVERAGES * data.n_inputs
                && (len / 2 + 1).saturating_mul(16 * per_line) <= MAX_BYTES
        })
        .collect()
}

/// Longest power of two that leaves more averages than drives.
fn longest(data: &Data<'_>, settings: &FrfSettings) -> Option<usize> {
    (0..usize::BITS - 1)
        .map(|bit| 1_usize << bit)
        .skip_while(|&len| len < FrfSettings::MIN_SEGMENT_LEN)
        .take_while(|&len| data.n_averages(&settings.welch(len), |n| n) > data.n_inputs)
        .last()
}

/// The stretch that settings are compared on.
struct HeldOut<'a> {
    data: &'a Data<'a>,
    /// The kept part's working point.
    means: Means,
    /// Samples at each run's end that are not scored: there the longest candidate would be
    /// judged by the values held after the end.
    tail: Vec<usize>,
}

impl<'a> HeldOut<'a> {
    fn new(data: &'a Data<'a>, longest: usize) -> Self {
        let means = means(&data.stretches(kept));
        let tail = data
            .runs
            .iter()
            .map(|(x, _)| (longest / 2).min((x.n_samples() - kept(x.n_samples())) / 4))
            .collect();
        Self { data, means, tail }
    }

    /// Mean over the outputs of error / deviation on the held-out stretch, for each ridge. The
    /// spectra of one segment length serve all ridges.
    fn errors(
        &self,
        settings: &FrfSettings,
        len: usize,
        ridges: &[f64],
    ) -> Result<Vec<(f64, f64)>, EngineError> {
        let data = self.data;
        let spectra =
            cross_spectra(&data.stretches(kept), &self.means, &settings.welch(len), data.sample_rate_hz)?;
        let lines = Lines::new(&spectra, &data.x_scale)?;
        let mut errors = Vec::with_capacity(ridges.len());
        for &ridge in ridges {
            let frf = match solve(data, &lines, &self.means, settings.estimator, ridge, len) {
                Ok((frf, _)) => frf,
                // A larger ridge may tell them apart.
                Err(EngineError::DependentInputs { .. }) => continue,
                Err(error) => return Err(error),
            };
            let filter = frf.filter()?;
            let per_run: Vec<Vec<(f64, f64)>> = data
                .runs
                .par_iter()
                .zip(&self.tail)
                .map(|((x, y), tail)| {
                    let (n, from) = (x.n_samples(), kept(x.n_samples()));
                    if from == n {
                        return Ok(vec![(0.0, 0.0); data.n_outputs]);
                    }
                    let context = from.saturating_sub(len);
                    let predicted = filter.apply(&x.slice(context..n))?;
                    Ok(self.score(y, &predicted, context, from..n - tail))
                })
                .collect::<Result<_, EngineError>>()?;
            let (mut total, mut counted) = (0.0, 0_usize);
            for output in 0..data.n_outputs {
                let error: f64 = per_run.iter().map(|run| run[output].0).sum();
                let power: f64 = per_run.iter().map(|run| run[output].1).sum();
                if power > 0.0 {
                    total += (error / power).sqrt();
                    counted += 1;
                }
            }
            errors.push((ridge, total / counted.max(1) as f64));
        }
        Ok(errors)
    }

    /// Sums of squares per output: error, and deviation from the working point.
    fn score(
        &self,
        y: &Signal,
        predicted: &Signal,
        context: usize,
        scored: std::ops::Range<usize>,
    ) -> Vec<(f64, f64)> {
        (0..self.data.n_outputs)
            .map(|output| {
                let measured = &y.channel(output)[scored.clone()];
                let found = &predicted.channel(output)[scored.start - context..scored.end - context];
                let error = measured.iter().zip(found).map(|(m, f)| (m - f).powi(2)).sum();
                let mean = self.means.y[output];
                (error, measured.iter().map(|m| (m - mean).powi(2)).sum())
            })
            .collect()
    }
}
