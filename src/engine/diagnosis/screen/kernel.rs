//! Impulse responses: what they make of signals, sample by sample or in sum.

use std::ops::Range;

use serde::{Deserialize, Serialize};

use super::correlate::Filter;
use crate::diagnosis::numerics::linear::dot;

/// Taps at the end of an impulse response below this share of its largest are left out.
const TAIL: f64 = 1e-5;

/// An impulse response that begins at a lag, which is negative where it reaches ahead.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub(super) struct Kernel {
    pub from: isize,
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub taps: Vec<f64>,
    /// How many taps are kept apart from it; see `Forward::detach_taps`.
    #[serde(default, skip_serializing_if = "is_zero")]
    pub apart: usize,
}

fn is_zero(n: &usize) -> bool {
    *n == 0
}

impl Kernel {
    pub fn new(from: isize, taps: &[f64]) -> Self {
        let mut kernel = Self::default();
        kernel.add(taps, from, 1.0);
        kernel
    }

    /// Adds an impulse response that begins at a lag, times a factor.
    pub fn add(&mut self, impulse: &[f64], from: isize, factor: f64) {
        let end = (from + impulse.len() as isize).max(self.from + self.taps.len() as isize);
        let start = if self.taps.is_empty() { from } else { from.min(self.from) };
        if start < self.from || self.taps.is_empty() {
            let before = if self.taps.is_empty() { 0 } else { (self.from - start) as usize };
            self.taps.splice(0..0, std::iter::repeat_n(0.0, before));
            self.from = start;
        }
        self.taps.resize((end - start) as usize, 0.0);
        let at = (from - start) as usize;
        self.taps[at..at + impulse.len()].iter_mut().zip(impulse).for_each(|(t, h)| *t += factor * h);
    }

    /// Leaves out the end that is next to nothing.
    pub fn trim(&mut self) {
        let most = self.taps.iter().fold(0.0_f64, |m, h| m.max(h.abs()));
        let last = self.taps.iter().rposition(|h| h.abs() > TAIL * most).map_or(0, |at| at + 1);
        self.taps.truncate(last);
    }

    /// Sum of its taps.
    pub fn sum(&self) -> f64 {
        self.taps.iter().sum()
    }

    /// What it makes of a signal that was zero before its first sample and is held after its last.
    pub fn apply(&self, x: &[f64]) -> Vec<f64> {
        if self.taps.is_empty() {
            return vec![0.0; x.len()];
        }
        let (lead, held) = ((-self.from).max(0) as usize, x.last().copied().unwrap_or(0.0));
        let longer: Vec<f64> =
            std::iter::once(0.0).chain(x.iter().copied()).chain(std::iter::repeat_n(held, lead)).collect();
        let y = Filter::new(self.taps.clone(), longer.len()).apply(&longer);
        let at = |t: usize| usize::try_from(t as isize + 1 - self.from).map_or(0.0, |k| y[k]);
        (0..x.len()).map(at).collect()
    }

    /// What it makes of a drive that was at its first sample for ever, about `mean`.
    pub fn apply_held(&self, x: &[f64], mean: f64) -> Vec<f64> {
        let first = x.first().copied().unwrap_or(mean);
        let moved: Vec<f64> = x.iter().map(|x| x - first).collect();
        let level = (first - mean) * self.sum();
        let mut y = self.apply(&moved);
        y.iter_mut().for_each(|y| *y += level);
        y
    }

    /// Sum over rows of what it makes of a signal that was zero before its first sample and is held after its last.
    pub fn sum_over(&self, x: &RunningSums, rows: &Range<usize>) -> f64 {
        let [start, end] = [rows.start, rows.end].map(|t| t as isize);
        self.taps
            .iter()
            .zip(self.from..)
            .map(|(h, lag)| h * (x.up_to(end - lag) - x.up_to(start - lag)))
            .sum()
    }

    /// The same of a drive that was at its first sample for ever, about `mean`.
    pub fn sum_over_held(&self, x: &HeldSums, mean: f64, rows: &Range<usize>) -> f64 {
        self.sum_over(&x.moved, rows) + rows.len() as f64 * (x.first - mean) * self.sum()
    }

    /// Product with another over the lags that both have.
    pub fn along(&self, other: &Self) -> f64 {
        let from = self.from.max(other.from);
        let part = |k: &'_ Self| usize::try_from(from - k.from).ok().filter(|at| *at <= k.taps.len());
        let (Some(a), Some(b)) = (part(self), part(other)) else { return 0.0 };
        let n = (self.taps.len() - a).min(other.taps.len() - b);
        dot(&self.taps[a..a + n], &other.taps[b..b + n])
    }

    /// Taps of the past, from lag 1 on.
    pub fn past(&self) -> Vec<f64> {
        let at = |lag: isize| usize::try_from(lag - self.from).ok().and_then(|k| self.taps.get(k)).copied();
        let last = self.from + self.taps.len() as isize;
        (1..last).map(|lag| at(lag).unwrap_or(0.0)).collect()
    }
}

/// Running sums of a signal: what a filter makes of it is summed over any rows without filtering.
pub(super) struct RunningSums {
    /// Sum of the first samples, by their number.
    sums: Vec<f64>,
    last: f64,
}

impl RunningSums {
    pub fn new(x: impl ExactSizeIterator<Item = f64>) -> Self {
        let mut sums = Vec::with_capacity(x.len() + 1);
        let (mut sum, mut last) = (0.0, 0.0);
        sums.push(sum);
        for x in x {
            (sum, last) = (sum + x, x);
            sums.push(sum);
        }
        Self { sums, last }
    }

    /// Sum of all samples before sample `end`: zeros before the first, the last one held.
    fn up_to(&self, end: isize) -> f64 {
        let Ok(end) = usize::try_from(end) else { return 0.0 };
        let n = self.sums.len() - 1;
        self.sums[end.min(n)] + end.saturating_sub(n) as f64 * self.last
    }
}

/// Those of a drive about its first sample.
pub(super) struct HeldSums {
    first: f64,
    moved: RunningSums,
}

impl HeldSums {
    pub fn new(x: &[f64]) -> Self {
        let first = x.first().copied().unwrap_or(0.0);
        Self { first, moved: RunningSums::new(x.iter().map(|x| x - first)) }
    }
}
