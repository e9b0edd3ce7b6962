//! CSV as laboratories write it: titles, a header row of channel names, an optional units row, an optional time
//! column, then one row per sample.
//!
//! - Text is UTF-8, UTF-16 with its byte order mark, or Windows-1252.
//! - Cells are separated by a tab, `;` or `,`: the first of these, in this order, that the row above the first
//!   samples has outside quotes, or the one that a first line `sep=;` names.
//! - Blanks separate where rows of numbers have no other separator; several count as one.
//! - Rows above the header are passed over. A file whose first row is all numbers has no header; its channels have
//!   no names.
//! - A units row is a row below the header without any number; brackets around a unit are left off.
//! - Decimals have a point or a comma, the same in the whole file, and thousands may be grouped.
//! - A time column is one named `time`, `t` or `zeit`, with or without `_s`, `_ms` or a unit in brackets, or else
//!   the one column with the unit `s`, or columns of date-times. It must rise in even steps, and gives the sample
//!   rate; times may be rounded.
//! - CRLF, separators at the end of all rows and empty lines at the end are accepted. An empty line between samples
//!   is refused, since it may be a lost sample.

mod blanks;
mod clock;
mod head;
mod layout;
mod number;
mod pieces;
mod rows;
mod stamp;
mod time;
mod write;

use std::io::Read;

use super::error::excerpt;
use super::times::Rounding;
use super::{ChannelAt, FormatError, ParsedRun, ReadError, Spool};
use clock::ClockColumns;
use head::Head;
use number::{Fault, Numbers, trim};
use rows::Rows;
use stamp::stamp;
use time::TimeColumn;

pub use pieces::{CsvPieces, TimeOfRows};
pub use write::{head, rows, write};

/// Reads a file.
///
/// # Errors
/// The `csv.*` codes with row and column; `run.*` codes with channel and sample.
pub fn read(file: &[u8]) -> Result<ParsedRun, FormatError> {
    read_from(file, Spool::in_memory()).map(ParsedRun::into_memory).map_err(ReadError::of_bytes)
}

/// [`read`] for a file that is not in memory: only a piece of it is kept at a time, and its samples go to an
/// empty spool.
///
/// # Errors
/// As [`read`]; errors of the file system.
pub fn read_from(file: impl Read, spool: Spool) -> Result<ParsedRun<Spool>, ReadError> {
    let mut rows = Rows::new(file)?;
    let mut table = Table::begin(&mut rows, spool)?;
    loop {
        table.take(&rows)?;
        if !rows.next()? {
            return table.finish();
        }
    }
}

/// The use of a column.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Use {
    /// The samples of the channel with this index.
    Channel(usize),
    Time,
    /// A date or a time of the day.
    Stamp,
}

/// The column or columns that give the sample rate.
enum Axis {
    None,
    Time(TimeColumn),
    Clock(ClockColumns),
}

/// The columns read so far.
struct Table {
    numbers: Numbers,
    head: Head,
    columns: Vec<Use>,
    axis: Axis,
    channels: Spool,
    /// One column: the time of each sample, where the file has it.
    times: Spool,
    rounding: Rounding,
    /// Digits of the first column of a file without names.
    first_column: Rounding,
    /// Samples of each channel.
    samples: usize,
    /// Line of the first sample.
    first_row: u64,
}

impl Table {
    /// A table without samples, the first row of which is the current one.
    fn begin(rows: &mut Rows<impl Read>, spool: Spool) -> Result<Self, ReadError> {
        let numbers = Numbers::new(rows.layout().separator);
        let head = head::read(rows, &numbers)?;
        let width = head.names.as_ref().map_or_else(|| rows.cells().trimmed_len().max(1), Vec::len);
        rows.begin_samples(width);
        let is_stamp = |cell| !numbers.looks_like_one(cell) && stamp(cell).is_some();
        let mut stamps: Vec<bool> = rows.cells().iter().take(width).map(is_stamp).collect();
        stamps.resize(width, false);
        let time = match &head.names {
            Some(names) => TimeColumn::find(names, head.units.as_deref(), &stamps, head.row)?,
            None => None,
        };
        let axis = match time {
            Some(time) => Axis::Time(time),
            None => ClockColumns::find(rows, &stamps)?.map_or(Axis::None, Axis::Clock),
        };
        let mut n = 0;
        let columns = stamps.iter().enumerate().map(|(column, stamp)| match time {
            _ if *stamp => Use::Stamp,
            Some(time) if time.column == column => Use::Time,
            _ => {
                n += 1;
                Use::Channel(n - 1)
            }
        });
        let columns = columns.collect();
        let (mut times, mut channels) = (spool.another(), spool);
        times.add_columns(1);
        channels.add_columns(n);
        let rounding = Rounding::default();
        Ok(Self {
            numbers,
            head,
            columns,
            axis,
            channels,
            times,
            rounding,
            first_column: rounding,
            samples: 0,
            first_row: rows.row(),
        })
    }

    /// Adds one row of samples.
    fn take(&mut self, rows: &Rows<impl Read>) -> Result<(), ReadError> {
        self.check_width(rows)?;
        for (column, cell) in rows.cells().iter().take(self.columns.len()).enumerate() {
            let place = self.columns[column];
            if place == Use::Stamp {
                continue;
            }
            let value = self.value(cell, rows.row(), column)?;
            match place {
                Use::Channel(channel) => {
                    // It may turn out to be the times of a file without names.
                    if column == 0 && self.head.names.is_none() {
                        self.first_column.add(number::digits(cell).unwrap_or_default());
                    }
                    self.channels.push(channel, value)?;
                }
                _ => {
                    self.rounding.add(number::digits(cell).unwrap_or_default());
                    self.times.push(0, value)?;
                }
            }
        }
        if let Axis::Clock(clock) = &mut self.axis {
            let (seconds, decimals) = clock.read(rows)?;
            self.rounding.add_decimals(decimals);
            self.times.push(0, seconds)?;
        }
        self.samples += 1;
        Ok(())
    }

    /// Cells beyond the columns must be empty: the end of a row may have separators.
    fn check_width(&self, rows: &Rows<impl Read>) -> Result<(), FormatError> {
        let (cells, expected) = (rows.cells(), self.columns.len());
        if cells.len() >= expected && cells.trimmed_len() <= expected {
            return Ok(());
        }
        Err(FormatError::CsvRagged { row: rows.row(), expected, found: cells.len() })
    }

    /// The finite number in a cell.
    fn value(&mut self, cell: &[u8], row: u64, column: usize) -> Result<f64, FormatError> {
        let name = |column: usize| self.head.names.as_ref().and_then(|names| names.get(column)).cloned();
        match self.numbers.read(cell, row, column + 1) {
            Ok(value) if value.is_finite() => Ok(value),
            Ok(_) => {
                let index = match self.columns[column] {
                    Use::Channel(channel) => channel,
                    _ => column,
                };
                let channel = ChannelAt { index, name: name(column) };
                Err(FormatError::NonFinite {
                    channel,
                    sample: self.samples,
                    row: Some(row),
                    column: Some(column + 1),
                })
            }
            Err(Fault::NotANumber) => Err(FormatError::CsvNotANumber {
                row,
                column: column + 1,
                name: name(column),
                found: excerpt(&String::from_utf8_lossy(trim(cell))),
            }),
            Err(Fault::Ambiguous(cell)) => Err(FormatError::CsvAmbiguousNumber {
                row: cell.row,
                column: cell.column,
                name: name(cell.column - 1),
                found: excerpt(&cell.text),
            }),
        }
    }

    fn finish(self) -> Result<ParsedRun<Spool>, ReadError> {
        let rate = match &self.axis {
            Axis::None => None,
            Axis::Time(time) => time.sample_rate(&self.times, self.rounding, self.first_row)?,
            Axis::Clock(clock) => {
                time::even(&self.times, self.rounding, self.first_row, clock.time_column(), 1.0)?
            }
        };
        let of_channels = |texts: Vec<String>| -> Vec<String> {
            let is_channel = |place: &Use| matches!(place, Use::Channel(_));
            texts
                .into_iter()
                .zip(&self.columns)
                .filter(|(_, c)| is_channel(c))
                .map(|(text, _)| text)
                .collect()
        };
        let Head { names, units, .. } = self.head;
        Ok(ParsedRun {
            sample_rate_hz: rate.map(|(rate, _)| rate),
            sample_rate_error: rate.map_or(0.0, |(_, error)| error),
            names: names.map(of_channels),
            units: units.map(of_channels),
            first_column: self.first_column,
            ..ParsedRun::of(self.channels)
        }
        .check()?)
    }
}

#[cfg(test)]
mod tests;
