//! The catalogue's name of a law at a place.

use super::law::Law;
use super::place::Place;
use crate::Quantity;
use crate::diagnosis::effects::effect::Effect;

/// Kinks beyond so many deviations are stops; a gap inside is one that the rig rattles through.
const STOP: f64 = 1.2;
/// A slider that slips at fewer deviations is dry friction.
const DRY: f64 = 0.08;

/// Stribeck's second part relative to its first, where they take each other away so far that the force has no jump where
/// sliding begins: whatever a linear damper adds to it, it is no friction.
const WITHOUT_JUMP: std::ops::Range<f64> = -1.35..-0.65;
/// The cubic part of a polynomial relative to its square, in deviations, below which the square is more of the force: of
/// a normal displacement their variances beyond a straight line are 6 and 2.
const LOPSIDED: f64 = 0.577;

/// What stands at a place: its laws have names of their own.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Role {
    /// A force of the structure that acts on a motion; a positive gain gives way to the motion.
    Structure,
    /// The specimen under a commanded motion, whose force is measured, or on a table; a positive gain resists.
    Specimen,
    Actuator,
    Sensor,
}

/// The effect that a law at a place is. `gain` is the law's gain relative to the linear part's of the same
/// signal: its sign tells a clip from a dead zone and a slider from a play. `second` is the second signal of a law
/// relative to its first.
pub(super) fn effect(
    law: Law,
    place: Place,
    of: Quantity,
    response: Quantity,
    gain: f64,
    second: f64,
) -> Effect {
    if matches!(law, Law::Stribeck { .. }) && WITHOUT_JUMP.contains(&second) {
        return Effect::FreeDamping;
    }
    let (law, gain) = match law {
        Law::Polynomial if second.abs() < LOPSIDED => (Law::Quadratic, gain),
        // What resists beyond a kink gives way before it.
        Law::Gap { at } => (Law::Kink { at }, -gain),
        Law::OneSidedBelow { at } => (Law::OneSided { at }, -gain),
        Law::OneSidedDampingBelow { at } => (Law::OneSidedDamping { at }, -gain),
        Law::DampingBeyond { at } => (Law::KinkedDamping { at }, -gain),
        law => (law, gain),
    };
    let role = match place {
        Place::Response(_) | Place::Between(..) => Role::Structure,
        Place::Output(_) => Role::Sensor,
        Place::Drive(_) if of.is_motion() && !response.is_motion() => Role::Specimen,
        Place::OnTable(..) => Role::Specimen,
        Place::Drive(_) | Place::Error(..) => Role::Actuator,
    };
    match role {
        Role::Structure => of_force(law, -gain),
        Role::Specimen => of_force(law, gain),
        Role::Actuator => of_actuator(law, gain),
        Role::Sensor => of_sensor(law, gain),
    }
}

/// A force; a positive gain resists the motion.
fn of_force(law: Law, gain: f64) -> Effect {
    match law {
        Law::Cubic | Law::Polynomial => Effect::CubicStiffness,
        Law::Quadratic => Effect::QuadraticStiffness,
        Law::Kink { at } if gain < 0.0 && at < STOP => Effect::Clearance,
        Law::Kink { .. } if gain < 0.0 => Effect::BumpStop,
        Law::OneSided { .. } | Law::OneSidedBelow { .. } => Effect::OneSidedStop,
        Law::Kink { .. } | Law::Gap { .. } | Law::FreeStiffness | Law::Sandwich => Effect::FreeStiffness,
        Law::Coulomb { .. } => Effect::CoulombFriction,
        Law::Slider { limit } if limit < DRY => Effect::CoulombFriction,
        Law::Stribeck { .. } => Effect::StribeckFriction,
        Law::Slider { .. } | Law::BoucWen { .. } => Effect::BoucWenHysteresis,
        Law::FreeHysteresis => Effect::FreeHysteresis,
        Law::QuadraticDamping | Law::PowerDamping { .. } => Effect::QuadraticDamping,
        Law::OneSidedDamping { .. } | Law::OneSidedDampingBelow { .. } | Law::FreeDamping => {
            Effect::FreeDamping
        }
        Law::KinkedDamping { .. } | Law::DampingBeyond { .. } => Effect::FreeDamping,
        Law::RateLimit { .. } => Effect::RateLimit,
        Law::ValveFlow => Effect::ValveFlow,
        Law::CrossAxisKinematic => Effect::CrossAxisKinematic,
        Law::StiffnessDrift => Effect::StiffnessDrift,
        Law::Block { .. } | Law::Bent { .. } => Effect::Sandwich,
    }
}

/// A map of the drive; a positive gain adds to the drive's.
fn of_actuator(law: Law, gain: f64) -> Effect {
    match law {
        Law::Cubic | Law::Quadratic | Law::Polynomial => Effect::DrivePolynomial,
        Law::Kink { .. } if gain < 0.0 => Effect::DeadZone,
        Law::Kink { .. } => Effect::DriveSaturation,
        Law::OneSided { at } if at * gain < 0.0 => Effect::DriveSaturation,
        Law::OneSided { .. } | Law::FreeStiffness => Effect::FreeDriveMap,
        Law::Slider { .. } | Law::FreeHysteresis | Law::BoucWen { .. } if gain < 0.0 => Effect::Backlash,
        other => of_force(other, gain),
    }
}

/// A map of the response; a positive gain adds to the sensor's.
fn of_sensor(law: Law, gain: f64) -> Effect {
    match law {
        Law::Kink { .. } if gain > 0.0 => Effect::SensorSaturation,
        Law::OneSided { at } if at * gain < 0.0 => Effect::SensorSaturation,
        Law::Sandwich => Effect::Sandwich,
        _ => Effect::SensorNonlinearity,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_sign_of_a_gain_tells_a_clip_from_a_dead_zone_and_hysteresis_from_play() {
        let (force, length) = (Quantity::Force, Quantity::Displacement);
        let kink = Law::Kink { at: 0.7 };
        let slider = Law::Slider { limit: 0.5 };
        let of = |law, place, drive, response, gain| effect(law, place, drive, response, gain, 0.0);
        assert_eq!(of(kink, Place::Drive(0), force, length, 0.4), Effect::DriveSaturation);
        assert_eq!(of(kink, Place::Drive(0), force, length, -0.4), Effect::DeadZone);
        assert_eq!(of(kink, Place::Drive(0), length, force, -0.4), Effect::Clearance);
        assert_eq!(of(kink, Place::Response(0), length, length, 0.4), Effect::Clearance);
        assert_eq!(of(kink, Place::Output(0), length, length, 0.4), Effect::SensorSaturation);
        assert_eq!(of(kink.apart(), Place::Response(0), length, length, -0.4), Effect::Clearance);
        assert_eq!(of(kink.apart(), Place::Response(0), length, length, 0.4), Effect::FreeStiffness);
        assert_eq!(of(slider, Place::Drive(0), length, force, 0.4), Effect::BoucWenHysteresis);
        assert_eq!(of(slider, Place::Drive(0), force, length, -0.9), Effect::Backlash);
        let stribeck = Law::Stribeck { smooth: 0.04, decay: 0.7 };
        let sliding = |second| effect(stribeck, Place::Response(0), length, length, -1.0, second);
        assert_eq!(sliding(0.5), Effect::StribeckFriction);
        assert_eq!(sliding(-0.9), Effect::FreeDamping);
        let spring = |cubic| effect(Law::Polynomial, Place::Response(0), length, length, -1.0, cubic);
        assert_eq!(spring(0.2), Effect::QuadraticStiffness);
        assert_eq!(spring(-1.5), Effect::CubicStiffness);
    }
}
