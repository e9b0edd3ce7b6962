//! The runs of an estimate, checked once.

use std::ops::Range;

use rayon::prelude::*;

use crate::spectral::{Means, Record, Welch, same_shape};
use crate::{EngineError, Signal};

/// A part of one run; the parts of an estimate belong together.
#[derive(Debug, Clone)]
pub struct RunPart<'a> {
    /// Inputs of the whole run.
    pub x: &'a Signal,
    /// Outputs of the whole run, as long.
    pub y: &'a Signal,
    /// The samples that count.
    pub samples: Range<usize>,
}

/// Runs that belong together: input and output equally long, the same channels and sample rate
/// everywhere, every channel moving in at least one run.
pub(super) struct Data<'a> {
    pub runs: Vec<Record<'a>>,
    pub sample_rate_hz: f64,
    pub n_inputs: usize,
    pub n_outputs: usize,
    /// Standard deviation of each input about its runs' means: inputs of different units and
    /// levels are weighed alike once divided by it.
    pub x_scale: Vec<f64>,
    /// Working point: mean of each channel over all samples of all runs.
    pub means: Means,
}

impl<'a> Data<'a> {
    pub fn check(parts: &[RunPart<'a>]) -> Result<Self, EngineError> {
        let Some(RunPart { x, y, .. }) = parts.first() else {
            return Err(EngineError::TooShort { what: "runs of an FRF", needed: 1, found: 0 });
        };
        for part in parts {
            same_shape("frf inputs", x, part.x)?;
            same_shape("frf outputs", y, part.y)?;
            let (expected, found) = (part.x.n_samples(), part.y.n_samples());
            if expected != found {
                return Err(EngineError::UnequalLength { what: "frf outputs", channel: 0, expected, found });
            }
            let (expected_hz, found_hz) = (part.x.sample_rate_hz(), part.y.sample_rate_hz());
            if !Signal::same_rate(expected_hz, found_hz) {
                return Err(EngineError::SampleRate { what: "frf outputs", expected_hz, found_hz });
            }
        }
        let cut = |signal: &'a Signal, samples: &Range<usize>| -> Vec<&'a [f64]> {
            signal.channels().iter().map(|channel| &channel[samples.clone()]).collect()
        };
        let runs: Vec<Record<'a>> = parts
            .iter()
            .map(|part| Record { x: cut(part.x, &part.samples), y: cut(part.y, &part.samples) })
            .collect();
        let (x_mean, x_scale) = moments("frf inputs", &runs.iter().map(|run| &run.x).collect::<Vec<_>>())?;
        let (y_mean, _) = moments("frf outputs", &runs.iter().map(|run| &run.y).collect::<Vec<_>>())?;
        Ok(Self {
            runs,
            sample_rate_hz: x.sample_rate_hz(),
            n_inputs: x.n_channels(),
            n_outputs: y.n_channels(),
            x_scale,
            means: Means { x: x_mean, y: y_mean },
        })
    }

    /// Samples of one run.
    pub fn n_samples(&self, run: usize) -> usize {
        self.runs[run].x[0].len()
    }

    /// Samples of all runs.
    pub fn total_samples(&self) -> usize {
        (0..self.runs.len()).map(|run| self.n_samples(run)).sum()
    }

    /// All samples of all runs.
    pub fn all(&self) -> Vec<Record<'a>> {
        self.runs.iter().map(|run| part(run, 0..run.x[0].len())).collect()
    }

    /// What is left of all runs before and after a range, `range(run, n_samples)`, of each.
    pub fn without(&self, range: impl Fn(usize, usize) -> Range<usize>) -> Vec<Record<'a>> {
        let around = |(index, run): (usize, &Record<'a>)| {
            let n = run.x[0].len();
            let Range { start, end } = range(index, n);
            [part(run, 0..start), part(run, end..n)]
        };
        self.runs.iter().enumerate().flat_map(around).filter(|rest| !rest.x[0].is_empty()).collect()
    }

    /// Segments that all runs give.
    pub fn n_averages(&self, welch: &Welch) -> usize {
        (0..self.runs.len()).map(|run| welch.n_segments(self.n_samples(run))).sum()
    }
}

fn part<'a>(run: &Record<'a>, range: Range<usize>) -> Record<'a> {
    let cut = |channels: &[&'a [f64]]| channels.iter().map(|c| &c[range.clone()]).collect();
    Record { x: cut(&run.x), y: cut(&run.y) }
}

/// Working point: mean of each channel over all samples of all records.
pub(super) fn means(records: &[Record<'_>]) -> Means {
    let x: Vec<&Vec<&[f64]>> = records.iter().map(|s| &s.x).collect();
    let y: Vec<&Vec<&[f64]>> = records.iter().map(|s| &s.y).collect();
    Means { x: channel_means(&x), y: channel_means(&y) }
}

fn channel_means(runs: &[&Vec<&[f64]>]) -> Vec<f64> {
    let count: usize = runs.iter().map(|run| run[0].len()).sum();
    (0..runs[0].len())
        .into_par_iter()
        .map(|c| {
            let sum = |run: &&Vec<&[f64]>| in_lanes(run[c], |sum, v| sum + v).iter().sum::<f64>();
            runs.iter().map(sum).sum::<f64>() / count.max(1) as f64
        })
        .collect()
}

/// Mean of each channel over all runs, and its standard deviation, each run about its own mean.
fn moments(what: &'static str, runs: &[&Vec<&[f64]>]) -> Result<(Vec<f64>, Vec<f64>), EngineError> {
    let n_channels = runs.first().map_or(0, |run| run.len());
    let moments = |channel: usize| {
        let (mut total, mut square, mut count, mut largest) = (0.0, 0.0, 0_usize, 0.0_f64);
        for samples in runs.iter().map(|run| run[channel]) {
            let moments = Moments::of(samples);
            total += moments.mean * samples.len() as f64;
            square += moments.square;
            largest = largest.max(moments.largest);
            count += samples.len();
        }
        let count = count.max(1) as f64;
        let (mean, deviation) = (total / count, (square / count).sqrt());
        if !(mean.is_finite() && deviation.is_finite()) {
            return Err(EngineError::NonFiniteResult { what, channel, sample: 0 });
        }
        // A deviation within the rounding of the sums is that of a constant.
        if deviation <= 1e-12 * largest {
            return Err(EngineError::DeadChannel { what, channel });
        }
        Ok((mean, deviation))
    };
    let all: Vec<Result<(f64, f64), EngineError>> = (0..n_channels).into_par_iter().map(moments).collect();
    // Collected in order first: with several bad channels, the first is always the one named.
    all.into_iter().collect()
}

/// Sums from one pass over a run.
struct Moments {
    mean: f64,
    /// Sum of squared distances from the mean.
    square: f64,
    largest: f64,
}

impl Moments {
    /// Two passes over each block while it is in the first-level cache, the blocks joined pairwise
    /// (Chan, Golub, LeVeque, "Updating formulae and a pairwise algorithm for computing sample
    /// variances", 1979, eq. 1.5): as exact as two passes over all, with half the memory traffic.
    fn of(samples: &[f64]) -> Self {
        const BLOCK: usize = 2048;
        let mut all = Self { mean: 0.0, square: 0.0, largest: 0.0 };
        let mut count = 0.0;
        for block in samples.chunks(BLOCK) {
            let n = block.len() as f64;
            let mean = in_lanes(block, |sum, v| sum + v).iter().sum::<f64>() / n;
            let squares = in_lanes(block, |sum, v| sum + (v - mean) * (v - mean));
            let largest = in_lanes(block, |largest, v| if v.abs() > largest { v.abs() } else { largest });
            let shift = mean - all.mean;
            all.square += squares.iter().sum::<f64>() + shift * shift * count * n / (count + n);
            count += n;
            all.mean += shift * n / count;
            all.largest = largest.into_iter().fold(all.largest, f64::max);
        }
        all
    }
}

/// Folds the samples from zero in eight lanes, since one running value would stall on the latency of each
/// operation.
fn in_lanes(samples: &[f64], fold: impl Fn(f64, f64) -> f64) -> [f64; 8] {
    let mut lanes = [0.0; 8];
    let (chunks, rest) = samples.as_chunks::<8>();
    for chunk in chunks {
        for (lane, &v) in lanes.iter_mut().zip(chunk) {
            *lane = fold(*lane, v);
        }
    }
    for (lane, &v) in lanes.iter_mut().zip(rest) {
        *lane = fold(*lane, v);
    }
    lanes
}
