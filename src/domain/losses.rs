//! The errors of a job's training so far (`GET /v1/jobs/{job}/losses`).

use serde::Serialize;

use super::ids::JobId;
use crate::engine::Loss;

/// The errors of a job's training, by epoch.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct JobLosses {
    /// The job.
    pub job: JobId,
    /// A curve for each training; none before the first epoch has ended.
    pub curves: Vec<LossCurve>,
}

/// Mean squared errors of one training, standardised, at the end of some of its epochs.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct LossCurve {
    /// Seed.
    pub seed: u64,
    /// Epochs, from 1.
    pub epochs: Vec<usize>,
    /// Error on the training data at these epochs.
    pub training: Vec<f64>,
    /// Error on the data that stop the training; `None` of a training that nothing stops: that of the winner on all
    /// training runs.
    pub stopping: Option<Vec<f64>>,
}

impl JobLosses {
    /// Curves of losses that are in order: those of one training together, by epoch.
    pub fn of(job: JobId, losses: &[Loss]) -> Self {
        let same = |a: &Loss, b: &Loss| a.seed == b.seed && a.stopping.is_some() == b.stopping.is_some();
        let curves = losses.chunk_by(same).map(|training| LossCurve {
            seed: training[0].seed,
            epochs: training.iter().map(|loss| loss.epoch).collect(),
            training: training.iter().map(|loss| loss.training).collect(),
            stopping: training.iter().map(|loss| loss.stopping).collect(),
        });
        Self { job, curves: curves.collect() }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_training_is_a_curve() {
        let loss = |seed, epoch, stopping| Loss { seed, epoch, training: epoch as f64, stopping };
        let all = [
            loss(1, 1, Some(0.4)),
            loss(1, 2, Some(0.3)),
            loss(2, 1, Some(0.5)),
            loss(2, 1, None),
            loss(2, 2, None),
        ];
        let found = JobLosses::of(JobId::from_u128(1), &all).curves;
        let of = |seed, epochs: &[usize], stopping: Option<&[f64]>| LossCurve {
            seed,
            epochs: epochs.to_vec(),
            training: epochs.iter().map(|epoch| *epoch as f64).collect(),
            stopping: stopping.map(<[f64]>::to_vec),
        };
        assert_eq!(
            found,
            [of(1, &[1, 2], Some(&[0.4, 0.3])), of(2, &[1], Some(&[0.5])), of(2, &[1, 2], None)]
        );
        assert_eq!(JobLosses::of(JobId::from_u128(1), &[]).curves, []);
    }
}
