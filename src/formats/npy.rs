//! NPY, the file of NumPy's `save`: `[samples, channels]`, or one channel as `[samples]`.
//!
//! The header is read here and not by the npyz crate: its parser descends into nested brackets
//! without a limit and multiplies shapes unchecked, which a file from outside must not reach. npyz
//! writes our headers, and the tests read our files with it.

use npyz::WriterBuilder;

use super::error::excerpt;
use super::{ChannelAt, FormatError, ParsedRun, check_channel_count};

/// Type of one number in a file.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Dtype {
    /// 32-bit float.
    F4,
    /// 64-bit float.
    F8,
    /// 16-bit signed integer.
    I2,
    /// 32-bit signed integer.
    I4,
}

impl Dtype {
    /// Bytes of one number.
    pub fn size(self) -> usize {
        match self {
            Self::I2 => 2,
            Self::F4 | Self::I4 => 4,
            Self::F8 => 8,
        }
    }
}

/// Which index runs fastest in a file of `[samples, channels]`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Order {
    /// The channel: all channels of sample 0 come first.
    C,
    /// The sample: all samples of channel 0 come first, as in memory.
    Fortran,
}

/// What an NPY header says; its sizes agree with the bytes behind it.
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
    /// Where the numbers begin, in bytes from the start of the file.
    pub data_offset: usize,
}

/// Reads and checks the header of a whole file.
///
/// # Errors
/// The `npy.*` codes; `run.empty`, `run.no_channels` and `run.too_many_channels` by the shape.
pub fn header(file: &[u8]) -> Result<Header, FormatError> {
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
    let data_offset = text_len.checked_add(text_offset).filter(|&end| end <= file.len()).ok_or(cut)?;
    let text = std::str::from_utf8(&file[text_offset..data_offset])
        .map_err(|_| FormatError::NpyHeader("the header is not text"))?;
    let Fields { descr, fortran, shape } = Fields::parse(text)?;

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
    let found = (file.len() - data_offset) as u64;
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
    // Both are at least 1 and their product is at most the length of a slice: they fit.
    let (samples, channels) = (samples as usize, channels as usize);
    Ok(Header { dtype, big_endian, order, samples, channels, data_offset })
}

/// Reads a file; names, units and sample rate are not part of the format.
///
/// # Errors
/// Those of [`header`]; `run.non_finite` with channel and sample.
pub fn read(file: &[u8]) -> Result<ParsedRun, FormatError> {
    let header = header(file)?;
    let data = &file[header.data_offset..];
    let channels = match (header.dtype, header.big_endian) {
        (Dtype::F4, false) => values(&header, data, |b| f64::from(f32::from_le_bytes(b))),
        (Dtype::F4, true) => values(&header, data, |b| f64::from(f32::from_be_bytes(b))),
        (Dtype::F8, false) => values(&header, data, f64::from_le_bytes),
        (Dtype::F8, true) => values(&header, data, f64::from_be_bytes),
        (Dtype::I2, false) => values(&header, data, |b| f64::from(i16::from_le_bytes(b))),
        (Dtype::I2, true) => values(&header, data, |b| f64::from(i16::from_be_bytes(b))),
        (Dtype::I4, false) => values(&header, data, |b| f64::from(i32::from_le_bytes(b))),
        (Dtype::I4, true) => values(&header, data, |b| f64::from(i32::from_be_bytes(b))),
    };
    ParsedRun { sample_rate_hz: None, names: None, units: None, channels }.check()
}

/// Numbers of `N` bytes, sorted into channels.
fn values<const N: usize>(header: &Header, data: &[u8], number: impl Fn([u8; N]) -> f64) -> Vec<Vec<f64>> {
    let (numbers, _) = data.as_chunks::<N>();
    match header.order {
        Order::Fortran => {
            numbers.chunks_exact(header.samples).map(|c| c.iter().map(|&b| number(b)).collect()).collect()
        }
        Order::C => {
            let mut channels = vec![Vec::with_capacity(header.samples); header.channels];
            for row in numbers.chunks_exact(header.channels) {
                for (channel, &bytes) in channels.iter_mut().zip(row) {
                    channel.push(number(bytes));
                }
            }
            channels
        }
    }
}

/// Writes `[channel][sample]` as `<f4` or `<f8` (integers are not written) of shape
/// `[samples, channels]`.
///
/// # Errors
/// `run.*` codes where the channels make no run; `run.non_finite` too where a number does not fit
/// into `<f4`.
///
/// # Panics
/// If `dtype` is an integer: our bug.
pub fn write(channels: &[Vec<f64>], dtype: Dtype, order: Order) -> Result<Vec<u8>, FormatError> {
    let samples = check_equal(channels)?;
    let mut file = npy_header(samples, channels.len(), dtype, order);
    file.reserve_exact(samples * channels.len() * dtype.size());
    let mut put = |channel: usize, sample: usize| {
        let value = channels[channel][sample];
        let finite = match dtype {
            Dtype::F4 => {
                file.extend_from_slice(&(value as f32).to_le_bytes());
                (value as f32).is_finite()
            }
            _ => {
                file.extend_from_slice(&value.to_le_bytes());
                value.is_finite()
            }
        };
        if finite {
            return Ok(());
        }
        let channel = ChannelAt { index: channel, name: None };
        Err(FormatError::NonFinite { channel, sample, row: None, column: None })
    };
    match order {
        Order::C => {
            for sample in 0..samples {
                for channel in 0..channels.len() {
                    put(channel, sample)?;
                }
            }
        }
        Order::Fortran => {
            for channel in 0..channels.len() {
                for sample in 0..samples {
                    put(channel, sample)?;
                }
            }
        }
    }
    Ok(file)
}

/// Samples per channel.
fn check_equal(channels: &[Vec<f64>]) -> Result<usize, FormatError> {
    let expected = channels.first().ok_or(FormatError::NoChannels)?.len();
    for (index, samples) in channels.iter().enumerate() {
        if samples.len() != expected {
            let channel = ChannelAt { index, name: None };
            return Err(FormatError::UnequalLengths { channel, expected, found: samples.len() });
        }
    }
    Ok(expected)
}

fn npy_header(samples: usize, channels: usize, dtype: Dtype, order: Order) -> Vec<u8> {
    let descr = match dtype {
        Dtype::F4 => "<f4",
        Dtype::F8 => "<f8",
        Dtype::I2 | Dtype::I4 => unreachable!("integers are only read: this is a bug"),
    };
    let order = match order {
        Order::C => npyz::Order::C,
        Order::Fortran => npyz::Order::Fortran,
    };
    npyz::WriteOptions::new_header_only()
        .dtype(npyz::DType::Plain(descr.parse().expect("a plain type of NumPy")))
        .shape(&[samples as u64, channels as u64])
        .order(order)
        .writer(Vec::new())
        .write_header_only()
        .expect("a vector takes all that is written")
}

/// Type and byte order of a `descr` such as `<f8`; anything else is refused as it stands.
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

/// The three fields of a header, before their values are judged.
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

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    /// A version 1.0 file with this header text and data.
    fn file(text: &str, data: &[u8]) -> Vec<u8> {
        let mut file = b"\x93NUMPY\x01\x00".to_vec();
        file.extend((text.len() as u16).to_le_bytes());
        file.extend(text.as_bytes());
        file.extend(data);
        file
    }

    fn plain(descr: &str, fortran: bool, shape: &str, data: &[u8]) -> Vec<u8> {
        let fortran = if fortran { "True" } else { "False" };
        file(&format!("{{'descr': '{descr}', 'fortran_order': {fortran}, 'shape': {shape}, }}     \n"), data)
    }

    #[test]
    fn every_type_and_order_reads_as_channels() {
        let expected = [vec![1.0, 3.0, 5.0], vec![-2.0, 4.0, 6.0]];
        let (c, f) = ([1i16, -2, 3, 4, 5, 6], [1i16, 3, 5, -2, 4, 6]);
        for (fortran, numbers) in [(false, c), (true, f)] {
            let bytes =
                |of: &dyn Fn(i16) -> Vec<u8>| numbers.iter().flat_map(|&v| of(v)).collect::<Vec<u8>>();
            for (descr, data) in [
                ("<f4", bytes(&|v| f32::from(v).to_le_bytes().to_vec())),
                (">f4", bytes(&|v| f32::from(v).to_be_bytes().to_vec())),
                ("<f8", bytes(&|v| f64::from(v).to_le_bytes().to_vec())),
                (">f8", bytes(&|v| f64::from(v).to_be_bytes().to_vec())),
                ("<i2", bytes(&|v| v.to_le_bytes().to_vec())),
                (">i2", bytes(&|v| v.to_be_bytes().to_vec())),
                ("<i4", bytes(&|v| i32::from(v).to_le_bytes().to_vec())),
                (">i4", bytes(&|v| i32::from(v).to_be_bytes().to_vec())),
            ] {
                let run = read(&plain(descr, fortran, "(3, 2)", &data)).unwrap();
                assert_eq!(run.channels, expected, "{descr} fortran {fortran}");
                assert_eq!((run.names, run.units, run.sample_rate_hz), (None, None, None));
            }
        }
    }

    #[test]
    fn one_dimension_is_one_channel_in_every_spelling() {
        let data: Vec<u8> = [1.5f64, 2.5].iter().flat_map(|v| v.to_le_bytes()).collect();
        for shape in ["(2,)", "( 2 , )", "(2L,)", "(2)", "(2, 1)"] {
            assert_eq!(read(&plain("<f8", false, shape, &data)).unwrap().channels, [[1.5, 2.5]], "{shape}");
        }
        let other = r#"{"shape":(2,),"fortran_order":False,"descr":"<f8"}"#;
        assert_eq!(read(&file(other, &data)).unwrap().channels, [[1.5, 2.5]]);
    }

    #[test]
    fn versions_two_and_three_have_a_longer_length() {
        let text = "{'descr': '<f8', 'fortran_order': False, 'shape': (1,)}\n";
        for version in [2, 3] {
            let mut file = b"\x93NUMPY".to_vec();
            file.extend([version, 0]);
            file.extend((text.len() as u32).to_le_bytes());
            file.extend(text.as_bytes());
            file.extend(7.0f64.to_le_bytes());
            assert_eq!(read(&file).unwrap().channels, [[7.0]]);
        }
    }

    #[test]
    fn types_that_are_not_read_are_refused_as_they_stand() {
        for descr in ["|O", "<f2", "<f16", "<c8", "<U5", "|S3", "|b1", "<i8", "<u4", "=f8", "f8", "", "é8"] {
            let error = read(&plain(descr, false, "(1,)", &[0; 8])).unwrap_err();
            assert_eq!(error, FormatError::NpyDtype { found: descr.into() });
            assert_eq!(error.code(), "npy.dtype");
        }
        let text = "{'descr': [('a', '<f4'), ('b', '<i4')], 'fortran_order': False, 'shape': (1,), }";
        let error = read(&file(text, &[0; 8])).unwrap_err();
        assert_eq!(error, FormatError::NpyDtype { found: "[('a', '<f4'), ('b', '<i4')]".into() });
    }

    #[test]
    fn shapes_are_compared_with_the_bytes_before_anything_is_allocated() {
        let refused = |shape: &str, data: &[u8]| read(&plain("<f8", false, shape, data)).unwrap_err();
        assert_eq!(refused("(3, 2)", &[0; 47]), FormatError::NpyTruncated { expected: 48, found: 47 });
        assert_eq!(refused("(3, 2)", &[0; 49]), FormatError::NpyTrailing { expected: 48, found: 49 });
        assert_eq!(
            refused("(1000000000000000, 2)", &[0; 16]),
            FormatError::NpyTruncated { expected: 16_000_000_000_000_000, found: 16 }
        );
        let huge = refused("(18446744073709551615, 18446744073709551615)", &[0; 16]);
        assert_eq!(huge, FormatError::NpyShape { found: vec![u64::MAX, u64::MAX] });
        assert_eq!(refused("(1, 2, 3)", &[0; 48]), FormatError::NpyShape { found: vec![1, 2, 3] });
        assert_eq!(refused("()", &[0; 8]), FormatError::NpyShape { found: vec![] });
        assert_eq!(refused("(0, 2)", &[]).code(), "run.empty");
        assert_eq!(refused("(2, 0)", &[]).code(), "run.no_channels");
        assert_eq!(refused("(1, 2000)", &[0; 16_000]).code(), "run.too_many_channels");
        for shape in ["(-1, 2)", "(1.0,)", "(18446744073709551616,)", "[1]", "(1,,2)", "(1", "((1,))"] {
            assert_eq!(refused(shape, &[0; 8]).code(), "npy.header", "{shape}");
        }
    }

    #[test]
    fn broken_headers_are_refused_at_every_length() {
        let good = plain("<f8", false, "(2,)", &[0; 16]);
        assert!(read(&good).is_ok());
        for len in 0..good.len() {
            let code = read(&good[..len]).unwrap_err().code();
            assert!(matches!(code, "npy.header" | "npy.truncated"), "{len}: {code}");
        }
        for text in [
            "",
            "{}",
            "[1]",
            "{'descr': '<f8', 'fortran_order': False}",
            "{'descr': '<f8', 'fortran_order': 0, 'shape': (1,)}",
            "{'descr': '<f8', 'descr': '<f8', 'fortran_order': False, 'shape': (1,)}",
            "{'descr': '<f8', 'fortran_order': False, 'shape': (1,), 'more': 1}",
            "{'descr': '<f8', 'fortran_order': False, 'shape': (1,)} 1",
            "{'descr': '<f8' 'fortran_order': False, 'shape': (1,)}",
            "{'descr",
        ] {
            assert_eq!(read(&file(text, &[0; 8])).unwrap_err().code(), "npy.header", "{text}");
        }
        let deep = format!("{{'descr': {}", "[".repeat(60_000));
        assert_eq!(read(&file(&deep, &[])).unwrap_err().code(), "npy.dtype");
        let mut old = good.clone();
        old[6] = 9;
        assert_eq!(read(&old).unwrap_err().code(), "npy.header");
    }

    #[test]
    fn not_finite_numbers_are_named_by_channel_and_sample() {
        let data: Vec<u8> = [0.0, 1.0, 2.0, f64::NAN].iter().flat_map(|v| v.to_le_bytes()).collect();
        let error = read(&plain("<f8", false, "(2, 2)", &data)).unwrap_err();
        assert_eq!(
            (error.code(), error.channel_index(), error.sample()),
            ("run.non_finite", Some(1), Some(1))
        );
        let error = read(&plain("<f8", true, "(4, 1)", &data)).unwrap_err();
        assert_eq!((error.channel_index(), error.sample()), (Some(0), Some(3)));
    }

    #[test]
    fn nothing_that_is_not_finite_is_written() {
        let error = write(&[vec![0.0, 1e300]], Dtype::F4, Order::C).unwrap_err();
        assert_eq!(
            (error.code(), error.channel_index(), error.sample()),
            ("run.non_finite", Some(0), Some(1))
        );
        assert!(write(&[vec![0.0], vec![f64::NAN]], Dtype::F8, Order::Fortran).is_err());
        assert_eq!(write(&[], Dtype::F8, Order::C).unwrap_err().code(), "run.no_channels");
        let error = write(&[vec![0.0], vec![]], Dtype::F8, Order::C).unwrap_err();
        assert_eq!((error.code(), error.channel_index()), ("run.unequal_lengths", Some(1)));
    }

    #[test]
    fn numbers_begin_where_the_header_says_and_on_a_multiple_of_64() {
        let file = write(&[vec![1.0, 2.0], vec![3.0, 4.0]], Dtype::F8, Order::Fortran).unwrap();
        let header = header(&file).unwrap();
        assert_eq!((header.samples, header.channels, header.order), (2, 2, Order::Fortran));
        assert_eq!(header.data_offset % 64, 0);
        let at = header.data_offset + 8 * 2;
        assert_eq!(file[at..at + 8], 3.0f64.to_le_bytes());
    }

    fn channels() -> impl Strategy<Value = Vec<Vec<f64>>> {
        (1usize..5, 1usize..40).prop_flat_map(|(c, n)| {
            prop::collection::vec(prop::collection::vec(prop::num::f64::NORMAL, n), c)
        })
    }

    proptest! {
        #[test]
        fn what_is_written_reads_back_and_npyz_agrees(channels in channels(), fortran: bool) {
            let order = if fortran { Order::Fortran } else { Order::C };
            let file = write(&channels, Dtype::F8, order).unwrap();
            prop_assert_eq!(&read(&file).unwrap().channels, &channels);
            let theirs = npyz::NpyFile::new(&file[..]).unwrap();
            prop_assert_eq!(theirs.shape(), [channels[0].len() as u64, channels.len() as u64]);
            let strides = theirs.strides().to_vec();
            let flat: Vec<f64> = theirs.into_vec().unwrap();
            for (c, samples) in channels.iter().enumerate() {
                for (i, v) in samples.iter().enumerate() {
                    prop_assert_eq!(flat[i * strides[0] as usize + c * strides[1] as usize], *v);
                }
            }
        }

        #[test]
        fn single_precision_rounds_once(
            channels in prop::collection::vec(prop::collection::vec(-1e30..1e30f64, 7), 1..4)
        ) {
            let rounded: Vec<Vec<f64>> =
                channels.iter().map(|c| c.iter().map(|&v| f64::from(v as f32)).collect()).collect();
            let file = write(&channels, Dtype::F4, Order::C).unwrap();
            prop_assert_eq!(read(&file).unwrap().channels, rounded);
        }

        #[test]
        fn any_bytes_are_read_or_refused(bytes in prop::collection::vec(any::<u8>(), 0..200), prefix: bool) {
            let bytes = if prefix { plain("<f8", false, "(2, 3)", &bytes) } else { bytes };
            if let Ok(run) = read(&bytes) {
                prop_assert_eq!(run.channels.len(), 3);
            }
        }
    }
}
