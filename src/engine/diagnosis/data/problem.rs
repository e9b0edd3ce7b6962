//! One response of one rig, prepared: what every candidate on it is fitted to and scored on.

use std::ops::Deref;
use std::sync::Arc;

use super::tolerance::Tolerance;
use crate::diagnosis::effects::plant::{Course, Plant};
use crate::diagnosis::input::{Input, Mode};
use crate::diagnosis::numerics::linear::{dot, mean};
use crate::diagnosis::numerics::rows::Rows;

/// A stretch of a run that is simulated from its start and scored after its lead-in. Clones share
/// its signals.
#[derive(Clone)]
pub struct Stretch {
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

/// One response with its core and its stretches. Those of all responses of a request are the same
/// stretches of time, in the same order.
#[derive(Clone)]
pub struct Problem {
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

/// Lets stretches that were driven and are scored alike, as those of repeats are, share what they have in
/// common: they then share their free runs too.
pub fn share(stretches: &mut [Stretch]) {
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
pub fn first_equivalent(stretches: &[Stretch], time: bool) -> Vec<usize> {
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

/// Rows of all stretches.
pub fn scored_rows(stretches: &[Stretch]) -> f64 {
    stretches.iter().map(|s| s.rows.len()).sum::<usize>() as f64
}
