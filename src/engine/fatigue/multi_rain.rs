//! Multi-Rain: the largest damage over directions in space of a three-channel group.
//!
//! Source: Beste, Dressler, Koetzle, Krueger, Maier, Petersen, "Multiaxial rainflow", 1992, as
//! used by Heindel et al. (arXiv 2107.03645), section 3.2: `d_psi(s) = d(psi_x s_x + psi_y s_y +
//! psi_z s_z)`, largest of 500 evenly spread unit vectors `psi`.
//!
//! Directions are computed in small groups, block by block, so that a block is read from memory once per
//! group and the projection never leaves the first-level cache.

use rayon::prelude::*;
use serde::Serialize;

use super::block::{BLOCK, Block};
use super::damage::{DamageSettings, MinerSum, Power, WithPower, check_finite, finite, with_power};
use crate::EngineError;
use crate::simd::{Isa, Kernel, Simd, dispatch};

/// The largest damage and its direction.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct MultiRain {
    /// Palmgren-Miner sum in that direction.
    pub damage: f64,
    /// Unit vector `[x, y, z]`, `z > 0`; its opposite has the same damage.
    pub direction: [f64; 3],
}

/// Direction `i` of `n`: a spiral of equal areas over the upper half sphere,
/// `z = (i + 0.5) / n`, azimuth `i * pi * (3 - sqrt 5)`.
pub fn direction(i: usize, n: usize) -> [f64; 3] {
    let z = (i as f64 + 0.5) / n as f64;
    let radius = (1.0 - z * z).sqrt();
    let azimuth = i as f64 * std::f64::consts::PI * (3.0 - 5.0f64.sqrt());
    [radius * azimuth.cos(), radius * azimuth.sin(), z]
}

/// Largest damage over `settings.directions` directions of the channels x, y, z of `group`.
///
/// Runs on rayon's current pool; the result is bit-identical for any number of threads. Of equal damages the
/// direction with the lowest index is returned.
///
/// # Errors
/// Settings outside their limits; unequal lengths; a sample that is not finite; damage, or a
/// projected sample, beyond `f64`.
pub fn multi_rain(group: [&[f64]; 3], settings: &DamageSettings) -> Result<MultiRain, EngineError> {
    check_group(group, settings)?;
    multi_rain_unchecked(group, settings, "group", 0)
}

/// Damage of the channels x, y, z of `group` in each of the directions, in the order of [`direction`]; the largest of
/// them is that of [`multi_rain`], bit for bit.
///
/// # Errors
/// As [`multi_rain`].
pub fn damage_by_direction(group: [&[f64]; 3], settings: &DamageSettings) -> Result<Vec<f64>, EngineError> {
    check_group(group, settings)?;
    by_direction_unchecked(group, settings, "group", 0)
}

fn check_group(group: [&[f64]; 3], settings: &DamageSettings) -> Result<(), EngineError> {
    settings.check()?;
    for (channel, samples) in group.iter().enumerate() {
        if samples.len() != group[0].len() {
            return Err(EngineError::UnequalLength {
                what: "group",
                channel,
                expected: group[0].len(),
                found: samples.len(),
            });
        }
        check_finite("group", channel, samples)?;
    }
    Ok(())
}

/// [`multi_rain`] for finite samples of equal length and checked settings; `what` and `channel` (of x) name
/// the signal in an error.
pub(super) fn multi_rain_unchecked(
    group: [&[f64]; 3],
    settings: &DamageSettings,
    what: &'static str,
    channel: usize,
) -> Result<MultiRain, EngineError> {
    let damages = by_direction_unchecked(group, settings, what, channel)?;
    let mut best = 0;
    for (i, d) in damages.iter().enumerate() {
        if *d > damages[best] {
            best = i;
        }
    }
    Ok(MultiRain { damage: damages[best], direction: direction(best, settings.directions) })
}

fn by_direction_unchecked(
    group: [&[f64]; 3],
    settings: &DamageSettings,
    what: &'static str,
    channel: usize,
) -> Result<Vec<f64>, EngineError> {
    let largest: f64 = group.iter().map(|s| s.iter().fold(0.0, |m: f64, v| m.max(v.abs()))).sum();
    if !largest.is_finite() {
        return Err(EngineError::DamageOverflow { what, channel });
    }
    let damages = with_power(settings.slope, Directions { isa: Isa::of_process()?, group, settings });
    for damage in &damages {
        finite(*damage, what, channel)?;
    }
    Ok(damages)
}

/// A group of directions for which the samples are read once.
const AT_ONCE: usize = 16;

/// Damage of each direction.
struct Directions<'a> {
    isa: Isa,
    group: [&'a [f64]; 3],
    settings: &'a DamageSettings,
}

impl WithPower for Directions<'_> {
    type Answer = Vec<f64>;

    fn run<P: Power>(self, power: P) -> Vec<f64> {
        let n = self.settings.directions;
        let parts: Vec<Vec<f64>> = (0..n.div_ceil(AT_ONCE))
            .into_par_iter()
            .map(|part| {
                let first = part * AT_ONCE;
                let directions: Vec<_> = (first..(first + AT_ONCE).min(n)).map(|i| direction(i, n)).collect();
                self.damages(&directions, power)
            })
            .collect();
        parts.concat()
    }
}

impl Directions<'_> {
    fn damages<P: Power>(&self, directions: &[[f64; 3]], power: P) -> Vec<f64> {
        let n = self.group[0].len();
        let mut sums: Vec<_> = directions.iter().map(|_| MinerSum::new(power)).collect();
        let mut work = Block::new();
        if n == 0 {
            return vec![0.0; directions.len()];
        }
        let project_one = |d: &[f64; 3], i: usize| {
            d[0] * self.group[0][i] + d[1] * self.group[1][i] + d[2] * self.group[2][i]
        };
        for (d, sum) in directions.iter().zip(&mut sums) {
            sum.push(project_one(d, 0));
        }
        // Neighbouring blocks share two samples, so that each inner sample is the middle of three once.
        for start in (0..n.saturating_sub(2)).step_by(BLOCK - 2) {
            let span = start..(start + BLOCK).min(n);
            let block = self.group.map(|s| &s[span.clone()]);
            for (d, sum) in directions.iter().zip(&mut sums) {
                dispatch(self.isa, ProjectAndTake { channels: block, d: *d, block: &mut work });
                sum.push_block(&work);
            }
        }
        for (d, sum) in directions.iter().zip(&mut sums) {
            sum.push(project_one(d, n - 1));
        }
        sums.into_iter().map(|sum| sum.finish(self.settings.residue) / self.settings.constant).collect()
    }
}

/// Writes the projection `d . channels` into `block`; bit-identical on every instruction set.
struct ProjectAndTake<'a> {
    channels: [&'a [f64]; 3],
    d: [f64; 3],
    block: &'a mut Block,
}

impl Kernel for ProjectAndTake<'_> {
    type Out = ();
    const WIDE: bool = false;

    #[inline(always)]
    fn run<S: Simd>(self, s: S) {
        let Self { channels: [x, y, z], d, block } = self;
        let n = x.len();
        let (y, z) = (&y[..n], &z[..n]);
        block.take(s, n, |projected| {
            let projected = &mut projected[..n];
            for i in 0..n {
                projected[i] = d[0] * x[i] + d[1] * y[i] + d[2] * z[i];
            }
        });
    }
}

#[cfg(test)]
mod tests {
    use super::super::damage;
    use super::*;
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    /// Three low-passed noises, different in level.
    fn group(n: usize, seed: u64) -> [Vec<f64>; 3] {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        [1.0, 2.0, 0.5].map(|level| {
            let (mut a, mut b) = (0.0, 0.0);
            (0..n)
                .map(|_| {
                    a += 0.4 * (rng.random_range(-level..level) - a);
                    b += 0.4 * (a - b);
                    b
                })
                .collect()
        })
    }

    fn refs(group: &[Vec<f64>; 3]) -> [&[f64]; 3] {
        [&group[0], &group[1], &group[2]]
    }

    fn project(group: &[Vec<f64>; 3], d: [f64; 3]) -> Vec<f64> {
        (0..group[0].len()).map(|i| d[0] * group[0][i] + d[1] * group[1][i] + d[2] * group[2][i]).collect()
    }

    #[test]
    fn it_is_the_largest_damage_of_the_projected_signals() {
        for (n, slope) in [(1, 5.0), (2, 5.0), (3, 5.0), (500, 3.5), (2 * BLOCK + 7, 5.0)] {
            let group = group(n, 7);
            let settings = DamageSettings { slope, directions: 37, ..Default::default() };
            let found = multi_rain(refs(&group), &settings).unwrap();
            let all = damage_by_direction(refs(&group), &settings).unwrap();
            assert_eq!((all.len(), all.iter().copied().fold(0.0, f64::max)), (37, found.damage));
            let damages: Vec<f64> =
                (0..37).map(|i| damage(&project(&group, direction(i, 37)), &settings).unwrap()).collect();
            let mut best = 0;
            for i in 1..37 {
                if damages[i] > damages[best] {
                    best = i;
                }
            }
            // The same sums in the same order.
            assert_eq!(found.damage, damages[best], "{n} samples");
            assert_eq!(found.direction, direction(best, 37), "{n} samples");
        }
    }

    #[test]
    fn directions_are_unit_vectors_spread_evenly_over_the_upper_half() {
        let n = 500;
        let all: Vec<_> = (0..n).map(|i| direction(i, n)).collect();
        for d in &all {
            let norm: f64 = d.iter().map(|v| v * v).sum();
            assert!((norm - 1.0).abs() < 1e-14 && d[2] > 0.0);
        }
        // Evenly spread: the mean of p p^T over the half sphere is I / 3.
        for (i, j) in [(0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)] {
            let mean = all.iter().map(|d| d[i] * d[j]).sum::<f64>() / n as f64;
            let expected = if i == j { 1.0 / 3.0 } else { 0.0 };
            assert!((mean - expected).abs() < 2e-3, "{i}{j}: {mean}");
        }
        assert_eq!(direction(0, 500)[1], 0.0);
        assert_eq!(direction(0, 500)[2], 0.001);
    }

    #[test]
    fn a_uniaxial_load_is_found_in_its_direction() {
        let psi = direction(123, 500);
        let load: Vec<f64> = (0..400).map(|i| (0.3 * f64::from(i)).sin()).collect();
        let group = psi.map(|p| load.iter().map(|v| p * v).collect::<Vec<_>>());
        let found = multi_rain(refs(&group), &DamageSettings::default()).unwrap();
        assert_eq!(found.direction, psi);
        let uniaxial = damage(&load, &DamageSettings::default()).unwrap();
        // psi . psi is 1 to a few units in the last place, five times over.
        assert!((found.damage / uniaxial - 1.0).abs() < 1e-13);
    }

    #[test]
    fn a_direction_and_its_opposite_have_the_same_damage() {
        let group = group(3000, 3);
        let settings = DamageSettings::default();
        for i in [0, 17, 250, 499] {
            let d = direction(i, 500);
            let one = damage(&project(&group, d), &settings).unwrap();
            let opposite = damage(&project(&group, d.map(|v| -v)), &settings).unwrap();
            assert_eq!(one, opposite);
        }
        let negated = group.clone().map(|s| s.into_iter().map(|v| -v).collect::<Vec<_>>());
        assert_eq!(multi_rain(refs(&group), &settings), multi_rain(refs(&negated), &settings));
    }

    #[test]
    fn thread_count_changes_no_bit() {
        let group = group(5000, 11);
        let on = |threads| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            pool.install(|| multi_rain(refs(&group), &DamageSettings::default()).unwrap())
        };
        let one = on(1);
        assert!(one.damage > 0.0);
        for threads in [2, 3, 5] {
            assert_eq!(on(threads), one);
        }
    }

    #[test]
    fn every_instruction_set_gives_the_same_bits() {
        let group = group(BLOCK, 5);
        let (mut found, mut portable) = (Block::new(), Block::new());
        for isa in Isa::ALL {
            if !isa.is_available() {
                println!("skipped {}: not on this machine", isa.name());
                continue;
            }
            for n in [1, 2, 3, 4, 9, 1000, BLOCK] {
                let (channels, d) = (refs(&group).map(|s| &s[..n]), direction(33, 500));
                dispatch(isa, ProjectAndTake { channels, d, block: &mut found });
                dispatch(Isa::Portable, ProjectAndTake { channels, d, block: &mut portable });
                assert_eq!(found.points(), portable.points(), "{} {n} samples", isa.name());
                assert_eq!(found.closed(), portable.closed(), "{} {n} samples", isa.name());
            }
            assert!(!found.closed().is_empty());
        }
    }

    #[test]
    fn a_still_group_has_no_damage_and_the_first_direction() {
        for n in [0, 1, 50] {
            let group = [vec![1.0; n], vec![2.0; n], vec![3.0; n]];
            let found = multi_rain(refs(&group), &DamageSettings::default()).unwrap();
            assert_eq!(found.damage, 0.0);
            assert_eq!(found.direction, direction(0, 500));
        }
    }

    #[test]
    fn bad_groups_are_refused_by_channel_and_sample() {
        let settings = DamageSettings::default();
        let (a, b) = (vec![0.0, 1.0], vec![0.0, f64::INFINITY]);
        assert_eq!(
            multi_rain([&a, &b, &a], &settings),
            Err(EngineError::NonFinite { what: "group", channel: 1, sample: 1 })
        );
        assert_eq!(
            multi_rain([&a, &a, &a[..1]], &settings),
            Err(EngineError::UnequalLength { what: "group", channel: 2, expected: 2, found: 1 })
        );
        let huge = vec![f64::MAX, -f64::MAX];
        assert_eq!(
            multi_rain([&huge, &huge, &huge], &settings),
            Err(EngineError::DamageOverflow { what: "group", channel: 0 })
        );
    }

    /// Noise without content above `share` of the sample rate, by its spectrum.
    fn band_limited(n: usize, share: f64, rng: &mut ChaCha8Rng) -> Vec<f64> {
        let inverse = rigcast_numerics::fft::RealFftPlanner::new().plan_fft_inverse(n);
        let mut spectrum = inverse.make_input_vec();
        for line in &mut spectrum[1..(share * n as f64) as usize] {
            line.re = rng.random_range(-1.0..1.0);
            line.im = rng.random_range(-1.0..1.0);
        }
        let mut x = inverse.make_output_vec();
        inverse.process(&mut spectrum, &mut x).unwrap();
        x
    }

    #[test]
    #[ignore = "a timing of 500 directions over 3 x 600 s at 1 kHz; meant for a release build"]
    fn ten_minutes_of_three_channels_take_seconds_at_most() {
        let mut rng = ChaCha8Rng::seed_from_u64(1);
        let group = [(); 3].map(|()| band_limited(600_000, 0.08, &mut rng));
        let turning = super::super::turning_points(&group[0]).len();
        let mut times: Vec<f64> = (0..7)
            .map(|_| {
                let start = std::time::Instant::now();
                let found = multi_rain(refs(&group), &DamageSettings::default()).unwrap();
                assert!(found.damage > 0.0);
                start.elapsed().as_secs_f64()
            })
            .collect();
        times.sort_by(f64::total_cmp);
        println!("multi_rain: {times:.3?} s, {turning} turning points in x");
        // A wide bound, since other work may share the cores: an algorithm that is not O(n) takes minutes.
        assert!(times[0] < 10.0, "{times:?} s");
    }
}
