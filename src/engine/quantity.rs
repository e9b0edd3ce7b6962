//! Physical quantities of channels.

use serde::{Deserialize, Serialize};

/// Physical quantity of a channel.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
#[expect(missing_docs, reason = "the words say it")]
pub enum Quantity {
    Displacement,
    Velocity,
    Acceleration,
    Force,
    #[default]
    Other,
}

impl Quantity {
    /// The word of the contract.
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Displacement => "displacement",
            Self::Velocity => "velocity",
            Self::Acceleration => "acceleration",
            Self::Force => "force",
            Self::Other => "other",
        }
    }

    /// Whether it is a displacement or one of its rates.
    pub fn is_motion(self) -> bool {
        matches!(self, Self::Displacement | Self::Velocity | Self::Acceleration)
    }

    /// How often it has to be integrated to be a displacement; 0 of what is none of its derivatives.
    pub fn integrals(self) -> usize {
        match self {
            Self::Velocity => 1,
            Self::Acceleration => 2,
            Self::Displacement | Self::Force | Self::Other => 0,
        }
    }
}
