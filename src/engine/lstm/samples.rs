//! Seeded signals and systems for the tests of the network.

use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};

use super::settings::{HybridStart, LstmSettings, Optimizer, RecombineChoice, Schedule, WindowOffset};

/// Small settings for tests: one block of eight cells, windows of 64.
pub(super) fn settings() -> LstmSettings {
    LstmSettings {
        blocks: vec![8],
        window_len: 64,
        hop: 32,
        optimizer: Optimizer::Adam,
        learning_rate: 5e-3,
        schedule: Schedule::Cosine,
        warmup_steps: 20,
        epochs: 4,
        validate_every: None,
        batch_size: 40,
        window_offset: WindowOffset::Drawn,
        burn_in: 0.25,
        clip_norm: Some(1.0),
        forget_bias: 1.0,
        hybrid_start: HybridStart::Copy,
        recombine: RecombineChoice::Auto,
        seeds: vec![1],
    }
}

/// Standard normal noise, smoothed a little, `[channel][sample]`.
pub(super) fn noise(channels: usize, samples: usize, seed: u64) -> Vec<Vec<f32>> {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    (0..channels)
        .map(|_| {
            let mut state = 0.0_f64;
            (0..samples)
                .map(|_| {
                    let n: f64 = StandardNormal.sample(&mut rng);
                    state = 0.8 * state + 0.6 * n;
                    state as f32
                })
                .collect()
        })
        .collect()
}

/// Standard deviation over all values.
pub(super) fn std_of(y: &[Vec<f64>]) -> f64 {
    let n = y.iter().map(Vec::len).sum::<usize>() as f64;
    let mean = y.iter().flatten().sum::<f64>() / n;
    (y.iter().flatten().map(|v| (v - mean).powi(2)).sum::<f64>() / n).sqrt()
}

/// Largest distance between an `f32` signal and an `f64` one; lengths must agree.
pub(super) fn distance(found: &[Vec<f32>], expected: &[Vec<f64>]) -> f64 {
    assert_eq!(found.len(), expected.len(), "channels");
    let mut worst = 0.0_f64;
    for (f, e) in found.iter().zip(expected) {
        assert_eq!(f.len(), e.len(), "samples");
        for (f, e) in f.iter().zip(e) {
            worst = worst.max((f64::from(*f) - e).abs());
        }
    }
    worst
}
