//! How much of the gap a fitted candidate leaves, and how sure that is.

use std::collections::BTreeMap;

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};

use super::echo::Echo;
use super::fitting::Fitted;
use super::naming::{line_in_disguise, misplaced, open_sandwich, passivity, straightened, unusual};
use super::problem::{Problem, Stretch, scored_rows};

/// Draws of the block bootstrap.
const DRAWS: usize = 400;
/// Length of a block: longer than the memory of most rigs, short enough that there are many.
const BLOCK_S: f64 = 0.5;

/// Share of the draws that the interval of 90 % holds, set on blind cases: where nothing is left, as with nearly
/// every effect that is named, the draws are of the noise alone, and what the law itself errs by is less.
const HELD: f64 = 0.8;

/// Standard error of the noise floor, relative to it: some thousand rows, and the model of their spectrum.
const FLOOR: f64 = 0.03;

/// Remaining shares that differ by less are equal.
pub(super) const EQUAL: f64 = 0.02;

/// A fitted candidate with its score on the select stretches.
#[derive(Debug, Clone)]
pub(super) struct Scored {
    /// Index of the problem, and so of the response.
    pub problem: usize,
    pub fitted: Fitted,
    /// Rows of the fit stretches of the response itself.
    pub fit_rows: f64,
    /// The same effect at the other responses.
    pub echoes: Vec<Echo>,
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
    /// A free shape that does as well straightened, a stop or a gap that is a line, or a sandwich with
    /// nothing before its middle.
    pub needless: bool,
    /// How far its force works as one at the response's own place does, -1 to 1.
    pub passivity: f64,
    /// Not far enough: whatever it closes, it is not this force.
    pub misplaced: bool,
    /// A law that has two names where the linear part is free too, and that fits the other better.
    pub unusual: bool,
}

/// Sums of squares in noise floors over blocks of time, and the rows that they stand for. Repeats share their
/// blocks: what a law errs by is the same in each of them, and would count as often as the drive was run.
#[derive(Debug, Clone)]
pub(super) struct Blocks {
    pub sums: Vec<f64>,
    pub rows: Vec<f64>,
}

/// Squares of residuals, `[stretch][sample]`, over blocks of time.
pub(super) fn blocks(stretches: &[Stretch], residuals: &[Vec<f64>], rate_hz: f64) -> Blocks {
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
pub(super) fn score(
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
    let needless = straight.is_some_and(|straight| straight - left < EQUAL)
        || open_sandwich(problem, &fitted.candidate, &fitted.p)
        || line_in_disguise(problem, &fitted, &predictions, chi2);
    let passivity = passivity(problem, &fitted, &predictions);
    let misplaced = misplaced(problem, &fitted.candidate, passivity);
    let fit_rows = scored_rows(&problem.fit);
    let unusual = unusual(problem, &fitted, &predictions);
    Some(Scored {
        problem: index,
        fitted,
        echoes: Vec::new(),
        host_chi2: chi2,
        chi2,
        remaining: left,
        beside: None,
        blocks,
        needless,
        passivity,
        misplaced,
        unusual,
        fit_rows,
    })
}

/// `(chi2 - 1)+ / (chi2_none - 1)`; 1 where there was no gap.
pub(super) fn remaining(chi2: f64, chi2_none: f64) -> f64 {
    if chi2_none > 1.0 { (chi2 - 1.0).max(0.0) / (chi2_none - 1.0) } else { 1.0 }
}

/// Shortest interval that holds the closure in 90 % of cases, by drawing blocks with replacement, and the floor of
/// the noise with them: where nothing is left above it, how well the floor is known is all that bounds the closure.
pub(super) fn closure_interval(before: &Blocks, after: &Blocks, seed: u64) -> [f64; 2] {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let n = before.sums.len();
    let mut closures: Vec<f64> = (0..DRAWS)
        .map(|_| {
            let (mut b, mut a, mut rows) = (0.0, 0.0, 0.0);
            for _ in 0..n {
                let k = rng.random_range(0..n);
                b += before.sums[k];
                a += after.sums[k];
                rows += before.rows[k];
            }
            let error: f64 = StandardNormal.sample(&mut rng);
            // Less than the floor says that the floor is wrong, and of what is left it says no more.
            1.0 - remaining((a / rows).max(1.0) + FLOOR * error, b / rows)
        })
        .collect();
    closures.sort_by(f64::total_cmp);
    shortest(&closures, (DRAWS as f64 * HELD) as usize)
}

/// Ends of the shortest interval that holds `count` of the sorted draws: no closure is above 1, and where many
/// are 1 an interval of equal tails would be as sure of them as one of 95 %.
fn shortest(draws: &[f64], count: usize) -> [f64; 2] {
    let ends = draws.windows(count).map(|held| [held[0], held[count - 1]]);
    ends.min_by(|a, b| (a[1] - a[0]).total_cmp(&(b[1] - b[0]))).expect("more draws than are held")
}

/// Whether the difference of two candidates on the same blocks may be chance: its 90 % interval,
/// blocks paired, holds 0.
pub(super) fn may_be_equal(a: &[f64], b: &[f64], seed: u64) -> bool {
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
mod tests {
    use super::*;
    use crate::engine::diagnosis::prepare::prepare;
    use crate::engine::diagnosis::tests::rig::{RATE, hardening, request};

    #[test]
    fn what_remains_is_counted_above_the_noise() {
        assert!((remaining(2.0, 11.0) - 0.1).abs() < 1e-15);
        assert_eq!(remaining(0.9, 11.0), 0.0);
        assert_eq!(remaining(0.9, 0.8), 1.0);
    }

    #[test]
    fn repeats_share_their_blocks() {
        let prepared = prepare(&request(hardening, 0.01)).unwrap();
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
    fn the_shortest_interval_of_draws_that_pile_up_at_an_end_reaches_it() {
        let draws = [0.0, 1.0, 2.0, 3.0, 3.5, 3.75, 4.0, 4.0, 4.0, 4.0];
        assert_eq!(shortest(&draws, 9), [1.0, 4.0]);
        assert_eq!(shortest(&draws, 5), [3.75, 4.0]);
    }
}
