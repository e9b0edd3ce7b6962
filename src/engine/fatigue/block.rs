//! The vectorisable front of damage counting: a block of samples becomes a few turning points.
//!
//! Rainflow on a stack costs two mispredicted branches a turning point, many times what the
//! arithmetic costs. So most cycles are closed before the stack, without branches on data: where a
//! range is smaller than both its neighbours the four-point rule closes it whatever comes before
//! and after, and in noise a third of all ranges is such. Three passes leave about a sixth of the
//! points to the stack; the cycles are the same, in another order.

use super::turning::may_turn;

/// Samples that are looked at in one go: small enough for the first-level cache.
pub(super) const BLOCK: usize = 1024;

/// A block and two more places, so that whole mask words can be computed to its end.
type Padded = [f64; BLOCK + 2];

/// One bit per sample.
type Masks = [u64; BLOCK / 64];

/// Passes that close cycles; a fourth gains nothing.
const PASSES: usize = 3;

/// Work space of a block; nothing in it outlives one.
pub(super) struct Block {
    samples: Padded,
    points: [f64; BLOCK],
    n_points: usize,
    ranges: Padded,
    closed: [f64; BLOCK],
    n_closed: usize,
    masks: Masks,
}

impl Block {
    /// Empty.
    pub(super) fn new() -> Self {
        Self {
            samples: [0.0; BLOCK + 2],
            points: [0.0; BLOCK],
            n_points: 0,
            ranges: [0.0; BLOCK + 2],
            closed: [0.0; BLOCK],
            n_closed: 0,
            masks: [0; BLOCK / 64],
        }
    }

    /// Lets `fill` write `n` samples (at most [`BLOCK`]), finds the turning points among the inner
    /// ones and closes cycles among them.
    #[inline(always)]
    pub(super) fn take(&mut self, n: usize, fill: impl FnOnce(&mut [f64])) {
        fill(&mut self.samples[..n]);
        mask_of_three(&self.samples, n, &mut self.masks, may_turn);
        let mut n_points = 0;
        for_each_bit(&self.masks, |i| {
            self.points[n_points % BLOCK] = self.samples[i + 1];
            n_points += 1;
        });
        self.n_points = n_points;
        self.n_closed = 0;
        for _ in 0..PASSES {
            if !self.close_small_ranges() {
                break;
            }
        }
    }

    /// Turning points that are left, in order. Plateaus may leave points that do not turn.
    pub(super) fn points(&self) -> &[f64] {
        &self.points[..self.n_points]
    }

    /// Ranges of the cycles that were closed.
    pub(super) fn closed(&self) -> &[f64] {
        &self.closed[..self.n_closed]
    }

    /// One pass; says whether another may find more.
    #[inline(always)]
    fn close_small_ranges(&mut self) -> bool {
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
            // A plateau left points that do not turn: the rule below needs points that alternate.
            return false;
        }
        // Bit i: the cycle between points i + 1 and i + 2 closes. Of equal neighbours only the
        // last may, so that no point belongs to two cycles.
        mask_of_three(&self.ranges, n - 1, &mut self.masks, |before, range, after| {
            (range <= before) & (range < after)
        });
        let mut n_closed = self.n_closed;
        for_each_bit(&self.masks[..n.div_ceil(64)], |i| {
            self.closed[n_closed % BLOCK] = self.ranges[(i + 1) % BLOCK];
            n_closed += 1;
        });
        let found = n_closed - self.n_closed;
        let mut carry = 0;
        for mask in &mut self.masks {
            let closing = *mask;
            *mask = !((closing << 1) | (closing << 2) | carry);
            carry = (closing >> 63) | (closing >> 62);
        }
        let mut kept = 0;
        for_each_bit(&self.masks[..n.div_ceil(64)], |i| {
            // What lies behind the last point is written, but not counted below.
            self.points[kept % BLOCK] = self.points[i % BLOCK];
            kept += 1;
        });
        self.n_points = n - 2 * found;
        self.n_closed = n_closed;
        found > 0
    }
}

/// Bit `i` says `test(x[i], x[i + 1], x[i + 2])` within the first `n` values; all other bits are 0.
#[inline(always)]
fn mask_of_three(x: &Padded, n: usize, masks: &mut Masks, test: impl Fn(f64, f64, f64) -> bool) {
    let tests = n.saturating_sub(2);
    for (word, mask) in masks.iter_mut().enumerate() {
        let wanted = tests.saturating_sub(64 * word);
        if wanted == 0 {
            *mask = 0;
            continue;
        }
        // Always 66 values, whatever is wanted: this is the loop that the compiler vectorises.
        let x = x[64 * word..].first_chunk::<66>().expect("a padded block holds 66 values from each word on");
        let mut bits = 0;
        for i in 0..64 {
            bits |= u64::from(test(x[i], x[i + 1], x[i + 2])) << i;
        }
        *mask = if wanted < 64 { bits & ((1 << wanted) - 1) } else { bits };
    }
}

/// Calls `f` with the place of every set bit, in order.
#[inline(always)]
fn for_each_bit(masks: &[u64], mut f: impl FnMut(usize)) {
    for (word, &mask) in masks.iter().enumerate() {
        let mut left = mask;
        while left != 0 {
            f(64 * word + left.trailing_zeros() as usize);
            left &= left - 1;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::rainflow::Rainflow;
    use super::super::turning::{TurningPoint, turning_points};
    use super::*;
    use proptest::prelude::*;

    /// Closed ranges and residue of `x`, sorted ranges: the order of closing is free.
    fn counted(x: &[f64]) -> (Vec<f64>, Vec<f64>) {
        let counted = Rainflow::of_points(&turning_points(x));
        let mut ranges: Vec<f64> = counted.cycles.iter().map(|c| c.range()).collect();
        ranges.sort_by(f64::total_cmp);
        (ranges, counted.residue.iter().map(|p: &TurningPoint| p.value).collect())
    }

    fn take(block: &mut Block, x: &[f64]) {
        block.take(x.len(), |samples| samples.copy_from_slice(x));
    }

    fn check(x: &[f64]) {
        let mut block = Block::new();
        // A dirty work space must not show.
        take(&mut block, &(0..BLOCK).map(|i| ((i * i) % 101) as f64).collect::<Vec<_>>());
        take(&mut block, x);
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
        take(&mut block, &x);
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

        #[test]
        fn masks_hold_the_test_of_every_three(x in prop::collection::vec(-1.0..1.0f64, 0..=BLOCK)) {
            let mut masks = [u64::MAX; BLOCK / 64];
            let mut padded = [0.5; BLOCK + 2];
            padded[..x.len()].copy_from_slice(&x);
            mask_of_three(&padded, x.len(), &mut masks, |a, b, c| a + c < b);
            let mut found = Vec::new();
            for_each_bit(&masks, |i| found.push(i));
            let expected: Vec<usize> =
                x.windows(3).enumerate().filter(|(_, w)| w[0] + w[2] < w[1]).map(|(i, _)| i).collect();
            prop_assert_eq!(found, expected);
        }
    }
}
