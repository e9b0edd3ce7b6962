//! How much of the gap a fitted candidate leaves, and how sure that is.

use std::collections::BTreeMap;

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};

use super::naming::{
    alias_preferred, line_in_disguise, more_than_its_drive, not_collocated, open_sandwich, passivity,
    straightened,
};
use super::propagation::Propagation;
use crate::diagnosis::data::problem::{Problem, Stretch, scored_rows};
#[cfg(test)]
use crate::diagnosis::effects::candidate::{Candidate, Part};
use crate::diagnosis::fit::fitting::Fitted;

/// Draws of the block bootstrap.
const DRAWS: usize = 400;
/// Length of a block: longer than the memory of most rigs, short enough that there are many.
const BLOCK_S: f64 = 0.5;

/// Coverage of the interval of a closure.
const COVERAGE: f64 = 0.9;

/// Standard error of the noise floor, relative to it: some thousand rows, and the model of their spectrum.
const FLOOR: f64 = 0.03;

/// Remaining shares that differ by less are equal.
pub const EQUAL: f64 = 0.02;

/// A fitted candidate with its score on the select stretches.
#[derive(Debug, Clone)]
pub struct Scored {
    /// Index of the problem, and so of the response.
    pub problem: usize,
    pub fitted: Fitted,
    /// Rows of the fit stretches of the response itself.
    pub fit_rows: f64,
    /// The same effect at the other responses.
    pub propagations: Vec<Propagation>,
    /// Mean square in noise floors on the select stretches of the response itself.
    pub host_chi2: f64,
    /// The same over all responses with a gap.
    pub chi2: f64,
    /// Share of the gap that remains, `(chi2 - 1)+ / (chi2_none - 1)`.
    pub remaining: f64,
    /// The same where a linear change may stand beside it, if that was asked.
    pub beside: Option<f64>,
    /// Squared rows per block of the select stretches.
    pub blocks: Vec<f64>,
    /// A free shape that does as well straightened, a stop or a gap that is a line, a sandwich with
    /// nothing before its middle, or a bend that exceeds its drive.
    pub overflexible: bool,
    /// How far its force works as one at the response's own place does, -1 to 1.
    pub passivity: f64,
    /// Not far enough: whatever it closes, it is not this force.
    pub not_collocated: bool,
    /// A law that has two names where the linear part is free too, and that fits the other better.
    pub alias_preferred: bool,
}

/// Sums of squares in noise floors over blocks of time, and the rows that they stand for. Repeats share their
/// blocks: what a law errs by is the same in each of them, and would count as often as the drive was run.
#[derive(Debug, Clone)]
pub struct Blocks {
    pub sums: Vec<f64>,
    pub rows: Vec<f64>,
}

/// Squares of residuals, `[stretch][sample]`, over blocks of time.
pub fn blocks(stretches: &[Stretch], residuals: &[Vec<f64>], rate_hz: f64) -> Blocks {
    let mut by_drive: BTreeMap<(usize, usize), (f64, f64)> = BTreeMap::new();
    for (stretch, residual) in stretches.iter().zip(residuals) {
        let white = stretch.rows.whitened(&residual[stretch.lead..]);
        let len = ((BLOCK_S * rate_hz) as usize).clamp(1, white.len());
        let count = (white.len() / len).max(1);
        for k in 0..count {
            let (from, to) = (k * white.len() / count, (k + 1) * white.len() / count);
            let block = by_drive.entry((stretch.group, k)).or_default();
            block.0 += white[from..to].iter().map(|e| e * e).sum::<f64>();
            block.1 += stretch.rows.len() as f64 / count as f64;
        }
    }
    let (sums, rows) = by_drive.into_values().unzip();
    Blocks { sums, rows }
}

/// Scores a fitted candidate; `None` if its free run of a select stretch runs away.
pub fn score(
    index: usize,
    problem: &Problem,
    fitted: Fitted,
    chi2_none: f64,
    rate_hz: f64,
) -> Option<Scored> {
    let predictions = fitted.candidate.predictions(problem, &problem.select, &fitted.p)?;
    let chi2 = problem.chi2(&problem.select, &predictions);
    let residuals: Vec<Vec<f64>> =
        problem.select.iter().zip(&predictions).map(|(s, p)| s.residual(p)).collect();
    let blocks = blocks(&problem.select, &residuals, rate_hz).sums;
    let left = remaining(chi2, chi2_none);
    let straight = straightened(problem, &fitted).map(|chi2| remaining(chi2, chi2_none));
    let overflexible = straight.is_some_and(|straight| straight - left < EQUAL)
        || open_sandwich(problem, &fitted.candidate, &fitted.p)
        || line_in_disguise(problem, &fitted, &predictions, chi2)
        || more_than_its_drive(problem, &fitted);
    let passivity = passivity(problem, &fitted, &predictions);
    let not_collocated = not_collocated(problem, &fitted.candidate, passivity);
    let fit_rows = scored_rows(&problem.fit);
    let alias_preferred = alias_preferred(problem, &fitted, &predictions);
    Some(Scored {
        problem: index,
        fitted,
        propagations: Vec::new(),
        host_chi2: chi2,
        chi2,
        remaining: left,
        beside: None,
        blocks,
        overflexible,
        passivity,
        not_collocated,
        alias_preferred,
        fit_rows,
    })
}

/// `(chi2 - 1)+ / (chi2_none - 1)`; 1 where there was no gap.
pub fn remaining(chi2: f64, chi2_none: f64) -> f64 {
    if chi2_none > 1.0 { (chi2 - 1.0).max(0.0) / (chi2_none - 1.0) } else { 1.0 }
}

/// Share of the gap that remains, `(chi2 - 1) / (chi2_none - 1)`, below 0 where less is left than the noise
/// floor says; 1 where there was no gap.
fn unbounded(chi2: f64, chi2_none: f64) -> f64 {
    if chi2_none > 1.0 { (chi2 - 1.0) / (chi2_none - 1.0) } else { 1.0 }
}

/// Interval that holds the closure with a probability of 90 %, whatever the closure is: that of
/// [`bounded_interval`] for the share of the gap that remains, whose standard error comes of drawing blocks
/// with replacement and the noise floor within its own error.
pub fn closure_interval(before: &Blocks, after: &Blocks, seed: u64) -> [f64; 2] {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let n = before.sums.len();
    let mut shares: Vec<f64> = (0..DRAWS)
        .map(|_| {
            let (mut b, mut a, mut rows) = (0.0, 0.0, 0.0);
            for _ in 0..n {
                let k = rng.random_range(0..n);
                b += before.sums[k];
                a += after.sums[k];
                rows += before.rows[k];
            }
            let error: f64 = StandardNormal.sample(&mut rng);
            let floors = (1.0 + FLOOR * error) / rows;
            unbounded(a * floors, b * floors)
        })
        .collect();
    shares.sort_by(f64::total_cmp);
    // One standard deviation to either side; draws in which hardly a gap was left are far out.
    let error = 0.5 * (shares[DRAWS * 84 / 100] - shares[DRAWS * 16 / 100]);
    let rows: f64 = before.rows.iter().sum();
    let share = unbounded(after.sums.iter().sum::<f64>() / rows, before.sums.iter().sum::<f64>() / rows);
    if error > 0.0 {
        bounded_interval(share / error).map(|end| 1.0 - error * end)
    } else {
        [1.0 - share.max(0.0); 2]
    }
}

/// Ends, the larger first, of the interval for a mean that cannot be negative, from one estimate of it with
/// a normal error of standard deviation 1. It holds the mean in 90 % of cases, at its bound too, where
/// one of equal tails would in 95 %: it is made of the means under which the estimate is among the
/// most likely 90 % by likelihood ratio (Feldman and Cousins, Phys. Rev. D 57 (1998) 3873, section IV.B).
fn bounded_interval(estimate: f64) -> [f64; 2] {
    let normal = |x: f64| 0.5 * libm::erfc(-x / std::f64::consts::SQRT_2);
    // Probability, for this mean, of estimates with a larger ratio of its likelihood to the largest one.
    let nearer = |mean: f64| {
        let ratio = if estimate >= 0.0 { (estimate - mean).powi(2) } else { mean * (mean - 2.0 * estimate) };
        let reach = ratio.sqrt();
        let below = if reach <= mean { -reach } else { (mean * mean - ratio) / (2.0 * mean) - mean };
        normal(reach) - normal(below)
    };
    let nearest = estimate.max(0.0);
    let upper = where_reached(nearer, [nearest, nearest + 2.0]);
    let lower = if normal(nearest) <= COVERAGE { 0.0 } else { where_reached(nearer, [nearest, 0.0]) };
    [upper, lower]
}

/// Where a probability that rises along the way reaches the coverage.
fn where_reached(probability: impl Fn(f64) -> f64, [mut inside, mut outside]: [f64; 2]) -> f64 {
    for _ in 0..60 {
        let middle = 0.5 * (inside + outside);
        if probability(middle) <= COVERAGE { inside = middle } else { outside = middle }
    }
    inside
}

/// Whether the difference of two candidates on the same blocks may be chance: its 90 % interval,
/// blocks paired, holds 0.
pub fn may_be_equal(a: &[f64], b: &[f64], seed: u64) -> bool {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let n = a.len().min(b.len());
    let mut differences: Vec<f64> = (0..DRAWS)
        .map(|_| {
            (0..n)
                .map(|_| {
                    let k = rng.random_range(0..n);
                    b[k] - a[k]
                })
                .sum()
        })
        .collect();
    differences.sort_by(f64::total_cmp);
    differences[DRAWS / 20] <= 0.0 && differences[DRAWS - 1 - DRAWS / 20] >= 0.0
}

#[cfg(test)]
impl Scored {
    /// A candidate of one part at the only response, which leaves `chi2` of `chi2_none` in so many rows.
    pub fn leaving(part: Part, chi2: f64, chi2_none: f64, rows: f64) -> Self {
        let candidate = Candidate::of(part, false);
        let fitted = Fitted { candidate, p: Vec::new(), scale: Vec::new(), chi2_fit: chi2 };
        Self {
            problem: 0,
            fitted,
            fit_rows: rows,
            propagations: Vec::new(),
            host_chi2: chi2,
            chi2,
            remaining: remaining(chi2, chi2_none),
            beside: None,
            blocks: vec![chi2; 20],
            overflexible: false,
            passivity: 1.0,
            not_collocated: false,
            alias_preferred: false,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::diagnosis::data::prepare::prepare;
    use crate::diagnosis::tests::rig::{RATE, hardening, request};
    use crate::progress::unwatched;

    #[test]
    fn what_remains_is_counted_above_the_noise() {
        assert!((remaining(2.0, 11.0) - 0.1).abs() < 1e-15);
        assert_eq!(remaining(0.9, 11.0), 0.0);
        assert_eq!(remaining(0.9, 0.8), 1.0);
    }

    #[test]
    fn repeats_share_their_blocks() {
        let prepared = prepare(&request(hardening, 0.01), &unwatched).unwrap();
        let problem = &prepared.problems[0];
        let gaps: Vec<Vec<f64>> = problem.select.iter().map(|s| s.gap(0)).collect();
        let of = |range: std::ops::Range<usize>| blocks(&problem.select[range.clone()], &gaps[range], RATE);
        let (one, both, all) = (of(0..1), of(0..2), of(0..problem.select.len()));
        let groups: Vec<usize> = problem.select.iter().map(|s| s.group).collect();
        assert_eq!(groups[0], groups[1], "a run and its repeat");
        assert_eq!(one.sums.len(), both.sums.len());
        assert!(one.sums.iter().zip(&both.sums).all(|(one, both)| (one / both - 0.5).abs() < 0.2));
        assert_eq!(both.rows[0], 2.0 * one.rows[0]);
        assert!(all.sums.len() > both.sums.len());
    }

    #[test]
    fn the_interval_holds_the_closure_of_even_blocks_and_is_narrow() {
        let before = Blocks { sums: vec![110.0; 40], rows: vec![10.0; 40] };
        let after = Blocks { sums: (0..40).map(|k| 15.0 + f64::from(k % 5)).collect(), rows: vec![10.0; 40] };
        let [low, high] = closure_interval(&before, &after, 1);
        assert!(low < 0.93 && high > 0.93 && high - low < 0.05, "{low} {high}");
        assert!(!may_be_equal(&before.sums, &after.sums, 1));
        assert!(may_be_equal(&after.sums, &after.sums, 1));
        let nothing = Blocks { sums: vec![7.0; 40], rows: vec![10.0; 40] };
        let [low, high] = closure_interval(&before, &nothing, 1);
        assert!(low < 1.0 && 1.0 - low < FLOOR / 5.0 && high == 1.0, "as sure as the floor: {low} {high}");
    }

    #[test]
    fn the_interval_of_a_bounded_mean_is_that_of_feldman_and_cousins() {
        // Their table X, 90 %.
        for (estimate, lower, upper) in [
            (-3.0, 0.0, 0.26),
            (-1.0, 0.0, 0.81),
            (0.0, 0.0, 1.64),
            (1.0, 0.0, 2.64),
            (1.3, 0.02, 2.94),
            (2.0, 0.58, 3.64),
            (3.0, 1.37, 4.64),
        ] {
            let found = bounded_interval(estimate);
            assert!(
                (found[0] - upper).abs() < 0.006 && (found[1] - lower).abs() < 0.006,
                "{estimate}: {found:?}"
            );
        }
    }

    /// Blocks of a response whose error has this mean square in noise floors before and after, with a floor
    /// that is known within its standard error.
    fn measured(before: f64, after: f64, rng: &mut ChaCha8Rng) -> [Blocks; 2] {
        const BLOCKS: usize = 32;
        const ROWS: usize = 40;
        let floor: f64 = 1.0 + FLOOR * Distribution::<f64>::sample(&StandardNormal, rng);
        let mut of = |chi2: f64| {
            let mut block = || -> f64 {
                let row = |_| Distribution::<f64>::sample(&StandardNormal, rng).powi(2);
                (0..ROWS).map(row).sum::<f64>() * chi2 / floor
            };
            Blocks { sums: (0..BLOCKS).map(|_| block()).collect(), rows: vec![ROWS as f64; BLOCKS] }
        };
        [of(before), of(after)]
    }

    #[test]
    fn the_interval_of_90_per_cent_holds_the_closure_in_90_of_100_cases() {
        const CASES: u64 = 1500;
        // From nothing left, at the closure's bound, to most of the gap.
        for (before, after) in [(60.0, 1.0), (5.0, 1.0), (60.0, 1.1), (20.0, 3.0), (6.0, 4.0)] {
            let truth = 1.0 - remaining(after, before);
            let mut rng = ChaCha8Rng::seed_from_u64(7);
            let held = (0..CASES).filter(|seed| {
                let [b, a] = measured(before, after, &mut rng);
                let [low, high] = closure_interval(&b, &a, *seed);
                low <= truth && truth <= high
            });
            let share = held.count() as f64 / CASES as f64;
            // Two standard errors of the count, and a bootstrap of 32 blocks that is a little narrow.
            assert!((share - 0.9).abs() < 0.025, "{before} to {after}: {share}");
        }
    }
}
