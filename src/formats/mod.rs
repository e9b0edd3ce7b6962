//! Reading and writing of measurement files, one module per format.
//!
//! Every reader takes the file from memory or piece by piece, and returns a [`ParsedRun`] or a
//! [`FormatError`] with the place of the error. Memory grows with the bytes that arrive: a size that a file
//! declares is compared with them before it is used. Arrays are `[sample, channel]` in files and
//! `[channel][sample]` in memory.

pub mod csv;
mod error;
pub mod json;
pub mod npy;

use std::collections::HashSet;

pub use error::{ChannelAt, FormatError, ReadError};

use crate::engine::first_not_finite;

/// Most channels of a file: a bound on memory per byte (each channel is a vector of its own), far
/// above any rig.
pub const MAX_CHANNELS: usize = 1024;

/// Bytes of a piece of a file.
const PIECE: usize = 64 << 10;

/// Numbers of a piece that is written: a third of a millisecond as text.
pub const NUMBERS_AT_ONCE: usize = 1 << 14;

/// Longest name of a channel: longer than a rig's may be.
pub const MAX_NAME_BYTES: usize = 4096;

/// The content of a measurement file.
#[derive(Debug, Clone, PartialEq)]
pub struct ParsedRun {
    /// Sample rate from the file's field or its time column.
    pub sample_rate_hz: Option<f64>,
    /// Channel names, distinct, where the format has them.
    pub names: Option<Vec<String>>,
    /// Units per channel (empty: none given), where the file has them.
    pub units: Option<Vec<String>>,
    /// `[channel][sample]`: at least one of each, equally long, finite.
    pub channels: Vec<Vec<f64>>,
}

impl ParsedRun {
    /// Checks the rules that all formats share.
    ///
    /// # Errors
    /// The `run.*` codes of [`FormatError`].
    pub(crate) fn check(self) -> Result<Self, FormatError> {
        let at = |index: usize| ChannelAt { index, name: self.names.as_ref().map(|n| n[index].clone()) };
        if self.channels.is_empty() {
            return Err(FormatError::NoChannels);
        }
        check_channel_count(self.channels.len() as u64)?;
        let mut seen = HashSet::new();
        if let Some(name) = self.names.iter().flatten().find(|name| !seen.insert(name.as_str())) {
            return Err(FormatError::DuplicateChannel { name: name.clone() });
        }
        if let Some(found) = self.sample_rate_hz
            && !(found.is_finite() && found > 0.0)
        {
            return Err(FormatError::SampleRate { found });
        }
        let expected = self.channels[0].len();
        for (index, samples) in self.channels.iter().enumerate() {
            if samples.len() != expected {
                return Err(FormatError::UnequalLengths {
                    channel: at(index),
                    expected,
                    found: samples.len(),
                });
            }
        }
        if expected == 0 {
            return Err(FormatError::Empty);
        }
        for (index, samples) in self.channels.iter().enumerate() {
            if let Some(sample) = first_not_finite(samples) {
                return Err(FormatError::NonFinite { channel: at(index), sample, row: None, column: None });
            }
        }
        Ok(self)
    }
}

/// # Errors
/// [`FormatError::LongName`] above [`MAX_NAME_BYTES`].
pub(crate) fn check_name(name: &str) -> Result<(), FormatError> {
    if name.len() > MAX_NAME_BYTES {
        return Err(FormatError::LongName { start: error::excerpt(name) });
    }
    Ok(())
}

/// # Errors
/// [`FormatError::TooManyChannels`] above [`MAX_CHANNELS`].
pub(crate) fn check_channel_count(found: u64) -> Result<(), FormatError> {
    if found > MAX_CHANNELS as u64 {
        return Err(FormatError::TooManyChannels { found, limit: MAX_CHANNELS });
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use std::io::Read;

    use super::*;

    /// A file that comes in pieces of three bytes; the cuts must not change the result.
    pub(super) struct Pieces<'a>(pub &'a [u8]);

    impl Read for Pieces<'_> {
        fn read(&mut self, space: &mut [u8]) -> std::io::Result<usize> {
            let n = space.len().min(3);
            self.0.read(&mut space[..n])
        }
    }

    #[test]
    fn a_file_that_comes_in_pieces_is_the_same_with_the_same_faults() {
        let same = |at_once: Result<ParsedRun, FormatError>, in_pieces: Result<ParsedRun, ReadError>| {
            assert_eq!(at_once, in_pieces.map_err(ReadError::of_bytes));
        };
        for text in ["", "a,b\n1,2\n3,4", "\u{feff}a\r\n1\r\n", "a,b\n1,x", "a\n1\n\n2", "a,a\n1,1"] {
            let file = text.as_bytes();
            same(csv::read(file), csv::read_from(Pieces(file), file.len() as u64));
        }
        for text in [
            r#"{"sample_rate_hz": 5, "channels": {"a": [1, 2.5], "b": [3, 4]}}"#,
            "{\n\"sample_rate_hz\": 5, \"channels\":\n{\"a\": [1, null]}}",
            r#"{"sample_rate_hz": 5, "channels": {"a": [1e999]}}"#,
            r#"{"rate": 5}"#,
            "{",
        ] {
            // The column may be one higher, since a reader looks ahead.
            let told = |error: FormatError| {
                (error.code(), error.row(), error.channel().map(str::to_owned), error.sample())
            };
            let in_pieces = json::read_from(Pieces(text.as_bytes())).map_err(ReadError::of_bytes);
            assert_eq!(json::read(text.as_bytes()).map_err(told), in_pieces.map_err(told));
        }
        let channels = vec![(0..3000).map(f64::from).collect::<Vec<_>>(), vec![0.5; 3000]];
        for order in [npy::Order::C, npy::Order::Fortran] {
            let file = npy::write(&channels, npy::Dtype::F8, order).unwrap();
            for len in [0, 5, 9, 11, 60, file.len() - 1, file.len()] {
                same(npy::read(&file[..len]), npy::read_from(Pieces(&file[..len]), len as u64));
            }
            // Shorter than its length was said to be, as by a failing disk.
            for len in [60, file.len() - 1] {
                let read = npy::read_from(Pieces(&file[..len]), file.len() as u64);
                assert!(matches!(read, Err(ReadError::Io(_))), "{read:?}");
            }
        }
    }

    fn run(names: &[&str], channels: Vec<Vec<f64>>) -> ParsedRun {
        let names = Some(names.iter().map(|n| n.to_string()).collect());
        ParsedRun { sample_rate_hz: None, names, units: None, channels }
    }

    #[test]
    fn what_no_format_may_hold_is_refused_by_name() {
        let code = |run: ParsedRun| run.check().unwrap_err().code();
        assert_eq!(code(run(&[], vec![])), "run.no_channels");
        assert_eq!(code(run(&["a"], vec![vec![]])), "run.empty");
        assert_eq!(code(run(&["a", "a"], vec![vec![1.0], vec![1.0]])), "run.duplicate_channel");
        let many = vec![vec![1.0]; MAX_CHANNELS + 1];
        let error =
            ParsedRun { sample_rate_hz: None, names: None, units: None, channels: many }.check().unwrap_err();
        assert_eq!(error.code(), "run.too_many_channels");
        assert_eq!(error.limit().unwrap(), "at most 1024 channels");

        let error = run(&["a", "b"], vec![vec![1.0, 2.0], vec![1.0]]).check().unwrap_err();
        assert_eq!(
            (error.code(), error.channel(), error.channel_index()),
            ("run.unequal_lengths", Some("b"), Some(1))
        );
        assert_eq!(error.limit().unwrap(), "2 samples");

        let error = run(&["a", "b"], vec![vec![1.0, 2.0], vec![1.0, f64::INFINITY]]).check().unwrap_err();
        assert_eq!((error.code(), error.channel(), error.sample()), ("run.non_finite", Some("b"), Some(1)));

        for rate in [0.0, -1.0, f64::NAN] {
            let run = ParsedRun { sample_rate_hz: Some(rate), ..run(&["a"], vec![vec![1.0]]) };
            assert_eq!(code(run), "run.sample_rate");
        }
    }

    /// Files that other programs wrote.
    #[test]
    fn measured_files_read_whole() {
        let root = std::env::var("RIGCAST_SHARED")
            .unwrap_or_else(|_| concat!(env!("CARGO_MANIFEST_DIR"), "/../shared").into());
        let load = |name: &str| {
            let path = std::path::Path::new(&root).join("data").join(name);
            let file = std::fs::read(&path).ok();
            if file.is_none() {
                println!("skipped: there is no {}", path.display());
            }
            file
        };
        if let Some(file) = load("silverbox/train.csv") {
            let run = csv::read(&file).unwrap();
            assert_eq!(run.names.unwrap(), ["drive", "response"]);
            assert_eq!(run.sample_rate_hz, None);
            // One line a sample under the header.
            assert_eq!(run.channels[0].len(), file.iter().filter(|&&b| b == b'\n').count() - 1);
            assert_eq!((run.channels[0][0], run.channels[1][0]), (-0.0145043307, 0.0364508525));
        }
        if let Some(file) = load("multiaxis_shaker/run1.npy") {
            let run = npy::read(&file).unwrap();
            assert_eq!((run.channels.len(), run.channels[0].len()), (12, 102_000));
            let again = npy::write(&run.channels, npy::Dtype::F4, npy::Order::C).unwrap();
            assert_eq!(again[again.len() - 4 * 12 * 102_000..], file[file.len() - 4 * 12 * 102_000..]);
        }
    }
}
