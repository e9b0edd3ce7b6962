//! How far a core may be off: it was fitted to baseline runs with noise, and what it errs by there grows
//! with the drive. Where even the best effect leaves more than noise, the linear part may move with it, but
//! not from what the baseline runs say: each move costs what it would have cost them.

use super::problem::Problem;
use crate::diagnosis::effects::candidate::{Candidate, Part};
use crate::diagnosis::effects::effect::Effect;
use crate::diagnosis::effects::kernel::{self, Clock};
use crate::diagnosis::effects::law::Law;
use crate::diagnosis::effects::plant::Plant;
use crate::diagnosis::numerics::linear::{cholesky, dot};
use crate::diagnosis::numerics::rows::Rows;

/// How well the working point is known at least, in RMS of the response: a band without it says nothing.
const WORKING_POINT: f64 = 0.01;

/// What the baseline runs say against a retune.
#[derive(Debug, Clone)]
pub struct Tolerance {
    /// Upper triangle whose square is the Fisher information of the retune's parameters, `[row][parameter]`,
    /// in noise floors.
    factor: Vec<Vec<f64>>,
}

impl Tolerance {
    /// From the drives of each baseline run and the rows in which its response is scored after `lead`
    /// samples; `None` where they leave a parameter open.
    pub fn new(plant: &Plant, baseline: &[(&[Vec<f64>], Rows, usize)]) -> Option<Self> {
        let (core, scales) = (&plant.core, plant.scales);
        let mut columns: Vec<Vec<f64>> = Vec::new();
        for (drives, rows, lead) in baseline {
            let y = core.simulate(drives);
            let clock = Clock { start: 0.0, step: 0.0 };
            let mut signals = core.modes.basis(&kernel::along(&Law::Linear, &[], &y, &[], scales, clock));
            for (drive, mean) in drives.iter().zip(&core.drive_mean) {
                let moved: Vec<f64> = drive.iter().map(|u| u - mean).collect();
                signals.extend(core.modes.basis(&moved));
                signals.push(moved);
            }
            signals.push(vec![scales.y; y.len()]);
            columns.resize(signals.len(), Vec::new());
            for (column, signal) in columns.iter_mut().zip(&signals) {
                rows.extend(&signal[*lead..], column);
            }
        }
        let mut information: Vec<Vec<f64>> =
            columns.iter().map(|a| columns.iter().map(|b| dot(a, b)).collect()).collect();
        *information.last_mut()?.last_mut()? += WORKING_POINT.powi(-2);
        Some(Self { factor: cholesky(&information)? })
    }

    /// Rows of a retune that is off by so much.
    fn rows<'a>(&'a self, retune: &'a [f64]) -> impl Iterator<Item = f64> + 'a {
        self.factor.iter().map(|row| dot(row, retune))
    }
}

impl Problem {
    /// Whether a retuned candidate may move its linear part as it likes.
    pub fn retunes_freely(&self, candidate: &Candidate) -> bool {
        candidate.retune && self.tolerance_of(candidate).is_none()
    }

    /// What holds the candidate's retune; none for a linear change, which is one.
    fn tolerance_of(&self, candidate: &Candidate) -> Option<&Tolerance> {
        let changes = |part: &Part| part.effect == Effect::LinearChange;
        let held = candidate.retune && !candidate.parts.iter().any(changes);
        self.tolerance.as_deref().filter(|_| held)
    }
}

impl Candidate {
    /// What a fit of this candidate makes small: its rows on the fit stretches, and what its retune costs.
    pub fn fit_rows(&self, problem: &Problem, p: &[f64]) -> Option<Vec<f64>> {
        let mut rows = self.residual_rows(problem, &problem.fit, p)?;
        if let Some(tolerance) = problem.tolerance_of(self) {
            rows.extend(tolerance.rows(&p[p.len() - self.retuned(problem)..]));
        }
        Some(rows)
    }

    /// Adds to each parameter's derivatives those of what the retune costs.
    pub fn hold(&self, problem: &Problem, columns: &mut [Vec<f64>]) {
        let Some(tolerance) = problem.tolerance_of(self) else { return };
        let own = columns.len() - self.retuned(problem);
        for (i, column) in columns.iter_mut().enumerate() {
            let of = |row: &Vec<f64>| if i < own { 0.0 } else { row[i - own] };
            column.extend(tolerance.factor.iter().map(of));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::diagnosis::data::prepare::prepare;
    use crate::diagnosis::fit::fitting::{Fitted, tolerant};
    use crate::diagnosis::numerics::linear::norm;
    use crate::diagnosis::tests::rig::{friction, none, request};
    use crate::diagnosis::{Input, Mode};
    use crate::progress::unwatched;

    fn of(effect: Effect, law: Option<Law>) -> Candidate {
        let part = law.map_or_else(Part::linear_change, |law| Part::force(effect, vec![law], None));
        Candidate { parts: vec![part], retune: true }
    }

    fn costs(problem: &Problem, candidate: &Candidate, p: &[f64]) -> f64 {
        let rows = candidate.fit_rows(problem, p).unwrap();
        norm(&rows[candidate.residual_rows(problem, &problem.fit, p).unwrap().len()..])
    }

    #[test]
    fn a_retune_costs_what_the_baseline_runs_would_show_of_it() {
        let input = request(friction, 0.01);
        let prepared = prepare(&input, &unwatched).unwrap();
        let problem = &prepared.problems[0];
        let candidate = of(Effect::CoulombFriction, Some(Law::Coulomb));
        let count = candidate.parameters(problem);
        // The direct part of the drive, last but for the working point: what it adds is the drive itself.
        let mut p = vec![0.0; count];
        p[count - 2] = 1e-3;
        let drive = input.baseline[0].drive.channel(0);
        let lead = problem.core.settling(drive.len());
        let rows = Rows::new(drive.len() - lead, prepared.band, &prepared.noises[0].ar);
        let moved: Vec<f64> = drive[lead..].iter().map(|u| 1e-3 * (u - problem.core.drive_mean[0])).collect();
        let mut expected = Vec::new();
        rows.extend(&moved, &mut expected);
        let found = costs(problem, &candidate, &p);
        assert!((found / norm(&expected) - 1.0).abs() < 1e-3, "{found} {}", norm(&expected));
        let change = of(Effect::LinearChange, None);
        let p = vec![1e-3; change.parameters(problem)];
        assert_eq!(costs(problem, &change, &p), 0.0, "a linear change is free");
        let in_situ = prepare(&Input { mode: Mode::InSitu, ..input }, &unwatched).unwrap();
        assert!(in_situ.problems[0].tolerance.is_none(), "so is all in situ");
    }

    #[test]
    fn a_core_that_errs_is_corrected_within_its_tolerance() {
        let mut prepared = prepare(&request(none, 0.01), &unwatched).unwrap();
        let problem = &mut prepared.problems[0];
        let candidate = Candidate::of(Part::force(Effect::CubicStiffness, vec![Law::Cubic], None), false);
        let p = vec![0.0; candidate.parameters(problem)];
        let rows = candidate.residual_rows(problem, &problem.fit, &p).unwrap();
        let chi2_fit = dot(&rows, &rows) / rows.len() as f64;
        let scale = vec![1e-3; p.len()];
        let fitted = Fitted { candidate, p, scale, chi2_fit };
        let found = tolerant(problem, fitted.clone(), 2.0);
        assert!(found.candidate.retune && found.chi2_fit <= fitted.chi2_fit);
        let cost = costs(problem, &found.candidate, &found.p);
        let freedom = found.candidate.retuned(problem) as f64;
        assert!(cost * cost < 10.0 * freedom, "{cost} for {freedom} numbers");
        assert_eq!(tolerant(problem, fitted.clone(), 1.0).p, fitted.p, "nothing is left to err");
        problem.tolerance = None;
        assert!(!tolerant(problem, fitted, 2.0).candidate.retune);
    }
}
