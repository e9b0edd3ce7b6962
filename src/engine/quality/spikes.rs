//! Spikes: up to three samples on end that lie far outside what their neighbours allow.
//!
//! The samples are bridged by the cubic through two neighbours on each side. The excursion from that bridge must be
//! - far outside the scale of the same error over the run and over [`AROUND`] samples on each side. The limits
//!   are those of Gaussian noise for [`super::FALSE_ALARM`], so that noise and its rare peaks give none;
//! - [`STEPS`] times any step between neighbours around the bridge or, on a smooth slope, [`BENDS`] times any change
//!   of that step, and [`ENDS`] times the distance between the lines that go on
//!   from both sides to its middle. That leaves out edges of square waves, corners of triangles, impacts that ring,
//!   and single counts of a coarse converter;
//! - [`LEAST`] of the channel's standard deviation.

use serde::{Deserialize, Serialize};

use super::{Excerpts, gaussian_limit, student_limit};

/// Longest spike, samples.
pub const LONGEST: usize = 3;
/// Samples on each side that the local scale is taken from.
pub(super) const AROUND: usize = 64;
/// Samples on each side whose steps are compared.
const NEAR: usize = 8;
/// Excursion over the largest step between neighbours. The edge of a square wave gives at most 1 and the corner of a
/// triangle 1.2; four is well above both, and below any spike that matters on a smooth signal.
const STEPS: f64 = 4.0;
/// Excursion over the largest change of that step. The corner of a triangle gives at most 3.
const BENDS: f64 = 6.0;
/// Excursion over the distance of both sides. At an edge it is 1 at most.
const ENDS: f64 = 2.0;
/// Excursion over the standard deviation of the channel. A smaller spike moves neither a peak nor a fit.
const LEAST: f64 = 0.1;
/// Degrees of freedom of the local scale: 2 x 64 errors of white noise whose neighbours correlate by 56/70, 28/70, 8/70 and
/// 1/70, thus `128 / (1 + 2 * sum(rho^2))`.
const FREEDOM: f64 = 48.0;
/// Largest errors around that are left out of the local scale, those of two other spikes nearby; and what is left of the
/// deviation of Gaussian errors without so many of 132.
const OTHERS: (usize, f64) = (10, 0.825);
/// Share of the errors below the quantile that gives the scale of the run, and that quantile of |x| for a Gaussian.
/// It is robust against spikes, which are rare, and looks at the moving part of a run that rests most of the time.
const QUANTILE: (f64, f64) = (0.9, 1.645);

/// Spikes of one channel.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
pub struct Spikes {
    /// Number.
    pub count: u64,
    /// Sample of the first one, from 0; `None` without one.
    pub first_sample: Option<u64>,
    /// Largest excursion, in the channel's unit.
    pub largest: f64,
}

/// Error of a sample against the cubic through its four neighbours; a sixth of the fourth difference.
fn error(x: &[f64], at: usize) -> f64 {
    x[at] + (x[at - 2] + x[at + 2] - 4.0 * (x[at - 1] + x[at + 1])) / 6.0
}

/// Finds the spikes of a channel, block by block.
#[derive(Debug)]
pub(super) struct SpikeFinder {
    /// Error over the run that a Gaussian channel does not exceed.
    limit: f64,
    /// The same over the local scale, as a factor.
    local: f64,
    /// A step that any channel makes: its converter's, or the rounding of its values.
    least_step: f64,
    /// Next sample that may begin a spike.
    from: usize,
    found: Spikes,
}

impl SpikeFinder {
    /// For a channel of `n` samples; `step` is that of its values, 0 for none.
    pub fn new(excerpts: &Excerpts, n: usize, std: f64, peak: f64, step: f64) -> Self {
        let mut errors: Vec<f64> = Vec::new();
        for part in excerpts.parts() {
            errors.extend((2..part.len().saturating_sub(2)).map(|at| error(part, at).abs()));
        }
        let scale = super::quantile(&mut errors, QUANTILE.0) / QUANTILE.1;
        // 32-bit floats near the peak are so far apart.
        let least_step = step.max(peak * f64::from(f32::EPSILON));
        let limit = (gaussian_limit(n) * scale).max(LEAST * std).max(STEPS * least_step);
        Self { limit, local: student_limit(n, FREEDOM), least_step, from: 0, found: Spikes::default() }
    }

    /// Samples that [`Self::take`] needs on both sides of those that it judges.
    pub const MARGIN: usize = AROUND + LONGEST + 4;

    /// Judges the samples `judged` of `x`, which begins at sample `start` of the channel.
    pub fn take(&mut self, x: &[f64], judged: std::ops::Range<usize>, start: usize) {
        // An error of half the excursion is seen at the first or second sample of any spike, or just before it.
        let candidate = 0.5 * self.limit;
        for at in judged {
            if error(x, at).abs() < candidate || start + at < self.from {
                continue;
            }
            let found = (1..=LONGEST)
                .flat_map(|width| (at..at + 3).map(move |first| (first, width)))
                .find_map(|(first, width)| Some((first, width, self.excursion(x, first, width)?)));
            if let Some((first, width, excursion)) = found {
                self.found.count += 1;
                self.found.first_sample.get_or_insert((start + first) as u64);
                self.found.largest = self.found.largest.max(excursion);
                self.from = start + first + width + 2;
            }
        }
    }

    /// Largest distance of `width` samples from their bridge, if they are a spike.
    fn excursion(&self, x: &[f64], first: usize, width: usize) -> Option<f64> {
        let after = first + width;
        if first < AROUND + 2 || after + AROUND + 2 > x.len() {
            return None;
        }
        let bridge = bridge(x, first, width);
        let excursion = (0..width).map(|k| (x[first + k] - bridge[k]).abs()).fold(0.0, f64::max);
        if excursion < self.limit {
            return None;
        }
        let bridged = |at: usize| if (first..after).contains(&at) { bridge[at - first] } else { x[at] };
        let near = first - NEAR..after + NEAR - 2;
        let steps = near.clone().map(|at| (bridged(at + 1) - bridged(at)).abs());
        let bends = near.map(|at| (bridged(at + 2) - 2.0 * bridged(at + 1) + bridged(at)).abs());
        let (step, bend) = (steps.fold(self.least_step, f64::max), bends.fold(self.least_step, f64::max));
        if excursion < (STEPS * step).min(BENDS * bend) {
            return None;
        }
        let half = 0.5 * (width + 1) as f64;
        let left = x[first - 1] + half * (x[first - 1] - x[first - 2]);
        let right = x[after] - half * (x[after + 1] - x[after]);
        if excursion < ENDS * (right - left).abs() {
            return None;
        }
        let around: Vec<f64> = (first - AROUND - 2..after + AROUND + 2).map(bridged).collect();
        let mut errors: Vec<f64> = (2..around.len() - 2).map(|at| error(&around, at).powi(2)).collect();
        let kept = errors.len() - OTHERS.0;
        errors.select_nth_unstable_by(kept, f64::total_cmp);
        let scale = (errors[..kept].iter().sum::<f64>() / kept as f64).sqrt() / OTHERS.1;
        (excursion >= self.local * scale).then_some(excursion)
    }

    pub fn end(self) -> Spikes {
        self.found
    }
}

/// The cubic through two samples on each side of a gap, at the samples of the gap.
fn bridge(x: &[f64], first: usize, width: usize) -> [f64; LONGEST] {
    let at = [-2.0, -1.0, width as f64, (width + 1) as f64];
    let values = [x[first - 2], x[first - 1], x[first + width], x[first + width + 1]];
    let lagrange = |t: f64| -> f64 {
        let weight =
            |i: usize| -> f64 { (0..4).filter(|&j| j != i).map(|j| (t - at[j]) / (at[i] - at[j])).product() };
        (0..4).map(|i| weight(i) * values[i]).sum()
    };
    std::array::from_fn(|k| if k < width { lagrange(k as f64) } else { 0.0 })
}
