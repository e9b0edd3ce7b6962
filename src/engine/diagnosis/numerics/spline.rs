//! A free one-variable function: values at even knots, cubic between them (Catmull and Rom), and
//! straight on beyond the ends so that no extrapolation explodes.

use serde::{Deserialize, Serialize};

/// Even knots over a range.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Spline {
    low: f64,
    step: f64,
    knots: usize,
}

impl Spline {
    /// # Panics
    /// For fewer than three knots or an empty range: both are constants or checked before.
    pub fn new(low: f64, high: f64, knots: usize) -> Self {
        assert!(knots >= 3 && high > low, "a spline needs a range");
        Self { low, step: (high - low) / (knots - 1) as f64, knots }
    }

    /// Number of values that shape it.
    pub fn knots(&self) -> usize {
        self.knots
    }

    /// Where the knots lie.
    pub fn places(&self) -> Vec<f64> {
        (0..self.knots).map(|i| self.low + self.step * i as f64).collect()
    }

    /// Value at `x` of the function with these knot values.
    #[inline]
    pub fn at(&self, values: &[f64], x: f64) -> f64 {
        let last = self.knots - 1;
        let p = (x - self.low) / self.step;
        if p <= 0.0 {
            return values[0] + p * (values[1] - values[0]);
        }
        if p >= last as f64 {
            return values[last] + (p - last as f64) * (values[last] - values[last - 1]);
        }
        let i = (p as usize).min(last - 1);
        let s = p - i as f64;
        let (b, c) = (values[i], values[i + 1]);
        let a = if i == 0 { 2.0 * b - c } else { values[i - 1] };
        let d = if i + 2 > last { 2.0 * c - b } else { values[i + 2] };
        b + 0.5 * s * (c - a + s * (2.0 * a - 5.0 * b + 4.0 * c - d + s * (3.0 * (b - c) + d - a)))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn straight_lines_are_exact_everywhere_and_knots_are_hit() {
        let spline = Spline::new(-2.0, 2.0, 7);
        let line: Vec<f64> = spline.places().iter().map(|x| 0.5 - 3.0 * x).collect();
        for x in [-5.0, -2.0, -1.1, 0.0, 0.3, 1.99, 2.0, 7.0] {
            assert!((spline.at(&line, x) - (0.5 - 3.0 * x)).abs() < 1e-12, "{x}");
        }
        let cubic: Vec<f64> = spline.places().iter().map(|x| x * x * x).collect();
        for (place, value) in spline.places().iter().zip(&cubic) {
            assert!((spline.at(&cubic, *place) - value).abs() < 1e-12);
        }
        assert!((spline.at(&cubic, 1.0) - 1.0).abs() < 0.05);
    }
}
