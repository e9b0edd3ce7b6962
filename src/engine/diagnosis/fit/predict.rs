//! Free runs of a candidate over stretches, and what they leave.

use crate::diagnosis::data::problem::{Problem, Stretch, first_equivalent};
use crate::diagnosis::effects::candidate::Candidate;

impl Candidate {
    /// What each stretch gives, repeats that give the same only once.
    pub fn map_unique<T: Clone>(
        &self,
        stretches: &[Stretch],
        of: impl Fn(&Stretch) -> Option<T>,
    ) -> Option<Vec<T>> {
        let mut out: Vec<T> = Vec::with_capacity(stretches.len());
        for (i, first) in first_equivalent(stretches, self.asks_for_time()).into_iter().enumerate() {
            let found = if first < i { out[first].clone() } else { of(&stretches[i])? };
            out.push(found);
        }
        Some(out)
    }

    /// Predictions of several stretches, `[stretch][sample]`.
    pub fn predictions(&self, problem: &Problem, stretches: &[Stretch], p: &[f64]) -> Option<Vec<Vec<f64>>> {
        self.map_unique(stretches, |s| self.predict(problem, s, p))
    }

    /// Rows that the candidate leaves; `None` if a free run runs away.
    pub fn residual_rows(&self, problem: &Problem, stretches: &[Stretch], p: &[f64]) -> Option<Vec<f64>> {
        let mut rows = Vec::new();
        for (stretch, prediction) in stretches.iter().zip(self.predictions(problem, stretches, p)?) {
            stretch.extend(&stretch.residual(&prediction), &mut rows);
        }
        rows.iter().all(|r| r.is_finite()).then_some(rows)
    }
}
