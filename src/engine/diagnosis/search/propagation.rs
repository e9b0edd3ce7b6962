//! An effect at one response as the others feel it, and the score of all together.
//!
//! The effect's own free run runs at its host. What its laws do there is carried to every other
//! response, where it enters by a path `E` of that response's own: linear, so one regression fits
//! it. A drive that is mapped is mapped for all.

use std::ops::Range;
use std::sync::Arc;

use super::score::{Scored, blocks, remaining};
use crate::diagnosis::data::overview::{Overview, gaps};
use crate::diagnosis::data::prepare::Prepared;
use crate::diagnosis::data::problem::{Problem, Stretch, scored_rows};
use crate::diagnosis::effects::candidate::Candidate;
use crate::diagnosis::effects::effect::Effect;
use crate::diagnosis::effects::input_map::InputMap;
use crate::diagnosis::effects::plant::Course;
use crate::diagnosis::fit::fitting::{Effort, Fitted, fit, improve};
use crate::diagnosis::fit::start::Regression;

/// The same effect at another response.
#[derive(Debug, Clone)]
pub struct Propagation {
    /// Index of the response.
    pub response: usize,
    pub fitted: Fitted,
    /// Mean square in noise floors that it leaves of the select stretches.
    pub chi2: f64,
}

impl Problem {
    /// The same response with what an effect at `host` does carried to it; `None` where the effect's
    /// free run runs away.
    pub fn carrying(&self, host: &Self, fitted: &Fitted) -> Option<Self> {
        let carried = |own: &[Stretch], of_host: &[Stretch]| -> Option<Vec<Stretch>> {
            let carry = |s: &Stretch| fitted.candidate.carry(host, s, &fitted.p).map(Arc::new);
            let laws = fitted.candidate.map_unique(of_host, carry)?;
            let carrying = |(own, laws): (&Stretch, _)| {
                let course = Course { carried: laws, ..own.course.clone() };
                Stretch { course, ..own.clone() }
            };
            Some(own.iter().zip(laws).map(carrying).collect())
        };
        Some(Self {
            fit: carried(&self.fit, &host.fit)?,
            select: carried(&self.select, &host.select)?,
            test: carried(&self.test, &host.test)?,
            plant: self.plant.clone(),
            drive_quantiles: self.drive_quantiles.clone(),
            drive_slope: self.drive_slope.clone(),
            band_end: self.band_end,
            tolerance: self.tolerance.clone(),
        })
    }
}

impl Candidate {
    /// The same effects as another response sees them, without those of the host's sensor; each with the place of its
    /// input map in the host's parameters `p`. `None` where the sensor has all of them.
    fn propagated(&self, order: usize) -> Option<(Self, Vec<Range<usize>>)> {
        let (mut laws, mut at) = (0, 0);
        let (mut parts, mut maps) = (Vec::new(), Vec::new());
        for part in &self.parts {
            if let Some(propagated) = part.propagated(laws) {
                maps.push(at..at + part.input.as_ref().map_or(0, InputMap::parameters));
                parts.push(propagated);
            }
            laws += part.forces.len() + usize::from(part.sandwich);
            at += part.parameters(order);
        }
        (!parts.is_empty()).then_some((Self { parts, retune: self.retune }, maps))
    }
}

/// Fits the propagation of one effect at another response.
fn propagated(host: &Problem, fitted: &Fitted, other: &Problem) -> Option<Propagation> {
    let problem = other.carrying(host, fitted)?;
    // What a linear part may move by is known of the host alone.
    let (effects, maps) = fitted.candidate.propagated(host.core.modes.order())?;
    let candidate = Candidate { retune: host.retunes_freely(&fitted.candidate), ..effects };
    let regression = Regression::new(&problem, candidate.retune);
    let fitted = if candidate.parts[0].effect == Effect::LinearChange {
        fit(&problem, &regression, &candidate, &[], Effort { rounds: 10 })?
    } else {
        // One part on top of the others, each with the numbers that its drive's map has at the host.
        let mut known: Option<Fitted> = None;
        for (k, map) in maps.into_iter().enumerate() {
            let upto = Candidate { parts: candidate.parts[..=k].to_vec(), ..candidate };
            let before =
                known.as_ref().map_or(&[][..], |f| &f.p[..f.p.len() - f.candidate.retuned(&problem)]);
            let start = regression.propagated(&upto, before, &fitted.p[map])?;
            // Without a retune all that is free of one part is linear, and fitted.
            let rounds = if candidate.retune || k > 0 { 8 } else { 0 };
            known = Some(improve(&problem, &upto, &start, Effort { rounds })?);
        }
        known?
    };
    let predictions = fitted.candidate.predictions(&problem, &problem.select, &fitted.p)?;
    Some(Propagation { response: other.response, chi2: problem.chi2(&problem.select, &predictions), fitted })
}

/// What every response leaves without any effect, ready to be summed.
pub struct BaselineScore {
    /// Responses with a systematic gap.
    seen: Vec<usize>,
    /// Rows of each response's select stretches.
    pub rows: f64,
    /// Mean square over all of them, in noise floors.
    pub chi2: f64,
    of_response: Vec<(f64, Vec<f64>)>,
}

impl BaselineScore {
    pub fn of(prepared: &Prepared, overview: &Overview, rate_hz: f64) -> Self {
        let seen = overview.seen.clone();
        let of_response: Vec<(f64, Vec<f64>)> = seen
            .iter()
            .map(|&r| {
                let problem = &prepared.problems[r];
                (
                    overview.chi2_select[r],
                    blocks(&problem.select, &gaps(problem, &problem.select), rate_hz).sums,
                )
            })
            .collect();
        let rows = scored_rows(&prepared.problems[0].select);
        let chi2 = of_response.iter().map(|r| r.0).sum::<f64>() / seen.len().max(1) as f64;
        Self { rows: rows * seen.len() as f64, chi2, seen, of_response }
    }

    /// The effect with its propagation to all responses with a gap, scored over all of them.
    pub fn join(&self, prepared: &Prepared, mut host: Scored, rate_hz: f64, propagates: bool) -> Scored {
        if self.seen.len() < 2 && self.seen.first() == Some(&host.problem) {
            return host;
        }
        let (mut chi2, mut sums) = (0.0, vec![0.0; host.blocks.len()]);
        let mut add = |of: f64, blocks: &[f64]| {
            chi2 += of / self.seen.len() as f64;
            sums.iter_mut().zip(blocks).for_each(|(s, b)| *s += b);
        };
        for (&r, silent) in self.seen.iter().zip(&self.of_response) {
            if r == host.problem {
                add(host.chi2, &host.blocks);
                continue;
            }
            let (own, other) = (&prepared.problems[host.problem], &prepared.problems[r]);
            let found = if propagates { propagated(own, &host.fitted, other) } else { None };
            // A propagation that makes things worse on what it was not fitted to is none.
            let Some(found) = found.filter(|f| f.chi2 < silent.0) else {
                add(silent.0, &silent.1);
                continue;
            };
            let residuals = residuals(own, &host.fitted, other, &found.fitted);
            match residuals {
                Some((problem, left)) => add(found.chi2, &blocks(&problem.select, &left, rate_hz).sums),
                None => add(silent.0, &silent.1),
            }
            host.propagations.push(found);
        }
        host.host_chi2 = host.chi2;
        Scored { chi2, remaining: remaining(chi2, self.chi2), blocks: sums, ..host }
    }
}

fn residuals(
    host: &Problem,
    of_host: &Fitted,
    other: &Problem,
    fitted: &Fitted,
) -> Option<(Problem, Vec<Vec<f64>>)> {
    let problem = other.carrying(host, of_host)?;
    let predictions = fitted.candidate.predictions(&problem, &problem.select, &fitted.p)?;
    let left = problem.select.iter().zip(&predictions).map(|(s, p)| s.residual(p)).collect();
    Some((problem, left))
}
