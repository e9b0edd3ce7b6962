//! The vectorised first stage of damage counting: a block of samples becomes a few turning points.
//!
//! Rainflow on a stack costs two mispredicted branches per turning point, many times the cost of the
//! arithmetic. Most cycles are therefore closed before the stack, without branches on data. The
//! four-point rule closes a range that is smaller than both its neighbours whatever comes before and
//! after it; in noise a third of all ranges is such. Three passes leave about a sixth of the points to the
//! stack. The cycles are the same, in another order.

use crate::simd::Simd;

/// Samples per block, small enough for the first-level cache.
pub(super) const BLOCK: usize = 1024;

/// Values that are compared at once.
const AT_ONCE: usize = 8;

/// Length of the buffers: a block and some padding, so that its last values need no special case.
type Padded = [f64; BLOCK + 2 * AT_ONCE];

/// Passes that close cycles; a fourth gains nothing.
const PASSES: usize = 3;

/// Work space of a block; nothing in it is kept from block to block.
pub(super) struct Block {
    samples: Padded,
    points: Padded,
    n_points: usize,
    ranges: Padded,
    closed: Padded,
    n_closed: usize,
}

impl Block {
    /// Empty.
    pub(super) fn new() -> Self {
        let empty = [0.0; BLOCK + 2 * AT_ONCE];
        Self { samples: empty, points: empty, n_points: 0, ranges: empty, closed: empty, n_closed: 0 }
    }

    /// Lets `fill` write `n` samples (at most [`BLOCK`]), finds the turning points among the inner
    /// ones and closes cycles among them.
    #[inline(always)]
    pub(super) fn take<S: Simd>(&mut self, s: S, n: usize, fill: impl FnOnce(&mut [f64])) {
        fill(&mut self.samples[..n]);
        let tests = n.saturating_sub(2);
        self.n_points = 0;
        for first in (0..tests).step_by(AT_ONCE) {
            let [a, b, c] = [0, 1, 2].map(|k| eight(&self.samples, first + k));
            // All points but those inside a strictly monotone part. Comparisons only, so that no
            // difference can overflow.
            let monotone = s.less(a, b) & s.less(b, c) | s.less(b, a) & s.less(c, b);
            let turns = !monotone & valid(tests - first);
            s.compress(*b, turns, eight_mut(&mut self.points, self.n_points));
            self.n_points += turns.count_ones() as usize;
        }
        self.n_closed = 0;
        for _ in 0..PASSES {
            if !self.close_small_ranges(s) {
                break;
            }
        }
    }

    /// The remaining turning points, in order. Plateaus may leave points that do not turn.
    pub(super) fn points(&self) -> &[f64] {
        &self.points[..self.n_points]
    }

    /// Ranges of the cycles that were closed.
    pub(super) fn closed(&self) -> &[f64] {
        &self.closed[..self.n_closed]
    }

    /// One pass; returns whether another may find more.
    #[inline(always)]
    fn close_small_ranges<S: Simd>(&mut self, s: S) -> bool {
        let n = self.n_points;
        if n < 8 {
            return false;
        }
        let (points, ranges) = (&self.points[..n], &mut self.ranges[..n - 1]);
        let mut still = false;
        for (range, w) in ranges.iter_mut().zip(points.windows(2)) {
            *range = (w[1] - w[0]).abs();
            still |= *range == 0.0;
        }
        if still {
            // A plateau left points that do not turn, and the rule below needs alternating points.
            return false;
        }
        // The cycle between points i + 1 and i + 2 closes. Of equal neighbours only the last may,
        // so that no point belongs to two cycles.
        let tests = n - 3;
        let (mut kept, mut found, mut carry) = (0, 0, 0);
        for first in (0..n).step_by(AT_ONCE) {
            let [before, range, after] = [0, 1, 2].map(|k| eight(&self.ranges, first + k));
            let closing = !s.less(before, range) & s.less(range, after) & valid(tests.saturating_sub(first));
            s.compress(*range, closing, eight_mut(&mut self.closed, self.n_closed + found));
            found += closing.count_ones() as usize;
            let keep = !(closing << 1 | closing << 2 | carry);
            carry = closing >> 7 | closing >> 6;
            // The place that is written was read before.
            let points = *eight(&self.points, first);
            s.compress(points, keep, eight_mut(&mut self.points, kept));
            kept += keep.count_ones() as usize;
        }
        self.n_points = n - 2 * found;
        self.n_closed += found;
        found > 0
    }
}

/// Eight values from `at` on.
#[inline(always)]
fn eight(values: &Padded, at: usize) -> &[f64; AT_ONCE] {
    values[at..].first_chunk().expect("a padded block goes on for eight values")
}

/// Eight places from `at` on.
#[inline(always)]
fn eight_mut(values: &mut Padded, at: usize) -> &mut [f64; AT_ONCE] {
    values[at..].first_chunk_mut().expect("a padded block goes on for eight values")
}

/// A mask with the first `n` of eight bits set.
#[inline(always)]
fn valid(n: usize) -> u8 {
    if n < AT_ONCE { (1 << n) - 1 } else { u8::MAX }
}

#[cfg(test)]
mod tests {
    use super::super::rainflow::Rainflow;
    use super::super::turning::{TurningPoint, turning_points};
    use super::*;
    use crate::simd::{Isa, Kernel, dispatch};
    use proptest::prelude::*;

    /// Closed ranges and residue of `x`, sorted ranges: the order of closing is free.
    fn counted(x: &[f64]) -> (Vec<f64>, Vec<f64>) {
        let counted = Rainflow::of_points(&turning_points(x));
        let mut ranges: Vec<f64> = counted.cycles.iter().map(|c| c.range()).collect();
        ranges.sort_by(f64::total_cmp);
        (ranges, counted.residue.iter().map(|p: &TurningPoint| p.value).collect())
    }

    /// Runs `x` through a block on one instruction set.
    fn take(isa: Isa, block: &mut Block, x: &[f64]) {
        struct Take<'a>(&'a mut Block, &'a [f64]);
        impl Kernel for Take<'_> {
            type Out = ();
            const WIDE: bool = false;
            #[inline(always)]
            fn run<S: Simd>(self, s: S) {
                self.0.take(s, self.1.len(), |samples| samples.copy_from_slice(self.1));
            }
        }
        dispatch(isa, Take(block, x));
    }

    fn check(x: &[f64]) {
        for isa in Isa::ALL.into_iter().filter(|isa| isa.is_available()) {
            check_on(isa, x);
        }
    }

    fn check_on(isa: Isa, x: &[f64]) {
        let mut block = Block::new();
        // A used work space must give the same result.
        take(isa, &mut block, &(0..BLOCK).map(|i| ((i * i) % 101) as f64).collect::<Vec<_>>());
        take(isa, &mut block, x);
        let mut left = vec![x[0]];
        left.extend(block.points());
        left.push(x[x.len() - 1]);
        let (mut ranges, residue) = counted(&left);
        ranges.extend(block.closed());
        ranges.sort_by(f64::total_cmp);
        assert_eq!((ranges, residue), counted(x));
    }

    #[test]
    fn cycles_closed_ahead_of_the_stack_are_those_of_the_stack() {
        for n in [1, 2, 3, 10, 63, 64, 65, 66, 67, 127, 130, 700, BLOCK - 1, BLOCK] {
            check(&(0..n).map(|i| ((i * i * 7) % 1013) as f64 * 0.37).collect::<Vec<_>>());
            check(&(0..n).map(|i| (i as f64 * 0.9).sin() + (i as f64 * 0.21).cos()).collect::<Vec<_>>());
        }
    }

    #[test]
    fn most_points_of_noise_never_reach_the_stack() {
        let x: Vec<f64> = (0..BLOCK).map(|i| ((i * i * 7919) % 10_007) as f64).collect();
        let mut block = Block::new();
        take(Isa::Portable, &mut block, &x);
        let all = turning_points(&x).len();
        assert!(block.points().len() * 5 < all, "{} of {all}", block.points().len());
    }

    proptest! {
        #[test]
        fn any_block_counts_as_the_stack_counts(
            x in prop_oneof![
                prop::collection::vec((-4i8..4).prop_map(f64::from), 1..300),
                prop::collection::vec(any::<i16>().prop_map(f64::from), 1..BLOCK),
            ]
        ) {
            check(&x);
        }
    }
}
