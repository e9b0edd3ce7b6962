//! JSON: `{"sample_rate_hz": 1000.0, "channels": {"drive_x": [0.0, 0.1]}}`, nothing more.
//!
//! Channels keep the order of the file. Unknown fields and fields that come twice are refused, so that a
//! typing error does not silently become a default.

mod token_limit;

use std::fmt;
use std::io::{self, BufReader, Read};

use serde::Deserializer;
use serde::de::{DeserializeSeed, Error, MapAccess, SeqAccess, Visitor};

use super::error::excerpt;
use super::{ChannelAt, FormatError, PIECE, ParsedRun, ReadError, Spool, check_channel_count, check_name};
use crate::engine::wording::plain;
use token_limit::TokenLimit;

/// Reads a file.
///
/// # Errors
/// The `json.*` codes, with row and column where the parser has them; `run.*` codes.
pub fn read(file: &[u8]) -> Result<ParsedRun, FormatError> {
    parse(serde_json::Deserializer::from_slice(file), Spool::in_memory())
        .map(ParsedRun::into_memory)
        .map_err(ReadError::of_bytes)
}

/// [`read`] for a file that is not in memory: only a piece of it is kept at a time, and its samples go to an
/// empty spool.
///
/// # Errors
/// As [`read`]; errors of the file system.
pub fn read_from(file: impl Read, spool: Spool) -> Result<ParsedRun<Spool>, ReadError> {
    let text = BufReader::with_capacity(PIECE, TokenLimit::new(file));
    parse(serde_json::Deserializer::from_reader(text), spool)
}

fn parse<'de>(
    mut json: serde_json::Deserializer<impl serde_json::de::Read<'de>>,
    spool: Spool,
) -> Result<ParsedRun<Spool>, ReadError> {
    let mut place = ParsePosition { spool, ..ParsePosition::default() };
    let read = File(&mut place).deserialize(&mut json).and_then(|run| json.end().map(|()| run));
    match read {
        Ok((sample_rate_hz, names)) => {
            let (sample_rate_hz, names) = (Some(sample_rate_hz), Some(names));
            Ok(ParsedRun { sample_rate_hz, names, ..ParsedRun::of(place.spool) }.check()?)
        }
        Err(error) if error.is_io() => {
            // What is too long for the parser is the file's fault.
            Err(io::Error::from(error)
                .downcast::<FormatError>()
                .map_or_else(ReadError::Io, ReadError::Format))
        }
        Err(error) => Err(place.explain(&error)),
    }
}

/// The position of the parser, the samples before it, and the error that a rule of this format or the spool
/// found there: serde's errors are text only.
#[derive(Default)]
struct ParsePosition {
    refused: Option<ReadError>,
    /// The array being read.
    channel: Option<ChannelAt>,
    /// Elements of it that are read.
    sample: usize,
    spool: Spool,
}

impl ParsePosition {
    /// Keeps the error, and gives serde one that stops the parser.
    fn refuse<E: Error>(&mut self, error: impl Into<ReadError>) -> E {
        let error = error.into();
        let stop = E::custom(&error);
        self.refused = Some(error);
        stop
    }

    /// Adds a sample to the channel being read.
    fn push<E: Error>(&mut self, value: f64) -> Result<(), E> {
        let channel = self.channel.as_ref().map_or(0, |channel| channel.index);
        self.sample += 1;
        self.spool.push(channel, value).map_err(|error: io::Error| self.refuse(error))
    }

    fn explain(self, error: &serde_json::Error) -> ReadError {
        if let Some(error) = self.refused {
            return error;
        }
        let (row, column) = (error.line() as u64, error.column());
        let text = error.to_string();
        match self.channel {
            Some(channel) if text.starts_with("number out of range") => {
                FormatError::NonFinite { channel, sample: self.sample, row: Some(row), column: Some(column) }
            }
            Some(channel) if error.is_data() => {
                FormatError::JsonNotANumber { channel, sample: self.sample, row, column }
            }
            _ => {
                // The place is in fields of its own.
                let detail = plain(text.split(" at line ").next().unwrap_or_default());
                FormatError::Json { row, column, detail }
            }
        }
        .into()
    }
}

/// The whole file.
struct File<'p>(&'p mut ParsePosition);

impl<'de> DeserializeSeed<'de> for File<'_> {
    type Value = (f64, Vec<String>);

    fn deserialize<D: Deserializer<'de>>(self, deserializer: D) -> Result<Self::Value, D::Error> {
        deserializer.deserialize_map(self)
    }
}

impl<'de> Visitor<'de> for File<'_> {
    type Value = (f64, Vec<String>);

    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("an object with sample_rate_hz and channels")
    }

    fn visit_map<A: MapAccess<'de>>(self, mut map: A) -> Result<Self::Value, A::Error> {
        let (mut sample_rate_hz, mut channels) = (None, None);
        while let Some(key) = map.next_key::<String>()? {
            match key.as_str() {
                "sample_rate_hz" if sample_rate_hz.is_none() => {
                    sample_rate_hz = Some(map.next_value::<f64>()?);
                }
                "channels" if channels.is_none() => {
                    channels = Some(map.next_value_seed(ChannelMap(&mut *self.0))?);
                }
                "sample_rate_hz" | "channels" => {
                    return Err(self.0.refuse(FormatError::JsonDuplicateKey { key }));
                }
                _ => return Err(self.0.refuse(FormatError::JsonUnknownKey { key: excerpt(&key) })),
            }
        }
        let Some(sample_rate_hz) = sample_rate_hz else {
            return Err(self.0.refuse(FormatError::JsonMissingKey { key: "sample_rate_hz" }));
        };
        let Some(channels) = channels else {
            return Err(self.0.refuse(FormatError::JsonMissingKey { key: "channels" }));
        };
        Ok((sample_rate_hz, channels))
    }
}

/// The value of `channels`.
struct ChannelMap<'p>(&'p mut ParsePosition);

impl<'de> DeserializeSeed<'de> for ChannelMap<'_> {
    /// Names of the channels.
    type Value = Vec<String>;

    fn deserialize<D: Deserializer<'de>>(self, deserializer: D) -> Result<Vec<String>, D::Error> {
        deserializer.deserialize_map(self)
    }
}

impl<'de> Visitor<'de> for ChannelMap<'_> {
    type Value = Vec<String>;

    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("an object of channel names, each with an array of numbers")
    }

    fn visit_map<A: MapAccess<'de>>(self, mut map: A) -> Result<Vec<String>, A::Error> {
        let mut names: Vec<String> = Vec::new();
        while let Some(name) = map.next_key::<String>()? {
            let index = names.len();
            if let Err(error) = check_channel_count(index as u64 + 1) {
                return Err(self.0.refuse(error));
            }
            if let Err(error) = check_name(&name) {
                return Err(self.0.refuse(error));
            }
            if names.contains(&name) {
                return Err(self.0.refuse(FormatError::DuplicateChannel { name }));
            }
            self.0.channel = Some(ChannelAt { index, name: Some(name.clone()) });
            self.0.sample = 0;
            self.0.spool.add_columns(1);
            map.next_value_seed(Samples(&mut *self.0))?;
            self.0.channel = None;
            names.push(name);
        }
        Ok(names)
    }
}

/// One channel.
struct Samples<'p>(&'p mut ParsePosition);

impl<'de> DeserializeSeed<'de> for Samples<'_> {
    type Value = ();

    fn deserialize<D: Deserializer<'de>>(self, deserializer: D) -> Result<(), D::Error> {
        // Programs that write a list of one as its element write a single sample so.
        deserializer.deserialize_any(self)
    }
}

impl<'de> Visitor<'de> for Samples<'_> {
    type Value = ();

    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("an array of numbers")
    }

    fn visit_f64<E: Error>(self, value: f64) -> Result<(), E> {
        self.0.push(value)
    }

    fn visit_i64<E: Error>(self, value: i64) -> Result<(), E> {
        self.0.push(value as f64)
    }

    fn visit_u64<E: Error>(self, value: u64) -> Result<(), E> {
        self.0.push(value as f64)
    }

    fn visit_seq<A: SeqAccess<'de>>(self, mut seq: A) -> Result<(), A::Error> {
        // No size hint is trusted: the array grows with the elements that arrive.
        while let Some(value) = seq.next_element::<f64>()? {
            self.0.push(value)?;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn refused(text: &str) -> FormatError {
        read(text.as_bytes()).unwrap_err()
    }

    #[test]
    fn channels_keep_the_order_of_the_file() {
        let run =
            read(br#" {"channels": {"z": [1, 2.5e0], "a": [-3, 0]}, "sample_rate_hz": 1000} "#).unwrap();
        assert_eq!(run.sample_rate_hz, Some(1000.0));
        assert_eq!(run.names, Some(vec!["z".into(), "a".into()]));
        assert_eq!(run.channels, [[1.0, 2.5], [-3.0, 0.0]]);
        assert_eq!(run.units, None);
    }

    #[test]
    fn unknown_missing_and_double_fields_are_named() {
        let unknown = refused(r#"{"sample_rate_hz": 1, "rate": 2, "channels": {"a": [1]}}"#);
        assert_eq!(unknown, FormatError::JsonUnknownKey { key: "rate".into() });
        assert_eq!(unknown.code(), "json.unknown_field");
        let double = refused(r#"{"sample_rate_hz": 1, "sample_rate_hz": 1, "channels": {"a": [1]}}"#);
        assert_eq!(double, FormatError::JsonDuplicateKey { key: "sample_rate_hz".into() });
        let double = refused(r#"{"sample_rate_hz": 1, "channels": {"a": [1]}, "channels": {"a": [1]}}"#);
        assert_eq!(double, FormatError::JsonDuplicateKey { key: "channels".into() });
        let double = refused(r#"{"sample_rate_hz": 1, "channels": {"a": [1], "b": [1], "a": [1]}}"#);
        assert_eq!(double, FormatError::DuplicateChannel { name: "a".into() });
        // The same name in another spelling.
        let double = refused(r#"{"sample_rate_hz": 1, "channels": {"a": [1], "\u0061": [1]}}"#);
        assert_eq!(double, FormatError::DuplicateChannel { name: "a".into() });
        let missing = refused(r#"{"channels": {"a": [1]}}"#);
        assert_eq!(missing, FormatError::JsonMissingKey { key: "sample_rate_hz" });
        let missing = refused(r#"{"sample_rate_hz": 1}"#);
        assert_eq!(missing, FormatError::JsonMissingKey { key: "channels" });
    }

    #[test]
    fn what_is_no_number_has_channel_and_sample() {
        for (element, code) in [
            ("null", "json.not_a_number"),
            ("\"1\"", "json.not_a_number"),
            ("[1]", "json.not_a_number"),
            ("{}", "json.not_a_number"),
            ("true", "json.not_a_number"),
            ("1e999", "run.non_finite"),
            ("-1e999", "run.non_finite"),
        ] {
            let error = refused(&format!(
                "{{\"sample_rate_hz\": 1,\n \"channels\": {{\"a\": [1], \"b\": [1, 2, {element}]}}}}"
            ));
            assert_eq!(error.code(), code, "{element}");
            assert_eq!((error.channel(), error.channel_index()), (Some("b"), Some(1)), "{element}");
            assert_eq!((error.sample(), error.row()), (Some(2), Some(2)), "{element}");
        }
        for odd in ["null", "\"1\"", "{}", "true"] {
            let error = refused(&format!(r#"{{"sample_rate_hz": 1, "channels": {{"a": {odd}}}}}"#));
            assert_eq!((error.code(), error.channel()), ("json.not_a_number", Some("a")), "{odd}");
        }
        let error = refused(r#"{"sample_rate_hz": 1, "channels": {"a": 1e999}}"#);
        assert_eq!((error.code(), error.sample()), ("run.non_finite", Some(0)));
    }

    #[test]
    fn a_single_number_is_a_channel_of_one_sample() {
        let run = read(br#"{"sample_rate_hz": 1, "channels": {"a": 5, "b": [-2.5], "c": -3}}"#).unwrap();
        assert_eq!(run.channels, [[5.0], [-2.5], [-3.0]]);
    }

    #[test]
    fn a_field_of_another_type_is_said_in_words() {
        let detail = |text: &str| match refused(text) {
            FormatError::Json { detail, .. } => detail,
            other => panic!("{other}"),
        };
        assert_eq!(detail("[]"), "expected an object with sample_rate_hz and channels, found an array");
        let text = r#"{"sample_rate_hz": "1"}"#;
        assert_eq!(detail(text), r#"expected a number, found the string "1""#);
    }

    #[test]
    fn broken_text_has_row_and_column() {
        let error = refused("{\"sample_rate_hz\": 1,\n\"channels\": {\"a\": [1,, 2]}}");
        assert_eq!(error, FormatError::Json { row: 2, column: 22, detail: "expected value".into() });
        for text in [
            "",
            "[]",
            "{",
            "nul",
            r#"{"sample_rate_hz": 1, "channels": {"a": [1"#,
            r#"{"sample_rate_hz": "1"}"#,
        ] {
            assert_eq!(refused(text).code(), "json.invalid", "{text}");
        }
        let trailing = refused(r#"{"sample_rate_hz": 1, "channels": {"a": [1]}} x"#);
        assert_eq!((trailing.code(), trailing.column()), ("json.invalid", Some(47)));
        for nan in ["NaN", "Infinity"] {
            let error = refused(&format!(r#"{{"sample_rate_hz": 1, "channels": {{"a": [{nan}]}}}}"#));
            assert_eq!(error.code(), "json.invalid", "{nan}");
        }
        // Deep nesting is refused because the types do not nest.
        assert_eq!(refused(&"[".repeat(100_000)).code(), "json.invalid");
        let deep = format!(r#"{{"sample_rate_hz": 1, "channels": {{"a": [{}"#, "[".repeat(100_000));
        assert_eq!(refused(&deep).code(), "json.not_a_number");
    }

    #[test]
    fn what_makes_no_run_is_refused() {
        assert_eq!(refused(r#"{"sample_rate_hz": 1, "channels": {}}"#).code(), "run.no_channels");
        assert_eq!(refused(r#"{"sample_rate_hz": 1, "channels": {"a": []}}"#).code(), "run.empty");
        assert_eq!(refused(r#"{"sample_rate_hz": 0, "channels": {"a": [1]}}"#).code(), "run.sample_rate");
        let error = refused(r#"{"sample_rate_hz": 1, "channels": {"a": [1, 2], "b": [1]}}"#);
        assert_eq!((error.code(), error.channel()), ("run.unequal_lengths", Some("b")));
        let many: Vec<String> = (0..1025).map(|i| format!("\"c{i}\": [1]")).collect();
        let many = format!(r#"{{"sample_rate_hz": 1, "channels": {{{}}}}}"#, many.join(","));
        assert_eq!(refused(&many).code(), "run.too_many_channels");
    }

    proptest! {
        #[test]
        fn what_serde_writes_reads_back(
            channels in (1usize..4, 1usize..20).prop_flat_map(|(c, n)|
                prop::collection::vec(prop::collection::vec(-1e12..1e12f64, n), c)),
            rate in 0.1..1e6f64
        ) {
            let map: Vec<String> = channels
                .iter()
                .enumerate()
                .map(|(i, c)| format!("\"c{i}\": {}", serde_json::to_string(c).unwrap()))
                .collect();
            let text = format!(r#"{{"sample_rate_hz": {rate}, "channels": {{{}}}}}"#, map.join(","));
            let run = read(text.as_bytes()).unwrap();
            prop_assert_eq!(run.channels.len(), channels.len());
            for (found, sent) in run.channels.iter().flatten().zip(channels.iter().flatten()) {
                // The parser's fast path may miss by one unit in the last place.
                prop_assert!((found - sent).abs() <= f64::EPSILON * sent.abs(), "{found} {sent}");
            }
            prop_assert_eq!(run.channels.iter().map(Vec::len).collect::<Vec<_>>(),
                channels.iter().map(Vec::len).collect::<Vec<_>>());
        }

        #[test]
        fn any_bytes_are_read_or_refused(bytes in prop::collection::vec(any::<u8>(), 0..60)) {
            prop_assert!(read(&bytes).is_err(), "60 random bytes are no run");
        }
    }
}
