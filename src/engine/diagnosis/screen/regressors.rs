//! The linear part's regressors, as far as a candidate's columns meet them.

use faer::Mat;

use super::correlate::Correlator;
use crate::diagnosis::numerics::linear::transposed_times;

/// Lags that are never written out, or columns that are.
pub(super) enum Regressors {
    Lags(Correlator),
    /// A matrix a segment.
    Columns(Vec<Mat<f64>>),
}

impl Regressors {
    /// Adds the products of the regressors of a segment with columns, centred and weighted, to `to`.
    pub fn add(&self, columns: &Mat<f64>, segment: usize, weight: f64, to: &mut Mat<f64>) {
        match self {
            Self::Lags(correlator) => {
                for c in 0..columns.ncols() {
                    correlator.add(columns.col_as_slice(c), segment, weight, to, c);
                }
            }
            Self::Columns(own) => *to += transposed_times(&own[segment], columns),
        }
    }
}
