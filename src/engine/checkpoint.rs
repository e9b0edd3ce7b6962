//! Checkpoints: state that long work saves now and then, so that it can go on after an interruption.

use serde::{Deserialize, Deserializer, Serializer, de::Error};

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;

/// A store of checkpoints, one for each part of some work. An implementation returns only checkpoints
/// that were saved for the same work.
pub trait CheckpointStore: Sync {
    /// The last checkpoint of a part, if there is one.
    fn load(&self, part: &str) -> Option<Vec<u8>>;

    /// Whether a part should be saved now; `done` when it has come to its end.
    fn is_due(&self, part: &str, done: bool) -> bool;

    /// Saves a part in the place of its last checkpoint.
    fn save(&self, part: &str, state: Vec<u8>);

    /// Parts that begin now, any of which another process may do.
    fn announce(&self, _parts: &[String]) {}

    /// Whether a part is left to another process; if so, the share of it that is done there. Asked before the part begins, and
    /// often while it goes on, with the share that is done here.
    fn elsewhere(&self, _part: &str, _done: f64) -> Option<f64> {
        None
    }

    /// Nothing here is at work any more on a part that has not ended. Its state was saved.
    fn hand_over(&self, _part: &str) {}
}

/// Saves nothing.
#[derive(Debug, Clone, Copy)]
pub struct NoCheckpoints;

impl CheckpointStore for NoCheckpoints {
    fn load(&self, _: &str) -> Option<Vec<u8>> {
        None
    }

    fn is_due(&self, _: &str, _: bool) -> bool {
        false
    }

    fn save(&self, _: &str, _: Vec<u8>) {}
}

/// Weights in JSON, as the base64 of their bytes: exact and fast to read.
pub(crate) mod floats {
    use super::*;

    pub(crate) fn serialize<S: Serializer>(values: &[f32], to: S) -> Result<S::Ok, S::Error> {
        let bytes: Vec<u8> = values.iter().flat_map(|v| v.to_le_bytes()).collect();
        to.serialize_str(&STANDARD.encode(bytes))
    }

    pub(crate) fn deserialize<'de, D: Deserializer<'de>>(from: D) -> Result<Vec<f32>, D::Error> {
        let bytes = STANDARD.decode(String::deserialize(from)?).map_err(D::Error::custom)?;
        let (values, rest) = bytes.as_chunks::<4>();
        if !rest.is_empty() {
            return Err(D::Error::custom("bytes of no whole number"));
        }
        Ok(values.iter().map(|b| f32::from_le_bytes(*b)).collect())
    }
}
