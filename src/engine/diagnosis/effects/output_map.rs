//! What a sensor may do to a response after the rig has made it.

use serde::{Deserialize, Serialize};

use super::input_map::limits;
use super::law::EARLIEST;

/// A map of one response; the response comes about its working point in units of its RMS.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub enum OutputMap {
    /// `y + b`; `b`
    Offset,
    /// `(1 + g) y`; `g`
    Gain,
    /// `clip(y, -low, high)`; `low, high`
    Saturation,
    /// `y + c2 y^2 + c3 y^3`; `c2, c3`
    Polynomial,
    /// `y + b (t + t0)`; `b` over the whole programme, `t0`: what drifts need not begin with the first run
    Drift,
    /// `round(y / q) q`; `ln q`, known from the samples, never fitted
    Round,
}

impl OutputMap {
    /// Number of parameters.
    pub fn parameters(self) -> usize {
        match self {
            Self::Saturation | Self::Polynomial | Self::Drift => 2,
            _ => 1,
        }
    }

    /// Points from which a fit starts.
    pub fn starts(self) -> Vec<Vec<f64>> {
        match self {
            Self::Offset => vec![vec![0.1]],
            Self::Drift => vec![vec![0.1, 0.0]],
            Self::Gain => vec![vec![0.05]],
            Self::Saturation => limits(&[0.8, 1.2, 1.6, 2.2, 5.0]),
            Self::Polynomial => vec![vec![0.02, 0.01], vec![0.02, -0.01]],
            Self::Round => Vec::new(),
        }
    }

    /// Maps in place; `time` is that of each sample in units of the programme.
    pub fn apply(self, p: &[f64], y: &mut [f64], time: impl Fn(usize) -> f64) {
        match self {
            Self::Offset => y.iter_mut().for_each(|y| *y += p[0]),
            Self::Gain => y.iter_mut().for_each(|y| *y *= 1.0 + p[0]),
            Self::Saturation => {
                let (low, high) = (-p[0].abs(), p[1].abs());
                y.iter_mut().for_each(|y| *y = y.clamp(low, high));
            }
            Self::Polynomial => y.iter_mut().for_each(|y| *y += p[0] * *y * *y + p[1] * *y * *y * *y),
            Self::Drift => {
                let before = p[1].clamp(-EARLIEST, EARLIEST);
                y.iter_mut().enumerate().for_each(|(k, y)| *y += p[0] * (time(k) + before));
            }
            Self::Round => {
                let q = p[0].exp();
                y.iter_mut().for_each(|y| *y = (*y / q).round() * q);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_map_does_what_its_equation_says() {
        let mapped = |map: OutputMap, p: &[f64]| {
            let mut y = vec![-2.0, 0.5, 3.0];
            map.apply(p, &mut y, |k| k as f64);
            y
        };
        assert_eq!(mapped(OutputMap::Offset, &[1.0]), [-1.0, 1.5, 4.0]);
        assert_eq!(mapped(OutputMap::Gain, &[0.5]), [-3.0, 0.75, 4.5]);
        assert_eq!(mapped(OutputMap::Saturation, &[1.0, 2.0]), [-1.0, 0.5, 2.0]);
        assert_eq!(mapped(OutputMap::Polynomial, &[1.0, 0.0]), [2.0, 0.75, 12.0]);
        assert_eq!(mapped(OutputMap::Drift, &[1.0, 0.5]), [-1.5, 2.0, 5.5]);
        assert_eq!(mapped(OutputMap::Round, &[0.0]), [-2.0, 1.0, 3.0]);
    }
}
