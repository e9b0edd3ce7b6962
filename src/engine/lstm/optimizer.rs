//! Optimisers: from a gradient to a step of the weights.

use serde::{Deserialize, Serialize};

use super::settings::{Optimizer, Schedule};
use crate::checkpoint::floats;

/// RMSProp's decay rate, Keras' default.
const RHO: f32 = 0.9;
/// RMSProp's epsilon, Keras' default; added to the root, as Keras did until its version 2.10 of 2022
/// (`optimizer_v2/rmsprop.py`). The paper is of 2021. Later versions add it to the mean square, which
/// shortens the steps wherever gradients are below 3e-4; PyTorch adds it to the root.
const RMSPROP_EPSILON: f32 = 1e-7;
/// Adam's decay rates.
const BETA: [f32; 2] = [0.9, 0.999];
/// Adam's epsilon; added to the root.
const ADAM_EPSILON: f32 = 1e-8;

/// An optimiser and its memory of earlier gradients.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(super) struct Descent {
    kind: Optimizer,
    /// Adam's mean of gradients.
    #[serde(with = "floats")]
    mean: Vec<f32>,
    /// Mean of squared gradients.
    #[serde(with = "floats")]
    square: Vec<f32>,
    /// Steps done.
    steps: i32,
}

impl Descent {
    /// An optimiser of `weights` weights, with empty memory.
    pub(super) fn new(kind: Optimizer, weights: usize) -> Self {
        Self { kind, mean: vec![0.0; weights], square: vec![0.0; weights], steps: 0 }
    }

    /// Whether its memory is one of `weights` weights.
    pub(super) fn suits(&self, weights: usize) -> bool {
        self.mean.len() == weights && self.square.len() == weights
    }

    /// One step down the gradient.
    pub(super) fn step(&mut self, weights: &mut [f32], gradient: &[f32], rate: f64) {
        self.steps = self.steps.saturating_add(1);
        match self.kind {
            Optimizer::Rmsprop => {
                let rate = rate as f32;
                for ((w, g), v) in weights.iter_mut().zip(gradient).zip(&mut self.square) {
                    *v = RHO * *v + (1.0 - RHO) * g * g;
                    *w -= rate * g / (v.sqrt() + RMSPROP_EPSILON);
                }
            }
            Optimizer::Adam => {
                // The bias corrections of both means go into the rate and into the root.
                let unbias = BETA.map(|b| 1.0 - f64::from(b).powi(self.steps));
                let rate = (rate / unbias[0]) as f32;
                let root = unbias[1].sqrt().recip() as f32;
                let memory = self.mean.iter_mut().zip(&mut self.square);
                for ((w, g), (m, v)) in weights.iter_mut().zip(gradient).zip(memory) {
                    *m = BETA[0] * *m + (1.0 - BETA[0]) * g;
                    *v = BETA[1] * *v + (1.0 - BETA[1]) * g * g;
                    *w -= rate * *m / (v.sqrt() * root + ADAM_EPSILON);
                }
            }
        }
    }
}

/// Scales `gradient` down to the Euclidean norm `limit` if it is longer. Returns the norm before, which is
/// not finite when the gradient is not.
pub(super) fn clip(gradient: &mut [f32], limit: Option<f64>) -> f64 {
    let norm = gradient.iter().map(|&g| f64::from(g) * f64::from(g)).sum::<f64>().sqrt();
    if let Some(limit) = limit.filter(|&limit| norm > limit) {
        let factor = (limit / norm) as f32;
        gradient.iter_mut().for_each(|g| *g *= factor);
    }
    norm
}

/// Learning rate relative to the setting: a linear rise over `warmup` steps, times the schedule at
/// `fraction` (0..1) of the whole training.
pub(super) fn relative_rate(schedule: Schedule, warmup: usize, step: usize, fraction: f64) -> f64 {
    let warm = if step < warmup { (step + 1) as f64 / warmup as f64 } else { 1.0 };
    match schedule {
        Schedule::Constant => warm,
        Schedule::Cosine => warm * 0.5 * (1.0 + (std::f64::consts::PI * fraction).cos()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rmsprop_takes_the_steps_of_the_paper_s_keras_down_to_the_smallest_gradients() {
        // v = 0.9 v + 0.1 g^2; w -= rate g / (sqrt v + 1e-7), by hand.
        for size in [1.0, 1e-5] {
            let (mut w, rate) = ([0.0_f32], 0.01);
            let (mut v, mut expected) = (0.0_f64, 0.0_f64);
            let mut descent = Descent::new(Optimizer::Rmsprop, 1);
            for g in [0.5, -0.25, 2.0].map(|g: f64| g * size) {
                v = 0.9 * v + 0.1 * g * g;
                expected -= rate * g / (v.sqrt() + 1e-7);
                descent.step(&mut w, &[g as f32], rate);
                assert!((f64::from(w[0]) - expected).abs() < 1e-6, "{size}: {} {expected}", w[0]);
            }
        }
    }

    #[test]
    fn adam_takes_the_steps_of_its_paper() {
        // Kingma and Ba, 2015, algorithm 1, in f64.
        let gradients = [0.5, -0.25, 1e-3, 2.0];
        let (mut m, mut v, mut expected) = (0.0_f64, 0.0_f64, 1.0_f64);
        let mut w = [1.0_f32];
        let mut descent = Descent::new(Optimizer::Adam, 1);
        for (t, g) in gradients.into_iter().enumerate() {
            m = 0.9 * m + 0.1 * g;
            v = 0.999 * v + 0.001 * g * g;
            let t = t as i32 + 1;
            expected -=
                0.01 * (m / (1.0 - 0.9_f64.powi(t))) / ((v / (1.0 - 0.999_f64.powi(t))).sqrt() + 1e-8);
            descent.step(&mut w, &[g as f32], 0.01);
            assert!((f64::from(w[0]) - expected).abs() < 1e-5, "{t}: {} {expected}", w[0]);
        }
    }

    #[test]
    fn a_long_gradient_is_clipped_and_a_short_one_is_not() {
        let mut g = [3.0, 4.0];
        assert_eq!(clip(&mut g, Some(1.0)), 5.0);
        assert!((g[0] - 0.6).abs() < 1e-6 && (g[1] - 0.8).abs() < 1e-6);
        let mut g = [0.3, 0.4];
        clip(&mut g, Some(1.0));
        assert_eq!(g, [0.3, 0.4]);
        clip(&mut g, None);
        assert_eq!(g, [0.3, 0.4]);
        assert!(clip(&mut [f32::NAN], Some(1.0)).is_nan());
    }

    #[test]
    fn the_rate_warms_up_and_falls_to_zero() {
        assert_eq!(relative_rate(Schedule::Constant, 4, 0, 0.0), 0.25);
        assert_eq!(relative_rate(Schedule::Constant, 4, 3, 0.5), 1.0);
        assert_eq!(relative_rate(Schedule::Constant, 0, 0, 0.0), 1.0);
        assert!((relative_rate(Schedule::Cosine, 0, 9, 0.5) - 0.5).abs() < 1e-12);
        assert!(relative_rate(Schedule::Cosine, 0, 99, 1.0).abs() < 1e-12);
    }
}
