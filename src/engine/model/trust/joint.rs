//! Means of all inputs together over short times. Each may be as the training had it, and their combination not.

use std::ops::Range;

use faer::Mat;
use rigcast_numerics::decompose::Cholesky;
use serde::{Deserialize, Serialize};

use super::InputRange;
use super::beyond::join;
use crate::EngineError;

/// Means that leave the middle of the training by this share of half an input's range are as near as the middle itself.
const SLACK: f64 = 0.05;

/// The distance may exceed the largest of the training by this factor: few means are a sample of all that could have been.
const DISTANCE_SLACK: f64 = 1.2;

/// Windows of a stretch of one mean, as a rule: so many count as one when covariances are estimated.
const WINDOWS_PER_STRETCH: f64 = 30.0;

/// The means of a model's inputs over windows of its training data: their middle, and how they scatter about it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct JointRange {
    /// Samples of a window.
    pub window: usize,
    /// Mean of the means of each input, channel unit.
    pub middle: Vec<f64>,
    /// Covariance of the means, row by row, channel units.
    pub covariance: Vec<Vec<f64>>,
    /// Largest Mahalanobis distance from the middle.
    pub max_distance: f64,
}

/// Measures distances.
#[derive(Debug, Clone)]
pub(super) struct Distance {
    middle: Vec<f64>,
    /// Inverse of the covariance, `[input, input]`.
    inverse: Mat<f64>,
}

impl JointRange {
    /// That of the windows of the training, `[window][input]`, of so many samples; `None` for one input, and without windows.
    pub(super) fn of_windows(window: usize, ranges: &[InputRange], means: &[Vec<f64>]) -> Option<Self> {
        let n = ranges.len();
        if n < 2 || means.is_empty() {
            return None;
        }
        let count = means.len() as f64;
        let mean = |i: usize| means.iter().map(|of| of[i]).sum::<f64>() / count;
        let middle: Vec<f64> = (0..n).map(mean).collect();
        // Of many inputs and few stretches the correlations are chance: they shrink (Ledoit, Wolf 2004) the more, the fewer
        // stretches there are for each input.
        let kept = 1.0 - n as f64 / (n as f64 + count / WINDOWS_PER_STRETCH);
        let of = |i: usize, j: usize| {
            let product = |of: &Vec<f64>| (of[i] - middle[i]) * (of[j] - middle[j]);
            let found = means.iter().map(product).sum::<f64>() / count;
            let half = (ranges[i].max - ranges[i].min) / 2.0;
            if i == j { found + (SLACK * half).powi(2) } else { kept * found }
        };
        let covariance = (0..n).map(|i| (0..n).map(|j| of(i, j)).collect()).collect();
        let mut joint = Self { window, middle, covariance, max_distance: 0.0 };
        // Squares may exceed the range of numbers: then nothing is known.
        if !joint.covariance.iter().flatten().all(|v| v.is_finite()) {
            return None;
        }
        let distance = joint.distance()?;
        joint.max_distance = means.iter().map(|means| distance.of(means).distance).fold(0.0, f64::max);
        Some(joint)
    }

    /// `None` where the covariance is none.
    pub(super) fn distance(&self) -> Option<Distance> {
        let n = self.middle.len();
        let factor = Cholesky::new(&Mat::from_fn(n, n, |i, j| self.covariance[i][j]))?;
        Some(Distance { middle: self.middle.clone(), inverse: factor.solve(&Mat::identity(n, n)) })
    }

    /// Distances above are outside.
    pub(super) fn limit(&self) -> f64 {
        DISTANCE_SLACK * self.max_distance
    }

    /// Whether it is one of so many inputs.
    ///
    /// # Errors
    /// What is wrong with a range from a file.
    pub(in crate::model) fn check(&self, inputs: usize) -> Result<(), EngineError> {
        let square = self.covariance.len() == inputs && self.covariance.iter().all(|row| row.len() == inputs);
        let whole = self.middle.len() == inputs && square && self.max_distance >= 0.0 && self.window > 0;
        if whole && self.distance().is_some() {
            return Ok(());
        }
        let needed = "a middle and a positive definite covariance of the inputs, a window and a distance that is not negative";
        Err(EngineError::Weights(format!("joint_range: {needed} are needed")))
    }
}

/// How far the means of a window are from the middle of the training.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Apart {
    pub distance: f64,
    /// The input that has the largest part in it.
    pub input: usize,
}

impl Distance {
    /// Of the means of all inputs over a window.
    pub fn of(&self, means: &[f64]) -> Apart {
        let from_middle: Vec<f64> =
            means.iter().zip(&self.middle).map(|(mean, middle)| mean - middle).collect();
        let part = |(i, v): (usize, &f64)| {
            v * from_middle.iter().enumerate().map(|(j, w)| self.inverse[(i, j)] * w).sum::<f64>()
        };
        let parts: Vec<f64> = from_middle.iter().enumerate().map(part).collect();
        let input = (0..parts.len()).max_by(|a, b| parts[*a].total_cmp(&parts[*b])).unwrap_or_default();
        Apart { distance: parts.iter().sum::<f64>().max(0.0).sqrt(), input }
    }
}

/// Stretches of windows beyond the limit, with the farthest of each.
pub(super) fn find(limit: f64, windows: &[(Range<usize>, Apart)]) -> Vec<(Range<usize>, Apart)> {
    let mut found = Vec::new();
    for (samples, apart) in windows.iter().filter(|(_, apart)| apart.distance > limit) {
        join(&mut found, samples, *apart, |farthest: &mut Apart, apart| {
            if apart.distance > farthest.distance {
                *farthest = apart;
            }
        });
    }
    found
}

#[cfg(test)]
mod tests {
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    use super::*;
    use crate::model::tests::made_up;
    use crate::model::trust::short_time::ShortTime;
    use crate::model::trust::watch::of_training;
    use crate::model::{ModelKind, RigModel};

    /// Stretches of a second at 100 Hz, with means from -1 to 1 that two inputs share and a third one has of its own.
    fn drive(stretches: usize, seed: u64) -> Vec<Vec<f64>> {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let mut inputs = vec![Vec::new(); 3];
        for _ in 0..stretches {
            let (shared, own): (f64, f64) = (rng.random_range(-1.0..1.0), rng.random_range(-1.0..1.0));
            for (input, mean) in inputs.iter_mut().zip([shared, shared, own]) {
                input.extend((0..1000).map(|_| mean + rng.random_range(-0.1..0.1)));
            }
        }
        inputs
    }

    fn model(stretches: usize) -> (RigModel, JointRange) {
        let inputs = drive(stretches, 1);
        let range = InputRange { min: -1.1, max: 1.1, max_rate: 1e3, band_hz: None, local: None };
        let model =
            RigModel { range: vec![range; 3], frf: None, sample_rate_hz: 100.0, ..made_up(ModelKind::Lstm) };
        let parts = [inputs.iter().map(Vec::as_slice).collect()];
        let joint = of_training(&model, &parts).1.unwrap();
        (model, joint)
    }

    #[test]
    fn means_that_each_input_reaches_but_not_together_are_far() {
        let (_, joint) = model(40);
        joint.check(3).unwrap();
        let distance = joint.distance().unwrap();
        let far = |means: [f64; 3]| distance.of(&means).distance > joint.limit();
        for inside in [[0.9, 0.9, -0.5], [-0.6, -0.6, 0.9], [0.0; 3]] {
            assert!(!far(inside), "{inside:?} {:?} {}", distance.of(&inside), joint.limit());
        }
        for outside in [[0.8, -0.8, 0.0], [1.9, 1.9, 0.0], [0.0, 0.0, 2.2]] {
            assert!(far(outside), "{outside:?} {:?} {}", distance.of(&outside), joint.limit());
        }
        assert_eq!(distance.of(&[0.0, 0.0, 2.2]).input, 2);
    }

    #[test]
    fn further_stretches_of_the_same_kind_are_inside() {
        let (_, joint) = model(40);
        let distance = joint.distance().unwrap();
        let fft = ShortTime::new(joint.window);
        let further = drive(200, 2);
        let inputs: Vec<&[f64]> = further.iter().map(Vec::as_slice).collect();
        let windows = fft.each(&inputs, |window| distance.of(window.means));
        let outside = find(joint.limit(), &windows).iter().map(|(samples, _)| samples.len()).sum::<usize>();
        assert!(outside < 4000, "{outside} of 200,000 samples");
    }

    #[test]
    fn one_input_has_none_and_a_file_cannot_have_half_of_one() {
        let (of_three, joint) = model(5);
        let (inputs, range) = (of_three.inputs[..1].to_vec(), of_three.range[..1].to_vec());
        let of_one = RigModel { inputs, range, ..of_three };
        assert_eq!(of_training(&of_one, &[vec![&[0.0; 9000]]]).1, None);
        assert!(joint.check(2).is_err());
        let flat = JointRange { covariance: vec![vec![0.0; 3]; 3], ..joint.clone() };
        let without_middle = JointRange { middle: Vec::new(), ..joint };
        assert!(flat.check(3).is_err() && without_middle.check(3).is_err());
    }
}
