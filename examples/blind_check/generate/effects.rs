//! The flaws of each suite and their names in the contract.

use rand::{Rng, RngExt};

use super::flaw::Flaw;

/// A flaw with the contract's name for it; one that the catalogue lacks has a name of its own, and a
/// family only where a member of that family comes near it.
#[derive(Debug, Clone, Copy)]
pub struct Named {
    pub flaw: Flaw,
    pub effect: &'static str,
    pub family: Option<&'static str>,
}

/// Effects of the catalogue by family, as the contract lists them.
pub const FAMILIES: &[(&str, &[&str])] = &[
    ("linear", &["gain", "delay", "extra_pole", "linear_change"]),
    (
        "stiffness",
        &[
            "cubic_stiffness",
            "quadratic_stiffness",
            "bump_stop",
            "one_sided_stop",
            "clearance",
            "free_stiffness",
        ],
    ),
    (
        "friction_hysteresis",
        &["coulomb_friction", "stribeck_friction", "bouc_wen_hysteresis", "free_hysteresis"],
    ),
    ("damping", &["quadratic_damping", "free_damping"]),
    ("actuator", &["drive_saturation", "drive_polynomial", "rate_limit", "valve_flow", "free_drive_map"]),
    ("deadband_backlash", &["dead_zone", "backlash"]),
    ("cross_axis", &["cross_axis_linear", "cross_axis_kinematic"]),
    ("time_variance", &["stiffness_drift", "offset_drift"]),
    ("sensor", &["offset", "sensor_gain", "sensor_saturation", "sensor_nonlinearity", "quantisation"]),
    ("block_structure", &["sandwich"]),
    ("disturbance", &["periodic_disturbance", "raised_noise"]),
];

/// Effects of other families that give the same response on every run of one response: a gain before
/// the rig or after it, a second drive's path by itself or as part of all paths.
const TWINS: &[(&str, &[&str])] = &[
    ("gain", &["sensor_gain"]),
    ("sensor_gain", &["gain", "linear_change"]),
    ("cross_axis_linear", &["linear_change"]),
];

/// The catalogue without an effect, its family and its twins.
pub fn struck(effect: &str, family: Option<&str>) -> Vec<&'static str> {
    let twins = TWINS.iter().find(|(e, _)| *e == effect).map_or(&[][..], |(_, twins)| twins);
    let rest = FAMILIES.iter().filter(|(f, _)| Some(*f) != family).flat_map(|(_, effects)| *effects);
    rest.copied().filter(|e| !twins.contains(e)).collect()
}

fn named(flaw: Flaw, effect: &'static str) -> Named {
    let family = FAMILIES.iter().find(|(_, effects)| effects.contains(&effect)).map(|(f, _)| *f);
    Named { flaw, effect, family }
}

fn sign(rng: &mut impl Rng) -> f64 {
    if rng.random_bool(0.5) { 1.0 } else { -1.0 }
}

/// Effects of the catalogue that act through a drive.
pub fn catalogue(rng: &mut impl Rng) -> Vec<Named> {
    let stop = rng.random_range(0.6..1.8);
    let change = Flaw::LinearChange { stiffness: sign(rng), damping: rng.random_range(-0.5..1.0) };
    let stribeck = Flaw::Stribeck {
        smooth: rng.random_range(0.02..0.06),
        peak: rng.random_range(0.5..1.5),
        decay: rng.random_range(0.2..0.6),
    };
    let bouc_wen =
        Flaw::BoucWen { yielding: rng.random_range(0.2..1.0), sharpness: rng.random_range(1.0..2.0) };
    let polynomial =
        Flaw::DrivePolynomial { even: rng.random_range(-1.0..1.0), odd: rng.random_range(-0.5..0.3) };
    let sensor =
        Flaw::SensorNonlinearity { even: rng.random_range(-1.0..1.0), odd: rng.random_range(-0.3..0.3) };
    vec![
        named(Flaw::Gain, "gain"),
        named(Flaw::Delay, "delay"),
        named(Flaw::ExtraPole, "extra_pole"),
        named(change, "linear_change"),
        named(Flaw::CubicStiffness { bend: rng.random_range(0.0..0.1) }, "cubic_stiffness"),
        named(Flaw::QuadraticStiffness, "quadratic_stiffness"),
        named(Flaw::BumpStop { gap: stop }, "bump_stop"),
        named(Flaw::OneSidedStop { gap: stop, side: sign(rng) }, "one_sided_stop"),
        named(Flaw::Clearance { gap: rng.random_range(0.2..1.2) }, "clearance"),
        named(Flaw::Coulomb { smooth: rng.random_range(0.01..0.08) }, "coulomb_friction"),
        named(stribeck, "stribeck_friction"),
        named(bouc_wen, "bouc_wen_hysteresis"),
        named(Flaw::QuadraticDamping, "quadratic_damping"),
        named(Flaw::DriveSaturation { skew: rng.random_range(0.6..1.6) }, "drive_saturation"),
        named(polynomial, "drive_polynomial"),
        named(Flaw::RateLimit, "rate_limit"),
        named(Flaw::ValveFlow, "valve_flow"),
        named(Flaw::DeadZone, "dead_zone"),
        named(Flaw::Backlash, "backlash"),
        named(Flaw::CrossLinear, "cross_axis_linear"),
        named(Flaw::CrossKinematic { mixed: rng.random_range(-1.0..1.0) }, "cross_axis_kinematic"),
        named(Flaw::StiffnessDrift, "stiffness_drift"),
        named(Flaw::OffsetDrift, "offset_drift"),
        named(Flaw::Offset, "offset"),
        named(Flaw::SensorGain, "sensor_gain"),
        named(Flaw::SensorSaturation { skew: rng.random_range(0.6..1.6) }, "sensor_saturation"),
        named(sensor, "sensor_nonlinearity"),
        named(Flaw::Sandwich { odd: rng.random_bool(0.5) }, "sandwich"),
    ]
}

/// No effect, and disturbances that no drive causes.
pub fn nothing(rng: &mut impl Rng) -> Vec<Named> {
    vec![
        Named { flaw: Flaw::Nothing, effect: "nothing", family: None },
        named(Flaw::RaisedNoise, "raised_noise"),
        named(Flaw::Hum { hz: [50.0, 60.0, 16.7, 33.0][rng.random_range(0..4)] }, "periodic_disturbance"),
        named(Flaw::Quantisation, "quantisation"),
    ]
}

/// Effects outside the catalogue.
pub fn outside(rng: &mut impl Rng) -> Vec<Named> {
    let flaws = [
        (Flaw::Cogging { pitch: rng.random_range(0.4..1.2) }, "cogging"),
        (Flaw::DropOuts, "drop_outs"),
        (Flaw::UnmeasuredForce, "unmeasured_force"),
        (Flaw::Parametric { hz: rng.random_range(0.7..4.0) }, "parametric_excitation"),
        (Flaw::NegativeDamping { width: rng.random_range(0.3..0.8) }, "negative_damping"),
    ];
    flaws.map(|(flaw, effect)| Named { flaw, effect, family: None }).to_vec()
}

/// The physics of a family in an equation that the catalogue does not write.
pub fn other_equation(rng: &mut impl Rng) -> Vec<Named> {
    let stop = rng.random_range(0.4..1.3);
    let flaws = [
        (Flaw::Quintic, "quintic_stiffness", "stiffness"),
        (Flaw::LuGre { smooth: rng.random_range(0.05..0.3) }, "lugre_friction", "friction_hysteresis"),
        (Flaw::TwoStageStop { gap: stop }, "two_stage_stop", "stiffness"),
        (Flaw::SoftSaturation, "soft_saturation", "actuator"),
        (Flaw::LeakingFlow { leak: rng.random_range(0.1..0.5) }, "leaking_valve_flow", "actuator"),
    ];
    flaws.map(|(flaw, effect, family)| Named { flaw, effect, family: Some(family) }).to_vec()
}

/// Effects that a sim fitted on the rig cannot have taken in: a linear one, or an offset, is part of it.
pub fn in_situ(rng: &mut impl Rng) -> Vec<Named> {
    let absorbed = |n: &Named| {
        n.family == Some("linear") || matches!(n.effect, "cross_axis_linear" | "sensor_gain" | "offset")
    };
    catalogue(rng).into_iter().filter(|n| !absorbed(n)).collect()
}

/// Effects that no linear part absorbs, in the catalogue's equations and in others, and now and then none.
pub fn without_repeats(rng: &mut impl Rng) -> Vec<Named> {
    // A constant has no gap beside a linear part, a drift of it none beside means.
    let lost = |n: &Named| matches!(n.effect, "offset_drift");
    let mut list: Vec<Named> = in_situ(rng).into_iter().filter(|n| !lost(n)).collect();
    list.extend(other_equation(rng));
    list.extend([nothing(rng)[0]; 5]);
    list
}

/// Every third time nothing: only the model errs. A default request is one about a model of the rig as it is, which has
/// taken in what is linear.
pub fn beside_errors(index: usize, by_default: bool, rng: &mut impl Rng) -> Vec<Named> {
    match (index / 3 % 3 == 2, by_default) {
        (true, _) => vec![nothing(rng)[0]],
        (false, true) => in_situ(rng),
        (false, false) => catalogue(rng),
    }
}

/// Effects that two at once are drawn from, no two of a pair from one family.
pub fn for_pairs(rng: &mut impl Rng) -> Vec<Named> {
    let effects = [
        "cubic_stiffness",
        "one_sided_stop",
        "clearance",
        "coulomb_friction",
        "bouc_wen_hysteresis",
        "quadratic_damping",
        "drive_saturation",
        "rate_limit",
        "dead_zone",
        "backlash",
        "cross_axis_kinematic",
        "offset_drift",
        "offset",
        "sensor_saturation",
    ];
    catalogue(rng).into_iter().filter(|n| effects.contains(&n.effect)).collect()
}

/// Effects of a rig with three coupled axes, where a second drive's path is already there.
pub fn three_axes(rng: &mut impl Rng) -> Vec<Named> {
    let other = ["cross_axis_linear", "sandwich"];
    catalogue(rng).into_iter().filter(|n| !other.contains(&n.effect)).collect()
}

/// An effect each of two axes, of any family and of one as well.
pub fn on_two_axes(rng: &mut impl Rng) -> Vec<Named> {
    let list: Vec<Named> =
        for_pairs(rng).into_iter().filter(|n| n.effect != "cross_axis_kinematic").collect();
    (0..2).map(|_| list[rng.random_range(0..list.len())]).collect()
}

/// Effects that are easily confused on runs of one level.
pub fn ambiguous(rng: &mut impl Rng) -> Vec<Named> {
    let families = ["stiffness", "friction_hysteresis", "damping", "actuator", "deadband_backlash"];
    catalogue(rng).into_iter().filter(|n| n.family.is_some_and(|f| families.contains(&f))).collect()
}

#[cfg(test)]
mod tests {
    use rigcast::engine::diagnosis::Effect;
    use serde_json::json;

    use super::*;

    #[test]
    fn the_families_are_the_contracts() {
        let ours: Vec<_> = FAMILIES
            .iter()
            .flat_map(|(family, effects)| effects.iter().map(move |e| (json!(e), json!(family))))
            .collect();
        assert_eq!(ours.len(), Effect::ALL.len());
        for effect in Effect::ALL {
            let theirs = (json!(effect), json!(effect.family()));
            assert!(ours.contains(&theirs), "{theirs:?}");
        }
    }

    #[test]
    fn what_is_struck_takes_family_and_twins_along() {
        let left = struck("sensor_gain", Some("sensor"));
        for gone in ["sensor_gain", "offset", "quantisation", "gain", "linear_change"] {
            assert!(!left.contains(&gone), "{gone}");
        }
        assert!(left.contains(&"delay") && left.contains(&"cubic_stiffness"));
    }
}
