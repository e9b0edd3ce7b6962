//! Random subsets of the data of a fit: blocks of the runs, drawn without replacement.

use std::ops::Range;

use rand::SeedableRng;
use rand::seq::SliceRandom;
use rand_chacha::ChaCha8Rng;

use crate::EngineError;
use crate::model::{FitData, FitSplit, Pair, Section};

/// Most blocks of a pool.
const MAX_BLOCKS: usize = 64;

/// Fewest blocks of a pool, so that the smallest subset is a choice.
const MIN_BLOCKS: usize = 8;

/// Share of all data that the smallest subset is.
const SMALLEST: f64 = 0.125;

/// The data that subsets are drawn from, and those that score them.
#[derive(Debug, Clone)]
pub struct Pool {
    /// Training data, whole runs or their first parts.
    training: Vec<Pair>,
    /// Data that stop a training with their first half and compare with their second.
    held_out: Vec<Pair>,
    /// Equal blocks of the training data, by run; the last of a run may be longer.
    blocks: Vec<(usize, Range<usize>)>,
}

impl Pool {
    /// Divides the data of a fit: what compares (of a fit that only stops on validation runs, what stops) is held out, and
    /// the rest is cut to blocks of at least `shortest` samples.
    ///
    /// # Errors
    /// [`EngineError::TooShort`] for fewer than eight blocks.
    pub fn new(data: FitData, held_out: &[Section], shortest: usize) -> Result<Self, EngineError> {
        let cut = |section: &Section| {
            let pair = data.run(section.run);
            Pair { x: pair.x.slice(section.samples.clone()), y: pair.y.slice(section.samples.clone()) }
        };
        let scored: Vec<Pair> = held_out.iter().map(cut).collect();
        let split = data.split.clone();
        let training: Vec<Pair> = match &split {
            FitSplit::LeftOut { comparison, .. } => {
                let kept = data.training.into_iter().enumerate().filter(|(run, _)| !comparison.contains(run));
                kept.map(|(_, pair)| pair).collect()
            }
            _ => data.without_comparison().training,
        };
        let total: usize = training.iter().map(|pair| pair.x.n_samples()).sum();
        let len = shortest.max(total / MAX_BLOCKS).max(1);
        let mut blocks = Vec::new();
        for (run, pair) in training.iter().enumerate() {
            let n = pair.x.n_samples();
            let count = n / len;
            for block in 0..count {
                let end = if block + 1 == count { n } else { (block + 1) * len };
                blocks.push((run, block * len..end));
            }
        }
        if blocks.len() < MIN_BLOCKS {
            return Err(EngineError::TooShort {
                what: "training data of a learning curve",
                needed: MIN_BLOCKS * len,
                found: total,
            });
        }
        Ok(Self { training, held_out: scored, blocks })
    }

    /// Numbers of blocks of `sizes` sizes, evenly on a logarithmic scale from an eighth of all to all.
    pub fn sizes(&self, sizes: usize) -> Vec<usize> {
        let n = self.blocks.len() as f64;
        let size = |i: usize| SMALLEST.powf(1.0 - i as f64 / (sizes - 1) as f64) * n;
        (0..sizes).map(|i| (size(i).round() as usize).max(1)).collect()
    }

    /// Samples of all blocks.
    pub fn n_samples(&self) -> usize {
        self.blocks.iter().map(|(_, samples)| samples.len()).sum()
    }

    /// `count` blocks, drawn from `seed`, as the data of a fit, and their samples. Neighbours are one run.
    pub fn subset(&self, count: usize, seed: u64) -> (FitData, usize) {
        let mut order: Vec<usize> = (0..self.blocks.len()).collect();
        order.shuffle(&mut ChaCha8Rng::seed_from_u64(seed));
        order.truncate(count);
        order.sort_unstable();
        let mut stretches: Vec<(usize, Range<usize>)> = Vec::new();
        for (run, samples) in order.into_iter().map(|block| self.blocks[block].clone()) {
            match stretches.last_mut() {
                Some((last, known)) if *last == run && known.end == samples.start => known.end = samples.end,
                _ => stretches.push((run, samples)),
            }
        }
        let samples = stretches.iter().map(|(_, samples)| samples.len()).sum();
        let cut = |(run, samples): (usize, Range<usize>)| {
            let pair = &self.training[run];
            Pair { x: pair.x.slice(samples.clone()), y: pair.y.slice(samples) }
        };
        let training = stretches.into_iter().map(cut).collect();
        (FitData::with_validation(training, self.held_out.clone(), FitSplit::ValidationHalves), samples)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Signal;

    /// A run whose samples are their own numbers, from `from` on.
    fn run(from: usize, n: usize) -> Pair {
        let signal = || Signal::new(100.0, vec![(from..from + n).map(|t| t as f64).collect()]).unwrap();
        Pair { x: signal(), y: signal() }
    }

    fn pool() -> Pool {
        let data = FitData::of_training(vec![run(0, 1050), run(2000, 700), run(5000, 300)]);
        let held_out = data.sections(crate::model::ModelKind::Lstm, 64).comparison;
        Pool::new(data, &held_out, 100).unwrap()
    }

    #[test]
    fn a_subset_holds_each_sample_once_and_none_that_scores() {
        let pool = pool();
        assert_eq!((pool.blocks.len(), pool.n_samples()), (17, 1750));
        for (count, seed) in [(2, 1), (5, 2), (17, 3)] {
            let (data, samples) = pool.subset(count, seed);
            let mut all: Vec<f64> =
                data.training.iter().flat_map(|pair| pair.x.channel(0).to_vec()).collect();
            assert_eq!(all.len(), samples);
            all.sort_by(f64::total_cmp);
            all.dedup();
            assert_eq!(all.len(), samples, "no sample twice");
            assert!(all.iter().all(|sample| *sample < 5000.0));
            assert_eq!(data.validation[0].x.channel(0)[0], 5000.0);
            assert_eq!(pool.subset(count, seed).0, data, "the same draw each time");
        }
        assert_eq!(pool.subset(17, 9).0.training.len(), 2, "all blocks are the runs again");
        assert_ne!(pool.subset(5, 1).0, pool.subset(5, 2).0);
    }

    #[test]
    fn sizes_go_from_an_eighth_to_all_and_too_little_data_are_refused() {
        assert_eq!(pool().sizes(3), [2, 6, 17]);
        let data = FitData::of_training(vec![run(0, 800)]);
        let refused = Pool::new(data, &[], 100);
        assert!(matches!(refused, Err(EngineError::TooShort { .. })), "a tenth of 800 compares");
    }
}
