//! An effect that came out of a file: checked before anything is simulated with it.

use crate::EngineError;
use crate::diagnosis::augmented::Augmented;
use crate::diagnosis::core::Core;
use crate::diagnosis::core::modes::Pole;
use crate::diagnosis::effects::candidate::{Candidate, Other, Part};
use crate::diagnosis::effects::input_map::InputMap;
use crate::diagnosis::effects::law::Law;
use crate::diagnosis::effects::plant::Plant;
use crate::diagnosis::numerics::spline::Spline;

/// Bounds far above what a diagnosis makes: a file must not set how long a prediction takes.
const MAX_ORDER: usize = 200;
const MAX_PARTS: usize = 8;
const MAX_FURTHER: usize = 8;
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
        numbers("time", &[self.time])?;
        if let Some(added) = &self.added {
            count("members", self.members.len(), 0)?;
            count("further effects", self.further.len(), 0)?;
            return added.check(drives, responses, sample_rate_hz);
        }
        let Some(host) = self.members.first() else { return Err("members: none".into()) };
        within("members", self.members.len(), responses + 1)?;
        let laws = host.candidate.parts.iter().map(|p| p.forces.len() + usize::from(p.sandwich)).sum();
        for (i, member) in self.members.iter().enumerate() {
            plant(&member.plant, drives, responses, sample_rate_hz)?;
            // What the host does is carried to the others; nothing is carried to the host.
            let carried = if i == 0 { 0 } else { laws };
            candidate(&member.candidate, &member.plant, carried)?;
            // Only now: a file's knots could have made the sum of their numbers overflow.
            count("parameters", member.p.len(), member.candidate.parameters(&member.plant))?;
            numbers("parameters", &member.p)?;
        }
        within("further effects", self.further.len(), MAX_FURTHER + 1)?;
        for next in &self.further {
            count("further effects of a further one", next.further.len(), 0)?;
            if next.added.is_some() {
                return Err("further effects: laws that were found by transfer".into());
            }
            next.checked(drives, responses, sample_rate_hz)?;
        }
        Ok(())
    }
}

fn plant(plant: &Plant, drives: usize, responses: usize, sample_rate_hz: f64) -> Checked {
    within("response", plant.response, responses)?;
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

fn candidate(candidate: &Candidate, plant: &Plant, carried: usize) -> Checked {
    if candidate.parts.is_empty() || candidate.parts.len() > MAX_PARTS {
        return Err(format!("1 to {MAX_PARTS} parts"));
    }
    candidate.parts.iter().try_for_each(|p| part(p, plant, carried))
}

fn part(part: &Part, plant: &Plant, carried: usize) -> Checked {
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
    match &part.input {
        Some(InputMap::Free(shape)) => spline(shape)?,
        Some(InputMap::Scaled(map)) if !map.is_a_limit() => {
            return Err("a map that has no size of its own".into());
        }
        _ => {}
    }
    part.forces.iter().try_for_each(|law| match law {
        Law::FreeStiffness(shape) | Law::FreeDamping(shape) => spline(shape),
        Law::OneSided(side) => numbers("side", &[*side]),
        Law::Carried(law) => within("carried law", *law, carried),
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

#[cfg(test)]
mod tests {
    use serde_json::{Value, json};

    use crate::Signal;
    use crate::diagnosis::tests::rig::{RATE, hardening, noise_drive, request};
    use crate::diagnosis::{Augmented, Effect, Input, diagnose};
    use crate::progress::unwatched;

    fn found(effects: Vec<Effect>) -> Vec<Augmented> {
        let input = Input { catalogue: effects, ..request(hardening, 0.01) };
        diagnose(&input, &unwatched).unwrap().augmented
    }

    /// Every place of a document at which `wanted` is true, as a pointer.
    fn places(value: &Value, at: &str, wanted: &dyn Fn(&Value) -> bool, found: &mut Vec<String>) {
        if wanted(value) {
            found.push(at.to_owned());
        }
        match value {
            Value::Array(list) => {
                list.iter().enumerate().for_each(|(i, v)| places(v, &format!("{at}/{i}"), wanted, found));
            }
            Value::Object(map) => {
                map.iter().for_each(|(k, v)| places(v, &format!("{at}/{k}"), wanted, found))
            }
            _ => {}
        }
    }

    /// Reads, checks and simulates; whatever it is, nothing panics and nothing takes long.
    fn survives(document: Value) -> bool {
        let Ok(augmented) = serde_json::from_value::<Augmented>(document) else { return false };
        if augmented.check(1, 1, RATE).is_err() {
            return false;
        }
        let drive = Signal::new(RATE, vec![noise_drive(2.0, 1.0, 9)]).unwrap();
        match augmented.apply(&drive, &drive, None) {
            Ok(response) => assert_eq!(response.n_samples(), drive.n_samples()),
            Err(error) => assert!(error.to_string().contains("not finite"), "{error}"),
        }
        true
    }

    #[test]
    fn what_a_diagnosis_found_passes_and_belongs_to_its_channels_and_rate() {
        for augmented in found(vec![Effect::CubicStiffness, Effect::FreeStiffness, Effect::Gain]) {
            augmented.check(1, 1, RATE).unwrap();
            for (drives, responses, rate) in [(2, 1, RATE), (1, 2, RATE), (0, 0, RATE), (1, 1, 2.0 * RATE)] {
                let error = augmented.check(drives, responses, rate).unwrap_err().to_string();
                assert!(error.contains("effect: "), "{error}");
            }
            assert!(survives(serde_json::to_value(&augmented).unwrap()));
        }
    }

    #[test]
    fn a_hostile_file_is_refused_or_harmless_whichever_number_or_list_is_changed() {
        let hostile = [
            json!(1e300),
            json!(-1e300),
            json!(0.0),
            json!(-1.0),
            json!(1e14),
            json!(3),
            json!(u64::MAX),
            json!(u64::from(u32::MAX)),
            json!(null),
            json!([]),
        ];
        let effects = vec![
            Effect::CubicStiffness,
            Effect::FreeStiffness,
            Effect::FreeDamping,
            Effect::FreeDriveMap,
            Effect::Delay,
            Effect::BoucWenHysteresis,
        ];
        let mut refused = 0;
        for augmented in found(effects) {
            let document = serde_json::to_value(&augmented).unwrap();
            let (mut numbers, mut lists) = (Vec::new(), Vec::new());
            places(&document, "", &Value::is_number, &mut numbers);
            places(&document, "", &Value::is_array, &mut lists);
            assert!(numbers.len() > 10 && lists.len() > 5, "{document}");
            for place in &numbers {
                for value in &hostile {
                    let mut changed = document.clone();
                    *changed.pointer_mut(place).unwrap() = value.clone();
                    refused += usize::from(!survives(changed));
                }
            }
            for place in &lists {
                for longer in [false, true] {
                    let mut changed = document.clone();
                    let list = changed.pointer_mut(place).unwrap().as_array_mut().unwrap();
                    if longer {
                        list.extend(list.clone());
                    } else {
                        list.pop();
                    }
                    refused += usize::from(!survives(changed));
                }
            }
        }
        assert!(refused > 100, "{refused} refused");
    }
}
