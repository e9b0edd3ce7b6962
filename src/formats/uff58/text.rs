//! Numbers as text in fixed columns.

use std::io::Read;

use crate::formats::{FormatError, ReadError, Spool, labels};

use super::fields::number;
use super::header::Header;
use super::lines::Lines;

/// Reads the numbers of a data set into a column, and the `-1` after them. Single precision is 6E13.5, double precision
/// 4E20.12; a line may be short.
///
/// # Errors
/// `uff58.header`, `uff58.size`, `uff58.not_a_number`.
pub(super) fn read(
    lines: &mut Lines<impl Read>,
    header: &Header,
    column: usize,
    spool: &mut Spool,
) -> Result<(), ReadError> {
    let (width, per_line) = if header.double { (20, 4) } else { (13, 6) };
    let declared = format!("{} numbers", header.numbers);
    let mut left = header.numbers;
    while left > 0 {
        let ended = |at, what: &str| {
            let found = format!("{what} ends after {}", header.numbers - left);
            ReadError::from(FormatError::Uff58Size { at, declared: declared.clone(), found })
        };
        let end = lines.place();
        let Some(line) = lines.next()? else { return Err(ended(end, "the file")) };
        if line.is_delimiter() {
            return Err(ended(line.at, "the data set"));
        }
        if line.bytes.len() > width * per_line {
            let columns = width * per_line;
            return Err(line.refuse(format!("a line of numbers has more than {columns} columns")).into());
        }
        // Fortran programs write the last line whole: numbers that are not declared are no data.
        let wanted = usize::try_from(left).unwrap_or(usize::MAX);
        for (index, field) in line.bytes.chunks(width).enumerate().take(wanted) {
            let value = number(field).ok_or_else(|| FormatError::Uff58NotANumber {
                at: line.at,
                column: index * width + 1,
                found: labels::utf8_or_windows_1252(field),
            })?;
            spool.push(column, value)?;
            left -= 1;
        }
    }
    lines.end_functions(&declared)
}
