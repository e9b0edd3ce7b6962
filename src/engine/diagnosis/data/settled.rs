//! What signals differ by, the beginning left aside that a start from rest colours.

use crate::diagnosis::numerics::linear::squares_about_mean;

/// One part of a run in so many is its beginning.
const BEGINNING: usize = 5;

/// A signal without its beginning.
pub fn settled(signal: &[f64]) -> &[f64] {
    &signal[signal.len() / BEGINNING..]
}

/// Sum of the squares of what two signals differ by.
pub fn differ(a: &[f64], b: &[f64]) -> f64 {
    settled(a).iter().zip(settled(b)).map(|(a, b)| (a - b) * (a - b)).sum()
}

/// Sum of the squares of a signal about its mean.
pub fn size(signal: &[f64]) -> f64 {
    squares_about_mean(settled(signal))
}
