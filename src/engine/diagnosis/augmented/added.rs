//! A law found by transfer as an addition to a sim: `sim(u) + [augmented(u) - linear(u)]`.

use serde::{Deserialize, Serialize};

use crate::diagnosis::effects::effect::Effect;
use crate::diagnosis::numerics::linear::rms;
use crate::diagnosis::screen::{Forward, Simulated};

/// Beyond this many times the linear part's own RMS a free run is not bounded.
const BOUND: f64 = 20.0;

/// A law on its linear part, ready to be simulated on any drives.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Added {
    pub effect: Effect,
    /// The response that it helps most.
    pub response: usize,
    pub forward: Forward,
    /// Of each response, whether the augmented linear part is the whole prediction, with nothing of the sim.
    pub alone: Vec<bool>,
}

impl Added {
    /// A law on some responses of a rig as one on all `count` of them; `kept` says which they were.
    pub fn among(self, kept: &[usize], count: usize) -> Self {
        let mut alone = vec![false; count];
        kept.iter().zip(&self.alone).for_each(|(&r, is)| alone[r] = *is);
        Self { response: kept[self.response], forward: self.forward.among(kept, count), alone, ..self }
    }

    /// The sim's responses with the law; `None` where the free run diverges. `before` is what effects that were adopted
    /// earlier add, of a law that was found beside them.
    pub fn predict(
        &self,
        drives: &[Vec<f64>],
        simulated: &[Vec<f64>],
        before: Option<&[Vec<f64>]>,
    ) -> Option<Vec<Vec<f64>>> {
        let found = self.forward.simulate(drives, before)?;
        let of = |(r, s): (usize, Simulated)| {
            if self.alone[r] {
                return match before {
                    Some(before) => s.augmented.iter().zip(&before[r]).map(|(y, more)| y + more).collect(),
                    None => s.augmented,
                };
            }
            let added = s.augmented.iter().zip(&s.linear).zip(&simulated[r]);
            added.map(|((augmented, linear), sim)| sim + augmented - linear).collect()
        };
        Some(found.into_iter().enumerate().map(of).collect())
    }

    /// What the law adds to its linear part.
    pub fn addition(&self, drives: &[Vec<f64>], before: Option<&[Vec<f64>]>) -> Option<Vec<Vec<f64>>> {
        let of = |s: Simulated| s.augmented.iter().zip(&s.linear).map(|(a, l)| a - l).collect();
        Some(self.forward.simulate(drives, before)?.into_iter().map(of).collect())
    }

    /// Whether the free run stays bounded for drives scaled so that each reaches its limit.
    pub fn bounded(&self, drives: &[Vec<f64>], limit: &[f64]) -> bool {
        let scaled = drives.iter().zip(limit).map(|(drive, limit)| {
            let peak = drive.iter().fold(0.0_f64, |m, u| m.max(u.abs())).max(f64::MIN_POSITIVE);
            drive.iter().map(|u| u * limit / peak).collect()
        });
        let scaled: Vec<Vec<f64>> = scaled.collect();
        let Some(found) = self.forward.simulate(&scaled, None) else { return false };
        let moved = |y: &[f64]| {
            let mean = y.iter().sum::<f64>() / y.len().max(1) as f64;
            rms(&y.iter().map(|y| y - mean).collect::<Vec<f64>>())
        };
        found.iter().all(|s| moved(&s.augmented) <= BOUND * moved(&s.linear))
    }

    /// Checks what came out of a file.
    pub fn check(&self, drives: usize, responses: usize, rate_hz: f64) -> Result<(), String> {
        if self.response >= responses || self.alone.len() != responses {
            return Err(format!("response {} of {}", self.response, self.alone.len()));
        }
        self.forward.check(drives, responses, rate_hz)
    }
}
