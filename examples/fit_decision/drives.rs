//! Drives of the population: noise, multisines in periods, sweeps.

use std::f64::consts::TAU;

use rand::{Rng, RngExt};
use rand_distr::{Distribution, StandardNormal};

/// How all drives of a rig are made.
#[derive(Debug, Clone, Copy)]
pub enum Kind {
    Noise,
    /// Random phases, periods of so many samples.
    Multisine {
        period: usize,
    },
    Sweep,
}

/// A drive with RMS 1 between two frequencies in cycles a sample.
pub fn drive(kind: Kind, n: usize, low: f64, high: f64, rng: &mut impl Rng) -> Vec<f64> {
    let mut out: Vec<f64> = match kind {
        Kind::Noise => {
            // Lines without a common period, closer than the record tells apart.
            let lines = n / 2;
            let spread = coloured(n + 200, high, rng);
            let slow = if lines > 0 && low > 0.0 { smooth(&spread, low) } else { vec![0.0; spread.len()] };
            spread.iter().zip(&slow).skip(200).map(|(x, s)| x - s).collect()
        }
        Kind::Multisine { period } => {
            let lines: Vec<usize> =
                (1..period / 2).filter(|k| (low..high).contains(&(*k as f64 / period as f64))).collect();
            let phases: Vec<f64> = lines.iter().map(|_| rng.random_range(0.0..TAU)).collect();
            let one: Vec<f64> = (0..period)
                .map(|t| {
                    let at = |(k, phase): (&usize, &f64)| {
                        (TAU * (k * t % period) as f64 / period as f64 + phase).cos()
                    };
                    lines.iter().zip(&phases).map(at).sum()
                })
                .collect();
            (0..n).map(|t| one[t % period]).collect()
        }
        Kind::Sweep => (0..n)
            .map(|t| {
                let (from, to) = (low.max(0.002), high);
                let share = t as f64 / n as f64;
                (TAU * n as f64 * (from * share + 0.5 * (to - from) * share * share)).sin()
            })
            .collect(),
    };
    let level = deviation(&out).max(1e-9);
    out.iter_mut().for_each(|x| *x /= level);
    out
}

/// White noise through four one-pole filters.
pub fn coloured(n: usize, high: f64, rng: &mut impl Rng) -> Vec<f64> {
    let mut out: Vec<f64> = (0..n).map(|_| StandardNormal.sample(rng)).collect();
    for _ in 0..4 {
        out = smooth(&out, 2.0 * high);
    }
    out
}

fn smooth(x: &[f64], corner: f64) -> Vec<f64> {
    let share = 1.0 - (-TAU * corner.min(0.45)).exp();
    let mut state = 0.0;
    x.iter()
        .map(|x| {
            state += share * (x - state);
            state
        })
        .collect()
}

pub fn deviation(x: &[f64]) -> f64 {
    let n = x.len().max(1) as f64;
    let mean = x.iter().sum::<f64>() / n;
    (x.iter().map(|x| (x - mean).powi(2)).sum::<f64>() / n).sqrt()
}
