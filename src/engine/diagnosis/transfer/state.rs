//! Whether the runs that the model was fitted to show the rig as the runs to explain do.
//!
//! In situ they are runs of the same rig and help to tell a law. But a rig may have changed since: then a mixture of
//! both states has no law, or only a drift that the runs to explain do not show, and these are screened by themselves.

use super::recording::Runs;
use crate::EngineError;
use crate::diagnosis::effects::effect::Family;
use crate::diagnosis::input::Input;
use crate::diagnosis::screen::{Screening, Transfer, screen};
use crate::metrics::geometric_mean;
use crate::progress::{Progress, Watch};

/// What the best predictor leaves at most of the linear part's error where both states are taken for one.
const EXPLAINED: f64 = 0.3;
/// What it leaves at most of the runs to explain alone, relative to what it leaves of the mixture, where they are two.
const CLEARLY: f64 = 0.6;

/// What a drift leaves at least of the linear part's error of runs among which nothing drifts.
const STILL: f64 = 0.9;

/// Runs of one state of the rig with their screening.
pub(super) struct Screened {
    pub runs: Runs,
    pub screening: Screening,
    /// Whether the rig has changed since the baseline, which is left out.
    pub changed: bool,
}

/// Screens the runs, of one state of the rig.
///
/// # Errors
/// Those of the screen.
pub(super) fn screened(input: &Input, watch: Watch<'_>) -> Result<Screened, EngineError> {
    let runs = Runs::of(input);
    let several = runs.has_baseline(input);
    let first = |p: Progress<'_>| watch(p.within(&(0.0..if several { 0.6 } else { 1.0 })));
    let screening = catalogued(input, &runs, &first)?;
    let together = Screened { runs, screening, changed: false };
    let Left { linear, law, any, .. } = Left::of(&together.screening);
    if !several || law < EXPLAINED * linear {
        return Ok(together);
    }
    let runs = Runs::without_baseline(input);
    let second = |p: Progress<'_>| watch(p.within(&(0.6..1.0)));
    let screening = match catalogued(input, &runs, &second) {
        Ok(screening) => screening,
        Err(EngineError::Cancelled) => return Err(EngineError::Cancelled),
        // They are too few to be held against each other.
        Err(_) => return Ok(together),
    };
    let alone = Screened { runs, screening, changed: true };
    let tells = alone.screening.transfer != Transfer::OneDrive;
    let of_alone = Left::of(&alone.screening);
    let other = if any < EXPLAINED * linear {
        // A change between the two looks like a drift; a drift shows among the runs to explain as well.
        of_alone.drift > STILL
    } else {
        of_alone.any < CLEARLY * any
    };
    Ok(if tells && other { alone } else { together })
}

fn catalogued(input: &Input, runs: &Runs, watch: Watch<'_>) -> Result<Screening, EngineError> {
    let mut screening = screen(&runs.recording, &runs.grouping, watch)?;
    screening.standings.retain(|standing| input.catalogue.contains(&standing.effect));
    Ok(screening)
}

/// Held-out errors, relative to the responses: geometric means, since one loud group would outweigh all others.
struct Left {
    /// Of the linear part.
    linear: f64,
    /// Of the best of it and the free runs of all laws that are no drift.
    law: f64,
    /// Of the best of it and all free runs.
    any: f64,
    /// Of the best drift by regression, relative to that of the linear part.
    drift: f64,
}

impl Left {
    fn of(screening: &Screening) -> Self {
        let of = |errors: &[Vec<f64>]| {
            let moving: Vec<f64> = errors.concat().into_iter().filter(|e| *e > 0.0).collect();
            geometric_mean(&moving).unwrap_or(1.0)
        };
        let linear = of(&screening.linear.errors);
        let mut left = Self { linear, law: linear, any: linear, drift: 1.0 };
        for standing in &screening.standings {
            let drifts = standing.family == Family::TimeVariance;
            if drifts {
                left.drift = left.drift.min(standing.ratio);
            }
            let Some(free) = &standing.free else { continue };
            let error = of(&free.errors);
            left.any = left.any.min(error);
            if !drifts {
                left.law = left.law.min(error);
            }
        }
        left
    }
}
