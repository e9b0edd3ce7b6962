//! A fast parser for JSON bodies that are mostly numbers.
//!
//! The arrays of the signals are lifted out of the document, and all threads parse their numbers. The
//! rest is small and goes through the strict parser. If the fast parser meets anything wrong, the whole
//! document goes through the strict parser, which reports the error and its place.

use memchr::{memchr, memchr_iter};
use rayon::prelude::*;
use serde::de::DeserializeOwned;

use super::json::{self, PARSE_HERE_BYTES};
use super::signals::Channels;
use crate::http::codes;
use crate::http::problem::{Answer, FieldError, Problem};

/// Bytes of numbers that one thread parses at a time.
const STRETCH_BYTES: usize = 1 << 16;

/// Deepest nesting for the fast parser; deeper documents go through the strict one.
const MAX_DEPTH: usize = 16;

/// Largest number of arrays that are lifted; a valid body has fewer.
const MAX_ARRAYS: usize = 1024;

/// Largest number of values of a document. With it, the values and the document take at most 64 MiB plus
/// four times its bytes.
const MAX_VALUES: usize = 31_000_000;

/// The key of objects that hold signals, at any depth.
const CHANNELS: &[u8] = b"channels";

/// A body that holds signals, each under the key `channels`.
pub trait HoldsSignals: DeserializeOwned {
    /// All signals of the body, in the order of the document.
    fn signals(&mut self) -> Vec<&mut Channels>;
}

/// Parses a document; a long one on all threads of the caller's pool.
///
/// # Errors
/// As [`json::parse`]; `body.too_large` for too many values.
pub fn parse<T: HoldsSignals>(bytes: &[u8]) -> Answer<T> {
    // Shorter documents cannot hold that many values.
    if bytes.len() >= 2 * MAX_VALUES && memchr_iter(b',', bytes).count() >= MAX_VALUES {
        let limit = format!("{MAX_VALUES} values");
        return Err(Problem::new(codes::BODY_TOO_LARGE, format!("The body holds more than {limit}."))
            .with(FieldError::new("", limit)));
    }
    match quick(bytes) {
        Some(value) => Ok(value),
        None => json::parse(bytes),
    }
}

fn quick<T: HoldsSignals>(bytes: &[u8]) -> Option<T> {
    let Lifted { rest, arrays } = lift(std::str::from_utf8(bytes).ok()?)?;
    let mut value: T = json::parse(rest.as_bytes()).ok()?;
    let mut arrays: Vec<Option<Vec<f64>>> =
        read(&arrays, bytes.len() > PARSE_HERE_BYTES)?.into_iter().map(Some).collect();
    // Every array under that key was lifted and replaced by its index in the list. A single number in
    // place of an array was not lifted and would be taken for an index.
    if value.signals().iter().map(|channels| channels.0.len()).sum::<usize>() != arrays.len() {
        return None;
    }
    for (_, samples) in value.signals().into_iter().flat_map(|channels| &mut channels.0) {
        let [place] = samples[..] else { return None };
        *samples = arrays.get_mut(place as usize)?.take()?;
    }
    Some(value)
}

/// A document without the arrays of its signals.
struct Lifted<'a> {
    /// The document; each lifted array holds only its index in `arrays`.
    rest: String,
    /// The text between the brackets of each array.
    arrays: Vec<&'a str>,
}

/// Lifts every array that is a direct value of an object under the key `channels`. Gives `None` for a
/// document that it cannot follow. The rest may still be no JSON.
fn lift(text: &str) -> Option<Lifted<'_>> {
    let bytes = text.as_bytes();
    let (mut rest, mut arrays) = (String::new(), Vec::new());
    // For each open bracket: whether it belongs to an object that holds signals.
    let mut open: Vec<bool> = Vec::new();
    let mut string: &[u8] = &[];
    let (mut at, mut copied) = (0, 0);
    while let Some(&byte) = bytes.get(at) {
        match byte {
            b'"' => {
                let start = at + 1;
                at = end_of_string(bytes, start)?;
                string = &bytes[start..at];
            }
            b'[' if open.last() == Some(&true) => {
                if arrays.len() == MAX_ARRAYS {
                    return None;
                }
                let end = at + memchr(b']', &bytes[at..])?;
                rest.push_str(&text[copied..=at]);
                rest.push_str(&arrays.len().to_string());
                arrays.push(&text[at + 1..end]);
                (at, copied) = (end, end);
            }
            b'{' => open.push(string == CHANNELS),
            b'[' | b'}' | b']' | b',' => {
                if byte == b'[' {
                    open.push(false);
                } else if byte != b',' {
                    open.pop()?;
                }
                // The next value does not belong to the last string.
                string = &[];
            }
            _ => {}
        }
        if open.len() > MAX_DEPTH {
            return None;
        }
        at += 1;
    }
    rest.push_str(&text[copied..]);
    Some(Lifted { rest, arrays })
}

/// Index of the quotation mark that ends a string.
fn end_of_string(bytes: &[u8], start: usize) -> Option<usize> {
    let mut at = start;
    loop {
        match bytes.get(at)? {
            b'"' => return Some(at),
            b'\\' => at += 2,
            _ => at += 1,
        }
    }
}

/// The numbers of all arrays.
fn read(arrays: &[&str], on_all_threads: bool) -> Option<Vec<Vec<f64>>> {
    let counted: Vec<Vec<(&str, usize)>> =
        arrays.iter().map(|text| stretches(text).map(|s| (s, commas(s) + 1)).collect()).collect();
    // Each part is parsed into its final place, so that the numbers are in memory once.
    let mut found: Vec<Vec<f64>> =
        counted.iter().map(|stretches| vec![0.0; stretches.iter().map(|(_, n)| n).sum()]).collect();
    let mut places = Vec::new();
    for (stretches, samples) in counted.iter().zip(&mut found) {
        let mut rest = &mut samples[..];
        for (text, n) in stretches {
            let (place, after) = rest.split_at_mut(*n);
            places.push((*text, place));
            rest = after;
        }
    }
    let read = if on_all_threads {
        places.into_par_iter().try_for_each(|(text, place)| numbers(text, place))
    } else {
        places.into_iter().try_for_each(|(text, place)| numbers(text, place))
    };
    read.map(|()| found)
}

fn commas(text: &str) -> usize {
    memchr_iter(b',', text.as_bytes()).count()
}

/// The text between brackets, cut at commas into parts; none for an empty array.
fn stretches(text: &str) -> impl Iterator<Item = &str> {
    let mut left = (!text.trim_ascii().is_empty()).then_some(text);
    std::iter::from_fn(move || {
        let text = left?;
        let comma = text
            .as_bytes()
            .get(STRETCH_BYTES..)
            .and_then(|rest| Some(STRETCH_BYTES + memchr(b',', rest)?))
            .filter(|&comma| text.is_char_boundary(comma));
        left = comma.map(|comma| &text[comma + 1..]);
        Some(comma.map_or(text, |comma| &text[..comma]))
    })
}

/// Parses comma-separated numbers into `places`, one for each. Gives `None` for anything else, and for
/// numbers beyond the range of 64 bits.
fn numbers(text: &str, places: &mut [f64]) -> Option<()> {
    let bytes = text.as_bytes();
    let mut at = 0;
    for place in places {
        at = blanks(bytes, at);
        let end = number(bytes, at)?;
        // The standard library rounds correctly. It accepts more than JSON, but `number` has checked the
        // text.
        *place = text[at..end].parse().ok().filter(|v: &f64| v.is_finite())?;
        at = blanks(bytes, end);
        match bytes.get(at) {
            None => {}
            Some(b',') => at += 1,
            Some(_) => return None,
        }
    }
    Some(())
}

fn blanks(bytes: &[u8], at: usize) -> usize {
    at + bytes[at..].iter().take_while(|b| matches!(b, b' ' | b'\t' | b'\n' | b'\r')).count()
}

/// End of the JSON number (RFC 8259, section 6) that begins at `start`.
fn number(bytes: &[u8], start: usize) -> Option<usize> {
    let digits = |at: usize| {
        let count = bytes[at..].iter().take_while(|b| b.is_ascii_digit()).count();
        (count > 0).then_some(at + count)
    };
    let mut at = start + usize::from(bytes.get(start) == Some(&b'-'));
    at = if bytes.get(at) == Some(&b'0') { at + 1 } else { digits(at)? };
    if bytes.get(at) == Some(&b'.') {
        at = digits(at + 1)?;
    }
    if let Some(b'e' | b'E') = bytes.get(at) {
        at += 1;
        at = digits(at + usize::from(matches!(bytes.get(at), Some(b'+' | b'-'))))?;
    }
    Some(at)
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;
    use serde::Deserialize;

    use super::*;

    #[derive(Debug, PartialEq, Deserialize)]
    #[serde(deny_unknown_fields)]
    struct Body {
        drive: Part,
        #[serde(default)]
        target: Option<Part>,
        #[serde(default)]
        names: Vec<String>,
        #[serde(default)]
        limits: Vec<f64>,
    }

    #[derive(Debug, PartialEq, Deserialize)]
    #[serde(deny_unknown_fields)]
    struct Part {
        #[serde(default)]
        channels: Channels,
    }

    impl HoldsSignals for Body {
        fn signals(&mut self) -> Vec<&mut Channels> {
            std::iter::once(&mut self.drive).chain(&mut self.target).map(|p| &mut p.channels).collect()
        }
    }

    /// The result of the strict parser, and whether the fast parser accepted the text.
    fn both(text: &str) -> (Result<Body, String>, bool) {
        let strict = json::parse::<Body>(text.as_bytes()).map_err(|p| p.code().to_owned());
        let quick = quick::<Body>(text.as_bytes());
        let taken = quick.is_some();
        if let Some(quick) = quick {
            assert_eq!(Ok(&quick), strict.as_ref(), "{text}");
        }
        (strict, taken)
    }

    #[test]
    fn signals_are_the_same_either_way() {
        for text in [
            r#"{"drive": {"channels": {"a": [1, -2.5e-3 , 0], "b": []}}}"#,
            r#"{"target": {"channels": {"a": [1]}}, "drive": {"channels": {"a": [0.1,2e0]}}, "limits": [0, 1]}"#,
            "{\"drive\":{\"channels\":{\"a\":[\n1,\r\t2 ],\"b\":[ ]}}}",
            r#"{"drive": {"channels": {"channels": [-0, 5e-324], "]\"[": [1.7976931348623157e308]}}}"#,
            r#"{"names": ["channels", "[", "]"], "drive": {"channels": {}}}"#,
            r#"{"names": ["channels"], "drive": {}, "limits": [7]}"#,
            r#"{"drive": {"channels": {"a": [0.1000000000000000055511151231257827021181583404541015625]}}}"#,
        ] {
            let (strict, quick) = both(text);
            assert!(strict.is_ok() && quick, "{text}: {strict:?}");
        }
    }

    #[test]
    fn whatever_is_wrong_goes_the_strict_way() {
        let numbers = [
            "01", "+1", ".5", "1.", "1.e5", "1e", "-", "--1", "1 2", "1,", ",1", "1,,2", "0x1", "1_0", "NaN",
            "inf", "Infinity", "1e999", "-1e400", "null", "\"1\"", "[1]", "{}", "true", "\u{a0}1", "1\u{0}",
        ];
        for number in numbers {
            let text = format!(r#"{{"drive": {{"channels": {{"a": [0.5, {number}]}}}}}}"#);
            let (strict, quick) = both(&text);
            assert!(strict.is_err() && !quick, "{text}: {strict:?}");
        }
        for text in [
            "",
            "[]",
            r#"{"drive": {"channels": {"a": [1"#,
            r#"{"drive": {"channels": {"a": [1]}}} x"#,
            r#"{"drive": {"channels": {"a": [1], "a": [2]}}}"#,
            r#"{"drive": {"channels": {"a": "1"}}}"#,
            r#"{"drive": {"channels": {"a": {}}}}"#,
            r#"{"drive": {"channels": [[1]]}}"#,
            r#"{"drive": {"canals": {"a": [1]}}}"#,
            r#"{"drive": {"channels": {"a": {"channels": {"b": [1]}}}}}"#,
        ] {
            assert!(both(text).0.is_err(), "{text}");
        }
        assert!(quick::<Body>(b"{\"drive\": {\"channels\": {\"a\xff\": [1]}}}").is_none(), "bad UTF-8");
    }

    #[test]
    fn a_single_number_is_a_signal_of_one_sample_and_no_array_is_lost() {
        for text in [
            r#"{"drive": {"channels": {"a": 0}}}"#,
            r#"{"drive": {"channels": {"a": 0, "b": [7]}}}"#,
            r#"{"drive": {"channels": {"b": [7, 8], "a": 0}}, "target": {"channels": {"c": 1}}}"#,
        ] {
            let (strict, quick) = both(text);
            assert!(!quick, "{text}");
            let drive = strict.expect(text).drive.channels;
            assert_eq!(drive.0.iter().find(|(name, _)| name == "a").expect("a").1, [0.0], "{text}");
        }
    }

    #[test]
    fn long_arrays_are_cut_at_commas_only() {
        let samples: Vec<f64> = (0..30_000).map(|i| (f64::from(i) * 0.37).sin() * 1e-3).collect();
        let text = samples.iter().map(|v| format!(" {v} ")).collect::<Vec<_>>().join(",");
        assert!(stretches(&text).count() > 5);
        assert_eq!(read(&[&text, " "], true), Some(vec![samples.clone(), vec![]]));
        assert_eq!(read(&[&text, "", &text], false), Some(vec![samples.clone(), vec![], samples]));
        assert_eq!(read(&[&format!("{text},")], true), None);
    }

    #[test]
    fn more_values_than_memory_may_take_are_refused_by_their_number() {
        let refused = |values: usize| {
            let body = format!("{{\"drive\": {{\"channels\": {{\"a\": [{}1]}}", "1,".repeat(values - 1));
            parse::<Body>(body.as_bytes()).map_err(|problem| problem.code().to_owned())
        };
        assert_eq!(refused(MAX_VALUES), Err("body.syntax".to_owned()), "a bracket is missing");
        assert_eq!(refused(MAX_VALUES + 1), Err("body.too_large".to_owned()));
    }

    proptest! {
        #[test]
        fn numbers_have_the_same_bits_either_way(
            samples in prop::collection::vec(prop::num::f64::NORMAL | prop::num::f64::SUBNORMAL, 1..50)
        ) {
            let text = serde_json::to_string(&samples).unwrap();
            let found = read(&[&text[1..text.len() - 1]], false).unwrap().remove(0);
            let strict: Vec<f64> = serde_json::from_str(&text).unwrap();
            for ((sample, found), strict) in samples.iter().zip(&found).zip(&strict) {
                prop_assert_eq!(sample.to_bits(), found.to_bits());
                prop_assert_eq!(sample.to_bits(), strict.to_bits());
            }
        }

        #[test]
        fn any_text_is_read_as_the_strict_way_reads_it(
            text in r#"[\[\]{}",:0-9e.+\- a]{0,12}"#, inside in 0usize..3
        ) {
            let text = match inside {
                0 => text,
                1 => format!(r#"{{"drive": {{"channels": {{"a": [{text}]}}}}}}"#),
                _ => format!(r#"{{"drive": {{"channels": {{{text}}}}}}}"#),
            };
            let _ = both(&text);
        }
    }
}
