//! What a screen finds.

use serde::{Deserialize, Serialize};

use super::free_run::FreeRun;
use super::groups::Transfer;
use super::law::Law;
use super::place::Place;
use crate::diagnosis::effects::effect::{Effect, Family};

/// The linear part, and the laws that predict what it leaves, best first.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Screening {
    /// What the held-out groups differ in.
    pub transfer: Transfer,
    /// Number of groups.
    pub groups: usize,
    /// The linear part of all responses.
    pub linear: LinearPart,
    /// Whether some laws were tried beside modes that were found beside bends of the motions, since a strong law had moved
    /// those of the linear part.
    pub apart: bool,
    /// Laws at their places, the smallest ratio first; where modes were found beside bends, first what free runs leave least
    /// of, those of other places beside the modes that were found alone.
    pub standings: Vec<Standing>,
}

/// The linear part that every law is measured against.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct LinearPart {
    /// Samples a second of the analysis.
    pub sample_rate_hz: f64,
    /// States of its modes, of each drive; `None` of a finite impulse response.
    pub modes: Option<usize>,
    /// Length of its impulse responses, s.
    pub memory_s: f64,
    /// How far they reach ahead of the present, s; 0 where that helps nothing.
    pub lead_s: f64,
    /// Ridge relative to the drives' power.
    pub ridge: f64,
    /// Error in each group by the fit to all others, relative to the response, `[response][group]`.
    pub errors: Vec<Vec<f64>>,
}

/// A law at a place, and what it leaves.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Standing {
    /// The law with its numbers, in deviations of its argument.
    pub law: Law,
    /// Its argument.
    pub place: Place,
    /// The other argument of a law of two.
    pub other: Option<Place>,
    /// Whether its argument is what the linear part makes of the drives, without noise, and its signals move every mode
    /// by factors of their own; else the argument is what was measured.
    pub predicted: bool,
    /// Whether it stands beside modes that were found beside bends.
    pub apart: bool,
    /// Its name in the catalogue.
    pub effect: Effect,
    /// Its family.
    pub family: Family,
    /// Held-out error relative to that of the linear part with the same signal let in unbent: over all responses
    /// the root of the share of the linear part's squared relative error, over groups the geometric mean.
    pub ratio: f64,
    /// The largest such ratio of a group, of the response that it helps most.
    pub worst: f64,
    /// Root of the mean over responses and groups of the squared held-out error relative to the response.
    pub error: f64,
    /// The response that it helps most.
    pub response: usize,
    /// Ratio at each response.
    pub ratios: Vec<f64>,
    /// Held-out error of each group at the response that it helps most, relative to the response.
    pub errors: Vec<f64>,
    /// Its gain relative to the linear part's of the same signal; where it moves every mode by itself, from -1, where it
    /// resists in every one, to 1.
    pub gain: f64,
    /// How much of the law each group alone asks for, 1 being the fit to all; for the foremost of each family.
    pub gains: Vec<Option<f64>>,
    /// What it leaves when it is simulated forward, for the foremost of each family near the best.
    pub free: Option<FreeRun>,
}

impl Screening {
    /// The first standing of each family, best first.
    pub fn foremost(&self) -> Vec<&Standing> {
        let mut first: Vec<&Standing> = Vec::new();
        for standing in &self.standings {
            if first.iter().all(|s| s.family != standing.family) {
                first.push(standing);
            }
        }
        first
    }
}

impl Standing {
    /// Whether of this and a standing that comes before it one is enough: of a family the foremost, and beside modes that
    /// were found beside bends, where regressions tell laws apart badly and free runs well, of each effect.
    pub(super) fn is_after(&self, other: &Self) -> bool {
        self.family == other.family && (!self.apart || self.effect == other.effect)
    }

    /// Deviation over the groups of what each alone asks for, relative to its mean; `None` where it is not known.
    pub fn spread(&self) -> Option<f64> {
        let gains: Vec<f64> = self.gains.iter().copied().flatten().collect();
        if gains.len() < 2 {
            return None;
        }
        let mean = gains.iter().sum::<f64>() / gains.len() as f64;
        let deviation = (gains.iter().map(|g| (g - mean).powi(2)).sum::<f64>() / gains.len() as f64).sqrt();
        (mean != 0.0).then(|| deviation / mean.abs())
    }
}
