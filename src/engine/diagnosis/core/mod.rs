//! The linear core: what one response does at low level, as a discrete state space.
//!
//! `y - y_mean = sum_d H_d(z) (u_d - u_d_mean)` with one set of poles for all drives, in the block
//! form of [`Modes`]: `x+ = A x + sum_d B_d u_d`, `y = C x + sum_d D_d u_d`.

use serde::{Deserialize, Serialize};

mod band;
mod fit;
pub(super) mod modes;
mod refine;
#[cfg(test)]
mod tests;
mod thin;

use modes::{Modes, natural};

pub(super) use band::drive_band;
pub(super) use fit::{CoreFit, Stretch, fit};
pub(super) use thin::{FEW_DRIVES, samples_for};

/// A stable linear model of one response.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Core {
    /// Sample rate of drives and response.
    pub sample_rate_hz: f64,
    /// Poles, shared by all drives.
    pub modes: Modes,
    /// `B`, response unit / drive unit, `[drive][state]`.
    pub input: Vec<Vec<f64>>,
    /// `D`, response unit / drive unit, `[drive]`.
    pub direct: Vec<f64>,
    /// Working point of each drive.
    pub drive_mean: Vec<f64>,
    /// Working point of the response.
    pub response_mean: f64,
}

impl Core {
    /// Free run from rest at the working point; `drives` is `[drive][sample]`, all equally long.
    ///
    /// # Panics
    /// If the number of drives is not the core's.
    pub fn simulate(&self, drives: &[Vec<f64>]) -> Vec<f64> {
        assert_eq!(drives.len(), self.input.len(), "a core has its own drives");
        let mut out = vec![self.response_mean; drives[0].len()];
        for (d, drive) in drives.iter().enumerate() {
            let moved: Vec<f64> = drive.iter().map(|u| u - self.drive_mean[d]).collect();
            for (out, y) in out.iter_mut().zip(self.path(d, &moved)) {
                *out += y;
            }
        }
        out
    }

    /// What a change of one drive does to the response: `H_d(z) change`, from rest.
    pub(super) fn path(&self, drive: usize, change: &[f64]) -> Vec<f64> {
        let mut out = self.modes.filter(&self.input[drive], change);
        for (out, u) in out.iter_mut().zip(change) {
            *out += self.direct[drive] * u;
        }
        out
    }

    /// Natural frequency, Hz, and damping ratio of each oscillating mode, lowest first.
    pub fn natural(&self) -> Vec<(f64, f64)> {
        let mut found: Vec<(f64, f64)> =
            self.modes.poles().iter().filter_map(|&p| natural(p, self.sample_rate_hz)).collect();
        found.sort_by(|a, b| a.0.total_cmp(&b.0));
        found
    }

    /// Samples at the start of a run that its unknown state before may still colour.
    pub(super) fn settling(&self, run_samples: usize) -> usize {
        (self.modes.ring_down(2e-3) + (0.1 * self.sample_rate_hz) as usize).min(run_samples / 5)
    }
}
