//! CSV: a header row of channel names, an optional units row, an optional time column, then one
//! row per sample.
//!
//! - Cells are separated by a tab, `;` or `,`: the first of these, in this order, that the first
//!   row has outside quotes. Where the separator is not the comma, `1,5` is a number like `1.5`.
//! - A file whose first row is all numbers has no header; its channels have no names.
//! - A units row is a second row without any number; brackets around a unit are left off.
//! - A time column is one named `time`, `t` or `zeit`, with or without `_s`, `_ms` or a unit in
//!   brackets, or else the one column with the unit `s`. It must rise in even steps, and gives the
//!   sample rate.
//! - A byte order mark, CRLF and empty lines at the end are accepted. An empty line between rows is
//!   refused, since it may be a lost sample.

mod number;
mod pieces;
mod rows;
mod time;
mod write;

use std::io::Read;

use super::error::excerpt;
use super::{ChannelAt, FormatError, ParsedRun, ReadError, Spool, check_channel_count, check_name};
use number::{number, trim};
use rows::Rows;
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
    let mut table = Table {
        decimal_comma: rows.separator() != b',',
        times: spool.another(),
        channels: spool,
        ..Table::default()
    };
    if !rows.next()? {
        return Err(FormatError::Empty.into());
    }
    table.width = rows.cells().len();
    check_channel_count(table.width as u64)?;

    let header_row = rows.row();
    let mut more = true;
    if table.is_header(&rows)? {
        table.names = Some(names(&rows)?);
        more = rows.next()?;
        if more && table.is_units(&rows) {
            table.check_width(&rows)?;
            table.units = Some(units(&rows)?);
            more = rows.next()?;
        }
    }
    let time = match &table.names {
        Some(names) => TimeColumn::find(names, table.units.as_deref(), header_row)?,
        None => None,
    };
    table.channels.add_columns(table.width - usize::from(time.is_some()));
    table.times.add_columns(1);
    table.first_row = rows.row();
    while more {
        table.take(&rows, time.as_ref())?;
        more = rows.next()?;
    }
    table.finish(time)
}

/// The columns read so far.
#[derive(Default)]
struct Table {
    decimal_comma: bool,
    width: usize,
    names: Option<Vec<String>>,
    units: Option<Vec<String>>,
    channels: Spool,
    /// One column: the time of each sample, where the file has it.
    times: Spool,
    /// Samples of each channel.
    samples: usize,
    /// Line of the first sample.
    first_row: u64,
}

impl Table {
    /// Whether the first row has names. A mixture of names and numbers is refused: it would lose a sample or
    /// a name.
    fn is_header(&self, rows: &Rows<impl Read>) -> Result<bool, FormatError> {
        let is_number = |cell: &[u8]| number(cell, self.decimal_comma).is_some();
        let Some(column) = rows.cells().iter().position(is_number) else { return Ok(true) };
        if rows.cells().iter().all(is_number) {
            return Ok(false);
        }
        let reason = "a header row holds names only, a row of samples numbers only";
        Err(FormatError::CsvHeader { row: rows.row(), column: column + 1, reason })
    }

    fn is_units(&self, rows: &Rows<impl Read>) -> bool {
        let mut cells = rows.cells().iter();
        cells.clone().all(|cell| number(cell, self.decimal_comma).is_none())
            && cells.any(|cell| !trim(cell).is_empty())
    }

    fn check_width(&self, rows: &Rows<impl Read>) -> Result<(), FormatError> {
        let found = rows.cells().len();
        if found == self.width {
            return Ok(());
        }
        Err(FormatError::CsvRagged { row: rows.row(), expected: self.width, found })
    }

    /// Adds one row of samples.
    fn take(&mut self, rows: &Rows<impl Read>, time: Option<&TimeColumn>) -> Result<(), ReadError> {
        self.check_width(rows)?;
        for (column, cell) in rows.cells().iter().enumerate() {
            let Some(value) = number(cell, self.decimal_comma) else {
                return Err(FormatError::CsvNotANumber {
                    row: rows.row(),
                    column: column + 1,
                    name: self.names.as_ref().map(|n| n[column].clone()),
                    found: excerpt(&String::from_utf8_lossy(trim(cell))),
                }
                .into());
            };
            if !value.is_finite() {
                return Err(FormatError::NonFinite {
                    channel: self.channel_at(column, time),
                    sample: self.samples,
                    row: Some(rows.row()),
                    column: Some(column + 1),
                }
                .into());
            }
            match time {
                Some(time) if time.column == column => self.times.push(0, value)?,
                time => self.channels.push(channel(column, time), value)?,
            }
        }
        self.samples += 1;
        Ok(())
    }

    fn channel_at(&self, column: usize, time: Option<&TimeColumn>) -> ChannelAt {
        let name = self.names.as_ref().map(|names| names[column].clone());
        ChannelAt { index: channel(column, time), name }
    }

    fn finish(mut self, time: Option<TimeColumn>) -> Result<ParsedRun<Spool>, ReadError> {
        let mut sample_rate_hz = None;
        if let Some(time) = time {
            if let Some(names) = &mut self.names {
                names.remove(time.column);
            }
            if let Some(units) = &mut self.units {
                units.remove(time.column);
            }
            sample_rate_hz = time.sample_rate_hz(&self.times, self.first_row)?;
        }
        let Self { names, units, channels, .. } = self;
        Ok(ParsedRun { sample_rate_hz, names, units, channels }.check()?)
    }
}

/// Index of a column among those that are not the time.
fn channel(column: usize, time: Option<&TimeColumn>) -> usize {
    column - usize::from(time.is_some_and(|time| time.column < column))
}

/// Channel names of a header row: not empty, each once.
fn names(rows: &Rows<impl Read>) -> Result<Vec<String>, FormatError> {
    let mut names: Vec<String> = Vec::with_capacity(rows.cells().len());
    for (column, cell) in rows.cells().iter().enumerate() {
        let name = rows.text(cell)?;
        if name.is_empty() {
            let reason = "a channel needs a name";
            return Err(FormatError::CsvHeader { row: rows.row(), column: column + 1, reason });
        }
        check_name(name)?;
        if names.iter().any(|n| n == name) {
            return Err(FormatError::DuplicateChannel { name: name.into() });
        }
        names.push(name.into());
    }
    Ok(names)
}

fn units(rows: &Rows<impl Read>) -> Result<Vec<String>, FormatError> {
    rows.cells().iter().map(|cell| Ok(without_brackets(rows.text(cell)?).to_owned())).collect()
}

fn without_brackets(unit: &str) -> &str {
    [('[', ']'), ('(', ')')]
        .iter()
        .find_map(|(open, close)| unit.strip_prefix(*open)?.strip_suffix(*close))
        .unwrap_or(unit)
        .trim()
}

#[cfg(test)]
mod tests;
