//! The computations whose speed is measured: the paper's hybrid 2 network (9 inputs, 39 cells, 6 outputs,
//! windows of 256 samples that half overlap) and three drives with six responses, at 1 kHz.

use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};
use rigcast::engine::frf::{Estimator, FrfSettings};
use rigcast::engine::lstm::{
    HybridStart, LstmNet, LstmSettings, Optimizer, RecombineChoice, Schedule, Segment, WindowOffset,
};
use rigcast::engine::{EngineError, Signal};

/// Sample rate, Hz.
pub const FS: usize = 1000;
/// Window length, samples.
pub const WINDOW: usize = 256;
/// Step between windows, samples.
pub const HOP: usize = WINDOW / 2;

/// Noise below about 80 Hz, standard deviation near one.
pub fn noise(samples: usize, seed: u64) -> Vec<f64> {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let mut state = [0.0_f64; 4];
    (0..samples)
        .map(|_| {
            let mut value: f64 = StandardNormal.sample(&mut rng);
            for s in &mut state {
                *s += 0.5 * (value - *s);
                value = *s;
            }
            2.2 * value
        })
        .collect()
}

/// The network, untrained: speed does not depend on the weights.
pub fn net() -> LstmNet {
    LstmNet::init(9, &[39], 6, 1.0, &mut ChaCha8Rng::seed_from_u64(1))
}

/// Standardised inputs of the network.
pub fn net_input(seconds: usize) -> Vec<Vec<f32>> {
    standardised(9, seconds)
}

/// Ten minutes to train on, and one window to validate on, which takes hardly any time.
pub fn training() -> (Segment, Segment) {
    let training = Segment { x: standardised(9, 600), y: standardised(6, 600), score_from: 0 };
    let short = |channels: &[Vec<f32>]| channels.iter().map(|c| c[..WINDOW].to_vec()).collect();
    let validation = Segment { x: short(&training.x), y: short(&training.y), score_from: 0 };
    (training, validation)
}

/// Settings of a training.
pub fn training_settings(batch_size: usize, epochs: usize) -> LstmSettings {
    LstmSettings {
        blocks: vec![39],
        window_len: WINDOW,
        hop: HOP,
        optimizer: Optimizer::Adam,
        learning_rate: 5e-3,
        schedule: Schedule::Cosine,
        warmup_steps: 100,
        epochs,
        validate_every: None,
        batch_size,
        window_offset: WindowOffset::Drawn,
        burn_in: 0.25,
        clip_norm: Some(1.0),
        forget_bias: 1.0,
        hybrid_start: HybridStart::Random,
        recombine: RecombineChoice::Welch,
        seeds: vec![1],
    }
}

/// Three drives.
pub fn drives(seconds: usize) -> Result<Signal, EngineError> {
    signal(3, seconds, 1)
}

/// Six responses.
pub fn responses(seconds: usize) -> Result<Signal, EngineError> {
    signal(6, seconds, 100)
}

/// H1 on segments of 4096 samples that half overlap.
pub fn frf_settings() -> FrfSettings {
    FrfSettings { segment_len: Some(4096), overlap: 0.5, estimator: Estimator::H1, ridge: Some(0.0) }
}

/// Ten minutes of a three-channel group.
pub fn group() -> [Vec<f64>; 3] {
    [0, 1, 2].map(|channel| noise(600 * FS, channel))
}

fn signal(channels: u64, seconds: usize, seed: u64) -> Result<Signal, EngineError> {
    Signal::new(FS as f64, (0..channels).map(|c| noise(seconds * FS, seed + c)).collect())
}

fn standardised(channels: u64, seconds: usize) -> Vec<Vec<f32>> {
    (0..channels).map(|c| noise(seconds * FS, c).iter().map(|&v| v as f32).collect()).collect()
}
