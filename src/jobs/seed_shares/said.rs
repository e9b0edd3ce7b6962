//! What the workers of a fit tell each other, each in a checkpoint of the job.

use serde::{Deserialize, Serialize};
use uuid::Uuid;

use crate::jobs::helping::OFFER;

/// What the processes tell each other.
#[derive(Debug, Serialize, Deserialize)]
pub(super) enum Said {
    /// Networks can be had of the fit's worker.
    Offer,
    /// A helper is there, or leaves, and has done this share of its network.
    Helper { who: Uuid, done: f64, leaves: bool },
    /// The fit's worker leaves a part to a helper, or to none any more; `gift` counts how often it was given.
    Given { part: String, to: Option<Uuid>, gift: u32 },
    /// A helper has ended a part, or leaves it.
    Back { part: String, gift: u32, ended: bool },
}

impl Said {
    /// The name of the checkpoint that says it.
    pub(super) fn place(&self) -> String {
        match self {
            Self::Offer => OFFER.into(),
            Self::Helper { who, .. } => format!("share helper {who}"),
            Self::Given { part, .. } => format!("share given {part}"),
            Self::Back { part, gift, .. } => format!("share back {part} {gift}"),
        }
    }
}
