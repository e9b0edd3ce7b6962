//! The filter ahead of a bend: a pair of poles and a lag, both with a gain of 1 at rest.
//!
//! What a sampled filter of this kind cannot do, its zeros, is of little weight where the rate is some times the corner;
//! the filter behind the bend is free and takes what it can of the rest.

use std::f64::consts::TAU;

use serde::{Deserialize, Serialize};

use super::forward::{Number, NumberOf};

/// Corners of the pair inside the band, its dampings, and the lag's corner as a multiple of the pair's; a corner far
/// above the rate is none.
const CORNERS: usize = 5;
const DAMPINGS: [f64; 3] = [0.2, 0.5, 0.9];
const LAGS: [f64; 2] = [0.6, NONE];
const NONE: f64 = 1e3;
/// A corner beyond so many times the rate filters nothing.
const HIGHEST: f64 = 30.0;

/// A filter of sampled signals, `w_t = a_1 w_(t-1) + a_2 w_(t-2) + (1 - a_1 - a_2) u_t`, `x_t = b x_(t-1) + (1 - b) w_t`.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(from = "Stored", into = "Stored")]
pub struct Front {
    /// Natural frequency of the pair, cycles a sample.
    corner: f64,
    /// Its damping ratio, at most 1.
    damping: f64,
    /// Corner of the lag, cycles a sample.
    lag: f64,
    /// `a_1`, `a_2` and `b`, which follow from the numbers above.
    poles: [f64; 3],
    /// Deviation of the output where that of the drive is 1.
    level: f64,
}

/// What a file has of it.
#[derive(Serialize, Deserialize)]
struct Stored {
    corner: f64,
    damping: f64,
    lag: f64,
    level: f64,
}

impl From<Stored> for Front {
    fn from(Stored { corner, damping, lag, level }: Stored) -> Self {
        Self { level, ..Self::new(corner, damping, lag) }
    }
}

impl From<Front> for Stored {
    fn from(Front { corner, damping, lag, level, .. }: Front) -> Self {
        Self { corner, damping, lag, level }
    }
}

impl Front {
    /// How many numbers it has.
    pub(super) const NUMBERS: usize = 3;

    /// Of corners in cycles a sample.
    pub(super) fn new(corner: f64, damping: f64, lag: f64) -> Self {
        let (corner, damping, lag) = (corner.min(HIGHEST), damping.clamp(0.01, 1.0), lag.min(HIGHEST));
        let radius = (-TAU * corner * damping).exp();
        let angle = TAU * corner * (1.0 - damping * damping).sqrt();
        let poles = [2.0 * radius * angle.cos(), -radius * radius, (-TAU * lag).exp()];
        Self { corner, damping, lag, poles, level: 1.0 }
    }

    /// Filters that are tried first.
    pub(super) fn grid(low_hz: f64, high_hz: f64, rate_hz: f64) -> Vec<Self> {
        let (low, high) = (low_hz.max(0.05 * high_hz) / rate_hz, high_hz / rate_hz);
        (0..CORNERS)
            .map(|k| low * (1.5 * high / low).powf(k as f64 / (CORNERS - 1) as f64))
            .flat_map(|corner| {
                DAMPINGS.into_iter().flat_map(move |z| LAGS.map(|lag| Self::new(corner, z, lag * corner)))
            })
            .collect()
    }

    /// The same with each of its three numbers as it is, larger or smaller by a factor, in all combinations: what one
    /// corner lets through the other may hold back. A lag that filters nothing comes into view at four times the pair's
    /// corner.
    pub(super) fn nearby(self, factor: f64) -> Vec<Self> {
        let lag = if self.lag > 10.0 * self.corner { 4.0 * self.corner } else { self.lag };
        let steps = [1.0, factor, 1.0 / factor];
        let of = |k: usize| {
            let [a, b, c] = [k / 9, k / 3 % 3, k % 3].map(|step| steps[step]);
            Self::new(self.corner * a, self.damping * b, if c == 1.0 { self.lag } else { lag * c })
        };
        (1..27).map(of).collect()
    }

    /// The same at its level with the logarithms of corner, damping and lag changed.
    pub(super) fn changed(self, [corner, damping, lag]: [f64; Self::NUMBERS]) -> Self {
        let changed =
            Self::new(self.corner * corner.exp(), self.damping * damping.exp(), self.lag * lag.exp());
        Self { level: self.level, ..changed }
    }

    /// The same with its level from a drive in deviations, `[record][sample]`.
    pub(super) fn levelled<'a>(
        mut self,
        drive: impl Iterator<Item = &'a [f64]>,
        centre: f64,
        scale: f64,
    ) -> Self {
        self.level = 1.0;
        let (mut sum, mut squares, mut n) = (0.0, 0.0, 0.0);
        for record in drive {
            let mut state = [record.first().map_or(0.0, |u| (u - centre) / scale); 3];
            for u in record {
                let x;
                (state, x) = self.next(state, (u - centre) / scale);
                sum += x;
                squares += x * x;
                n += 1.0;
            }
        }
        let variance = squares / f64::max(n, 1.0) - (sum / f64::max(n, 1.0)).powi(2);
        self.level = if variance > 1e-24 { variance.sqrt() } else { 1.0 };
        self
    }

    /// States after a sample, and the output in its deviations.
    pub(super) fn next(self, [w, before, x]: [f64; 3], u: f64) -> ([f64; 3], f64) {
        let [a1, a2, b] = self.poles;
        let now = a1 * w + a2 * before + (1.0 - a1 - a2) * u;
        let x = b * x + (1.0 - b) * now;
        ([now, w, x], x / self.level)
    }

    /// Whether it filters below a frequency in cycles a sample: one that does not leaves a bend over the drive itself.
    pub(super) fn filters_below(self, high: f64) -> bool {
        self.corner <= high
    }

    /// Its numbers.
    pub(super) fn values(self) -> Vec<f64> {
        vec![self.corner, self.damping, self.lag, self.level]
    }

    /// Natural frequency and damping of the pair and corner of the lag, as far as they are below half of the rate.
    pub(super) fn numbers(self, rate_hz: f64) -> Vec<Number> {
        let number = |name, value, of| Number { name, value, of };
        let mut numbers = Vec::new();
        if self.corner < 0.5 {
            numbers.push(number("front_frequency", self.corner * rate_hz, NumberOf::Frequency));
            numbers.push(number("front_damping", self.damping, NumberOf::Ratio));
        }
        if self.lag < 0.5 {
            numbers.push(number("front_lag", self.lag * rate_hz, NumberOf::Frequency));
        }
        numbers
    }

    /// Whether it rests when its drive does.
    pub(super) fn is_stable(self) -> bool {
        let [a1, a2, b] = self.poles;
        a2.abs() < 1.0 && a1.abs() < 1.0 - a2 && b.abs() < 1.0 && self.level > 0.0
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_filter_rests_at_its_drive_and_rings_at_its_corner() {
        let front = Front::new(0.02, 0.05, 0.3);
        assert!(front.is_stable());
        let (mut state, mut x) = ([0.0; 3], 0.0);
        let mut crossings = Vec::new();
        for t in 0..4000 {
            let before = x;
            (state, x) = front.next(state, 1.0);
            if t < 200 && before < 1.0 && x >= 1.0 {
                crossings.push(f64::from(t));
            }
        }
        assert!((x - 1.0).abs() < 1e-9, "{x}");
        assert!((crossings[1] - crossings[0] - 50.0).abs() <= 1.0, "{crossings:?}");
    }

    #[test]
    fn the_level_makes_the_output_one_deviation() {
        let drive: Vec<f64> = (0..5000).map(|k| 3.0 + 2.0 * (0.3 * f64::from(k)).sin()).collect();
        let front = Front::new(0.03, 0.5, 0.02).levelled(std::iter::once(drive.as_slice()), 3.0, 2.0);
        let mut state = [0.0; 3];
        let mut x = Vec::new();
        for u in &drive {
            let y;
            (state, y) = front.next(state, (u - 3.0) / 2.0);
            x.push(y);
        }
        let square = x.iter().map(|x| x * x).sum::<f64>() / x.len() as f64;
        assert!((square - 1.0).abs() < 0.02, "{square}");
    }

    #[test]
    fn a_filter_out_of_a_file_is_the_same_and_one_that_grows_is_told() {
        let front = Front { level: 0.7, ..Front::new(0.031, 0.27, 0.4) };
        let text = serde_json::to_string(&front).unwrap();
        assert_eq!(serde_json::from_str::<Front>(&text).unwrap(), front);
        let grows = text.replace("0.031", "-0.031");
        assert!(!serde_json::from_str::<Front>(&grows).unwrap().is_stable());
    }

    #[test]
    fn a_corner_above_the_rate_filters_nothing() {
        let front = Front::new(NONE, 0.5, NONE);
        assert_eq!(front.next([0.0; 3], 0.7).1, 0.7);
        assert!(front.numbers(100.0).is_empty());
    }
}
