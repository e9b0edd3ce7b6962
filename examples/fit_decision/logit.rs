//! Conditional logit: weights under which the right alternatives, or none, are likeliest.

use rigcast::engine::diagnosis::{FEATURES, Weights};

/// Number of weights.
pub const N: usize = FEATURES.len();
/// Penalty on a weight's square, in cases: a weight that few cases tell stays small.
const PENALTY: f64 = 0.5;
const ROUNDS: usize = 4000;

/// The alternatives of one case, and which of them are right; none of them where no one is.
#[derive(Debug, Clone)]
pub struct Row {
    pub features: Vec<[f64; N]>,
    pub right: Vec<bool>,
}

impl Row {
    /// Probability of what is right.
    pub fn of_truth(&self, probabilities: &[f64]) -> f64 {
        if self.right.contains(&true) {
            probabilities.iter().zip(&self.right).filter(|(_, right)| **right).map(|(p, _)| p).sum()
        } else {
            1.0 - probabilities.iter().sum::<f64>()
        }
    }
}

/// The weights with the largest penalised likelihood, by gradient ascent with a step that adapts.
pub fn fit(rows: &[Row]) -> Weights {
    let mut weights =
        Weights { features: FEATURES.iter().map(|f| (*f).to_owned()).collect(), weights: vec![0.0; N] };
    let mut step = 1e-3;
    let (mut value, mut slope) = likelihood(&weights, rows);
    for _ in 0..ROUNDS {
        let mut next = weights.clone();
        next.weights.iter_mut().zip(&slope).for_each(|(w, s)| *w += step * s);
        let (found, further) = likelihood(&next, rows);
        if found > value {
            (weights, value, slope) = (next, found, further);
            step *= 1.3;
        } else {
            step *= 0.4;
        }
    }
    weights
}

/// Penalised log-likelihood and its gradient.
fn likelihood(weights: &Weights, rows: &[Row]) -> (f64, Vec<f64>) {
    let mut value = -PENALTY * weights.weights.iter().map(|w| w * w).sum::<f64>();
    let mut slope: Vec<f64> = weights.weights.iter().map(|w| -2.0 * PENALTY * w).collect();
    for row in rows {
        let p = weights.probabilities(&row.features, 1.0);
        let truth = row.of_truth(&p).max(1e-12);
        value += truth.ln();
        let any = row.right.contains(&true);
        for ((x, p), right) in row.features.iter().zip(&p).zip(&row.right) {
            // The share of the truth that this alternative is, less its probability.
            let of_truth = if any && *right { p / truth } else { 0.0 };
            slope.iter_mut().zip(x).for_each(|(s, x)| *s += (of_truth - p) * x);
        }
    }
    (value, slope)
}
