//! One response as a free run sees it: its linear core, its units, and the drives of a stretch of time.

use std::sync::Arc;

use serde::{Deserialize, Serialize};

use super::candidate::Other;
use super::kernel::{Clock, Scales};
use super::output_map::OutputMap;
use crate::diagnosis::core::Core;

/// What a free run needs of a stretch of time.
#[derive(Clone)]
pub struct Course {
    /// `[drive][sample]`, as commanded.
    pub drives: Arc<Vec<Vec<f64>>>,
    /// What the sim says of each response, `[response][sample]`.
    pub simulated: Arc<Vec<Vec<f64>>>,
    /// Free run of the core, with what adopted effects of the sim add to it.
    pub core: Arc<Vec<f64>>,
    /// Time of the run in units of the programme.
    pub clock: Clock,
    /// What the laws of an effect at another response do, midway to the next sample,
    /// `[law][sample]`; empty while no effect is carried here.
    pub carried: Arc<Vec<Vec<f64>>>,
}

/// What a free run needs of one response.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Plant {
    /// Index of the response.
    pub response: usize,
    /// Its linear core.
    pub core: Core,
    /// Units of its arguments.
    pub scales: Scales,
    /// RMS of each response's simulation about its mean, units of `other`.
    pub other_scale: Vec<f64>,
    /// Mean of each response's simulation.
    pub other_mean: Vec<f64>,
    /// Largest magnitude of each drive in the fit stretches.
    pub drive_peak: Vec<f64>,
}

impl Course {
    /// Whether a free run of the other is one of this, of laws that may ask for the `time`.
    pub fn same(&self, other: &Self, time: bool) -> bool {
        Arc::ptr_eq(&self.drives, &other.drives)
            && Arc::ptr_eq(&self.simulated, &other.simulated)
            && Arc::ptr_eq(&self.core, &other.core)
            && Arc::ptr_eq(&self.carried, &other.carried)
            && (!time || self.clock == other.clock)
    }
}

impl Plant {
    /// The signal that a law calls other on one stretch, or nothing.
    pub fn other(&self, stretch: &Course, other: Option<Other>) -> Vec<f64> {
        match other {
            None => Vec::new(),
            Some(Other::Drive(d)) => self.drive(stretch, d),
            Some(Other::Response(r)) => {
                stretch.simulated[r].iter().map(|y| (y - self.other_mean[r]) / self.other_scale[r]).collect()
            }
        }
    }

    /// One drive of a stretch in units of its peak.
    pub fn drive(&self, stretch: &Course, drive: usize) -> Vec<f64> {
        stretch.drives[drive].iter().map(|u| u / self.drive_peak[drive]).collect()
    }

    /// What a change of one drive, in units of its peak, adds to the response.
    pub fn path(&self, drive: usize, mut change: Vec<f64>) -> Vec<f64> {
        change.iter_mut().for_each(|u| *u *= self.drive_peak[drive]);
        self.core.path(drive, &change)
    }

    /// What a sensor's map makes of a response, in place.
    pub fn sense(&self, map: OutputMap, p: &[f64], stretch: &Course, y: &mut [f64]) {
        let (mean, scale) = (self.scales.y_mean, self.scales.y);
        y.iter_mut().for_each(|y| *y = (*y - mean) / scale);
        map.apply(p, y, |k| stretch.clock.start + stretch.clock.step * k as f64);
        y.iter_mut().for_each(|y| *y = *y * scale + mean);
    }
}
