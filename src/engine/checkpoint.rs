//! How long work survives an interruption: what it puts by now and then, and finds when it begins
//! again.

use serde::{Deserialize, Deserializer, Serializer, de::Error};

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;

/// Where work puts by what it would need to go on, part by part, and finds it again. Whoever keeps
/// it makes sure that what is found was put by for the same work.
pub trait Keeper: Sync {
    /// What was put by of a part, if anything was.
    fn kept(&self, part: &str) -> Option<Vec<u8>>;

    /// Whether it is time to put a part by; `done` when it has come to its end.
    fn due(&self, part: &str, done: bool) -> bool;

    /// Puts a part by in the place of what was kept of it.
    fn keep(&self, part: &str, state: Vec<u8>);
}

/// Keeps nothing.
#[derive(Debug, Clone, Copy)]
pub struct Forget;

impl Keeper for Forget {
    fn kept(&self, _: &str) -> Option<Vec<u8>> {
        None
    }

    fn due(&self, _: &str, _: bool) -> bool {
        false
    }

    fn keep(&self, _: &str, _: Vec<u8>) {}
}

/// Weights in JSON: their bytes in base64, so that each comes back bit for bit and none takes long.
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
