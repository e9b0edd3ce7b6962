//! Least squares, eigenvalues and small solves: the linear algebra that the diagnosis needs.

use faer::Mat;
use realfft::num_complex::Complex64;
use rigcast_numerics::decompose::{self, Cholesky};

use crate::simd::{Isa, Kernel, Simd, dispatch};

/// Share of a scaled column below which its direction is rounding: keeps parallel columns harmless.
const RIDGE: f64 = 1e-7;

/// Minimises `|target - sum_c x_c column_c|^2` with columns scaled to unit length and a ridge of
/// rounding's size; a column of zeros gets 0.
pub fn least_squares(columns: &[&[f64]], target: &[f64]) -> Vec<f64> {
    let (rows, p) = (target.len(), columns.len());
    if p == 0 {
        return Vec::new();
    }
    let norms: Vec<f64> = columns.iter().map(|c| norm(c)).collect();
    let scale: Vec<f64> =
        norms.iter().map(|&n| if n > 0.0 && n.is_finite() { 1.0 / n } else { 0.0 }).collect();
    let mut matrix = Mat::zeros(rows + p, p);
    for (j, (column, scale)) in columns.iter().zip(&scale).enumerate() {
        let of = matrix.col_as_slice_mut(j);
        of[..rows].iter_mut().zip(*column).for_each(|(to, x)| *to = x * scale);
        of[rows + j] = RIDGE;
    }
    let rhs = Mat::from_fn(rows + p, 1, |i, _| if i < rows { target[i] } else { 0.0 });
    let x = decompose::least_squares(&matrix, &rhs);
    (0..p).map(|j| if x[(j, 0)].is_finite() { x[(j, 0)] * scale[j] } else { 0.0 }).collect()
}

/// Solves the symmetric positive definite system `matrix x = rhs`, `matrix[i][j]`; `None` where it
/// is singular to rounding.
pub fn solve_spd(matrix: &[Vec<f64>], rhs: &[f64]) -> Option<Vec<f64>> {
    let n = rhs.len();
    let a = Mat::from_fn(n, n, |i, j| matrix[i][j]);
    let b = Mat::from_fn(n, 1, |i, _| rhs[i]);
    let x = Cholesky::new(&a)?.solve(&b);
    let x: Vec<f64> = (0..n).map(|i| x[(i, 0)]).collect();
    x.iter().all(|v| v.is_finite()).then_some(x)
}

/// Upper triangle `u` with `u^T u = matrix`, `u[i][j]`, of a symmetric positive definite matrix; `None` where
/// it is singular to rounding.
pub fn cholesky(matrix: &[Vec<f64>]) -> Option<Vec<Vec<f64>>> {
    let n = matrix.len();
    let scale: Vec<f64> = (0..n).map(|i| matrix[i][i].sqrt()).collect();
    if !scale.iter().all(|s| *s > 0.0 && s.is_finite()) {
        return None;
    }
    // Of unit diagonal, so that units do not matter.
    let unit = |i: usize, j: usize| matrix[i][j] / (scale[i] * scale[j]) + if i == j { RIDGE } else { 0.0 };
    let factor = Cholesky::new(&Mat::from_fn(n, n, unit))?;
    let lower = factor.lower();
    Some(
        (0..n)
            .map(|i| (0..n).map(|j| if j < i { 0.0 } else { lower[(j, i)] * scale[j] }).collect())
            .collect(),
    )
}

/// Inverse of a symmetric positive definite matrix, if it has one.
pub fn inverse_spd(matrix: &[Vec<f64>]) -> Option<Vec<Vec<f64>>> {
    let n = matrix.len();
    (0..n)
        .map(|j| {
            let unit: Vec<f64> = (0..n).map(|i| if i == j { 1.0 } else { 0.0 }).collect();
            solve_spd(matrix, &unit)
        })
        .collect()
}

/// Eigenvalues of a square real matrix, `matrix[i][j]`; `None` where the iteration fails.
pub fn eigenvalues(matrix: &[Vec<f64>]) -> Option<Vec<Complex64>> {
    let n = matrix.len();
    if n == 0 {
        return Some(Vec::new());
    }
    let values = decompose::eigenvalues(&Mat::from_fn(n, n, |i, j| matrix[i][j]))?;
    values.iter().all(|z| z.re.is_finite() && z.im.is_finite()).then_some(values)
}

/// Euclidean length.
pub fn norm(x: &[f64]) -> f64 {
    dot(x, x).sqrt()
}

/// Sums that run side by side in a long inner product: one alone would wait for each addition.
const SUMS: usize = 32;
/// Fewest samples of a long one: calling a kernel costs as much as some tens of products.
const LONG: usize = 128;

/// An inner product in sums side by side, which the compiler puts into lanes.
struct Dot<'a>(&'a [f64], &'a [f64]);

impl Kernel for Dot<'_> {
    type Out = f64;
    const WIDE: bool = false;

    #[inline(always)]
    fn run<S: Simd>(self, _: S) -> f64 {
        in_sums::<SUMS>(self.0, self.1)
    }
}

/// Inner product of two equally long slices.
pub fn dot(a: &[f64], b: &[f64]) -> f64 {
    if a.len() < LONG {
        return in_sums::<4>(a, b);
    }
    dispatch(Isa::of_plain_loops(), Dot(a, b))
}

#[inline(always)]
fn in_sums<const N: usize>(a: &[f64], b: &[f64]) -> f64 {
    let (a_chunks, b_chunks) = (a.chunks_exact(N), b.chunks_exact(N));
    let rest: f64 = a_chunks.remainder().iter().zip(b_chunks.remainder()).map(|(a, b)| a * b).sum();
    let mut sums = [0.0; N];
    for (a, b) in a_chunks.zip(b_chunks) {
        for k in 0..N {
            sums[k] += a[k] * b[k];
        }
    }
    let mut half = N / 2;
    while half > 0 {
        for k in 0..half {
            sums[k] += sums[k + half];
        }
        half /= 2;
    }
    sums[0] + rest
}

/// Columns up to which `a^T b` is summed by inner products: a general product would first copy all of `a`.
const FEW: usize = 6;

/// `a^T b`, of a `b` that mostly has a few long columns.
pub fn transposed_times(a: &Mat<f64>, b: &Mat<f64>) -> Mat<f64> {
    if b.ncols() > FEW {
        return a.transpose() * b;
    }
    Mat::from_fn(a.ncols(), b.ncols(), |r, c| dot(a.col_as_slice(r), b.col_as_slice(c)))
}

/// A matrix of columns of `rows` rows.
pub fn from_columns(rows: usize, columns: &[impl AsRef<[f64]>]) -> Mat<f64> {
    let mut out = Mat::zeros(rows, columns.len());
    for (c, column) in columns.iter().enumerate() {
        out.col_as_slice_mut(c).copy_from_slice(column.as_ref());
    }
    out
}

/// Root mean square; 0 for no samples.
pub fn rms(x: &[f64]) -> f64 {
    if x.is_empty() { 0.0 } else { (dot(x, x) / x.len() as f64).sqrt() }
}

/// Sum of the squares about the mean.
pub fn squares_about_mean(x: &[f64]) -> f64 {
    let centre = mean(x);
    x.iter().map(|x| (x - centre) * (x - centre)).sum()
}

/// Mean; 0 for no samples.
pub fn mean(x: &[f64]) -> f64 {
    if x.is_empty() { 0.0 } else { x.iter().sum::<f64>() / x.len() as f64 }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn least_squares_finds_the_weights_of_columns_of_very_different_size() {
        let a: Vec<f64> = (0..50).map(|i| (f64::from(i) * 0.3).sin() * 1e6).collect();
        let b: Vec<f64> = (0..50).map(|i| (f64::from(i) * 0.7).cos() * 1e-6).collect();
        let zero = vec![0.0; 50];
        let target: Vec<f64> = a.iter().zip(&b).map(|(a, b)| 2e-6 * a - 3e6 * b).collect();
        let x = least_squares(&[&a, &b, &zero], &target);
        assert!((x[0] / 2e-6 - 1.0).abs() < 1e-9 && (x[1] / -3e6 - 1.0).abs() < 1e-9 && x[2] == 0.0, "{x:?}");
    }

    #[test]
    fn products_of_few_columns_are_those_of_many() {
        let wave = |f: f64| move |r: usize, c: usize| (f * (r + 7 * c) as f64).sin();
        let (a, b) = (Mat::from_fn(300, 9, wave(0.3)), Mat::from_fn(300, 2 * FEW, wave(0.7)));
        let many = transposed_times(&a, &b);
        for few in [1, FEW] {
            let found = transposed_times(&a, &Mat::from_fn(300, few, |r, c| b[(r, c)]));
            assert_eq!((found.nrows(), found.ncols()), (9, few));
            for (r, c) in (0..9).flat_map(|r| (0..few).map(move |c| (r, c))) {
                assert!((found[(r, c)] - many[(r, c)]).abs() < 1e-11, "{r} {c}");
            }
        }
    }

    #[test]
    fn eigenvalues_of_a_rotation_are_its_conjugate_pair() {
        let (s, c) = 0.4_f64.sin_cos();
        let mut z = eigenvalues(&[vec![c, -s], vec![s, c]]).unwrap();
        z.sort_by(|a, b| a.im.total_cmp(&b.im));
        assert!((z[1] - Complex64::new(c, s)).norm() < 1e-14 && (z[0] - z[1].conj()).norm() < 1e-14);
    }

    #[test]
    fn a_matrix_times_its_inverse_is_one_and_a_singular_one_has_none() {
        let m = vec![vec![4.0, 1.0], vec![1.0, 3.0]];
        let inverse = inverse_spd(&m).unwrap();
        assert!((inverse[0][0] - 3.0 / 11.0).abs() < 1e-14 && (inverse[0][1] + 1.0 / 11.0).abs() < 1e-14);
        assert!(inverse_spd(&[vec![1.0, 1.0], vec![1.0, 1.0]]).is_none_or(|i| i[0][0].abs() > 1e10));
    }
}
