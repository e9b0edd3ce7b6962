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
        let x_scale = deviations("frf inputs", &inputs)?;
        deviations("frf outputs", &outputs)?;
        Ok(Self {
            runs,
            sample_rate_hz: x.sample_rate_hz(),
            n_inputs: x.n_channels(),
            n_outputs: y.n_channels(),
            x_scale,
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
        .map(|c| runs.iter().map(|run| sum(run[c], |v| v)).sum::<f64>() / count.max(1) as f64)
        .collect()
}

/// Standard deviation of each channel, each run about its own mean.
fn deviations(what: &'static str, runs: &[&Signal]) -> Result<Vec<f64>, EngineError> {
    let n_channels = runs.first().map_or(0, |r| r.n_channels());
    let deviation = |channel: usize| {
        let (mut square, mut count, mut largest) = (0.0, 0_usize, 0.0_f64);
        for samples in runs.iter().map(|r| r.channel(channel)) {
            let mean = sum(samples, |v| v) / samples.len().max(1) as f64;
            square += sum(samples, |v| (v - mean) * (v - mean));
            largest = samples.iter().fold(largest, |l, v| l.max(v.abs()));
            count += samples.len();
        }
        let deviation = (square / count.max(1) as f64).sqrt();
        if !deviation.is_finite() {
            return Err(EngineError::NonFiniteResult { what, channel, sample: 0 });
        }
        // What the sums' rounding leaves of a constant does not move.
        if deviation <= 1e-12 * largest {
            return Err(EngineError::DeadChannel { what, channel });
        }
        Ok(deviation)
    };
    let all: Vec<Result<f64, EngineError>> = (0..n_channels).into_par_iter().map(deviation).collect();
    // Collected in order first: with several bad channels, the first is always the one named.
    all.into_iter().collect()
}

/// Sum of `f` over the samples, in lanes: one running sum would wait for each addition.
fn sum(samples: &[f64], f: impl Fn(f64) -> f64) -> f64 {
    let mut lanes = [0.0; 8];
    let chunks = samples.chunks_exact(lanes.len());
    let rest: f64 = chunks.remainder().iter().map(|&v| f(v)).sum();
    for chunk in chunks {
        for (lane, &v) in lanes.iter_mut().zip(chunk) {
            *lane += f(v);
        }
    }
    lanes.iter().sum::<f64>() + rest
}
