//! The runs of an estimate, checked once.

use std::ops::Range;

use rayon::prelude::*;

use crate::engine::spectral::{Means, Stretch, Welch, same_shape};
use crate::engine::{EngineError, Signal};

/// Runs that belong together: input and output equally long, the same channels and sample rate
/// everywhere, every channel moving in at least one run.
pub(super) struct Data<'a> {
    pub runs: &'a [(&'a Signal, &'a Signal)],
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
    pub fn check(runs: &'a [(&'a Signal, &'a Signal)]) -> Result<Self, EngineError> {
        let Some((x, y)) = runs.first() else {
            return Err(EngineError::TooShort { what: "runs of an FRF", needed: 1, found: 0 });
        };
        for (run_x, run_y) in runs {
            same_shape("frf inputs", x, run_x)?;
            same_shape("frf outputs", y, run_y)?;
            let (expected, found) = (run_x.n_samples(), run_y.n_samples());
            if expected != found {
                return Err(EngineError::UnequalLength { what: "frf outputs", channel: 0, expected, found });
            }
            let (expected_hz, found_hz) = (run_x.sample_rate_hz(), run_y.sample_rate_hz());
            if !Signal::same_rate(expected_hz, found_hz) {
                return Err(EngineError::SampleRate { what: "frf outputs", expected_hz, found_hz });
            }
        }
        let inputs: Vec<&Signal> = runs.iter().map(|r| r.0).collect();
        let outputs: Vec<&Signal> = runs.iter().map(|r| r.1).collect();
        let (x_mean, x_scale) = moments("frf inputs", &inputs)?;
        let (y_mean, _) = moments("frf outputs", &outputs)?;
        Ok(Self {
            runs,
            sample_rate_hz: x.sample_rate_hz(),
            n_inputs: x.n_channels(),
            n_outputs: y.n_channels(),
            x_scale,
            means: Means { x: x_mean, y: y_mean },
        })
    }

    /// All samples of all runs.
    pub fn all(&self) -> Vec<Stretch<'a>> {
        self.runs.iter().map(|run| part(run, 0..run.0.n_samples())).collect()
    }

    /// What is left of all runs before and after a range, `range(n_samples)`, of each.
    pub fn without(&self, range: impl Fn(usize) -> Range<usize>) -> Vec<Stretch<'a>> {
        let around = |run: &(&'a Signal, &'a Signal)| {
            let n = run.0.n_samples();
            let Range { start, end } = range(n);
            [part(run, 0..start), part(run, end..n)]
        };
        self.runs.iter().flat_map(around).collect()
    }

    /// Segments that all runs give.
    pub fn n_averages(&self, welch: &Welch) -> usize {
        self.runs.iter().map(|(x, _)| welch.n_segments(x.n_samples())).sum()
    }
}

fn part<'a>((x, y): &(&'a Signal, &'a Signal), range: Range<usize>) -> Stretch<'a> {
    let cut = |s: &'a Signal| s.channels().iter().map(|c| &c[range.clone()]).collect();
    Stretch { x: cut(x), y: cut(y) }
}

/// Working point: mean of each channel over all samples of all stretches.
pub(super) fn means(stretches: &[Stretch<'_>]) -> Means {
    let x: Vec<&Vec<&[f64]>> = stretches.iter().map(|s| &s.x).collect();
    let y: Vec<&Vec<&[f64]>> = stretches.iter().map(|s| &s.y).collect();
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
fn moments(what: &'static str, runs: &[&Signal]) -> Result<(Vec<f64>, Vec<f64>), EngineError> {
    let n_channels = runs.first().map_or(0, |r| r.n_channels());
    let moments = |channel: usize| {
        let (mut total, mut square, mut count, mut largest) = (0.0, 0.0, 0_usize, 0.0_f64);
        for samples in runs.iter().map(|r| r.channel(channel)) {
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
        // What the sums' rounding leaves of a constant does not move.
        if deviation <= 1e-12 * largest {
            return Err(EngineError::DeadChannel { what, channel });
        }
        Ok((mean, deviation))
    };
    let all: Vec<Result<(f64, f64), EngineError>> = (0..n_channels).into_par_iter().map(moments).collect();
    // Collected in order first: with several bad channels, the first is always the one named.
    all.into_iter().collect()
}

/// What one reading of a run from memory gives.
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

/// Folds the samples from zero in eight lanes: one running value would wait for each operation.
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
