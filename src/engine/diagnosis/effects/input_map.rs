//! What an actuator may do to a drive before the core sees it.

use serde::{Deserialize, Serialize};

use crate::diagnosis::numerics::spline::Spline;

/// A map `w = in(u)` of one drive; drives come in units of their peak, time in samples.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub enum InputMap {
    /// `(1 + g) u`; `g`
    Gain,
    /// `u(t - tau)`; `tau` in samples
    Delay,
    /// `w' = wc (u - w)`; `ln(wc dt)`
    ExtraPole,
    /// `clip(u, -low, high)`; `low, high`
    Saturation,
    /// `u + c2 u^2 + c3 u^3`; `c2, c3`
    Polynomial,
    /// Slew limit per sample; its logarithm
    RateLimit,
    /// Nothing inside `|u| < d`, and `d` less outside; `d`
    DeadZone,
    /// Play of half width `d`; `d`
    Backlash,
    /// `u` plus a free function of `u`; its values at the knots
    Free(Spline),
    /// `e^g (in(u) - u)`, counted from what a linear part does that was fitted with the map on the way: it is less than
    /// what is behind the map. Against its sign a limit would be a dead zone. The map's numbers, then `g`
    Scaled(Box<Self>),
}

impl InputMap {
    /// Number of parameters.
    pub fn parameters(&self) -> usize {
        match self {
            Self::Saturation | Self::Polynomial => 2,
            Self::Free(spline) => spline.knots(),
            Self::Scaled(map) => map.parameters() + 1,
            _ => 1,
        }
    }

    /// The map beside a linear part that was fitted with it on the way. What is free in size stays as it is.
    pub fn beside_fitted(self) -> Self {
        if self.is_a_limit() { Self::Scaled(Box::new(self)) } else { self }
    }

    /// Whether it takes away what a limit does not let through: the size of its change is given by its numbers.
    pub fn is_a_limit(&self) -> bool {
        matches!(self, Self::Saturation | Self::RateLimit | Self::DeadZone | Self::Backlash)
    }

    /// Whether it is a function of the drive at the same instant.
    pub fn is_instant(&self) -> bool {
        match self.bare() {
            Self::Gain | Self::Saturation | Self::Polynomial | Self::DeadZone | Self::Free(_) => true,
            Self::Delay | Self::ExtraPole | Self::RateLimit | Self::Backlash | Self::Scaled(_) => false,
        }
    }

    /// The map itself.
    pub fn bare(&self) -> &Self {
        if let Self::Scaled(map) = self { map.bare() } else { self }
    }

    /// Points from which a fit starts, for a drive with quantiles of `|u|` at 30, 60, 80, 95, 99 and
    /// 99.8 %, and a mean change per sample of `slope`.
    pub fn starts(&self, quantiles: [f64; 6], slope: f64) -> Vec<Vec<f64>> {
        match self {
            Self::Gain => vec![vec![-0.1], vec![0.1]],
            Self::Delay => [1.0, 3.0, 8.0].iter().map(|&d| vec![d]).collect(),
            Self::ExtraPole => [0.03_f64, 0.1, 0.3, 1.0].iter().map(|w| vec![w.ln()]).collect(),
            Self::Saturation => {
                let [_, middle, rest @ ..] = quantiles;
                let mut starts = limits(&[rest[0], rest[1], rest[2], rest[3], 1.0]);
                starts.push(vec![middle, middle]);
                starts
            }
            Self::Polynomial => vec![vec![0.05, 0.05], vec![-0.05, -0.2], vec![0.2, 0.0], vec![-0.2, 0.0]],
            Self::RateLimit => [0.5, 1.0, 1.5, 2.5].iter().map(|s| vec![(s * slope).ln()]).collect(),
            Self::DeadZone | Self::Backlash => {
                [0.02, 0.05, 0.3 * quantiles[0], 0.7 * quantiles[0], quantiles[0], quantiles[1]]
                    .iter()
                    .map(|&d| vec![d])
                    .collect()
            }
            Self::Free(spline) => vec![
                vec![0.0; spline.knots()],
                spline.places().iter().map(|u| -0.2 * u * u * u).collect(),
                spline.places().iter().map(|u| -u.clamp(-0.1, 0.1)).collect(),
            ],
            Self::Scaled(map) => {
                let mut starts = map.starts(quantiles, slope);
                starts.iter_mut().for_each(|p| p.push(0.0));
                starts
            }
        }
    }

    /// `in(u) - u`, sample by sample.
    pub fn change(&self, p: &[f64], drive: &[f64]) -> Vec<f64> {
        match self {
            Self::Gain => drive.iter().map(|u| p[0] * u).collect(),
            Self::Delay => (0..drive.len()).map(|k| delayed(drive, k as f64 - p[0]) - drive[k]).collect(),
            Self::ExtraPole => lagged(drive, p[0].exp()).zip(drive).map(|(w, u)| w - u).collect(),
            Self::Saturation => {
                let (low, high) = (-p[0].abs(), p[1].abs());
                drive.iter().map(|&u| u.clamp(low, high) - u).collect()
            }
            Self::Polynomial => drive.iter().map(|u| p[0] * u * u + p[1] * u * u * u).collect(),
            Self::RateLimit => {
                let limit = p[0].exp();
                let mut w = drive[0];
                drive
                    .iter()
                    .map(|&u| {
                        w += (u - w).clamp(-limit, limit);
                        w - u
                    })
                    .collect()
            }
            Self::DeadZone => drive.iter().map(|&u| -u.clamp(-p[0].abs(), p[0].abs())).collect(),
            Self::Backlash => {
                let d = p[0].abs();
                let mut w = drive[0];
                drive
                    .iter()
                    .map(|&u| {
                        w = w.clamp(u - d, u + d);
                        w - u
                    })
                    .collect()
            }
            Self::Free(spline) => drive.iter().map(|&u| spline.at(p, u)).collect(),
            Self::Scaled(map) => {
                let (own, factor) = p.split_at(map.parameters());
                let mut change = map.change(own, drive);
                change.iter_mut().for_each(|w| *w *= factor[0].exp());
                change
            }
        }
    }
}

/// Limits below and above from a list that ends with one that limits nothing.
pub fn limits(list: &[f64]) -> Vec<Vec<f64>> {
    let mut all: Vec<Vec<f64>> =
        list.iter().flat_map(|&low| list.iter().map(move |&high| vec![low, high])).collect();
    all.pop();
    all
}

/// A signal behind a pole of `corner` radians a sample, exact for the cubic through each four samples: a
/// straight line would weaken what lies at a tenth of the sample rate by some percent.
fn lagged(x: &[f64], corner: f64) -> impl Iterator<Item = f64> {
    let kept = (-corner).exp();
    let [m0, m1, m2, m3] = moments(corner);
    // Of the samples at -1, 0, 1 and 2 on the way from 0 to 1.
    let weights = [
        (-m3 + 3.0 * m2 - 2.0 * m1) / 6.0,
        (m3 - 2.0 * m2 - m1 + 2.0 * m0) / 2.0,
        (-m3 + m2 + 2.0 * m1) / 2.0,
        (m3 - m1) / 6.0,
    ];
    let last = x.len() - 1;
    let mut w = x[0];
    (0..x.len()).map(move |k| {
        if k > 0 {
            let around = [x[k.saturating_sub(2)], x[k - 1], x[k], x[(k + 1).min(last)]];
            w = kept * w + weights.iter().zip(around).map(|(w, x)| w * x).sum::<f64>();
        }
        w
    })
}

/// What a pole makes of `s^n` on the way from 0 to 1, `int_0^1 c e^(-c (1 - s)) s^n ds` for n from 0 to 3.
fn moments(c: f64) -> [f64; 4] {
    if c < 1.0 {
        // sum_j (-1)^j c^(j+1) n! / (n+1+j)!; the recursion below would cancel.
        return std::array::from_fn(|n| {
            (0..16).rev().fold(0.0, |sum, j| (1.0 - sum) * c / (n + 1 + j) as f64)
        });
    }
    let m0 = -(-c).exp_m1();
    let m1 = 1.0 - m0 / c;
    let m2 = 1.0 - 2.0 * m1 / c;
    [m0, m1, m2, 1.0 - 3.0 * m2 / c]
}

/// A signal between its samples by cubic Lagrange interpolation, held at its ends.
fn delayed(x: &[f64], at: f64) -> f64 {
    let last = x.len() as isize - 1;
    let i = at.floor();
    let s = at - i;
    let v = |k: isize| x[(i as isize + k).clamp(0, last) as usize];
    let (a, b, c, d) = (v(-1), v(0), v(1), v(2));
    -s * (s - 1.0) * (s - 2.0) / 6.0 * a + (s + 1.0) * (s - 1.0) * (s - 2.0) / 2.0 * b
        - (s + 1.0) * s * (s - 2.0) / 2.0 * c
        + (s + 1.0) * s * (s - 1.0) / 6.0 * d
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_fraction_of_a_sample_delays_a_sine_by_as_much() {
        let x: Vec<f64> = (0..200).map(|k| (0.2 * f64::from(k)).sin()).collect();
        let change = InputMap::Delay.change(&[2.3], &x);
        for k in 10..190 {
            let expected = (0.2 * (k as f64 - 2.3)).sin();
            assert!((x[k] + change[k] - expected).abs() < 1e-4, "sample {k}");
        }
    }

    #[test]
    fn maps_keep_their_limits() {
        let x: Vec<f64> = (0..100).map(|k| (0.3 * f64::from(k)).sin()).collect();
        let mapped = |map: InputMap, p: &[f64]| -> Vec<f64> {
            map.change(p, &x).iter().zip(&x).map(|(d, u)| u + d).collect()
        };
        assert!(mapped(InputMap::Saturation, &[0.5, 0.8]).iter().all(|w| (-0.5..=0.8).contains(w)));
        assert!(
            mapped(InputMap::RateLimit, &[0.1_f64.ln()])
                .windows(2)
                .all(|w| (w[1] - w[0]).abs() < 0.1 + 1e-12)
        );
        assert!(mapped(InputMap::Backlash, &[0.2]).iter().zip(&x).all(|(w, u)| (w - u).abs() <= 0.2 + 1e-12));
        assert!(mapped(InputMap::DeadZone, &[0.2]).iter().all(|w| w.abs() <= 0.8));
    }

    #[test]
    fn beside_a_fitted_linear_part_a_limit_comes_in_a_size_of_its_own() {
        let x: Vec<f64> = (0..100).map(|k| (0.3 * f64::from(k)).sin()).collect();
        let scaled = InputMap::DeadZone.beside_fitted();
        assert_eq!((scaled.parameters(), scaled.bare()), (2, &InputMap::DeadZone));
        let (own, twice) = (InputMap::DeadZone.change(&[0.2], &x), scaled.change(&[0.2, 2.0_f64.ln()], &x));
        assert!(own.iter().zip(&twice).all(|(a, b)| (2.0 * a - b).abs() < 1e-12));
        let starts = scaled.starts([0.3, 0.5, 0.7, 0.8, 0.9, 1.0], 0.1);
        assert!(starts.iter().all(|p| p.len() == 2 && p[1] == 0.0), "{starts:?}");
        assert_eq!(InputMap::Polynomial.beside_fitted(), InputMap::Polynomial, "free in size");
    }

    #[test]
    fn a_pole_turns_and_weakens_a_sine_as_it_should() {
        for corner in [0.05, 0.7, 2.5] {
            let x: Vec<f64> = (0..600).map(|k| (0.5 * f64::from(k)).sin()).collect();
            let change = InputMap::ExtraPole.change(&[f64::ln(corner)], &x);
            let (share, lag) = ((1.0 + (0.5 / corner).powi(2)).sqrt().recip(), (0.5 / corner).atan());
            for k in 300..590 {
                let expected = share * (0.5 * k as f64 - lag).sin();
                assert!((x[k] + change[k] - expected).abs() < 2e-3, "corner {corner}, sample {k}");
            }
        }
    }

    #[test]
    fn moments_meet_where_their_formulas_change() {
        let (below, above) = (moments(1.0 - 1e-12), moments(1.0));
        for (a, b) in below.iter().zip(above) {
            assert!((a - b).abs() < 1e-11, "{a} {b}");
        }
        assert!(
            moments(1e-6).iter().zip([1.0, 2.0, 3.0, 4.0]).all(|(m, n)| (m * n * 1e6 - 1.0).abs() < 1e-6)
        );
    }

    #[test]
    fn an_extra_pole_lets_slow_signals_through() {
        let x = vec![1.0; 50];
        assert!(InputMap::ExtraPole.change(&[0.1_f64.ln()], &x).iter().all(|d| d.abs() < 1e-12));
        let step: Vec<f64> = (0..200).map(|k| f64::from(u8::from(k > 10))).collect();
        let change = InputMap::ExtraPole.change(&[0.1_f64.ln()], &step);
        assert!(change[20] < -0.3 && change[199].abs() < 1e-6);
        let quick = InputMap::ExtraPole.change(&[50.0_f64.ln()], &step);
        assert!(quick.iter().all(|d| d.abs() < 0.03));
    }
}
