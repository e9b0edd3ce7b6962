//! The two matrix products that take most of a network's time, blocked for registers.

use crate::simd::{Columns, Lanes, Simd};

/// `R` rows of weights times step vectors of `NV * 16` windows.
///
/// `weights` is `[column][row]`, `vectors` is `[column][16 windows]`; sums run over the columns in
/// order, so every blocking of rows and windows gives the same bits.
#[inline(always)]
pub(super) fn product<S: Simd, const R: usize, const NV: usize>(
    s: S,
    weights: &[[f32; R]],
    vectors: &[[Lanes; NV]],
) -> [[S::V; NV]; R] {
    let mut sum = [[s.splat(0.0); NV]; R];
    for (w, z) in weights.iter().zip(vectors) {
        if R >= 16 {
            // One cache line per column: the hardware prefetcher alone is too slow.
            s.prefetch(w, 8);
        }
        for v in 0..NV {
            let z = s.load(&z[v]);
            for r in 0..R {
                sum[r][v] = s.mul_add(s.splat(w[r]), z, sum[r][v]);
            }
        }
    }
    sum
}

/// Rows of a matrix in groups of `R`, `[group][column][row of the group]`; the last group is padded
/// with zero rows. `value(row, column)` gives the elements.
pub(super) fn pack<const R: usize>(
    rows: usize,
    columns: usize,
    to: &mut Vec<[f32; R]>,
    value: impl Fn(usize, usize) -> f32,
) {
    to.clear();
    for first in (0..rows).step_by(R) {
        for column in 0..columns {
            let mut w = [0.0; R];
            for (r, w) in w.iter_mut().enumerate().take(rows - first) {
                *w = value(first + r, column);
            }
            to.push(w);
        }
    }
}

/// Rows of lanes, one row of `stride` per step; a view of columns `at..at + width` of each.
#[derive(Clone, Copy)]
pub(super) struct Steps<'a> {
    /// All steps, `[step][stride]`.
    pub data: &'a [Lanes],
    /// Columns stored per step.
    pub stride: usize,
    /// First column of the view.
    pub at: usize,
    /// Columns of the view.
    pub width: usize,
}

/// `gradient[row][column] += sum over steps and lanes of a[step][row] * b[step][column]`.
///
/// `gradient` is `[a.width, b.width]`, row-major. `steps` is a range `(from, to)`, short enough for
/// its columns to stay in the second-level cache. Products of steps and lanes are summed in a fixed
/// order. `WIDE`: there are registers for 4 x 6 sums.
#[inline(always)]
pub(super) fn outer<S: Simd, const WIDE: bool>(
    s: S,
    a: Steps<'_>,
    b: Steps<'_>,
    steps: (usize, usize),
    gradient: &mut [f32],
) {
    let mut column = 0;
    while column < b.width {
        let left = b.width - column;
        column += if WIDE {
            match left {
                1 => rows::<S, 4, 1>(s, a, b, steps, column, gradient),
                2 => rows::<S, 4, 2>(s, a, b, steps, column, gradient),
                3 => rows::<S, 4, 3>(s, a, b, steps, column, gradient),
                4 | 8 => rows::<S, 4, 4>(s, a, b, steps, column, gradient),
                5 | 9 | 10 => rows::<S, 4, 5>(s, a, b, steps, column, gradient),
                _ => rows::<S, 4, 6>(s, a, b, steps, column, gradient),
            }
        } else {
            match left {
                1 => rows::<S, 2, 1>(s, a, b, steps, column, gradient),
                2 | 4 => rows::<S, 2, 2>(s, a, b, steps, column, gradient),
                _ => rows::<S, 2, 3>(s, a, b, steps, column, gradient),
            }
        };
    }
}

/// All rows of `C` columns; returns `C`.
#[inline(always)]
fn rows<S: Simd, const R: usize, const C: usize>(
    s: S,
    a: Steps<'_>,
    b: Steps<'_>,
    span: (usize, usize),
    column: usize,
    gradient: &mut [f32],
) -> usize {
    let mut row = 0;
    while row + R <= a.width {
        tile::<S, R, C>(s, a, b, span, (row, column), gradient);
        row += R;
    }
    while row < a.width {
        tile::<S, 1, C>(s, a, b, span, (row, column), gradient);
        row += 1;
    }
    C
}

/// `R` rows of `C` columns.
#[inline(always)]
fn tile<S: Simd, const R: usize, const C: usize>(
    s: S,
    a: Steps<'_>,
    b: Steps<'_>,
    span: (usize, usize),
    (row, column): (usize, usize),
    gradient: &mut [f32],
) {
    let mut sum = [[s.splat(0.0); C]; R];
    let a = Columns::<R>::new(a.data, a.stride, a.at + row, span);
    let b_columns = Columns::<C>::new(b.data, b.stride, b.at + column, span);
    for (a, b) in a.zip(b_columns) {
        let mut factor = [s.splat(0.0); R];
        for r in 0..R {
            factor[r] = s.load(&a[r]);
        }
        for c in 0..C {
            let z = s.load(&b[c]);
            for r in 0..R {
                sum[r][c] = s.mul_add(factor[r], z, sum[r][c]);
            }
        }
    }
    // Through memory: sums that are indexed in a loop would not stay in registers above.
    let mut stored = [[Lanes::ZERO; C]; R];
    for r in 0..R {
        for c in 0..C {
            s.store(&mut stored[r][c], sum[r][c]);
        }
    }
    for (r, stored) in stored.iter().enumerate() {
        let to = &mut gradient[(row + r) * b.width + column..][..C];
        for (to, stored) in to.iter_mut().zip(stored) {
            *to += s.sum(s.load(stored));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::simd::Isa;
    use crate::simd::{Kernel, LANES, dispatch};

    /// Values that differ everywhere, in +-1.
    fn lanes(n: usize, phase: f32) -> Vec<Lanes> {
        (0..n)
            .map(|i| {
                let mut l = Lanes::ZERO;
                for (k, l) in l.0.iter_mut().enumerate() {
                    *l = (phase + (i * LANES + k) as f32 * 0.37).sin();
                }
                l
            })
            .collect()
    }

    struct Outer<'a, const WIDE: bool>(Steps<'a>, Steps<'a>, usize, &'a mut [f32]);

    impl<const WIDE: bool> Kernel for Outer<'_, WIDE> {
        type Out = ();
        const WIDE: bool = WIDE;
        #[inline(always)]
        fn run<S: Simd>(self, s: S) {
            let (first, last) = (self.2 / 3, self.2);
            outer::<S, WIDE>(s, self.0, self.1, (0, first), self.3);
            outer::<S, WIDE>(s, self.0, self.1, (first, last), self.3);
        }
    }

    #[test]
    fn the_outer_product_equals_the_naive_sum_for_every_width() {
        for isa in Isa::ALL.into_iter().filter(|i| i.is_available()) {
            for (a_width, b_width) in [(1, 1), (4, 6), (5, 7), (7, 2), (8, 3), (6, 13), (12, 11), (3, 9)] {
                let steps = 150;
                let (a, b) = (lanes(steps * (a_width + 2), 0.1), lanes(steps * (b_width + 1), 0.7));
                let a = Steps { data: &a, stride: a_width + 2, at: 1, width: a_width };
                let b = Steps { data: &b, stride: b_width + 1, at: 1, width: b_width };
                let mut expected = vec![0.5_f64; a_width * b_width];
                for t in 0..steps {
                    for r in 0..a_width {
                        for c in 0..b_width {
                            for l in 0..LANES {
                                expected[r * b_width + c] += f64::from(a.data[t * a.stride + 1 + r].0[l])
                                    * f64::from(b.data[t * b.stride + 1 + c].0[l]);
                            }
                        }
                    }
                }
                for wide in [false, true] {
                    let mut found = vec![0.5_f32; a_width * b_width];
                    if wide && isa == Isa::Avx512 {
                        dispatch(isa, Outer::<true>(a, b, steps, &mut found));
                    } else {
                        dispatch(isa, Outer::<false>(a, b, steps, &mut found));
                    }
                    for (f, e) in found.iter().zip(&expected) {
                        assert!((f64::from(*f) - e).abs() < 1e-3, "{} {a_width}x{b_width}", isa.name());
                    }
                }
            }
        }
    }

    #[test]
    fn packing_fills_the_last_group_of_rows_with_zeros() {
        let mut packed = Vec::new();
        pack::<4>(5, 2, &mut packed, |r, c| (10 * r + c) as f32);
        assert_eq!(
            packed,
            [[0.0, 10.0, 20.0, 30.0], [1.0, 11.0, 21.0, 31.0], [40.0, 0.0, 0.0, 0.0], [41.0, 0.0, 0.0, 0.0]]
        );
    }
}
