//! An effect that came out of a file: checked before anything is simulated with it.

use super::augmented::Augmented;
use super::candidate::{Candidate, Other, Part};
use super::core::Core;
use super::input_map::InputMap;
use super::law::Law;
use super::modes::Pole;
use super::problem::Plant;
use super::spline::Spline;
use crate::engine::EngineError;

/// Bounds far above what a diagnosis makes: a file must not set how long a prediction takes.
const MAX_ORDER: usize = 200;
const MAX_PARTS: usize = 8;
const MAX_KNOTS: usize = 1000;

/// Largest magnitude of any number.
const LARGEST: f64 = 1e15;

/// What is wrong, in words.
type Checked = Result<(), String>;

impl Augmented {
    /// Checks that the effect can be simulated on so many drives and responses at this rate.
    ///
    /// # Errors
    /// [`EngineError::Weights`]: numbers that are not finite, lists that do not belong together, poles
    /// on or outside the unit circle, more parts than any effect has.
    pub fn check(&self, drives: usize, responses: usize, sample_rate_hz: f64) -> Result<(), EngineError> {
        self.checked(drives, responses, sample_rate_hz)
            .map_err(|what| EngineError::Weights(format!("effect: {what}")))
    }

    fn checked(&self, drives: usize, responses: usize, sample_rate_hz: f64) -> Checked {
        within("response", self.response, responses)?;
        if self.plant.response != self.response {
            return Err("two responses".into());
        }
        plant(&self.plant, drives, responses, sample_rate_hz)?;
        numbers("time", &[self.time])?;
        candidate(&self.candidate, &self.plant)?;
        // Only now: a file's knots could have made the sum of their numbers overflow.
        count("parameters", self.p.len(), self.candidate.parameters(&self.plant))?;
        numbers("parameters", &self.p)
    }
}

fn plant(plant: &Plant, drives: usize, responses: usize, sample_rate_hz: f64) -> Checked {
    core(&plant.core, drives, sample_rate_hz)?;
    let scales = &plant.scales;
    numbers("scales", &[scales.y_mean])?;
    positive("scales", &[scales.y, scales.dy])?;
    count("drive_peak", plant.drive_peak.len(), drives)?;
    numbers("drive_peak", &plant.drive_peak)?;
    for (what, list) in [("other_scale", &plant.other_scale), ("other_mean", &plant.other_mean)] {
        count(what, list.len(), responses)?;
        numbers(what, list)?;
    }
    Ok(())
}

fn core(core: &Core, drives: usize, sample_rate_hz: f64) -> Checked {
    let rate = core.sample_rate_hz;
    if (rate - sample_rate_hz).abs().is_nan() || (rate - sample_rate_hz).abs() > 1e-6 * sample_rate_hz {
        return Err(format!("its core runs at {rate} Hz, the model at {sample_rate_hz} Hz"));
    }
    let inside = |pole: &Pole| pole.radius() < 1.0;
    if !core.modes.poles().iter().all(inside) {
        return Err("every pole lies inside the unit circle".into());
    }
    let order = core.modes.order();
    within("order of the core", order, MAX_ORDER + 1)?;
    count("core.input", core.input.len(), drives)?;
    for input in &core.input {
        count("core.input", input.len(), order)?;
        numbers("core.input", input)?;
    }
    for (what, list) in [("core.direct", &core.direct), ("core.drive_mean", &core.drive_mean)] {
        count(what, list.len(), drives)?;
        numbers(what, list)?;
    }
    numbers("core.response_mean", &[core.response_mean])
}

fn candidate(candidate: &Candidate, plant: &Plant) -> Checked {
    if candidate.parts.is_empty() || candidate.parts.len() > MAX_PARTS {
        return Err(format!("1 to {MAX_PARTS} parts"));
    }
    candidate.parts.iter().try_for_each(|p| part(p, plant))
}

fn part(part: &Part, plant: &Plant) -> Checked {
    within("drive of a part", part.drive, plant.drive_peak.len())?;
    let scaled = [plant.drive_peak[part.drive]];
    if part.input.is_some() || part.sandwich {
        positive("drive_peak", &scaled)?;
    }
    match part.other {
        None => {}
        Some(Other::Drive(drive)) => {
            within("drive of a law", drive, plant.drive_peak.len())?;
            positive("drive_peak", &[plant.drive_peak[drive]])?;
        }
        Some(Other::Response(response)) => {
            within("response of a law", response, plant.other_scale.len())?;
            positive("other_scale", &[plant.other_scale[response]])?;
        }
    }
    within("forces of a part", part.forces.len(), MAX_PARTS + 1)?;
    if let Some(InputMap::Free(shape)) = &part.input {
        spline(shape)?;
    }
    part.forces.iter().try_for_each(|law| match law {
        Law::FreeStiffness(shape) | Law::FreeDamping(shape) => spline(shape),
        Law::OneSided(side) => numbers("side", &[*side]),
        _ => Ok(()),
    })
}

fn spline(shape: &Spline) -> Checked {
    if !(3..=MAX_KNOTS).contains(&shape.knots()) {
        return Err(format!("3 to {MAX_KNOTS} knots"));
    }
    let places = shape.places();
    numbers("knots", &places)?;
    positive("distance of knots", &[places[1] - places[0]])
}

fn count(what: &str, found: usize, expected: usize) -> Checked {
    if found == expected { Ok(()) } else { Err(format!("{what}: {found} entries, expected {expected}")) }
}

fn within(what: &str, found: usize, end: usize) -> Checked {
    if found < end { Ok(()) } else { Err(format!("{what}: {found}, it must be below {end}")) }
}

fn numbers(what: &str, list: &[f64]) -> Checked {
    match list.iter().find(|v| v.is_nan() || v.abs() > LARGEST) {
        Some(v) => Err(format!("{what}: {v}, magnitudes up to {LARGEST:e} are read")),
        None => Ok(()),
    }
}

fn positive(what: &str, list: &[f64]) -> Checked {
    numbers(what, list)?;
    match list.iter().find(|v| **v <= 0.0) {
        Some(v) => Err(format!("{what}: {v}, it must be positive")),
        None => Ok(()),
    }
}
