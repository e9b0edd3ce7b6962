//! One response of one rig, prepared: what every candidate on it is fitted to and scored on.

use std::ops::Deref;
use std::sync::Arc;

use rigcast_numerics::fft::RealFftPlanner;
use serde::{Deserialize, Serialize};

use super::core::Core;
use super::input::{Input, Mode};
use super::kernel::{Clock, Scales};
use super::linear::{dot, mean};
use super::rows::Rows;
use super::tolerance::Tolerance;

/// What a free run needs of a stretch of time.
#[derive(Clone)]
pub(super) struct Course {
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

/// A stretch of a run that is simulated from its start and scored after its lead-in. Clones share
/// its signals.
#[derive(Clone)]
pub(super) struct Stretch {
    /// Which of the request's runs it is cut from.
    pub run: usize,
    /// First sample in that run.
    pub from: usize,
    /// Index of the stretch among those that share its drives; repeats have equal ones.
    pub group: usize,
    /// Drives and sim.
    pub course: Course,
    /// The response as measured.
    pub measured: Arc<Vec<f64>>,
    /// Samples that are simulated and not scored.
    pub lead: usize,
    /// Its rows.
    pub rows: Arc<Rows>,
}

impl Deref for Stretch {
    type Target = Course;

    fn deref(&self) -> &Course {
        &self.course
    }
}

/// What a free run needs of one response.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(super) struct Plant {
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

/// One response with its core and its stretches. Those of all responses of a request are the same
/// stretches of time, in the same order.
#[derive(Clone)]
pub(super) struct Problem {
    pub plant: Plant,
    /// Quantiles of `|u|` of each drive at 30, 60, 80, 95, 99 and 99.8 %, in units of the
    /// peak.
    pub drive_quantiles: Vec<[f64; 6]>,
    /// Mean change of each drive per sample, in units of the peak.
    pub drive_slope: Vec<f64>,
    /// Upper edge of the band, cycles a sample.
    pub band_end: f64,
    /// How far the core may be off; none where it is free to move, or where it is not the sim.
    pub tolerance: Option<Arc<Tolerance>>,
    /// Stretches that parameters are fitted to.
    pub fit: Vec<Stretch>,
    /// Stretches that effects are chosen on.
    pub select: Vec<Stretch>,
    /// Stretches that neither fitted nor chose.
    pub test: Vec<Stretch>,
}

impl Deref for Problem {
    type Target = Plant;

    fn deref(&self) -> &Plant {
        &self.plant
    }
}

impl Course {
    /// Whether a free run of the other is one of this, of laws that may ask for the `time`.
    fn same(&self, other: &Self, time: bool) -> bool {
        Arc::ptr_eq(&self.drives, &other.drives)
            && Arc::ptr_eq(&self.simulated, &other.simulated)
            && Arc::ptr_eq(&self.core, &other.core)
            && Arc::ptr_eq(&self.carried, &other.carried)
            && (!time || self.clock == other.clock)
    }
}

/// Lets stretches that were driven and are scored alike, as those of repeats are, share what they have in
/// common: they then share their free runs too.
pub(super) fn share(stretches: &mut [Stretch]) {
    for i in 1..stretches.len() {
        let (before, rest) = stretches.split_at_mut(i);
        let own = &mut rest[0];
        let alike = |s: &&mut Stretch| {
            (s.group, s.lead) == (own.group, own.lead)
                && s.drives == own.drives
                && s.simulated == own.simulated
        };
        if let Some(first) = before.iter_mut().find(alike) {
            own.rows = Arc::clone(&first.rows);
            own.course = Course { clock: own.clock, ..first.course.clone() };
        }
    }
}

/// For each stretch the first whose free runs, of laws that may ask for the `time`, and whose rows of them
/// are its own too.
pub(super) fn firsts(stretches: &[Stretch], time: bool) -> Vec<usize> {
    let alike = |a: &Stretch, b: &Stretch| Arc::ptr_eq(&a.rows, &b.rows) && a.course.same(&b.course, time);
    (0..stretches.len())
        .map(|i| stretches[..i].iter().position(|s| alike(s, &stretches[i])).unwrap_or(i))
        .collect()
}

impl Stretch {
    /// Adds the rows of a signal on this stretch.
    pub fn extend(&self, signal: &[f64], rows: &mut Vec<f64>) {
        self.rows.extend(&signal[self.lead..], rows);
    }

    /// The scored part of a signal about its mean.
    pub fn scored(&self, mut signal: Vec<f64>) -> Vec<f64> {
        let mut part = signal.split_off(self.lead);
        let centre = mean(&part);
        part.iter_mut().for_each(|x| *x -= centre);
        part
    }

    /// What the sim leaves of the response.
    pub fn gap(&self, response: usize) -> Vec<f64> {
        self.measured.iter().zip(&self.simulated[response]).map(|(y, s)| y - s).collect()
    }

    /// What the sim itself says of the response, also where the core stands for it in situ: what an effect
    /// closes there is counted from the sim as it is. An FRF from before the change, for which the core
    /// stands, errs by its estimate alone, and that is no gap.
    pub fn sim<'a>(&'a self, input: &'a Input, response: usize) -> &'a [f64] {
        let its_own = !input.core_stands(response) || input.mode == Mode::InSitu;
        let own = input.runs[self.run].simulated.as_ref().filter(|_| its_own);
        own.map_or(&self.simulated[response], |sim| {
            &sim.channel(response)[self.from..self.from + self.measured.len()]
        })
    }

    /// What a prediction leaves.
    pub fn residual(&self, prediction: &[f64]) -> Vec<f64> {
        self.measured.iter().zip(prediction).map(|(y, p)| y - p).collect()
    }
}

impl Problem {
    /// Rows of one signal per stretch, one after the other.
    pub fn rows(&self, stretches: &[Stretch], signal: impl Fn(&Stretch) -> Vec<f64>) -> Vec<f64> {
        let mut out = Vec::new();
        for stretch in stretches {
            stretch.extend(&signal(stretch), &mut out);
        }
        out
    }

    /// Mean square, in noise floors, of what predictions leave, `[stretch][sample]`.
    pub fn chi2(&self, stretches: &[Stretch], predictions: &[Vec<f64>]) -> f64 {
        let mut rows = Vec::new();
        for (stretch, prediction) in stretches.iter().zip(predictions) {
            stretch.extend(&stretch.residual(prediction), &mut rows);
        }
        dot(&rows, &rows) / rows.len().max(1) as f64
    }

    /// Mean square, in noise floors, of what the sim alone leaves.
    pub fn chi2_none(&self, stretches: &[Stretch]) -> f64 {
        let rows = self.rows(stretches, |s| s.gap(self.response));
        dot(&rows, &rows) / rows.len().max(1) as f64
    }
}

/// The signal without what lies far above the band: a measured argument for a regression, whose
/// velocity would otherwise be mostly noise.
pub(super) fn smooth(signal: &[f64], band_end: f64) -> Vec<f64> {
    let n = signal.len();
    let padded = super::rows::fast_len(2 * n + 64);
    // Mirrored at its end, so that the ends meet.
    let mut input: Vec<f64> = (0..padded)
        .map(|k| {
            let k = k % (2 * n).max(1);
            if k < n { signal[k] } else { signal[2 * n - 1 - k] }
        })
        .collect();
    let mut planner = RealFftPlanner::new();
    let (forward, inverse) = (planner.plan_fft_forward(padded), planner.plan_fft_inverse(padded));
    let mut lines = forward.make_output_vec();
    forward.process(&mut input, &mut lines).expect("buffers are the plan's own");
    for (line, z) in lines.iter_mut().enumerate() {
        let f = line as f64 / padded as f64;
        let over = ((f - 1.5 * band_end) / (0.5 * band_end)).clamp(0.0, 1.0);
        *z *= 0.5 * (1.0 + (std::f64::consts::PI * over).cos()) / padded as f64;
    }
    lines[0].im = 0.0;
    lines[padded / 2].im = 0.0;
    let mut out = inverse.make_output_vec();
    inverse.process(&mut lines, &mut out).expect("buffers are the plan's own");
    out.truncate(n);
    out
}

/// Rows of all stretches.
pub(super) fn scored_rows(stretches: &[Stretch]) -> f64 {
    stretches.iter().map(|s| s.rows.len()).sum::<usize>() as f64
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn smoothing_keeps_the_band_and_drops_what_lies_above() {
        let low: Vec<f64> = (0..1000).map(|k| (0.2 * f64::from(k)).cos()).collect();
        let both: Vec<f64> = low.iter().enumerate().map(|(k, y)| y + (2.5 * k as f64).sin()).collect();
        let smoothed = smooth(&both, 0.05);
        for k in 50..950 {
            assert!((smoothed[k] - low[k]).abs() < 0.02, "sample {k}");
        }
    }
}
