//! Errors counted in noise floors: the weighted spectrum of a stretch, inside the core's band.
//!
//! A stretch of `n` samples is tapered (Tukey, 5 % at each end) and transformed; each line in the
//! band is divided by the standard deviation that noise alone gives it. Real and imaginary parts
//! are then independent rows of variance 1, so the mean of their squares is `chi2` in noise floors.
//! Whitening and band limit in one step, without a filter's ring-down.
//!
//! A stretch whose past is unknown rings down from it: rows are then taken without their part along
//! the free decays of the rig, so that no run needs to start at rest.

use std::sync::Arc;

use realfft::num_complex::Complex64;
use rigcast_numerics::fft::{ComplexToReal, RealFftPlanner, RealToComplex};

use super::ar::Ar;
use super::linear::{dot, norm};

/// Share of a stretch that each end's taper takes.
const TAPER: f64 = 0.05;
/// Share of a decay's length below which those before it hold it already.
const SAME: f64 = 1e-6;

/// Turns stretches of one length into rows.
#[derive(Clone)]
pub struct Rows {
    n: usize,
    taper: Vec<f64>,
    first_line: usize,
    /// 1 / standard deviation of a row, per line in the band.
    weight: Vec<f64>,
    /// Orthonormal rows of what may be left of the past.
    past: Vec<Vec<f64>>,
    forward: Arc<dyn RealToComplex<f64>>,
    inverse: Arc<dyn ComplexToReal<f64>>,
}

impl Rows {
    /// Rows of the first [`fast_len`] of `samples` samples; `band` in cycles a sample.
    pub fn new(samples: usize, band: [f64; 2], noise: &Ar) -> Self {
        let n = fast_len(samples);
        let edge = ((n as f64 * TAPER) as usize).max(1);
        let taper: Vec<f64> = (0..n)
            .map(|i| {
                let from_end = i.min(n - 1 - i);
                if from_end >= edge {
                    1.0
                } else {
                    0.5 - 0.5 * (std::f64::consts::PI * (from_end as f64 + 0.5) / edge as f64).cos()
                }
            })
            .collect();
        let power: f64 = taper.iter().map(|w| w * w).sum();
        let first_line = (band[0] * n as f64).ceil() as usize;
        let last_line = ((band[1] * n as f64).floor() as usize).min(n / 2 - 1).max(first_line);
        let weight = (first_line..=last_line)
            .map(|line| {
                let variance = noise.power(line as f64 / n as f64) * power;
                let parts = if line == 0 { 1.0 } else { 2.0 };
                (parts / variance).sqrt()
            })
            .collect();
        let mut planner = RealFftPlanner::new();
        Self {
            n,
            taper,
            first_line,
            weight,
            past: Vec::new(),
            forward: planner.plan_fft_forward(n),
            inverse: planner.plan_fft_inverse(n),
        }
    }

    /// Rows without their part along `decays`, signals as long as a stretch.
    pub fn without(mut self, decays: &[Vec<f64>]) -> Self {
        for decay in decays {
            let mut rows = Vec::with_capacity(self.len());
            self.weighted(decay, &mut rows);
            let before = norm(&rows);
            // Twice, for what rounding leaves of the first time.
            self.forget(&mut rows);
            self.forget(&mut rows);
            let after = norm(&rows);
            if after > SAME * before {
                rows.iter_mut().for_each(|r| *r /= after);
                self.past.push(rows);
            }
        }
        self
    }

    fn forget(&self, rows: &mut [f64]) {
        for past in &self.past {
            let share = dot(past, rows);
            rows.iter_mut().zip(past).for_each(|(r, p)| *r -= share * p);
        }
    }

    /// Samples that are used of a stretch.
    pub fn samples(&self) -> usize {
        self.n
    }

    /// Rows per stretch.
    pub fn len(&self) -> usize {
        2 * self.weight.len() - usize::from(self.first_line == 0)
    }

    fn lines(&self, stretch: &[f64]) -> Vec<Complex64> {
        let mut input: Vec<f64> = stretch[..self.n].iter().zip(&self.taper).map(|(x, w)| x * w).collect();
        let mut lines = self.forward.make_output_vec();
        self.forward.process(&mut input, &mut lines).expect("buffers are the plan's own");
        lines
    }

    /// Appends the rows of a stretch of at least [`Rows::samples`] samples.
    pub fn extend(&self, stretch: &[f64], rows: &mut Vec<f64>) {
        let from = rows.len();
        self.weighted(stretch, rows);
        self.forget(&mut rows[from..]);
    }

    fn weighted(&self, stretch: &[f64], rows: &mut Vec<f64>) {
        let lines = self.lines(stretch);
        for (i, (z, w)) in lines[self.first_line..].iter().zip(&self.weight).enumerate() {
            rows.push(z.re * w);
            if i + self.first_line > 0 {
                rows.push(z.im * w);
            }
        }
    }

    /// The stretch as a time signal in noise floors: noise alone has a mean square of about
    /// `rows / samples`, whatever its colour.
    pub fn whitened(&self, stretch: &[f64]) -> Vec<f64> {
        let mut rows = Vec::with_capacity(self.len());
        self.extend(stretch, &mut rows);
        let mut rows = rows.into_iter();
        let mut lines = self.inverse.make_input_vec();
        let band = lines[self.first_line..].iter_mut().take(self.weight.len());
        for (line, z) in (self.first_line..).zip(band) {
            let re = rows.next().unwrap_or_default();
            let im = if line == 0 { 0.0 } else { rows.next().unwrap_or_default() };
            // A line stands for itself and its conjugate: half of the power each.
            let parts = if line == 0 { 1.0 } else { 0.5 };
            *z = Complex64::new(re, im) * f64::sqrt(parts / self.n as f64);
        }
        lines[0].im = 0.0;
        let mut out = self.inverse.make_output_vec();
        self.inverse.process(&mut lines, &mut out).expect("buffers are the plan's own");
        out
    }

    /// The stretch inside the band, tapered, in its own unit.
    pub fn in_band(&self, stretch: &[f64]) -> Vec<f64> {
        let mut lines = self.lines(stretch);
        let last = self.first_line + self.weight.len();
        for (i, z) in lines.iter_mut().enumerate() {
            *z = if i < self.first_line || i >= last { Complex64::default() } else { *z / self.n as f64 };
        }
        lines[0].im = 0.0;
        let mut out = self.inverse.make_output_vec();
        self.inverse.process(&mut lines, &mut out).expect("buffers are the plan's own");
        out
    }

    /// Mean square that a stretch loses to the taper.
    pub fn taper_power(&self) -> f64 {
        self.taper.iter().map(|w| w * w).sum::<f64>() / self.n as f64
    }
}

/// Largest even product of 2, 3 and 5 that is at most `n` (at least 2): quick to transform.
pub fn fast_len(n: usize) -> usize {
    let mut best = 2;
    let mut five = 2;
    while five <= n {
        let mut three = five;
        while three <= n {
            let mut two = three;
            while two <= n {
                best = best.max(two);
                two *= 2;
            }
            three *= 3;
        }
        five *= 5;
    }
    best
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;
    use rand_distr::{Distribution, StandardNormal};

    #[test]
    fn a_decay_from_the_past_leaves_no_rows_and_noise_keeps_its_own() {
        let (noise, samples) = coloured(4000, 5);
        let decay = |w: f64| -> Vec<f64> {
            (0..4000).map(|k| (-2e-3 * f64::from(k)).exp() * (w * f64::from(k)).cos()).collect()
        };
        let plain = Rows::new(4000, [0.002, 0.2], &noise);
        let rows = plain.clone().without(&[decay(0.1), decay(0.3), decay(0.1)]);
        let of = |rows: &Rows, x: &[f64]| {
            let mut out = Vec::new();
            rows.extend(x, &mut out);
            norm(&out)
        };
        let both: Vec<f64> = decay(0.1).iter().zip(decay(0.3)).map(|(a, b)| 3.0 * a - b).collect();
        assert!(of(&rows, &both) < 1e-9 * of(&plain, &both));
        let (kept, all) = (of(&rows, &samples), of(&plain, &samples));
        assert!(kept < all && kept > 0.99 * all);
        assert!(norm(&rows.whitened(&both)) < 1e-9 * norm(&plain.whitened(&both)));
    }

    fn coloured(n: usize, seed: u64) -> (Ar, Vec<f64>) {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let mut state = 0.0;
        let samples = (0..n + 100)
            .map(|_| {
                let e: f64 = StandardNormal.sample(&mut rng);
                state = 0.9 * state + 0.3 * e;
                state
            })
            .skip(100)
            .collect();
        (Ar { coefficients: vec![-0.9], variance: 0.09 }, samples)
    }

    #[test]
    fn noise_alone_has_rows_of_mean_square_one() {
        let (noise, samples) = coloured(40_000, 3);
        let rows = Rows::new(samples.len(), [0.0, 0.2], &noise);
        let mut out = Vec::new();
        rows.extend(&samples, &mut out);
        assert_eq!(out.len(), rows.len());
        let chi2 = out.iter().map(|r| r * r).sum::<f64>() / out.len() as f64;
        assert!((chi2 - 1.0).abs() < 0.04, "{chi2}");
    }

    #[test]
    fn the_whitened_signal_has_the_rows_sum_of_squares() {
        let (noise, samples) = coloured(3000, 4);
        for band in [[0.0, 0.2], [0.05, 0.3]] {
            let rows = Rows::new(samples.len(), band, &noise);
            let mut out = Vec::new();
            rows.extend(&samples, &mut out);
            let expected: f64 = out.iter().map(|r| r * r).sum();
            let found: f64 = rows.whitened(&samples).iter().map(|r| r * r).sum();
            assert!((found / expected - 1.0).abs() < 1e-9, "{found} {expected}");
        }
    }

    #[test]
    fn content_outside_the_band_is_not_scored() {
        let samples: Vec<f64> =
            (0..5000).map(|i| (std::f64::consts::TAU * 0.4 * f64::from(i)).sin()).collect();
        let rows = Rows::new(samples.len(), [0.01, 0.1], &Ar::white(1.0));
        let mut out = Vec::new();
        rows.extend(&samples, &mut out);
        assert!(out.iter().all(|r| r.abs() < 1e-3));
    }

    #[test]
    fn quick_lengths_are_products_of_two_three_and_five() {
        for (n, expected) in [(2, 2), (7, 6), (1000, 1000), (1023, 1000), (51_200, 51_200)] {
            assert_eq!(fast_len(n), expected);
        }
    }
}
