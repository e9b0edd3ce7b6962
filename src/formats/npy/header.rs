//! The header of an NPY file, checked against the bytes after it.

use std::io::Read;
use std::ops::Range;

use super::{Dtype, Order};
use crate::formats::error::excerpt;
use crate::formats::{FormatError, ReadError, check_channel_count};

/// The content of an NPY header; its sizes agree with the bytes after it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Header {
    /// Type of the numbers.
    pub dtype: Dtype,
    /// Whether the most significant byte comes first.
    pub big_endian: bool,
    /// Order of the array.
    pub order: Order,
    /// Samples per channel.
    pub samples: usize,
    /// Channels.
    pub channels: usize,
    /// Offset of the numbers from the start of the file, bytes.
    pub data_offset: usize,
}

/// Longest text of a header, bytes; that of a file with an array of numbers has some hundred.
const MAX_TEXT_BYTES: usize = 64 << 10;

/// Bytes at the start of a file that give the length of its header.
pub(super) const START: usize = 12;

/// Reads and checks the header of a whole file.
///
/// # Errors
/// The `npy.*` codes; `run.empty`, `run.no_channels` and `run.too_many_channels` by the shape.
pub fn header(file: &[u8]) -> Result<Header, FormatError> {
    let text = text(file, file.len() as u64)?;
    check(&file[text.clone()], text.end, (file.len() - text.end) as u64)
}

/// Reads and checks the header of a whole file that holds one signal, or a batch of signals of the same length as
/// `[batch, samples, channels]`. Gives the number of signals of a batch, and the header of the array in which they
/// stand one behind the other.
///
/// # Errors
/// As [`header`]; `npy.shape` for more dimensions.
pub fn batch_header(file: &[u8]) -> Result<(Header, Option<usize>), FormatError> {
    let text = text(file, file.len() as u64)?;
    let (data_offset, found) = (text.end, (file.len() - text.end) as u64);
    let not_text = |_| FormatError::NpyHeader("the header is not text");
    let mut fields = Fields::parse(std::str::from_utf8(&file[text]).map_err(not_text)?)?;
    let [batch, samples, channels] = fields.shape[..] else {
        return Ok((of_fields(fields, data_offset, found)?, None));
    };
    let rows = batch.checked_mul(samples).ok_or(FormatError::NpyShape { found: fields.shape.clone() })?;
    fields.shape = vec![rows, channels];
    let header = of_fields(fields, data_offset, found)?;
    // Not 0 and not more than the rows, which fit.
    Ok((header, Some(batch as usize)))
}

/// Range of the header's text in a file of `len` bytes with this beginning.
pub(super) fn text(file: &[u8], len: u64) -> Result<Range<usize>, FormatError> {
    let Some((b"\x93NUMPY", rest)) = file.split_at_checked(6) else {
        return Err(FormatError::NpyHeader("the file does not begin with the magic bytes of NPY"));
    };
    let cut = FormatError::NpyHeader("the file ends inside the header");
    let (text_len, text_offset) = match rest {
        [1, 0, a, b, ..] => (usize::from(u16::from_le_bytes([*a, *b])), 10),
        [2 | 3, 0, a, b, c, d, ..] => {
            let len = u32::from_le_bytes([*a, *b, *c, *d]);
            (usize::try_from(len).map_err(|_| cut.clone())?, 12)
        }
        [1..=3, 0, ..] => return Err(cut),
        [_, _, ..] => return Err(FormatError::NpyHeader("versions 1.0, 2.0 and 3.0 are read")),
        _ => return Err(cut),
    };
    let data_offset = text_len.checked_add(text_offset).filter(|&end| end as u64 <= len).ok_or(cut)?;
    if text_len > MAX_TEXT_BYTES {
        return Err(FormatError::NpyHeader("the header is longer than 64 KiB"));
    }
    Ok(text_offset..data_offset)
}

/// Reads the text of a header before `found` bytes of data, which begin at `data_offset`.
pub(super) fn check(text: &[u8], data_offset: usize, found: u64) -> Result<Header, FormatError> {
    let text = std::str::from_utf8(text).map_err(|_| FormatError::NpyHeader("the header is not text"))?;
    of_fields(Fields::parse(text)?, data_offset, found)
}

/// Checks the fields of a header before `found` bytes of data, which begin at `data_offset`.
fn of_fields(fields: Fields, data_offset: usize, found: u64) -> Result<Header, FormatError> {
    let Fields { descr, fortran, shape } = fields;
    let (dtype, big_endian) = dtype(&descr)?;
    let (samples, channels) = match shape[..] {
        [samples] => (samples, 1),
        [samples, channels] => (samples, channels),
        _ => return Err(FormatError::NpyShape { found: shape }),
    };
    let expected = samples
        .checked_mul(channels)
        .and_then(|n| n.checked_mul(dtype.size() as u64))
        .ok_or(FormatError::NpyShape { found: shape })?;
    if expected > found {
        return Err(FormatError::NpyTruncated { expected, found });
    }
    if channels == 0 {
        return Err(FormatError::NoChannels);
    }
    if samples == 0 {
        return Err(FormatError::Empty);
    }
    check_channel_count(channels)?;
    if expected < found {
        return Err(FormatError::NpyTrailing { expected, found });
    }
    let order = if fortran { Order::Fortran } else { Order::C };
    // Both are at least 1 and their product is at most the length of a slice, so that they fit.
    let (samples, channels) = (samples as usize, channels as usize);
    Ok(Header { dtype, big_endian, order, samples, channels, data_offset })
}

/// Type and byte order of a `descr` such as `<f8`; anything else is refused.
fn dtype(descr: &str) -> Result<(Dtype, bool), FormatError> {
    let refuse = || FormatError::NpyDtype { found: excerpt(descr) };
    let big_endian = match descr.as_bytes().first() {
        Some(b'<') => false,
        Some(b'>') => true,
        _ => return Err(refuse()),
    };
    let dtype = match &descr[1..] {
        "f4" => Dtype::F4,
        "f8" => Dtype::F8,
        "i2" => Dtype::I2,
        "i4" => Dtype::I4,
        _ => return Err(refuse()),
    };
    Ok((dtype, big_endian))
}

/// The header of an array in an archive, whose sizes nothing is compared with yet.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct ArrayHead {
    /// Type of the elements, as `<f8`.
    pub(crate) descr: String,
    /// Order of the array.
    pub(crate) order: Order,
    /// Its size in each dimension; none for a single element.
    pub(crate) shape: Vec<u64>,
}

impl ArrayHead {
    /// Reads the header of a file up to its data.
    ///
    /// # Errors
    /// `npy.header`, `npy.dtype`; those of the file as `fault` makes them.
    pub(crate) fn read(
        file: &mut impl Read,
        fault: impl Fn(std::io::Error) -> ReadError,
    ) -> Result<Self, ReadError> {
        let mut start = [0; START];
        file.read_exact(&mut start).map_err(&fault)?;
        let text = text(&start, u64::MAX)?;
        // The text of version 1.0 begins with the last bytes of the start.
        let mut rest = vec![0; text.end.saturating_sub(START)];
        file.read_exact(&mut rest).map_err(&fault)?;
        let text = [&start[text.start..], &rest[..]].concat();
        let text = String::from_utf8(text).map_err(|_| FormatError::NpyHeader("the header is not text"))?;
        let Fields { descr, fortran, shape } = Fields::parse(&text)?;
        Ok(Self { descr, order: if fortran { Order::Fortran } else { Order::C }, shape })
    }
}

/// The three fields of a header, before their values are checked.
struct Fields {
    /// A plain type, or the text of a structured one.
    descr: String,
    fortran: bool,
    shape: Vec<u64>,
}

impl Fields {
    /// Parses `{'descr': '<f8', 'fortran_order': False, 'shape': (3, 2), }`.
    fn parse(text: &str) -> Result<Self, FormatError> {
        let bad = || FormatError::NpyHeader("not a dictionary of descr, fortran_order and shape");
        let (mut descr, mut fortran, mut shape) = (None, None, None);
        let mut rest = text.trim().strip_prefix('{').ok_or_else(bad)?;
        loop {
            rest = rest.trim_start();
            if let Some(end) = rest.strip_prefix('}') {
                if !end.is_empty() {
                    return Err(bad());
                }
                break;
            }
            let (key, after) = quoted(rest).ok_or_else(bad)?;
            rest = after.trim_start().strip_prefix(':').ok_or_else(bad)?.trim_start();
            match key {
                "descr" if descr.is_none() => {
                    if !rest.starts_with(['\'', '"']) {
                        // A structured type is a list.
                        let list = rest.split_inclusive(']').next().unwrap_or_default();
                        return Err(FormatError::NpyDtype { found: excerpt(list) });
                    }
                    let (value, after) = quoted(rest).ok_or_else(bad)?;
                    descr = Some(value.to_owned());
                    rest = after;
                }
                "fortran_order" if fortran.is_none() => {
                    let (value, after) = if let Some(after) = rest.strip_prefix("True") {
                        (true, after)
                    } else {
                        (false, rest.strip_prefix("False").ok_or_else(bad)?)
                    };
                    fortran = Some(value);
                    rest = after;
                }
                "shape" if shape.is_none() => {
                    let (inside, after) =
                        rest.strip_prefix('(').and_then(|r| r.split_once(')')).ok_or_else(bad)?;
                    shape = Some(sizes(inside).ok_or_else(bad)?);
                    rest = after;
                }
                _ => return Err(bad()),
            }
            rest = rest.trim_start();
            if let Some(after) = rest.strip_prefix(',') {
                rest = after;
            } else if !rest.starts_with('}') {
                return Err(bad());
            }
        }
        match (descr, fortran, shape) {
            (Some(descr), Some(fortran), Some(shape)) => Ok(Self { descr, fortran, shape }),
            _ => Err(bad()),
        }
    }
}

/// A string in quotes (NumPy escapes nothing in these fields), and what follows it.
fn quoted(text: &str) -> Option<(&str, &str)> {
    let quote = text.chars().next().filter(|c| matches!(c, '\'' | '"'))?;
    text[1..].split_once(quote)
}

/// The numbers of `3, 2,`; Python 2 marked long ones with an L.
fn sizes(inside: &str) -> Option<Vec<u64>> {
    let inside = inside.trim();
    let inside = inside.strip_suffix(',').unwrap_or(inside);
    if inside.is_empty() {
        return Some(Vec::new());
    }
    inside
        .split(',')
        .map(|size| {
            let size = size.trim();
            let size = size.strip_suffix('L').unwrap_or(size);
            size.bytes().all(|b| b.is_ascii_digit()).then(|| size.parse().ok())?
        })
        .collect()
}
