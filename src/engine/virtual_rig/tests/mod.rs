mod drives;
mod dynamics;
mod fit;
mod linearity;
mod programme;
mod statics;

use super::drives::*;
use super::*;

/// Strong mixed noise from the whole interior.
fn mixed(duration_s: f64, seed: u64) -> Signal {
    mixed_noise(&MixedNoise { duration_s, stretch_s: 5.0, region: NoiseRegion::Interior }, seed).unwrap()
}

fn quiet(rig: &VirtualRig) -> VirtualRig {
    rig.with_effects(Effects { sensor_noise: 0.0, ..rig.effects() }).unwrap()
}

fn largest(values: &[f64]) -> f64 {
    values.iter().fold(0.0, |largest: f64, v| largest.max(v.abs()))
}

/// Largest difference relative to the largest value, over all channels.
fn difference(a: &Signal, b: &Signal) -> f64 {
    assert_eq!((a.n_channels(), a.n_samples()), (b.n_channels(), b.n_samples()));
    (0..a.n_channels())
        .map(|c| {
            let gap: Vec<f64> = a.channel(c).iter().zip(b.channel(c)).map(|(a, b)| a - b).collect();
            largest(&gap) / largest(b.channel(c))
        })
        .fold(0.0, f64::max)
}
