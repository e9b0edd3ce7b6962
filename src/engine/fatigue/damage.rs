//! Palmgren-Miner damage of a signal for `N = K * S_a^-k`, and damage ratios.
//!
//! Source: Heindel et al. (arXiv 2107.03645), section 3.2. This is the damage of a fictitious
//! Woehler line without endurance limit and without mean stress correction. It serves to compare signals
//! and does not predict a life.

use serde::{Deserialize, Serialize};

use super::block::{BLOCK, Block};
use super::rainflow::{Residue, Stack};
use crate::simd::{Isa, Kernel, Simd, dispatch};
use crate::{EngineError, first_not_finite};

/// Settings of a damage figure, which every answer repeats.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct DamageSettings {
    /// `k` of `N = K * S_a^-k`, in (0, 50].
    pub slope: f64,
    /// `K` of `N = K * S_a^-k`: cycles to failure at amplitude 1 in the channel's unit.
    pub constant: f64,
    /// Treatment of the residue.
    pub residue: Residue,
    /// Directions of Multi-Rain, 1..=10000.
    pub directions: usize,
}

impl Default for DamageSettings {
    /// The source paper's settings: `k = 5`, `K = 1e7`, 500 directions. The paper names no residue method;
    /// the default here is `repeated`.
    fn default() -> Self {
        Self { slope: 5.0, constant: 1e7, residue: Residue::Repeated, directions: 500 }
    }
}

impl DamageSettings {
    /// # Errors
    /// [`EngineError::Setting`] with `damage.slope`, `damage.constant` or `damage.directions`.
    pub fn check(&self) -> Result<(), EngineError> {
        let refuse = |setting, found: String, limit: &str| {
            Err(EngineError::Setting { setting, found, limit: limit.into() })
        };
        if !(self.slope > 0.0 && self.slope <= 50.0) {
            return refuse("damage.slope", self.slope.to_string(), "above 0, at most 50");
        }
        if !(self.constant.is_finite() && self.constant > 0.0) {
            return refuse("damage.constant", self.constant.to_string(), "a positive, finite number");
        }
        if !(1..=10_000).contains(&self.directions) {
            return refuse("damage.directions", self.directions.to_string(), "from 1 to 10000");
        }
        Ok(())
    }
}

/// Palmgren-Miner sum `D = sum n_i / N_i = sum n_i * S_a,i^k / K` over the rainflow cycles of
/// `samples` (Heindel et al., section 3.2); 0 for fewer than two different samples.
///
/// # Errors
/// Settings outside their limits; a sample that is not finite; damage beyond `f64`.
pub fn damage(samples: &[f64], settings: &DamageSettings) -> Result<f64, EngineError> {
    settings.check()?;
    check_finite("signal", 0, samples)?;
    damage_unchecked(samples, settings, "signal", 0)
}

/// Damage of finite samples for checked settings; `what` and `channel` are for the error.
pub(super) fn damage_unchecked(
    samples: &[f64],
    settings: &DamageSettings,
    what: &'static str,
    channel: usize,
) -> Result<f64, EngineError> {
    struct Channel<'a>(Isa, &'a [f64], Residue);
    impl WithPower for Channel<'_> {
        type Answer = f64;
        fn run<P: Power>(self, power: P) -> f64 {
            let Self(isa, samples, residue) = self;
            let [first, .., last] = *samples else { return 0.0 };
            let mut sum = MinerSum::new(power);
            let mut block = Block::new();
            sum.push(first);
            // Neighbouring blocks share two samples, so that each inner sample is the middle of three once.
            for start in (0..samples.len().saturating_sub(2)).step_by(BLOCK - 2) {
                let part = &samples[start..(start + BLOCK).min(samples.len())];
                dispatch(isa, Take { samples: part, block: &mut block });
                sum.push_block(&block);
            }
            sum.push(last);
            sum.finish(residue)
        }
    }
    let channel_sum = Channel(Isa::of_process()?, samples, settings.residue);
    finite(with_power(settings.slope, channel_sum) / settings.constant, what, channel)
}

/// Copies samples into a block; bit-identical on every instruction set.
struct Take<'a> {
    samples: &'a [f64],
    block: &'a mut Block,
}

impl Kernel for Take<'_> {
    type Out = ();
    const WIDE: bool = false;

    #[inline(always)]
    fn run<S: Simd>(self, s: S) {
        self.block.take(s, self.samples.len(), |block| block.copy_from_slice(self.samples));
    }
}

/// `S_a -> S_a^k` for one slope. Each slope is a type of its own, so that the compiler inlines it into the
/// counting loop.
pub(super) trait Power: Copy + Send + Sync {
    /// The k-th power of a non-negative amplitude.
    fn of(self, amplitude: f64) -> f64;
}

/// Whole slopes: multiplications only, as exact and many times faster than `powf`.
#[derive(Clone, Copy)]
struct Whole<const K: u32>;

impl<const K: u32> Power for Whole<K> {
    #[inline(always)]
    fn of(self, amplitude: f64) -> f64 {
        // Not `powi`, whose precision is unspecified; this order of products is fixed.
        let (mut result, mut base, mut k) = (1.0, amplitude, K);
        loop {
            if k & 1 == 1 {
                result *= base;
            }
            k >>= 1;
            if k == 0 {
                return result;
            }
            base *= base;
        }
    }
}

/// Any other slope.
#[derive(Clone, Copy)]
struct Real(f64);

impl Power for Real {
    #[inline]
    fn of(self, amplitude: f64) -> f64 {
        amplitude.powf(self.0)
    }
}

/// Work that needs a power; see [`with_power`].
pub(super) trait WithPower {
    /// Result of the work.
    type Answer;
    /// Does the work for one slope.
    fn run<P: Power>(self, power: P) -> Self::Answer;
}

/// Runs `work` with the fastest power for `slope`.
pub(super) fn with_power<W: WithPower>(slope: f64, work: W) -> W::Answer {
    match slope {
        1.0 => work.run(Whole::<1>),
        2.0 => work.run(Whole::<2>),
        3.0 => work.run(Whole::<3>),
        4.0 => work.run(Whole::<4>),
        5.0 => work.run(Whole::<5>),
        6.0 => work.run(Whole::<6>),
        7.0 => work.run(Whole::<7>),
        8.0 => work.run(Whole::<8>),
        9.0 => work.run(Whole::<9>),
        10.0 => work.run(Whole::<10>),
        _ => work.run(Real(slope)),
    }
}

/// `sum n_i * S_a,i^k` of turning points that come one by one.
pub(super) struct MinerSum<P> {
    stack: Stack<f64>,
    power: P,
    sum: f64,
}

impl<P: Power> MinerSum<P> {
    /// A sum without cycles.
    pub(super) fn new(power: P) -> Self {
        Self { stack: Stack { points: Vec::new() }, power, sum: 0.0 }
    }

    /// Adds the next candidate for a turning point.
    #[inline(always)]
    pub(super) fn push(&mut self, value: f64) {
        let (power, sum) = (self.power, &mut self.sum);
        self.stack.push(value, |from, to| *sum += power.of(0.5 * (to - from).abs()));
    }

    /// Adds the cycles and the remaining turning points of a block.
    #[inline]
    pub(super) fn push_block(&mut self, block: &Block) {
        // Lanes, so that the powers are computed in parallel; their order is fixed here, not by
        // the instruction set.
        let mut lanes = [0.0; 8];
        let (eights, rest) = block.closed().as_chunks::<8>();
        for ranges in eights {
            for (lane, range) in lanes.iter_mut().zip(ranges) {
                *lane += self.power.of(0.5 * range);
            }
        }
        for (lane, range) in lanes.iter_mut().zip(rest) {
            *lane += self.power.of(0.5 * range);
        }
        self.sum += lanes.iter().sum::<f64>();
        for &value in block.points() {
            self.push(value);
        }
    }

    /// Counts the residue and returns the sum.
    pub(super) fn finish(mut self, residue: Residue) -> f64 {
        match residue {
            Residue::Ignore => {}
            Residue::Half => {
                for w in self.stack.points.windows(2) {
                    self.sum += 0.5 * self.power.of(0.5 * (w[1] - w[0]).abs());
                }
            }
            Residue::Repeated => {
                for value in self.stack.points.clone() {
                    self.push(value);
                }
            }
        }
        self.sum
    }
}

/// The reason why there is no damage ratio.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum NoRatio {
    /// The target does no damage, so that the ratio is undefined.
    TargetDamageZero,
}

/// Predicted over target damage (Heindel et al., section 3.2), or the reason why there is none.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct DamageRatio {
    /// 1 is perfect; `None` comes with a reason.
    pub ratio: Option<f64>,
    /// Present when there is no ratio.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub reason: Option<NoRatio>,
}

impl DamageRatio {
    /// Ratio of two damages; not finite where it overflows.
    pub fn of(predicted: f64, target: f64) -> Self {
        if target == 0.0 {
            return Self { ratio: None, reason: Some(NoRatio::TargetDamageZero) };
        }
        Self { ratio: Some(predicted / target), reason: None }
    }
}

/// # Errors
/// [`EngineError::NonFinite`] for the first sample that is not finite.
pub(super) fn check_finite(what: &'static str, channel: usize, samples: &[f64]) -> Result<(), EngineError> {
    match first_not_finite(samples) {
        Some(sample) => Err(EngineError::NonFinite { what, channel, sample }),
        None => Ok(()),
    }
}

/// Refuses a damage that is not finite.
pub(super) fn finite(damage: f64, what: &'static str, channel: usize) -> Result<f64, EngineError> {
    if damage.is_finite() { Ok(damage) } else { Err(EngineError::DamageOverflow { what, channel }) }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::fatigue::{Prefilter, Rainflow};
    use proptest::prelude::*;

    fn settings(slope: f64, residue: Residue) -> DamageSettings {
        DamageSettings { slope, residue, ..Default::default() }
    }

    #[test]
    fn damage_of_one_repeated_range_is_one_over_its_life() {
        // Amplitude 10, K = 1e7, k = 5: N = 1e7 * 10^-5 = 100 cycles.
        let d = damage(&[-10.0, 10.0], &DamageSettings::default()).unwrap();
        assert_eq!(d, 0.01);
        assert_eq!(damage(&[-10.0, 10.0], &settings(5.0, Residue::Half)).unwrap(), 0.005);
        assert_eq!(damage(&[-10.0, 10.0], &settings(5.0, Residue::Ignore)).unwrap(), 0.0);
    }

    #[test]
    fn signals_that_do_not_move_do_no_damage() {
        for x in [&[][..], &[4.0], &[4.0, 4.0, 4.0]] {
            assert_eq!(damage(x, &DamageSettings::default()).unwrap(), 0.0);
        }
    }

    #[test]
    fn whole_slopes_agree_with_powf() {
        // powf is right to one unit in the last place, k - 1 products to k / 2 such units.
        for k in 1..=10 {
            for a in [0.0, 1e-3, 0.7, 1.0, 3.3, 1e6] {
                struct At(f64);
                impl WithPower for At {
                    type Answer = f64;
                    fn run<P: Power>(self, power: P) -> f64 {
                        power.of(self.0)
                    }
                }
                let whole = with_power(f64::from(k), At(a));
                let real = a.powf(f64::from(k));
                assert!((whole - real).abs() <= 2e-15 * real, "{a}^{k}: {whole} {real}");
            }
        }
    }

    #[test]
    fn damage_beyond_numbers_is_an_error() {
        let x = [-1e200, 1e200];
        assert_eq!(
            damage(&x, &DamageSettings::default()),
            Err(EngineError::DamageOverflow { what: "signal", channel: 0 })
        );
        let tiny = DamageSettings { constant: f64::MIN_POSITIVE, ..Default::default() };
        assert!(matches!(damage(&[-10.0, 10.0], &tiny), Err(EngineError::DamageOverflow { .. })));
        let nan = damage(&[0.0, f64::NAN], &DamageSettings::default());
        assert_eq!(nan, Err(EngineError::NonFinite { what: "signal", channel: 0, sample: 1 }));
    }

    #[test]
    fn settings_name_what_is_outside_its_limits() {
        let d = DamageSettings::default();
        let name = |s: DamageSettings| match s.check() {
            Err(EngineError::Setting { setting, .. }) => setting,
            other => panic!("{other:?}"),
        };
        for slope in [0.0, -1.0, 50.1, f64::NAN, f64::INFINITY] {
            assert_eq!(name(DamageSettings { slope, ..d }), "damage.slope");
        }
        for constant in [0.0, -1.0, f64::NAN, f64::INFINITY] {
            assert_eq!(name(DamageSettings { constant, ..d }), "damage.constant");
        }
        for directions in [0, 10_001] {
            assert_eq!(name(DamageSettings { directions, ..d }), "damage.directions");
        }
        assert!(DamageSettings { slope: 50.0, directions: 10_000, ..d }.check().is_ok());
    }

    #[test]
    fn settings_in_json_have_the_documented_defaults() {
        let d: DamageSettings = serde_json::from_str("{}").unwrap();
        assert_eq!(
            serde_json::to_string(&d).unwrap(),
            r#"{"slope":5.0,"constant":10000000.0,"residue":"repeated","directions":500}"#
        );
        assert!(serde_json::from_str::<DamageSettings>(r#"{"k": 5}"#).is_err());
        assert!(serde_json::from_str::<DamageSettings>(r#"{"residue": "full"}"#).is_err());
    }

    #[test]
    fn a_target_without_damage_gives_a_reason_instead_of_a_ratio() {
        let json = |r| serde_json::to_string(&r).unwrap();
        assert_eq!(json(DamageRatio::of(3.0, 2.0)), r#"{"ratio":1.5}"#);
        assert_eq!(json(DamageRatio::of(1.0, 0.0)), r#"{"ratio":null,"reason":"target_damage_zero"}"#);
        assert_eq!(json(DamageRatio::of(0.0, 0.0)), r#"{"ratio":null,"reason":"target_damage_zero"}"#);
    }

    fn signal() -> impl Strategy<Value = Vec<f64>> {
        prop::collection::vec((-40i8..40).prop_map(|v| f64::from(v) * 0.1), 0..80)
    }

    fn residue() -> impl Strategy<Value = Residue> {
        prop_oneof![Just(Residue::Ignore), Just(Residue::Half), Just(Residue::Repeated)]
    }

    /// Sums in another order differ by rounding only: at most 80 terms.
    fn close(a: f64, b: f64) -> bool {
        (a - b).abs() <= 1e-13 * a.abs().max(b.abs())
    }

    proptest! {
        #[test]
        fn damage_is_the_sum_over_the_listed_cycles(
            x in signal(), residue in residue(), k in prop_oneof![Just(5.0), Just(3.7), Just(12.0)]
        ) {
            let cycles = Rainflow::of_signal(&x, &Prefilter::default()).all_cycles(residue);
            let listed: f64 = cycles.iter().map(|c| c.count * c.amplitude().powf(k) / 1e7).sum();
            let d = damage(&x, &settings(k, residue)).unwrap();
            prop_assert!(close(d, listed), "{d} {listed}");
        }

        #[test]
        fn scaling_by_a_scales_damage_by_a_to_the_k(x in signal(), residue in residue(), a in -3.0..3.0f64) {
            let s = settings(5.0, residue);
            let scaled: Vec<f64> = x.iter().map(|v| 4.0 * v).collect();
            // A power of two changes no digit.
            prop_assert_eq!(damage(&scaled, &s).unwrap(), 1024.0 * damage(&x, &s).unwrap());
            let scaled: Vec<f64> = x.iter().map(|v| a * v).collect();
            let (d, expected) = (damage(&scaled, &s).unwrap(), a.abs().powi(5) * damage(&x, &s).unwrap());
            // Equal ranges may round differently and pair up in another way; apart from small ranges the
            // sum is then the same but for rounding.
            prop_assert!((d - expected).abs() <= 1e-12 * expected.max(f64::MIN_POSITIVE), "{d} {expected}");
        }

        #[test]
        fn sign_and_doubled_samples_change_nothing(x in signal(), residue in residue()) {
            let s = settings(5.0, residue);
            let d = damage(&x, &s).unwrap();
            let negated: Vec<f64> = x.iter().map(|v| -v).collect();
            let doubled: Vec<f64> = x.iter().flat_map(|&v| [v, v]).collect();
            prop_assert_eq!(damage(&negated, &s).unwrap(), d);
            // Plateaus take the slow path, which sums in another order.
            prop_assert!(close(damage(&doubled, &s).unwrap(), d));
        }
    }

    #[test]
    fn a_signal_longer_than_a_block_counts_across_the_joints() {
        // Plateaus, ends and extremes fall on every place of a block as the length changes.
        for n in [BLOCK - 1, BLOCK, BLOCK + 1, 3 * BLOCK + 5] {
            let x: Vec<f64> = (0..n)
                .map(|i| ((i * i) % 17) as f64 - ((i / 3) % 5) as f64 + (i as f64 * 0.01).sin())
                .collect();
            let cycles = Rainflow::of_signal(&x, &Prefilter::default()).all_cycles(Residue::Repeated);
            let listed: f64 = cycles.iter().map(|c| c.amplitude().powf(5.0)).sum::<f64>() / 1e7;
            let d = damage(&x, &DamageSettings::default()).unwrap();
            // A few thousand terms.
            assert!((d - listed).abs() <= 1e-11 * listed, "{n}: {d} {listed}");
        }
    }
}
