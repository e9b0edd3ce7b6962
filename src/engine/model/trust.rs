//! Whether an input lies inside what a model was fitted on.

use serde::{Deserialize, Serialize};

use crate::engine::Signal;

/// What one input channel did in the training data.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct InputRange {
    /// Smallest value, channel unit.
    pub min: f64,
    /// Largest value, channel unit.
    pub max: f64,
    /// Largest absolute rate of change, channel unit per second.
    pub max_rate: f64,
}

/// A stretch in which one channel is outside.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct TrustSpan {
    /// Start.
    pub from_s: f64,
    /// End (of the last sample outside).
    pub to_s: f64,
    /// Channel name.
    pub channel: String,
    /// What left the training range, with the limit.
    pub reason: String,
}

/// Share of samples inside, and the spans outside.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Trust {
    /// Share of samples at which every channel is inside, 0..=1.
    pub inside: f64,
    /// Spans outside, by start.
    pub spans: Vec<TrustSpan>,
}

pub(super) fn trust(_names: &[String], _range: &[InputRange], _x: &Signal) -> Trust {
    todo!()
}
