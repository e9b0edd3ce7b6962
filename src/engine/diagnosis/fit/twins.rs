//! Stops and clearances where the linear part is free: one law with two names, since `y - clamp(y)` and
//! `clamp(y)` differ by a stiffness. Where a fit of one has found less than that of the other, it is a
//! start of the other's too.

use super::fitting::{Effort, Fitted, improve};
use super::start::Start;
use crate::diagnosis::data::prepare::Prepared;
use crate::diagnosis::effects::law::Law;

/// Jacobians of a fit from the twin's.
const ROUNDS: usize = 8;

/// Which of the two a fitted candidate is.
fn law(fitted: &Fitted) -> Option<&Law> {
    match fitted.candidate.parts[0].forces.as_slice() {
        [law @ (Law::BumpStop | Law::Clearance)] if fitted.candidate.retune => Some(law),
        _ => None,
    }
}

/// Parameters of the twin that do the same: its gap, the path turned round, and the path once more as
/// feedback of the response.
fn twin(p: &[f64], order: usize) -> Vec<f64> {
    let mut out = p.to_vec();
    for n in 1..=order {
        out[n] = -p[n];
        out[order + n] += p[n];
    }
    out
}

/// Lets each of two twins at one response begin where the other is better; pairs of response and fit.
pub fn exchange(prepared: &Prepared, fitted: &mut [(usize, Fitted)]) {
    for i in 0..fitted.len() {
        let (r, own) = &fitted[i];
        let Some(of_own) = law(own) else { continue };
        let better = fitted.iter().find(|(other, f)| {
            other == r && law(f).is_some_and(|l| l != of_own) && f.chi2_fit < own.chi2_fit
        });
        let Some((_, better)) = better else { continue };
        let problem = &prepared.problems[*r];
        let p = twin(&better.p, problem.core.modes.order());
        let linear = vec![false; p.len()];
        let start = Start { p, scale: own.scale.clone(), cost: better.chi2_fit, linear };
        let found = improve(problem, &own.candidate, &start, Effort { rounds: ROUNDS });
        if let Some(found) = found.filter(|found| found.chi2_fit < own.chi2_fit) {
            fitted[i].1 = found;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::diagnosis::effects::law::Instant;

    #[test]
    fn a_twin_pushes_alike() {
        let p = [0.7, 0.3, -0.2, 0.05, 0.01, 9.0];
        let q = twin(&p, 2);
        assert!(twin(&q, 2).iter().zip(&p).all(|(a, b)| (a - b).abs() < 1e-12));
        for y in [-1.5, -0.4, 0.2, 0.9] {
            let at = |law: &Law, gap: f64| {
                law.at(&[gap], Instant { y, dy: 0.0, v: 0.0, t: 0.0, aux: 0.0 }, &mut [0.0; 6])
            };
            for n in 1..=2 {
                let push = |law: &Law, p: &[f64]| p[n] * at(law, p[0]) + p[2 + n] * y;
                assert!((push(&Law::BumpStop, &p) - push(&Law::Clearance, &q)).abs() < 1e-12);
            }
        }
    }
}
