//! Writing CSV.

use std::io::Write;

use super::head::{is_value, without_brackets};
use crate::formats::{ChannelAt, FormatError};

/// Writes `[channel][sample]` under a header row, and a units row where any of `units` is not
/// empty; numbers have the fewest digits that read back as the same `f64`. A unit that is itself a
/// number, such as `1`, is written in brackets.
///
/// # Errors
/// `run.*` codes where the channels are not a run: names, units and channels differ in number,
/// unequal lengths, numbers that are not finite. `csv.header` for a channel named like a number.
pub fn write(
    names: &[String],
    units: Option<&[String]>,
    channels: &[Vec<f64>],
) -> Result<Vec<u8>, FormatError> {
    let samples = channels.first().ok_or(FormatError::NoChannels)?.len();
    let at = |index: usize| ChannelAt { index, name: names.get(index).cloned() };
    let mut file = head(names, units, channels.len())?;
    for (index, channel) in channels.iter().enumerate() {
        if channel.len() != samples {
            let found = channel.len();
            return Err(FormatError::UnequalLengths { channel: at(index), expected: samples, found });
        }
        if let Some(sample) = channel.iter().position(|v| !v.is_finite()) {
            return Err(FormatError::NonFinite { channel: at(index), sample, row: None, column: None });
        }
    }
    let columns: Vec<&[f64]> = channels.iter().map(Vec::as_slice).collect();
    rows(&mut file, &columns);
    Ok(file)
}

/// The header row and, where any of `units` is not empty, the units row of a table of so many columns, as
/// [`write()`] writes them.
///
/// # Errors
/// As [`write()`].
pub fn head(names: &[String], units: Option<&[String]>, columns: usize) -> Result<Vec<u8>, FormatError> {
    if names.len() != columns || units.is_some_and(|u| u.len() != columns) {
        let channel = ChannelAt { index: columns, name: names.get(columns).cloned() };
        return Err(FormatError::UnequalLengths { channel, expected: columns, found: names.len() });
    }
    if let Some(index) = names.iter().position(|n| is_value(n)) {
        let reason = "a channel name that is a number would read back as a sample";
        return Err(FormatError::CsvHeader { row: 1, column: index + 1, reason });
    }
    let units: Option<Vec<String>> = units
        .filter(|units| units.iter().any(|u| !u.is_empty()))
        .map(|units| units.iter().map(|u| unit_cell(u)).collect());
    let texts = || names.iter().chain(units.iter().flatten());
    // The reader takes the separator from the first row, so that any other one must be quoted there.
    let quotes = if texts().any(|t| t.contains(['\t', ';'])) {
        csv::QuoteStyle::Always
    } else {
        csv::QuoteStyle::Necessary
    };
    let mut writer = csv::WriterBuilder::new().quote_style(quotes).from_writer(Vec::new());
    let fits = "writing to memory cannot fail, and both rows have a cell a channel";
    writer.write_record(names).expect(fits);
    if let Some(units) = &units {
        writer.write_record(units).expect(fits);
    }
    Ok(writer.into_inner().expect(fits))
}

/// Appends a row for each number of these columns, which are equally long and finite.
pub fn rows(file: &mut Vec<u8>, columns: &[&[f64]]) {
    for sample in 0..columns.first().map_or(0, |column| column.len()) {
        for (index, column) in columns.iter().enumerate() {
            let separator = if index == 0 { "" } else { "," };
            // Debug writes 1e300 where Display writes 301 digits; both read back exactly.
            write!(file, "{separator}{:?}", column[sample]).expect("writing to memory cannot fail");
        }
        file.push(b'\n');
    }
}

/// A unit in a form that reads back: the reader removes brackets, and takes numbers for samples.
fn unit_cell(unit: &str) -> String {
    if is_value(unit) || without_brackets(unit) != unit { format!("[{unit}]") } else { unit.to_owned() }
}
