//! Whether the runs that the model was fitted to show the rig as the runs to explain do.
//!
//! In situ they are runs of the same rig and help to tell a law. But a rig may have changed since: then a mixture of
//! both states has no law, and the runs to explain are screened by themselves.

use super::recording::Runs;
use crate::EngineError;
use crate::diagnosis::input::Input;
use crate::diagnosis::screen::{Screening, Transfer, screen};
use crate::metrics::geometric_mean;
use crate::progress::{Progress, Watch};

/// What the best predictor leaves at most of the linear part's error where both states are taken for one.
const EXPLAINED: f64 = 0.3;
/// What it leaves at most of the runs to explain alone, relative to what it leaves of the mixture, where they are two.
const CLEARLY: f64 = 0.6;

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
    let (linear, best) = errors(&together.screening);
    if !several || best < EXPLAINED * linear {
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
    Ok(if tells && errors(&alone.screening).1 < CLEARLY * best { alone } else { together })
}

fn catalogued(input: &Input, runs: &Runs, watch: Watch<'_>) -> Result<Screening, EngineError> {
    let mut screening = screen(&runs.recording, &runs.grouping, watch)?;
    screening.standings.retain(|standing| input.catalogue.contains(&standing.effect));
    Ok(screening)
}

/// Held-out errors, relative to the responses, of the linear part and of the best of it and all free runs: geometric
/// means, since one loud group would outweigh all others.
fn errors(screening: &Screening) -> (f64, f64) {
    let of = |errors: &[Vec<f64>]| {
        let moving: Vec<f64> = errors.concat().into_iter().filter(|e| *e > 0.0).collect();
        geometric_mean(&moving).unwrap_or(1.0)
    };
    let linear = of(&screening.linear.errors);
    let free = screening.standings.iter().filter_map(|s| s.free.as_ref());
    (linear, free.map(|run| of(&run.errors)).fold(linear, f64::min))
}
