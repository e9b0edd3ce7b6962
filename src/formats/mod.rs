//! Reading and writing of measurement files, one module per format.
//!
//! Every reader takes the file from memory or piece by piece, and returns a [`ParsedRun`] or a
//! [`FormatError`] with the place of the error. Samples go to memory or to a [`Spool`], whose memory does not
//! grow with them. A size that a file declares is compared with the bytes that arrive before it is used.
//! Arrays are `[sample, channel]` in files and `[channel][sample]` in memory.

pub mod csv;
mod error;
pub mod form_data;
mod format;
pub mod hdf5;
pub mod json;
mod labels;
pub mod mat;
pub mod npy;
pub mod npz;
mod numbers;
mod pieces;
pub mod rpc3;
mod spool;
mod step;
mod times;
pub mod uff58;
mod unpacked;
mod variables;

use std::collections::HashSet;
use std::io;

use times::{Even, Rounding};

pub use error::{ChannelAt, FormatError, ReadError, UffPlace};
pub use format::Format;
pub use spool::{Spool, SpooledSamples};

/// Most channels of a file: a bound on memory per byte (each channel is a vector of its own), far
/// above any rig.
pub const MAX_CHANNELS: usize = 1024;

/// Bytes of a piece of a file.
const PIECE: usize = 64 << 10;

/// Numbers of a piece that is written: a third of a millisecond as text.
pub const NUMBERS_AT_ONCE: usize = 1 << 14;

/// Longest name of a channel: longer than a rig's may be.
pub const MAX_NAME_BYTES: usize = 4096;

/// The content of a measurement file, its samples in memory unless they are in a [`Spool`].
#[derive(Debug, Clone, PartialEq)]
pub struct ParsedRun<C = Vec<Vec<f64>>> {
    /// Sample rate from the file's field or its time column.
    pub sample_rate_hz: Option<f64>,
    /// Largest relative error of the sample rate by times that are rounded in the file.
    pub sample_rate_error: f64,
    /// Channel names, distinct, where the format has them.
    pub names: Option<Vec<String>>,
    /// Units per channel (empty: none given), where the file has them.
    pub units: Option<Vec<String>>,
    /// `[channel][sample]`: at least one of each, equally long, finite.
    pub channels: C,
    /// What the reader left out, or what of the file may be meant otherwise: a sentence each.
    pub notes: Vec<String>,
    /// The digits that the first column of a file without names is written with.
    first_column: Rounding,
}

/// Fewest samples of a column that are told to be times.
const TIMES: usize = 3;

impl ParsedRun<Spool> {
    /// A run of which the file tells the samples only.
    pub(crate) fn of(channels: Spool) -> Self {
        Self {
            sample_rate_hz: None,
            sample_rate_error: 0.0,
            names: None,
            units: None,
            channels,
            notes: Vec::new(),
            first_column: Rounding::NONE,
        }
    }

    /// Samples per unit of the first column, if it rises in even steps as times or numbers of samples do, and the largest
    /// relative error of that by rounded values.
    ///
    /// # Errors
    /// Those of the file of the samples.
    pub fn even_first_column(&self) -> io::Result<Option<(f64, f64)>> {
        if self.channels.n_columns() == 0 || self.channels.len(0) < TIMES {
            return Ok(None);
        }
        Ok(match times::rate(&self.channels, self.first_column, 1.0)? {
            Even::Rate { rate_hz, error } => Some((rate_hz, error)),
            Even::Single | Even::Not { .. } => None,
        })
    }

    /// Checks the rules that all formats share.
    ///
    /// # Errors
    /// The `run.*` codes of [`FormatError`].
    pub(crate) fn check(self) -> Result<Self, FormatError> {
        let at = |index: usize| ChannelAt { index, name: self.names.as_ref().map(|n| n[index].clone()) };
        let channels = self.channels.n_columns();
        if channels == 0 {
            return Err(FormatError::NoChannels);
        }
        check_channel_count(channels as u64)?;
        let mut seen = HashSet::new();
        if let Some(name) = self.names.iter().flatten().find(|name| !seen.insert(name.as_str())) {
            return Err(FormatError::DuplicateChannel { name: name.clone() });
        }
        if let Some(found) = self.sample_rate_hz
            && !(found.is_finite() && found > 0.0)
        {
            return Err(FormatError::SampleRate { found });
        }
        let expected = self.channels.len(0);
        for index in 0..channels {
            let found = self.channels.len(index);
            if found != expected {
                return Err(FormatError::UnequalLengths { channel: at(index), expected, found });
            }
        }
        if expected == 0 {
            return Err(FormatError::Empty);
        }
        for index in 0..channels {
            if let Some(sample) = self.channels.first_not_finite(index) {
                return Err(FormatError::NonFinite { channel: at(index), sample, row: None, column: None });
            }
        }
        Ok(self)
    }

    /// The run of a spool in memory.
    pub(crate) fn into_memory(self) -> ParsedRun {
        let Self { sample_rate_hz, sample_rate_error, names, units, channels, notes, first_column } = self;
        ParsedRun {
            sample_rate_hz,
            sample_rate_error,
            names,
            units,
            channels: channels.into_columns(),
            notes,
            first_column,
        }
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
    use crate::measured::shared_data;

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
        let same = |at_once: Result<ParsedRun, FormatError>,
                    in_pieces: Result<ParsedRun<Spool>, ReadError>| {
            assert_eq!(at_once, in_pieces.map(ParsedRun::into_memory).map_err(ReadError::of_bytes));
        };
        for text in ["", "a,b\n1,2\n3,4", "\u{feff}a\r\n1\r\n", "a,b\n1,x", "a\n1\n\n2", "a,a\n1,1"] {
            let file = text.as_bytes();
            same(csv::read(file), csv::read_from(Pieces(file), Spool::in_memory()));
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
            let in_pieces = json::read_from(Pieces(text.as_bytes()), Spool::in_memory());
            let in_pieces = in_pieces.map(ParsedRun::into_memory).map_err(ReadError::of_bytes);
            assert_eq!(json::read(text.as_bytes()).map_err(told), in_pieces.map_err(told));
        }
        let channels = vec![(0..3000).map(f64::from).collect::<Vec<_>>(), vec![0.5; 3000]];
        for order in [npy::Order::C, npy::Order::Fortran] {
            let file = npy::write(&channels, npy::Dtype::F8, order).unwrap();
            for len in [0, 5, 9, 11, 60, file.len() - 1, file.len()] {
                let in_pieces = npy::read_from(Pieces(&file[..len]), len as u64, Spool::in_memory());
                same(npy::read(&file[..len]), in_pieces);
            }
            // Shorter than its length was said to be, as by a failing disk.
            for len in [60, file.len() - 1] {
                let read = npy::read_from(Pieces(&file[..len]), file.len() as u64, Spool::in_memory());
                assert!(matches!(read, Err(ReadError::Io(_))), "{read:?}");
            }
        }
    }

    /// Every format's samples go through a spool, whatever its place.
    #[test]
    fn a_file_that_goes_through_a_spool_on_disk_is_the_same_with_the_same_faults() {
        let directory = tempfile::tempdir().unwrap();
        let spool = || Spool::in_file(directory.path());
        let channels: Vec<Vec<f64>> =
            [0.25, 3.0].map(|k| (0..10_000).map(|i| (k * f64::from(i)).sin()).collect()).to_vec();
        let mut bad = channels.clone();
        (bad[0][9_990], bad[1][5_000]) = (f64::INFINITY, f64::NAN);
        let read = |run: ParsedRun<Spool>| {
            let mut found = vec![Vec::new(); run.channels.n_columns()];
            for (c, to) in found.iter_mut().enumerate() {
                run.channels.read(c, 0..run.channels.len(c), to).unwrap();
            }
            (run.sample_rate_hz, run.names, run.units, found)
        };
        let same = |at_once: Result<ParsedRun, FormatError>, spooled: Result<ParsedRun<Spool>, ReadError>| {
            let at_once = at_once.map(|run| (run.sample_rate_hz, run.names, run.units, run.channels));
            assert_eq!(at_once, spooled.map(read).map_err(ReadError::of_bytes));
        };
        for order in [npy::Order::C, npy::Order::Fortran] {
            let mut file = npy::write(&channels, npy::Dtype::F8, order).unwrap();
            same(npy::read(&file), npy::read_from(&file[..], file.len() as u64, spool()));
            let start = file.len() - 16 * channels[0].len();
            for (c, bad) in bad.iter().enumerate() {
                for (i, v) in bad.iter().enumerate() {
                    let at = if order == npy::Order::C { 2 * i + c } else { c * bad.len() + i };
                    file[start + 8 * at..][..8].copy_from_slice(&v.to_le_bytes());
                }
            }
            let refused = npy::read(&file).unwrap_err();
            assert_eq!((refused.channel_index(), refused.sample()), (Some(0), Some(9_990)));
            same(Err(refused), npy::read_from(&file[..], file.len() as u64, spool()));
        }
        let names = ["time_s".to_owned(), "u".into(), "y".into()];
        let table = |late: f64| {
            let time = (0..10_000).map(|i| 5.0 + f64::from(i) / 100.0 + if i == 9_000 { late } else { 0.0 });
            let columns = [vec![time.collect()], channels.clone()].concat();
            csv::write(&names, Some(&["s".to_owned(), "kN".into(), "mm".into()]), &columns).unwrap()
        };
        for late in [0.0, 0.004] {
            let file = table(late);
            assert_eq!(csv::read(&file).err().and_then(|e| e.row()), (late > 0.0).then_some(9_003));
            same(csv::read(&file), csv::read_from(&file[..], spool()));
        }
        let text = |c: &Vec<f64>| serde_json::to_string(c).unwrap();
        for longer in ["", ",1.5"] {
            let (u, y) = (text(&channels[0]), text(&channels[1]));
            let y = format!("{}{longer}]", &y[..y.len() - 1]);
            let file = format!(r#"{{"sample_rate_hz": 5, "channels": {{"u": {u}, "y": {y}}}}}"#);
            same(json::read(file.as_bytes()), json::read_from(file.as_bytes(), spool()));
        }
        assert_eq!(std::fs::read_dir(directory.path()).unwrap().count(), 0, "nothing is left behind");
    }

    fn spooled(channels: Vec<Vec<f64>>) -> Spool {
        let mut spool = Spool::in_memory();
        spool.add_columns(channels.len());
        for (c, samples) in channels.into_iter().enumerate() {
            spool.extend(c, samples).unwrap();
        }
        spool
    }

    fn run(names: &[&str], channels: Vec<Vec<f64>>) -> ParsedRun<Spool> {
        let names = Some(names.iter().map(|n| n.to_string()).collect());
        ParsedRun { names, ..ParsedRun::of(spooled(channels)) }
    }

    #[test]
    fn what_no_format_may_hold_is_refused_by_name() {
        let code = |run: ParsedRun<Spool>| run.check().unwrap_err().code();
        assert_eq!(code(run(&[], vec![])), "run.no_channels");
        assert_eq!(code(run(&["a"], vec![vec![]])), "run.empty");
        assert_eq!(code(run(&["a", "a"], vec![vec![1.0], vec![1.0]])), "run.duplicate_channel");
        let many = spooled(vec![vec![1.0]; MAX_CHANNELS + 1]);
        let error = ParsedRun::of(many).check().unwrap_err();
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
        let load = |name: &str| shared_data(name).map(|path| std::fs::read(path).unwrap());
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
