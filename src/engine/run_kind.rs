//! Kinds of runs and their use, in the words of the contract.

use serde::{Deserialize, Serialize};

/// The kind of excitation of a run.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum RunKind {
    /// Random excitation, from which models are identified.
    Noise,
    /// Service loads.
    Service,
    /// Sine at fixed frequency.
    Sine,
    /// Sine of sweeping frequency.
    Sweep,
    /// Anything else.
    Other,
}

impl RunKind {
    /// All kinds.
    pub const ALL: [Self; 5] = [Self::Noise, Self::Service, Self::Sine, Self::Sweep, Self::Other];

    /// The word of the contract.
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Noise => "noise",
            Self::Service => "service",
            Self::Sine => "sine",
            Self::Sweep => "sweep",
            Self::Other => "other",
        }
    }
}

/// The use of a run.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Split {
    /// Sets weights.
    #[default]
    Training,
    /// Chooses among models and settings.
    Validation,
    /// Never enters a fit.
    Test,
}

impl Split {
    /// All splits.
    pub const ALL: [Self; 3] = [Self::Training, Self::Validation, Self::Test];

    /// The word of the contract.
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Training => "training",
            Self::Validation => "validation",
            Self::Test => "test",
        }
    }
}
