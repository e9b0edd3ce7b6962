//! MAT, the file of MATLAB's `save`, version 5 (`-v6` and `-v7`; version 7.3 is HDF5): the variables of a workspace.
//!
//! Numbers go from the file to their channels piece by piece, decompressed on the way. The structure is that of the
//! "MAT-File Format" of MathWorks: a header of 128 bytes, then elements of a tag (type and bytes) and data, padded
//! to 8 bytes. A variable is an element of elements, compressed or not.

mod element;
mod matrix;
mod pieces;

use std::io::{self, Read};

use flate2::read::ZlibDecoder;

use super::unpacked::{self, Budget};
use super::variables::Variables;
use super::{FormatError, ParsedRun, ReadError, Spool};
use element::{COMPRESSED, Elements, MATRIX};

pub use pieces::MatPieces;

/// Bytes of the header.
const HEADER: usize = 128;

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
/// `mat.invalid` for a file whose structure is not that of version 5, `variables.*` for variables that are no run
/// (complex numbers, cells, function handles, objects, sparse matrices, arrays of structs), `file.unpacked_size`,
/// the `run.*` codes; errors of the file system.
pub fn read_from(mut file: impl Read, len: u64, spool: Spool) -> Result<ParsedRun<Spool>, ReadError> {
    let mut variables = Variables::new(spool);
    let mut budget = Budget::of(len);
    let mut file = Elements::new(&mut file, len);
    let mut header = [0; HEADER];
    file.fill(&mut header)?;
    file.big_endian = is_big_endian(&header)?;
    while !file.is_at_end() {
        let tag = file.tag()?;
        match tag.kind {
            MATRIX => {
                let mut element = file.inside(tag.bytes)?;
                matrix::read(&mut element, &mut variables)?;
                element.skip_rest()?;
                file.skip_padding(tag.bytes)?;
            }
            // Not padded.
            COMPRESSED => {
                let big_endian = file.big_endian;
                let mut packed = file.inside(tag.bytes)?;
                compressed(&mut packed, big_endian, &mut budget, &mut variables)?;
                packed.skip_rest()?;
            }
            kind => return Err(invalid(format!("an element of type {kind} is no variable")).into()),
        }
    }
    variables.finish()
}

/// Byte order of the file by its header: the version, and the letters "MI" as one number.
fn is_big_endian(header: &[u8; HEADER]) -> Result<bool, FormatError> {
    match header[124..] {
        [0, 1, b'I', b'M'] => Ok(false),
        [1, 0, b'M', b'I'] => Ok(true),
        [0, 2, b'I', b'M'] | [2, 0, b'M', b'I'] => Err(invalid("version 7.3 is an HDF5 file")),
        _ => Err(invalid("the header is not that of a MAT file of version 5")),
    }
}

/// Reads the variable of a compressed element.
fn compressed(
    packed: &mut Elements<'_>,
    big_endian: bool,
    budget: &mut Budget,
    variables: &mut Variables,
) -> Result<(), ReadError> {
    let mut unpacked = budget.reader(ZlibDecoder::new(packed));
    let mut elements = Elements::new(&mut unpacked, u64::MAX);
    elements.big_endian = big_endian;
    let tag = elements.tag()?;
    if tag.kind != MATRIX {
        return Err(invalid("a compressed element is no variable").into());
    }
    let mut element = elements.inside(tag.bytes)?;
    matrix::read(&mut element, variables)?;
    element.skip_rest()?;
    // To the end, where its checksum is compared.
    io::copy(&mut unpacked, &mut io::sink()).map_err(fault)?;
    Ok(())
}

/// The error of a file that is not as its format has it.
fn invalid(reason: impl Into<String>) -> FormatError {
    FormatError::Mat(reason.into())
}

/// An error of reading: of the file where its bytes are the reason, else of the file system.
fn fault(error: io::Error) -> ReadError {
    unpacked::fault(error, "the file ends inside an element", "a compressed element is damaged", invalid)
}

#[cfg(test)]
mod tests;
