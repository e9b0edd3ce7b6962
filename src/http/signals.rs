//! Signals as JSON: `{"sample_rate_hz": 1000.0, "channels": {"force_x": [0.0, 0.1]}}`.

use std::fmt;

use serde::de::{Error, MapAccess, Visitor};
use serde::ser::SerializeMap;
use serde::{Deserialize, Deserializer, Serialize, Serializer};

use crate::engine::Signal;

/// Most channels of a body.
const MAX_CHANNELS: usize = 128;

/// Samples by channel name, in the order that they were sent; no name twice.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Channels(pub Vec<(String, Vec<f64>)>);

/// Signals as a client sends them; lengths are not compared yet.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Signals {
    /// Samples per second.
    pub sample_rate_hz: f64,
    /// Samples by name.
    pub channels: Channels,
}

impl Channels {
    /// Takes one channel out.
    pub fn take(&mut self, name: &str) -> Option<Vec<f64>> {
        let at = self.0.iter().position(|(n, _)| n == name)?;
        Some(self.0.swap_remove(at).1)
    }

    /// Names, in order.
    pub fn names(&self) -> Vec<String> {
        self.0.iter().map(|(name, _)| name.clone()).collect()
    }
}

impl<'de> Deserialize<'de> for Channels {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        deserializer.deserialize_map(ChannelsVisitor)
    }
}

struct ChannelsVisitor;

impl<'de> Visitor<'de> for ChannelsVisitor {
    type Value = Channels;

    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("an object of arrays of numbers")
    }

    fn visit_map<A: MapAccess<'de>>(self, mut map: A) -> Result<Channels, A::Error> {
        let mut channels: Vec<(String, Vec<f64>)> = Vec::new();
        while let Some(name) = map.next_key::<String>()? {
            if channels.iter().any(|(n, _)| *n == name) {
                return Err(A::Error::custom(format_args!("channel {name:?} comes twice")));
            }
            if channels.len() == MAX_CHANNELS {
                return Err(A::Error::custom(format_args!("more than {MAX_CHANNELS} channels")));
            }
            channels.push((name, map.next_value()?));
        }
        Ok(Channels(channels))
    }
}

/// A signal and the names of its channels, to be written as JSON.
#[derive(Debug)]
pub struct Named<'a> {
    /// Names, in the order of the signal's channels.
    pub names: &'a [String],
    /// The signal: finite, so every number is one in JSON.
    pub signal: &'a Signal,
}

impl Serialize for Named<'_> {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        let mut map = serializer.serialize_map(Some(2))?;
        map.serialize_entry("sample_rate_hz", &self.signal.sample_rate_hz())?;
        map.serialize_entry("channels", &NamedChannels(self))?;
        map.end()
    }
}

struct NamedChannels<'a>(&'a Named<'a>);

impl Serialize for NamedChannels<'_> {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.collect_map(self.0.names.iter().zip(self.0.signal.channels()))
    }
}

/// Names for a header: commas between them; percent, blanks and what is not ASCII as `%XX`.
pub fn header_names(names: &[String]) -> String {
    let mut text = String::new();
    for (i, name) in names.iter().enumerate() {
        if i > 0 {
            text.push(',');
        }
        for byte in name.bytes() {
            if byte.is_ascii_graphic() && byte != b'%' && byte != b',' {
                text.push(char::from(byte));
            } else {
                text.push_str(&format!("%{byte:02X}"));
            }
        }
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn signals_keep_their_order_both_ways() {
        let text = r#"{"sample_rate_hz":10.0,"channels":{"b":[1.0,0.1],"a":[-2.5,3e-300]}}"#;
        let signals: Signals = serde_json::from_str(text).expect("signals");
        let names = signals.channels.names();
        assert_eq!(names, ["b", "a"]);
        let samples = signals.channels.0.into_iter().map(|(_, s)| s).collect();
        let signal = Signal::new(signals.sample_rate_hz, samples).expect("a signal");
        assert_eq!(serde_json::to_string(&Named { names: &names, signal: &signal }).expect("JSON"), text);
    }

    #[test]
    fn a_name_that_comes_twice_is_refused() {
        let error = serde_json::from_str::<Channels>(r#"{"a": [], "a": []}"#).expect_err("twice");
        assert!(error.to_string().contains("\"a\" comes twice"));
    }

    #[test]
    fn names_survive_a_header() {
        assert_eq!(
            header_names(&["Kraft x".into(), "50%".into(), "\u{f6}l".into()]),
            "Kraft%20x,50%25,%C3%B6l"
        );
    }
}
