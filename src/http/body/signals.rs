//! Signals as JSON: `{"sample_rate_hz": 1000.0, "channels": {"force_x": [0.0, 0.1]}}`.

use std::fmt;

use rayon::prelude::*;
use serde::de::{Error, MapAccess, Visitor};
use serde::{Deserialize, Deserializer};

use crate::engine::Signal;

/// Most channels of a body.
const MAX_CHANNELS: usize = 128;

/// Samples by channel name, in the order of the request; no name comes twice.
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

    /// Number of samples, all channels together.
    pub fn values(&self) -> usize {
        self.0.iter().map(|(_, samples)| samples.len()).sum()
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
        // `strict` refuses duplicate names, for all objects.
        while let Some(name) = map.next_key::<String>()? {
            if channels.len() == MAX_CHANNELS {
                return Err(A::Error::custom(format_args!("more than {MAX_CHANNELS} channels")));
            }
            channels.push((name, map.next_value()?));
        }
        Ok(Channels(channels))
    }
}

/// Samples that one thread prints at a time: a third of a millisecond.
const SAMPLES_AT_ONCE: usize = 1 << 14;

/// Longest text of a number, with the comma before it: `-2.2250738585072014e-308`.
const NUMBER_BYTES: usize = 25;

/// Appends a signal and the names of its channels as JSON; every number in the shortest form that
/// reads back as the same 64-bit one.
pub fn write_json(json: &mut Vec<u8>, names: &[String], signal: &Signal) {
    // Most of the text is numbers, which all threads can print.
    let stretches: Vec<(usize, &[f64])> = signal
        .channels()
        .iter()
        .enumerate()
        .flat_map(|(c, samples)| samples.chunks(SAMPLES_AT_ONCE).map(move |stretch| (c, stretch)))
        .collect();
    let texts: Vec<(usize, Vec<u8>)> =
        stretches.par_iter().map(|&(c, samples)| (c, numbers(samples))).collect();
    json.reserve(texts.iter().map(|(_, text)| text.len()).sum::<usize>() + 4096);
    begin_signal(json, signal.sample_rate_hz());
    let mut texts = texts.into_iter().peekable();
    for (c, name) in names.iter().enumerate() {
        begin_channel(json, c, name);
        let start = json.len();
        while let Some((_, text)) = texts.next_if(|(of, _)| *of == c) {
            // Every number but the first has a comma before it.
            json.extend_from_slice(&text[usize::from(json.len() == start)..]);
        }
        json.push(b']');
    }
    json.extend_from_slice(b"}}");
}

/// The text before the first channel.
pub(super) fn begin_signal(json: &mut Vec<u8>, sample_rate_hz: f64) {
    json.extend_from_slice(b"{\"sample_rate_hz\":");
    json.extend_from_slice(zmij::Buffer::new().format_finite(sample_rate_hz).as_bytes());
    json.extend_from_slice(b",\"channels\":{");
}

/// The text before the first number of a channel.
pub(super) fn begin_channel(json: &mut Vec<u8>, channel: usize, name: &str) {
    if channel > 0 {
        json.push(b',');
    }
    json.extend_from_slice(serde_json::Value::from(name).to_string().as_bytes());
    json.extend_from_slice(b":[");
}

/// Numbers, a comma before each. A signal is finite, so all of them are numbers in JSON.
pub(super) fn numbers(samples: &[f64]) -> Vec<u8> {
    let mut text = Vec::with_capacity(samples.len() * NUMBER_BYTES);
    let mut buffer = zmij::Buffer::new();
    for &sample in samples {
        text.push(b',');
        text.extend_from_slice(buffer.format_finite(sample).as_bytes());
    }
    text
}

/// Names for a header, with commas between them; `%`, blanks and characters beyond ASCII as `%XX`.
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

    fn written(names: &[String], signal: &Signal) -> String {
        let mut json = Vec::new();
        write_json(&mut json, names, signal);
        String::from_utf8(json).expect("text")
    }

    #[test]
    fn signals_keep_their_order_both_ways() {
        let text = r#"{"sample_rate_hz":10.0,"channels":{"b":[1.0,0.1],"a":[-2.5,3e-300]}}"#;
        let signals: Signals = serde_json::from_str(text).expect("signals");
        let names = signals.channels.names();
        assert_eq!(names, ["b", "a"]);
        let samples = signals.channels.0.into_iter().map(|(_, s)| s).collect();
        let signal = Signal::new(signals.sample_rate_hz, samples).expect("a signal");
        assert_eq!(written(&names, &signal), text);
    }

    #[test]
    fn every_number_is_written_as_serde_writes_it_in_stretches_or_not() {
        let mut samples =
            vec![0.0, -0.0, 5e-324, f64::MAX, f64::MIN_POSITIVE, 1e16, 1e15, 0.1, -123.456, 1e-5];
        samples.extend((0..2 * SAMPLES_AT_ONCE).map(|i| (i as f64).sin() * 10f64.powi(i as i32 % 40 - 20)));
        let names = ["a\"\u{7f}\u{f6}".to_owned(), "b".to_owned(), "c".to_owned()];
        for n in [0, 1, 10, SAMPLES_AT_ONCE, SAMPLES_AT_ONCE + 1, samples.len()] {
            let channels: Vec<Vec<f64>> =
                [1.0, 3.0, 2.0].iter().map(|k| samples[..n].iter().map(|v| v / k).collect()).collect();
            let signal = Signal::new(0.1, channels.clone()).expect("a signal");
            let found = written(&names, &signal);
            let texts: Vec<String> = names
                .iter()
                .zip(&channels)
                .map(|(name, c)| {
                    let name = serde_json::to_string(name).expect("JSON");
                    format!("{name}:{}", serde_json::to_string(c).expect("JSON"))
                })
                .collect();
            assert_eq!(found, format!("{{\"sample_rate_hz\":0.1,\"channels\":{{{}}}}}", texts.join(",")));
        }
    }

    #[test]
    fn names_survive_a_header() {
        assert_eq!(
            header_names(&["Kraft x".into(), "50%".into(), "\u{f6}l".into()]),
            "Kraft%20x,50%25,%C3%B6l"
        );
    }
}
