//! Writing CSV piece by piece, so that a table of any length takes the memory of a few thousand rows.

use std::io;
use std::ops::Range;

use super::write::{head, rows};
use crate::engine::Samples;
use crate::formats::FormatError;
use crate::formats::pieces::RowBlocks;

/// The first column of a table: the time of each row.
#[derive(Debug, Clone, PartialEq)]
pub struct TimeOfRows {
    /// Name of the column; its unit is `s`.
    pub name: String,
    /// Number of the first sample, counted from time zero.
    pub first: usize,
}

impl TimeOfRows {
    /// Times from the sample `first` on, in a column `time_s`; none where a channel has that name already.
    pub fn beside(names: &[String], first: usize) -> Option<Self> {
        const NAME: &str = "time_s";
        (!names.iter().any(|name| name == NAME)).then(|| Self { name: NAME.into(), first })
    }
}

/// The pieces of a table.
#[derive(Debug)]
pub struct CsvPieces<S> {
    head: Vec<u8>,
    time: Option<usize>,
    blocks: RowBlocks<S>,
}

impl<S: Samples> CsvPieces<S> {
    /// A table of samples with these names and units, with the rows that [`write`](super::write()) makes.
    ///
    /// # Errors
    /// `csv.header` for a channel named like a number; names or units that are not one a channel.
    pub fn new(
        mut names: Vec<String>,
        mut units: Vec<String>,
        time: Option<TimeOfRows>,
        samples: S,
    ) -> Result<Self, FormatError> {
        let columns = samples.n_channels() + usize::from(time.is_some());
        if let Some(time) = &time {
            names.insert(0, time.name.clone());
            units.insert(0, "s".into());
        }
        let head = head(&names, Some(&units), columns)?;
        Ok(Self { head, time: time.map(|time| time.first), blocks: RowBlocks::new(samples) })
    }

    fn piece(&mut self, range: Range<usize>, mut block: Vec<Vec<f64>>) -> Vec<u8> {
        if let Some(first) = self.time {
            let rate = self.blocks.samples().sample_rate_hz();
            block.insert(0, range.map(|i| (first + i) as f64 / rate).collect());
        }
        let columns: Vec<&[f64]> = block.iter().map(Vec::as_slice).collect();
        let mut text = std::mem::take(&mut self.head);
        rows(&mut text, &columns);
        text
    }
}

impl<S: Samples> Iterator for CsvPieces<S> {
    type Item = io::Result<Vec<u8>>;

    fn next(&mut self) -> Option<io::Result<Vec<u8>>> {
        let block = self.blocks.next()?;
        Some(block.map(|(range, block)| self.piece(range, block)))
    }
}

#[cfg(test)]
mod tests {
    use super::super::write;
    use super::*;
    use crate::engine::Signal;
    use crate::formats::NUMBERS_AT_ONCE;

    #[test]
    fn pieces_make_the_table_of_the_whole() {
        let (names, units) = (["a;b".to_owned(), "c".into()], ["kN".to_owned(), "1".into()]);
        for n in [0, 1, NUMBERS_AT_ONCE / 2, NUMBERS_AT_ONCE / 2 + 1, 3 * NUMBERS_AT_ONCE] {
            let channel =
                |k: f64| (0..n).map(move |i| (k * i as f64).sin() * 1e10_f64.powi(i as i32 % 7 - 3));
            let channels: Vec<Vec<f64>> = vec![channel(1.0).collect(), channel(2.0).collect()];
            let pieces = |time| {
                let signal = Signal::new(8.0, channels.clone()).unwrap();
                CsvPieces::new(names.to_vec(), units.to_vec(), time, signal).unwrap()
            };
            let text: Vec<Vec<u8>> = pieces(None).collect::<io::Result<_>>().unwrap();
            assert_eq!(text.len(), n.div_ceil(NUMBERS_AT_ONCE / 2).max(1));
            assert!(text.concat() == write(&names, Some(&units), &channels).unwrap(), "{n} samples");
            let time = (0..n).map(|i| (5 + i) as f64 / 8.0).collect();
            let timed = [vec![time], channels.clone()].concat();
            let of = |first: &str, rest: &[String; 2]| [&[first.to_owned()][..], rest].concat();
            let whole = write(&of("time_s", &names), Some(&of("s", &units)), &timed).unwrap();
            let text: io::Result<Vec<_>> =
                pieces(Some(TimeOfRows { name: "time_s".into(), first: 5 })).collect();
            assert!(text.unwrap().concat() == whole, "{n} samples");
        }
    }

    #[test]
    fn a_channel_named_like_a_number_is_refused_before_the_first_piece() {
        let signal = Signal::new(8.0, vec![vec![0.0]]).unwrap();
        let refused = CsvPieces::new(vec!["1".into()], vec![String::new()], None, signal);
        assert_eq!(refused.map(drop).unwrap_err().code(), "csv.header");
    }
}
