//! NPZ, the archive of NumPy's `savez` and `savez_compressed`: arrays by name, each an NPY file.
//!
//! Entries are read in their order and not by the directory at the end, which may name any number of them.

use std::io::{self, Read};

use super::error::excerpt;
use super::npy::{self, Order};
use super::numbers::{Kind, Numbers};
use super::unpacked::Budget;
use super::variables::{MAX_TEXT_BYTES, Use, Variables, unsupported};
use super::{FormatError, PIECE, ParsedRun, ReadError, Spool};

/// Most entries of an archive.
const MAX_ENTRIES: usize = 2 * super::MAX_CHANNELS;

/// Reads a file from memory.
///
/// # Errors
/// As [`read_from`], without those of the file system.
pub fn read(file: &[u8]) -> Result<ParsedRun, FormatError> {
    let read = read_from(file, file.len() as u64, Spool::in_memory());
    read.map(ParsedRun::into_memory).map_err(ReadError::of_bytes)
}

/// Reads a file of `len` bytes; its samples go to an empty spool.
///
/// # Errors
/// `npz.invalid` for a damaged archive, `npy.header` for a damaged array, `variables.*` for arrays that are no run
/// (complex numbers, objects, records), `file.unpacked_size`, the `run.*` codes; errors of the file system.
pub fn read_from(mut file: impl Read, len: u64, spool: Spool) -> Result<ParsedRun<Spool>, ReadError> {
    let mut variables = Variables::new(spool);
    let mut budget = Budget::of(len);
    let mut entries = 0;
    while let Some(mut entry) = zip::read::read_zipfile_from_stream(&mut file).map_err(archive)? {
        entries += 1;
        if entries > MAX_ENTRIES {
            return Err(invalid(format!("more than {MAX_ENTRIES} entries")).into());
        }
        let name = entry.name().map_err(archive)?.into_owned();
        let Some(name) = name.strip_suffix(".npy") else {
            return Err(invalid(format!("the entry {:?} is no NPY file", excerpt(&name))).into());
        };
        array(name, budget.reader(&mut entry), &mut variables)?;
    }
    variables.finish()
}

/// Reads one NPY file to its end, where the archive's checksum is compared.
fn array(name: &str, mut file: impl Read, variables: &mut Variables) -> Result<(), ReadError> {
    let header = npy::ArrayHead::read(&mut file, fault)?;
    let (order, shape) = (header.order, &header.shape[..]);
    let number = header.descr.split_at_checked(2).and_then(|(start, size)| {
        let (big_endian, kind) = match start {
            "<i" | "|i" => (false, Kind::Signed),
            ">i" => (true, Kind::Signed),
            "<u" | "|u" => (false, Kind::Unsigned),
            ">u" => (true, Kind::Unsigned),
            "<f" => (false, Kind::Float),
            ">f" => (true, Kind::Float),
            _ => return None,
        };
        Numbers::of(kind, size.parse().ok()?, big_endian)
    });
    match number {
        Some(numbers) => {
            let at = variables.begin(name, shape)?;
            match at {
                Use::Nothing => {
                    io::copy(&mut file, &mut io::sink()).map_err(fault)?;
                }
                Use::Channels { rows, columns, .. } if order == Order::C => {
                    by_rows(&mut file, numbers, rows, columns, |column, values| {
                        variables.extend(name, at, column, values.iter().copied())
                    })?;
                }
                Use::Channels { rows, columns, .. } => {
                    for column in 0..columns {
                        by_rows(&mut file, numbers, rows, 1, |_, values| {
                            variables.extend(name, at, column, values.iter().copied())
                        })?;
                    }
                }
                Use::Times { rows } => by_rows(&mut file, numbers, rows, 1, |_, values| {
                    variables.extend(name, at, 0, values.iter().copied())
                })?,
                Use::Rate | Use::Step => by_rows(&mut file, numbers, 1, 1, |_, values| {
                    variables.extend(name, at, 0, values.iter().copied())
                })?,
            }
        }
        None => {
            let size = header.descr.strip_prefix("<U").and_then(|size| size.parse::<usize>().ok());
            match size {
                Some(characters) => texts(name, &mut file, characters, shape, variables)?,
                None if header.descr.starts_with("|S") => {
                    return Err(unsupported(name, "is text of bytes: save it as str").into());
                }
                None => {
                    let reason =
                        format!("has the dtype {}: integers and floats are read", excerpt(&header.descr));
                    return Err(unsupported(name, reason).into());
                }
            }
        }
    }
    if io::copy(&mut file, &mut io::sink()).map_err(fault)? > 0 {
        return Err(invalid(format!(
            "the array {:?} has more bytes than its shape {shape:?}",
            excerpt(name)
        ))
        .into());
    }
    Ok(())
}

/// Reads `rows` of `columns` numbers and gives them to `each`, a column at a time.
fn by_rows(
    mut file: impl Read,
    numbers: Numbers,
    rows: usize,
    columns: usize,
    mut each: impl FnMut(usize, &[f64]) -> Result<(), ReadError>,
) -> Result<(), ReadError> {
    let row = columns * numbers.size();
    let rows_at_once = (PIECE / row).max(1);
    let (mut piece, mut values, mut column_values) = (Vec::new(), Vec::new(), Vec::new());
    let mut left = rows;
    while left > 0 {
        let now = rows_at_once.min(left);
        piece.resize(now * row, 0);
        file.read_exact(&mut piece).map_err(fault)?;
        values.clear();
        numbers.decode(&piece, &mut values);
        for column in 0..columns {
            column_values.clear();
            column_values.extend(values[column..].iter().step_by(columns));
            each(column, &column_values)?;
        }
        left -= now;
    }
    Ok(())
}

/// Reads text of `characters` of four bytes each, padded with zeros.
fn texts(
    name: &str,
    mut file: impl Read,
    characters: usize,
    shape: &[u64],
    variables: &mut Variables,
) -> Result<(), ReadError> {
    if !Variables::is_label(name) {
        io::copy(&mut file, &mut io::sink()).map_err(fault)?;
        return Ok(());
    }
    let size = characters.checked_mul(4).map(|size| size as u64);
    let bytes = shape.iter().try_fold(size.unwrap_or(u64::MAX), |bytes, &n| bytes.checked_mul(n));
    let Some(bytes) = bytes.and_then(|bytes| usize::try_from(bytes).ok()).filter(|&b| b <= MAX_TEXT_BYTES)
    else {
        return Err(unsupported(name, format!("is text of more than {MAX_TEXT_BYTES} bytes")).into());
    };
    let mut data = vec![0; bytes];
    file.read_exact(&mut data).map_err(fault)?;
    let (points, _) = data.as_chunks::<4>();
    let character =
        |&point: &[u8; 4]| char::from_u32(u32::from_le_bytes(point)).unwrap_or(char::REPLACEMENT_CHARACTER);
    let text =
        |points: &[[u8; 4]]| -> String { points.iter().map(character).take_while(|&c| c != '\0').collect() };
    let texts = match characters {
        0 => Vec::new(),
        _ => points.chunks(characters).map(text).collect(),
    };
    variables.text(name, texts);
    Ok(())
}

fn invalid(reason: impl Into<String>) -> FormatError {
    FormatError::Npz(reason.into())
}

/// The error of the archive, or of the file system.
fn archive(error: zip::result::ZipError) -> ReadError {
    match error {
        zip::result::ZipError::Io(error) => fault(error),
        error => invalid(error.to_string()).into(),
    }
}

/// An error of reading: of the archive where its bytes are the reason, else of the file system.
fn fault(error: io::Error) -> ReadError {
    super::unpacked::fault(
        error,
        "the archive ends inside an array",
        "an entry of the archive is damaged",
        invalid,
    )
}

#[cfg(test)]
mod tests;
