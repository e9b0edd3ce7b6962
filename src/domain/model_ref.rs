//! The model that a request refers to: the rig's active one, or a version.

use std::fmt;

use serde::de::{Error, Visitor};
use serde::{Deserialize, Deserializer, Serialize, Serializer};

/// `"active"` or a version.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum ModelRef {
    /// Whichever is active.
    #[default]
    Active,
    /// This one.
    Version(u32),
}

impl ModelRef {
    /// Reads `active` or the digits of a version.
    pub fn parse(text: &str) -> Option<Self> {
        if text == "active" { Some(Self::Active) } else { text.parse().ok().map(Self::Version) }
    }
}

impl Serialize for ModelRef {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        match self {
            Self::Active => serializer.serialize_str("active"),
            Self::Version(version) => serializer.serialize_u32(*version),
        }
    }
}

impl<'de> Deserialize<'de> for ModelRef {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        struct NameVisitor;
        impl Visitor<'_> for NameVisitor {
            type Value = ModelRef;

            fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                f.write_str("\"active\" or the number of a version")
            }

            fn visit_str<E: Error>(self, text: &str) -> Result<ModelRef, E> {
                if text == "active" {
                    Ok(ModelRef::Active)
                } else {
                    Err(E::invalid_value(serde::de::Unexpected::Str(text), &self))
                }
            }

            fn visit_u64<E: Error>(self, number: u64) -> Result<ModelRef, E> {
                let version = u32::try_from(number);
                version
                    .map(ModelRef::Version)
                    .map_err(|_| E::invalid_value(serde::de::Unexpected::Unsigned(number), &self))
            }
        }
        deserializer.deserialize_any(NameVisitor)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_model_is_active_or_a_number() {
        let model = |json: &str| serde_json::from_str::<ModelRef>(json).ok();
        assert_eq!(model("\"active\""), Some(ModelRef::Active));
        assert_eq!(model("3"), Some(ModelRef::Version(3)));
        for odd in ["\"3\"", "-1", "1.5", "null", "4294967296", "\"latest\""] {
            assert_eq!(model(odd), None, "{odd}");
        }
        for name in [ModelRef::Active, ModelRef::Version(3)] {
            assert_eq!(model(&serde_json::to_string(&name).unwrap()), Some(name));
        }
    }
}
