//! Universal File Format, data sets 58 and 58b: functions of measurement programs such as Testlab and those of B&K
//! (`.uff`, `.unv`). A file is a row of data sets, each between two lines of `-1`; a data set 58 is eleven lines of
//! text and the numbers of one channel, as text or (58b) as binary floats.
//!
//! Layout follows SDRC's description of the data set and UC-SDRL's of its binary form. Where programs differ from
//! them, the rule is stated where it is applied.

mod binary;
mod channels;
mod fields;
mod header;
mod lines;
mod text;

use std::io::Read;

use super::{FormatError, ParsedRun, ReadError, Spool, UffPlace};

use channels::Channels;
use header::{Encoding, Header};
use lines::Lines;

/// Reads a file.
///
/// # Errors
/// The `uff58.*` codes; `run.*` codes.
pub fn read(file: &[u8]) -> Result<ParsedRun, FormatError> {
    read_from(file, Spool::in_memory()).map(ParsedRun::into_memory).map_err(ReadError::of_bytes)
}

/// [`read`] for a file that is not in memory: only a piece of it is kept at a time, and its samples go to an empty
/// spool.
///
/// # Errors
/// As [`read`]; errors of the file system.
pub fn read_from(file: impl Read, mut spool: Spool) -> Result<ParsedRun<Spool>, ReadError> {
    let mut lines = Lines::new(file);
    let mut channels = Channels::default();
    while let Some(encoding) = next_functions(&mut lines)? {
        let header = Header::read(&mut lines, encoding)?;
        let column = spool.n_columns();
        channels.add(&header)?;
        spool.add_columns(1);
        match header.encoding {
            Encoding::Text => text::read(&mut lines, &header, column, &mut spool),
            Encoding::Binary(form) => binary::read(&mut lines, &header, form, column, &mut spool),
        }?;
    }
    if spool.n_columns() == 0 {
        return Err(FormatError::Uff58Unsupported {
            at: lines.place(),
            found: "the file ends without a data set 58".into(),
            expected: "a time response in a data set 58",
        }
        .into());
    }
    Ok(channels.run(spool).check()?)
}

/// Goes to the header of the next data set 58, over all others; none at the end of the file.
fn next_functions(lines: &mut Lines<impl Read>) -> Result<Option<Encoding>, ReadError> {
    while begin_set(lines)? {
        let Some(line) = lines.next()? else { return Err(lines.ends_early("a data set").into()) };
        if let Some(encoding) = Encoding::of(&line)? {
            lines.begin_functions();
            return Ok(Some(encoding));
        }
        loop {
            let Some(line) = lines.next()? else { return Err(lines.ends_early("a data set").into()) };
            if line.is_delimiter() {
                break;
            }
        }
    }
    Ok(None)
}

/// Reads the `-1` before a data set; false at the end of the file. Some programs leave empty lines between data sets.
fn begin_set(lines: &mut Lines<impl Read>) -> Result<bool, ReadError> {
    while let Some(line) = lines.next()? {
        if line.is_delimiter() {
            return Ok(true);
        }
        if !line.is_blank() {
            let found = line.excerpt();
            return Err(line
                .refuse(format!("the line is {found:?}, and not the -1 before a data set"))
                .into());
        }
    }
    Ok(false)
}

fn header(at: UffPlace, reason: impl Into<String>) -> FormatError {
    FormatError::Uff58Header { at, reason: reason.into() }
}

#[cfg(test)]
mod tests;
