//! Decompositions of real and complex matrices. `None` says that a decomposition failed: the matrix is singular to
//! rounding, or an iteration did not converge.

use faer::linalg::solvers::Llt;
use faer::prelude::{Solve, SolveLstsq};
use faer::{Mat, MatRef, Side};
use realfft::num_complex::Complex64;

/// The factor `L` of a symmetric positive definite matrix `A = L L^T`.
#[derive(Debug, Clone)]
pub struct Cholesky(Llt<f64>);

impl Cholesky {
    /// The factor of `a`, of which the lower triangle is read.
    pub fn new(a: &Mat<f64>) -> Option<Self> {
        a.llt(Side::Lower).ok().map(Self)
    }

    /// `x` of `A x = b`.
    pub fn solve(&self, b: &Mat<f64>) -> Mat<f64> {
        self.0.solve(b)
    }

    /// `L`.
    pub fn lower(&self) -> MatRef<'_, f64> {
        self.0.L()
    }
}

/// The `x` that minimises `|a x - b|`, by QR.
pub fn least_squares(a: &Mat<f64>, b: &Mat<f64>) -> Mat<f64> {
    a.qr().solve_lstsq(b)
}

/// `x` of `a x = b`, by LU with partial pivoting.
pub fn solve(a: &Mat<Complex64>, b: &Mat<Complex64>) -> Mat<Complex64> {
    a.partial_piv_lu().solve(b)
}

/// Eigenvalues of a square real matrix.
pub fn eigenvalues(a: &Mat<f64>) -> Option<Vec<Complex64>> {
    let values = a.eigenvalues().ok()?;
    Some(values.iter().map(|z| Complex64::new(z.re, z.im)).collect())
}

/// Eigenvalues, ascending, and eigenvectors, in columns, of a Hermitian matrix, of which the lower triangle is read.
pub fn hermitian_eigen(a: &Mat<Complex64>) -> Option<(Vec<f64>, Mat<Complex64>)> {
    let eigen = a.self_adjoint_eigen(Side::Lower).ok()?;
    Some((eigen.S().column_vector().iter().map(|e| e.re).collect(), eigen.U().to_owned()))
}

/// `U`, the singular values, descending, and `V` of `a = U S V^H`, without columns that belong to no singular value.
pub fn thin_svd(a: &Mat<Complex64>) -> Option<(Mat<Complex64>, Vec<f64>, Mat<Complex64>)> {
    let svd = a.thin_svd().ok()?;
    let singular = svd.S().column_vector().iter().map(|s| s.re).collect();
    Some((svd.U().to_owned(), singular, svd.V().to_owned()))
}
