//! Numbers as binary floats.

use std::io::Read;

use crate::formats::{FormatError, PIECE, ReadError, Spool};

use super::header::{Binary, Header};
use super::lines::Lines;

/// Reads the numbers of a data set into a column, and the `-1` after them.
///
/// # Errors
/// `uff58.size`.
pub(super) fn read(
    lines: &mut Lines<impl Read>,
    header: &Header,
    form: Binary,
    column: usize,
    spool: &mut Spool,
) -> Result<(), ReadError> {
    match (header.double, form.big_endian) {
        (false, false) => values(lines, header, form, column, spool, |b| f32::from_le_bytes(b).into()),
        (false, true) => values(lines, header, form, column, spool, |b| f32::from_be_bytes(b).into()),
        (true, false) => values(lines, header, form, column, spool, f64::from_le_bytes),
        (true, true) => values(lines, header, form, column, spool, f64::from_be_bytes),
    }
}

/// Numbers of `N` bytes.
fn values<const N: usize>(
    lines: &mut Lines<impl Read>,
    header: &Header,
    form: Binary,
    column: usize,
    spool: &mut Spool,
    number: impl Fn([u8; N]) -> f64,
) -> Result<(), ReadError> {
    let declared = format!("{} bytes of numbers", form.bytes);
    if header.numbers.checked_mul(N as u64) != Some(form.bytes) {
        let found = format!("which is not what {} numbers of {N} bytes take", header.numbers);
        return Err(FormatError::Uff58Size { at: lines.place(), declared, found }.into());
    }
    let mut piece = vec![0; PIECE];
    let mut left = form.bytes;
    while left > 0 {
        let wanted = usize::try_from(left).map_or(PIECE, |left| left.min(PIECE));
        let filled = lines.fill(&mut piece[..wanted])?;
        left -= filled as u64;
        if filled < wanted {
            let found = format!("the file ends after {}", form.bytes - left);
            return Err(FormatError::Uff58Size { at: lines.place(), declared, found }.into());
        }
        // A piece holds whole numbers, and so does what is left for the last.
        spool.extend(column, piece[..wanted].as_chunks::<N>().0.iter().map(|&bytes| number(bytes)))?;
    }
    // The format has the -1 at once; some programs end the line before it.
    lines.skip_padding()?;
    lines.end_functions(&declared)
}
