//! The catalogue: names, families and tiers of the effects that a rig may have and a model lack.

use serde::{Deserialize, Serialize};

/// A physical phenomenon that a model may lack.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
#[expect(missing_docs, reason = "the names are the field's own; equations stand with the laws and maps")]
pub enum Effect {
    Gain,
    Delay,
    ExtraPole,
    LinearChange,
    CubicStiffness,
    QuadraticStiffness,
    BumpStop,
    OneSidedStop,
    Clearance,
    FreeStiffness,
    CoulombFriction,
    StribeckFriction,
    BoucWenHysteresis,
    FreeHysteresis,
    QuadraticDamping,
    FreeDamping,
    DriveSaturation,
    DrivePolynomial,
    RateLimit,
    ValveFlow,
    FreeDriveMap,
    DeadZone,
    Backlash,
    CrossAxisLinear,
    CrossAxisKinematic,
    StiffnessDrift,
    OffsetDrift,
    Offset,
    SensorGain,
    SensorSaturation,
    SensorNonlinearity,
    Quantisation,
    Sandwich,
    PeriodicDisturbance,
    RaisedNoise,
}

/// Effects of one kind of physics; the coarse answer where the fine one cannot be had.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
#[expect(missing_docs, reason = "the names are the field's own")]
pub enum Family {
    Linear,
    Stiffness,
    FrictionHysteresis,
    Damping,
    Actuator,
    DeadbandBacklash,
    CrossAxis,
    TimeVariance,
    Sensor,
    BlockStructure,
    Disturbance,
}

impl Family {
    /// Whether its laws are forces over the motion of the structure.
    pub fn is_of_structure(self) -> bool {
        matches!(self, Self::Stiffness | Self::FrictionHysteresis | Self::Damping)
    }

    /// Whether its laws act on a drive or in a response's sensor.
    pub fn is_of_channel(self) -> bool {
        matches!(self, Self::Actuator | Self::DeadbandBacklash | Self::Sensor)
    }
}

/// How much an effect may bend: of two that explain alike the smaller tier is believed.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Tier {
    /// One linear number.
    Scalar,
    /// A linear change of any kind.
    Linear,
    /// A named nonlinear law.
    Law,
    /// A free shape.
    Free,
}

impl Effect {
    /// All of the catalogue, in the order of its table.
    pub const ALL: [Self; 35] = [
        Self::Gain,
        Self::Delay,
        Self::ExtraPole,
        Self::LinearChange,
        Self::CubicStiffness,
        Self::QuadraticStiffness,
        Self::BumpStop,
        Self::OneSidedStop,
        Self::Clearance,
        Self::FreeStiffness,
        Self::CoulombFriction,
        Self::StribeckFriction,
        Self::BoucWenHysteresis,
        Self::FreeHysteresis,
        Self::QuadraticDamping,
        Self::FreeDamping,
        Self::DriveSaturation,
        Self::DrivePolynomial,
        Self::RateLimit,
        Self::ValveFlow,
        Self::FreeDriveMap,
        Self::DeadZone,
        Self::Backlash,
        Self::CrossAxisLinear,
        Self::CrossAxisKinematic,
        Self::StiffnessDrift,
        Self::OffsetDrift,
        Self::Offset,
        Self::SensorGain,
        Self::SensorSaturation,
        Self::SensorNonlinearity,
        Self::Quantisation,
        Self::Sandwich,
        Self::PeriodicDisturbance,
        Self::RaisedNoise,
    ];

    /// Its name in the contract.
    pub fn name(self) -> String {
        let debug = format!("{self:?}");
        let mut name = String::with_capacity(debug.len() + 4);
        for c in debug.chars() {
            if c.is_uppercase() && !name.is_empty() {
                name.push('_');
            }
            name.extend(c.to_lowercase());
        }
        name
    }

    /// Its family.
    pub fn family(self) -> Family {
        match self {
            Self::Gain | Self::Delay | Self::ExtraPole | Self::LinearChange => Family::Linear,
            Self::CubicStiffness
            | Self::QuadraticStiffness
            | Self::BumpStop
            | Self::OneSidedStop
            | Self::Clearance
            | Self::FreeStiffness => Family::Stiffness,
            Self::CoulombFriction
            | Self::StribeckFriction
            | Self::BoucWenHysteresis
            | Self::FreeHysteresis => Family::FrictionHysteresis,
            Self::QuadraticDamping | Self::FreeDamping => Family::Damping,
            Self::DriveSaturation
            | Self::DrivePolynomial
            | Self::RateLimit
            | Self::ValveFlow
            | Self::FreeDriveMap => Family::Actuator,
            Self::DeadZone | Self::Backlash => Family::DeadbandBacklash,
            Self::CrossAxisLinear | Self::CrossAxisKinematic => Family::CrossAxis,
            Self::StiffnessDrift | Self::OffsetDrift => Family::TimeVariance,
            Self::Offset
            | Self::SensorGain
            | Self::SensorSaturation
            | Self::SensorNonlinearity
            | Self::Quantisation => Family::Sensor,
            Self::Sandwich => Family::BlockStructure,
            Self::PeriodicDisturbance | Self::RaisedNoise => Family::Disturbance,
        }
    }

    /// How far it bends to whatever it meets.
    pub(in crate::diagnosis) fn tier(self) -> Tier {
        match self {
            Self::Gain
            | Self::Delay
            | Self::ExtraPole
            | Self::OffsetDrift
            | Self::Offset
            | Self::SensorGain => Tier::Scalar,
            Self::LinearChange | Self::CrossAxisLinear => Tier::Linear,
            Self::FreeStiffness
            | Self::FreeHysteresis
            | Self::FreeDamping
            | Self::FreeDriveMap
            | Self::Sandwich => Tier::Free,
            _ => Tier::Law,
        }
    }

    /// Whether the effect is its family's free shape, which says no more than the family.
    pub(in crate::diagnosis) fn nameless(self) -> bool {
        matches!(self, Self::FreeStiffness | Self::FreeHysteresis | Self::FreeDamping | Self::FreeDriveMap)
    }

    /// Whether another effect of its own tier is a special case of it.
    pub(in crate::diagnosis) fn contains(self, other: Self) -> bool {
        matches!(
            (self, other),
            (Self::StribeckFriction, Self::CoulombFriction) | (Self::LinearChange, Self::CrossAxisLinear)
        )
    }

    /// Whether the effect is one of the drive's: its axis is that of the drive.
    pub fn on_drive(self) -> bool {
        matches!(
            self,
            Self::Gain
                | Self::Delay
                | Self::ExtraPole
                | Self::DriveSaturation
                | Self::DrivePolynomial
                | Self::RateLimit
                | Self::ValveFlow
                | Self::FreeDriveMap
                | Self::DeadZone
                | Self::Backlash
        )
    }

    /// Whether a refit of the linear part alone can stand for it.
    pub(in crate::diagnosis) fn linear(self) -> bool {
        matches!(
            self,
            Self::Gain
                | Self::Delay
                | Self::ExtraPole
                | Self::LinearChange
                | Self::SensorGain
                | Self::CrossAxisLinear
        )
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_effect_has_one_name_in_code_and_contract() {
        for effect in Effect::ALL {
            assert_eq!(serde_json::to_value(effect).unwrap(), effect.name());
        }
        let mut all = Effect::ALL.to_vec();
        all.sort();
        all.dedup();
        assert_eq!(all.len(), 35);
    }
}
