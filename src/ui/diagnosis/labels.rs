//! Names of effects and families for people.

use crate::engine::diagnosis::{Effect, Family};

/// Words for one effect.
#[derive(Debug, Clone, Copy)]
pub struct Words {
    /// In a list.
    pub name: &'static str,
    /// After "the rig has".
    pub noun: &'static str,
    /// Whether the model has the same property with another value.
    pub other: bool,
    /// Description in one sentence.
    pub plain: &'static str,
}

const fn lacks(name: &'static str, noun: &'static str, plain: &'static str) -> Words {
    Words { name, noun, other: false, plain }
}

const fn other(name: &'static str, noun: &'static str, plain: &'static str) -> Words {
    Words { name, noun, other: true, plain }
}

/// Words for an effect.
pub fn words(effect: Effect) -> Words {
    match effect {
        Effect::Gain => other(
            "drive gain",
            "another drive gain",
            "The same command moves the rig more, or less, than the model.",
        ),
        Effect::Delay => other(
            "drive delay",
            "another drive delay",
            "The rig follows its command sooner, or later, than the model.",
        ),
        Effect::ExtraPole => lacks(
            "extra lag",
            "an extra lag in the drive",
            "Above a corner frequency the actuator follows its command less and later.",
        ),
        Effect::LinearChange => other(
            "linear change",
            "other natural frequencies or damping",
            "Masses, stiffnesses or dampers differ, and the rig is as linear as the model.",
        ),
        Effect::CubicStiffness => lacks(
            "cubic stiffness",
            "cubic stiffness",
            "The spring force has a part that goes with the cube of the travel: the stiffness changes with amplitude, the same way in both directions.",
        ),
        Effect::QuadraticStiffness => lacks(
            "quadratic stiffness",
            "quadratic stiffness",
            "The spring is stiffer in one direction than in the other.",
        ),
        Effect::BumpStop => {
            lacks("bump stops", "bump stops", "Beyond a free travel a further spring engages on both sides.")
        }
        Effect::OneSidedStop => lacks(
            "one-sided stop",
            "a one-sided stop",
            "Beyond a free travel a further spring engages on one side.",
        ),
        Effect::Clearance => lacks(
            "clearance",
            "a clearance",
            "In the middle of the travel a part of the stiffness is missing, as in a loose joint.",
        ),
        Effect::FreeStiffness => lacks(
            "stiffness of free shape",
            "nonlinear stiffness",
            "The spring force is a curved function of travel that none of the standard laws describes as well.",
        ),
        Effect::CoulombFriction => lacks(
            "Coulomb friction",
            "Coulomb friction",
            "A force of constant size opposes the motion, whatever the speed.",
        ),
        Effect::StribeckFriction => lacks(
            "Stribeck friction",
            "Stribeck friction",
            "Dry friction that is larger at creep speed than in motion.",
        ),
        Effect::BoucWenHysteresis => lacks(
            "Bouc-Wen hysteresis",
            "Bouc-Wen hysteresis",
            "A spring that yields: force and travel form a loop, as in joints and rubber.",
        ),
        Effect::FreeHysteresis => lacks(
            "hysteresis of free shape",
            "hysteresis",
            "Force and travel form a loop that none of the standard laws describes as well.",
        ),
        Effect::QuadraticDamping => lacks(
            "quadratic damping",
            "quadratic damping",
            "A force that goes with the square of the speed, as of oil through an orifice.",
        ),
        Effect::FreeDamping => lacks(
            "damping of free shape",
            "nonlinear damping",
            "The damping force is a curved function of speed that none of the standard laws describes as well.",
        ),
        Effect::DriveSaturation => {
            lacks("drive saturation", "drive saturation", "Beyond a limit more command gives no more drive.")
        }
        Effect::DrivePolynomial => lacks(
            "curved drive characteristic",
            "a curved drive characteristic",
            "The drive is not proportional to its command.",
        ),
        Effect::RateLimit => lacks(
            "drive rate limit",
            "a rate limit of the drive",
            "The drive cannot change faster than a certain rate.",
        ),
        Effect::ValveFlow => lacks(
            "load-dependent valve flow",
            "load-dependent valve flow",
            "The servo valve passes less oil the more the load opposes it.",
        ),
        Effect::FreeDriveMap => lacks(
            "drive characteristic of free shape",
            "a nonlinear drive characteristic",
            "The drive is a curved function of its command that none of the standard laws describes as well.",
        ),
        Effect::DeadZone => lacks("dead zone", "a dead zone in the drive", "Small commands do nothing."),
        Effect::Backlash => {
            lacks("backlash", "backlash in the drive", "After each reversal the drive first takes up a play.")
        }
        Effect::CrossAxisLinear => lacks(
            "linear cross-coupling",
            "a linear coupling from another axis",
            "Another axis moves this one, in proportion.",
        ),
        Effect::CrossAxisKinematic => lacks(
            "kinematic cross-coupling",
            "a kinematic coupling from another axis",
            "Large travel of another axis shifts this one, as inclined rods do.",
        ),
        Effect::StiffnessDrift => lacks(
            "drifting stiffness",
            "a stiffness that drifts",
            "The stiffness changes in the course of the programme, as with wear or warmth.",
        ),
        Effect::OffsetDrift => lacks(
            "drifting offset",
            "a drifting offset",
            "The working point moves in the course of the programme.",
        ),
        Effect::Offset => lacks("offset", "a constant offset", "The signal is shifted by a constant."),
        Effect::SensorGain => other(
            "sensor gain",
            "another sensor gain",
            "The sensor reads more, or less, per unit than when the model was made.",
        ),
        Effect::SensorSaturation => {
            lacks("sensor saturation", "a saturating sensor", "Beyond a limit the sensor shows no more.")
        }
        Effect::SensorNonlinearity => lacks(
            "curved sensor characteristic",
            "a curved sensor characteristic",
            "The sensor's signal is not proportional to what it measures.",
        ),
        Effect::Quantisation => lacks(
            "coarse digitising",
            "coarse digitising of its samples",
            "The samples are rounded to steps that are not small.",
        ),
        Effect::Sandwich => lacks(
            "nonlinearity between two linear parts",
            "a nonlinearity between two linear parts",
            "A curved characteristic sits somewhere between drive and sensor, with dynamics before and behind it.",
        ),
        Effect::PeriodicDisturbance => lacks(
            "periodic disturbance",
            "a periodic disturbance",
            "A hum that no drive causes: mains, a pump, a rotating machine.",
        ),
        Effect::RaisedNoise => lacks(
            "raised noise",
            "raised noise",
            "The signals are noisier than in the baseline runs, and no drive causes it.",
        ),
    }
}

/// A family, in a list and after "an effect of the kind".
pub fn family(family: Family) -> &'static str {
    match family {
        Family::Linear => "linear change",
        Family::Stiffness => "nonlinear stiffness",
        Family::FrictionHysteresis => "friction or hysteresis",
        Family::Damping => "nonlinear damping",
        Family::Actuator => "actuator nonlinearity",
        Family::DeadbandBacklash => "dead zone or backlash",
        Family::CrossAxis => "cross-coupling of axes",
        Family::TimeVariance => "drift over time",
        Family::Sensor => "sensor effect",
        Family::BlockStructure => "nonlinearity inside the chain from drive to sensor",
        Family::Disturbance => "disturbance",
    }
}

/// Replaces the contract's names of effects in a text by names for people.
pub fn in_words(text: &str) -> String {
    text.split(' ')
        .map(|word| match Effect::ALL.iter().find(|e| e.name() == word) {
            Some(effect) => words(*effect).name,
            None => word,
        })
        .collect::<Vec<&str>>()
        .join(" ")
}

/// The name of a parameter in words, and its power of ten.
pub fn parameter(name: &str) -> String {
    // Of several effects together each number has its effect before it, and the place of one that is there twice.
    let of = |effect: &str| Effect::ALL.into_iter().find(|e| e.name() == effect).map(|e| words(e).name);
    if let Some((acting, number)) = name.split_once('.') {
        let (effect, place) = acting.split_once('@').map_or((acting, None), |(e, place)| (e, Some(place)));
        if let Some(effect) = of(effect) {
            let at = place.map_or_else(String::new, |place| format!(" at {place}"));
            return format!("{effect}{at}: {}", parameter(number));
        }
    }
    match name {
        "relative_gain" => "relative change of gain".into(),
        "corner" => "corner frequency".into(),
        "gap" => "free travel".into(),
        "bend" => "softening at large travel".into(),
        "c2" => "quadratic coefficient".into(),
        "c3" => "cubic coefficient".into(),
        "rate" => "largest rate".into(),
        "step" => "step of the samples".into(),
        "peak_over_sliding" => "excess at creep speed".into(),
        other => other.replace('_', " "),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_of_several_effects_say_whose_they_are() {
        assert_eq!(parameter("relative_gain"), "relative change of gain");
        assert_eq!(parameter("backlash.half_width"), "backlash: half width");
        assert_eq!(parameter("bump_stop@disp_x.gap"), "bump stops at disp_x: free travel");
        assert_eq!(parameter("change_at_0.125"), "change at 0.125");
    }

    #[test]
    fn every_effect_has_words_of_its_own() {
        let mut names: Vec<&str> = Effect::ALL.iter().map(|e| words(*e).name).collect();
        names.sort_unstable();
        names.dedup();
        assert_eq!(names.len(), Effect::ALL.len());
        for effect in Effect::ALL {
            let words = words(effect);
            assert!(!words.name.contains('_') && words.plain.ends_with('.'), "{effect:?}");
        }
    }

    #[test]
    fn names_of_the_contract_become_words() {
        assert_eq!(in_words("next best bump_stop leaves 3 %"), "next best bump stops leaves 3 %");
    }
}
