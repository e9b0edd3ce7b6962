//! How large the gap is, and how much of it is none.

use super::hypotheses::Listed;
use super::recording::Runs;
use crate::diagnosis::data::overview::Overview;
use crate::diagnosis::report::Gap;
use crate::diagnosis::screen::Screening;

/// The gap of each response, relative to its RMS in band.
pub(super) struct Evidence {
    /// What the sim leaves.
    whole: Vec<f64>,
    /// What is left by the best predictor of groups that it has not seen: the noise is no more.
    best: Vec<f64>,
    /// The noise of repeats.
    noise: Option<Vec<f64>>,
    /// What a linear part fitted to the other groups leaves.
    linear: Vec<f64>,
    /// See [`Runs::level_follows_time`].
    level_follows_time: bool,
}

impl Evidence {
    pub fn of(overview: &Overview, screening: &Screening, runs: &Runs, listed: &[Listed]) -> Self {
        let whole: Vec<f64> = overview.power.iter().map(|p| p.rms_error / p.level()).collect();
        let linear: Vec<f64> =
            screening.linear.errors.iter().enumerate().map(|(r, errors)| runs.left(r, errors)).collect();
        let best = (0..whole.len())
            .map(|r| {
                let of_laws = listed.iter().filter_map(|l| Some(runs.left(r, l.errors.get(r)?)));
                of_laws.fold(linear[r].min(whole[r]), f64::min)
            })
            .collect();
        let noise = runs
            .relative_noise(overview)
            .map(|noise| noise.into_iter().zip(&whole).map(|(noise, whole)| noise.min(*whole)).collect());
        Self { whole, best, noise, linear, level_follows_time: runs.level_follows_time() }
    }

    /// The response with the largest systematic error that may be.
    pub fn worst(&self) -> usize {
        let most = |r: usize| self.at_most(r);
        (0..self.whole.len()).max_by(|&a, &b| most(a).total_cmp(&most(b))).unwrap_or(0)
    }

    /// Systematic error of a response at most.
    pub fn at_most(&self, r: usize) -> f64 {
        less(self.whole[r], self.noise.as_ref().map_or(0.0, |n| n[r]))
    }

    /// And at least: what the best predictor shows to be none of the noise.
    pub fn at_least(&self, r: usize) -> f64 {
        self.noise.as_ref().map_or_else(|| less(self.whole[r], self.best[r]), |_| self.at_most(r))
    }

    /// What the sim leaves of a response.
    pub fn whole(&self, r: usize) -> f64 {
        self.whole[r]
    }

    /// What a linear part leaves of it.
    pub fn linear(&self, r: usize) -> f64 {
        self.linear[r]
    }

    /// The noise of a response at most.
    pub fn noise(&self, r: usize) -> f64 {
        self.noise.as_ref().map_or(self.best[r], |n| n[r])
    }

    /// Whether repeats tell the noise.
    pub fn repeats(&self) -> bool {
        self.noise.is_some()
    }

    /// Whether what time does and what level does are one in these runs.
    pub fn level_follows_time(&self) -> bool {
        self.level_follows_time
    }

    /// Share of the gap's power that a linear part closes.
    pub fn linear_closure(&self) -> f64 {
        let r = self.worst();
        1.0 - (self.linear[r] / self.whole[r].max(f64::MIN_POSITIVE)).powi(2).min(1.0)
    }

    pub fn gap(&self) -> Gap {
        let r = self.worst();
        let floors = (self.whole[r] / self.noise(r).max(f64::MIN_POSITIVE)).powi(2).min(1e12);
        Gap {
            systematic_rms_rel: self.at_most(r),
            systematic_at_least: self.at_least(r),
            systematic_at_most: self.at_most(r),
            noise_rms_rel: self.noise(r),
            chi2_select: floors,
            chi2_test: floors,
        }
    }
}

/// What is left of one RMS without another that does not go with it.
fn less(of: f64, without: f64) -> f64 {
    (of * of - without * without).max(0.0).sqrt()
}
