//! NPY, the file of NumPy's `save`: `[samples, channels]`, or one channel as `[samples]`.
//!
//! The header is read here and not by the npyz crate: its parser descends into nested brackets
//! without a limit and multiplies shapes unchecked, which a file from outside must not reach. The tests read our
//! files with npyz.

mod batch;
mod header;
mod pieces;

use std::io::Read;

use realfft::num_complex::Complex64;

use super::{ChannelAt, FormatError, ParsedRun, ReadError, Spool};

pub use batch::{Batch, read_batch};
pub(super) use header::ArrayHead;
pub use header::{Header, batch_header, header};
pub use pieces::NpyPieces;

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

/// The index that runs fastest in a file of `[samples, channels]`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Order {
    /// The channel: all channels of sample 0 come first.
    C,
    /// The sample: all samples of channel 0 come first, as in memory.
    Fortran,
}

/// Samples that are transposed at once: few enough to stay in the cache until the last channel is done.
const SAMPLES_AT_ONCE: usize = 1024;

/// Reads a file; names, units and sample rate are not part of the format.
///
/// # Errors
/// Those of [`header`]; `run.non_finite` with channel and sample.
pub fn read(file: &[u8]) -> Result<ParsedRun, FormatError> {
    let header = header(file)?;
    let read = numbers(&header, &file[header.data_offset..], Spool::in_memory());
    read.map(ParsedRun::into_memory).map_err(ReadError::of_bytes)
}

/// [`read`] for a file of `len` bytes that is not in memory: only a piece of it is kept at a time, and its
/// samples go to an empty spool.
///
/// # Errors
/// As [`read`]; errors of the file system.
pub fn read_from(mut file: impl Read, len: u64, spool: Spool) -> Result<ParsedRun<Spool>, ReadError> {
    let mut start = Vec::new();
    (&mut file).take(header::START as u64).read_to_end(&mut start)?;
    let text = header::text(&start, len)?;
    // It is no longer than the file.
    (&mut file).take(text.end.saturating_sub(start.len()) as u64).read_to_end(&mut start)?;
    let Some(found) = start.get(text.clone()) else {
        return Err(std::io::Error::from(std::io::ErrorKind::UnexpectedEof).into());
    };
    let header = header::check(found, text.end, len - text.end as u64)?;
    // A short header ends before the start does.
    let rest = start.split_off(text.end);
    numbers(&header, rest.as_slice().chain(file), spool)
}

/// Reads the numbers after a header.
fn numbers(header: &Header, data: impl Read, mut spool: Spool) -> Result<ParsedRun<Spool>, ReadError> {
    let to = &mut spool;
    match (header.dtype, header.big_endian) {
        (Dtype::F4, false) => values(header, data, to, |b| f64::from(f32::from_le_bytes(b))),
        (Dtype::F4, true) => values(header, data, to, |b| f64::from(f32::from_be_bytes(b))),
        (Dtype::F8, false) => values(header, data, to, f64::from_le_bytes),
        (Dtype::F8, true) => values(header, data, to, f64::from_be_bytes),
        (Dtype::I2, false) => values(header, data, to, |b| f64::from(i16::from_le_bytes(b))),
        (Dtype::I2, true) => values(header, data, to, |b| f64::from(i16::from_be_bytes(b))),
        (Dtype::I4, false) => values(header, data, to, |b| f64::from(i32::from_le_bytes(b))),
        (Dtype::I4, true) => values(header, data, to, |b| f64::from(i32::from_be_bytes(b))),
    }?;
    Ok(ParsedRun::of(spool).check()?)
}

/// Numbers of `N` bytes, sorted into channels.
fn values<const N: usize>(
    header: &Header,
    mut data: impl Read,
    spool: &mut Spool,
    number: impl Fn([u8; N]) -> f64,
) -> std::io::Result<()> {
    // These sizes were compared with the number of bytes.
    spool.add_columns(header.channels);
    spool.reserve(header.samples);
    // Channels one after the other are read as files of one channel each.
    let step = if header.order == Order::C { header.channels } else { 1 };
    let mut piece = Vec::new();
    for first in (0..header.channels).step_by(step) {
        for from in (0..header.samples).step_by(SAMPLES_AT_ONCE) {
            let rows = SAMPLES_AT_ONCE.min(header.samples - from);
            piece.resize(rows * step * N, 0);
            data.read_exact(&mut piece)?;
            let (numbers, _) = piece.as_chunks::<N>();
            for c in 0..step {
                spool.extend(first + c, numbers[c..].iter().step_by(step).map(|&b| number(b)))?;
            }
        }
    }
    Ok(())
}

/// Writes `[channel][sample]` as `<f4` or `<f8` (integers are not written) of shape
/// `[samples, channels]`.
///
/// # Errors
/// `run.*` codes where the channels are not a run; `run.non_finite` too where a number does not fit
/// into `<f4`.
///
/// # Panics
/// If `dtype` is an integer, which is a defect of the caller.
pub fn write(channels: &[Vec<f64>], dtype: Dtype, order: Order) -> Result<Vec<u8>, FormatError> {
    let samples = check_equal(channels)?;
    let mut file = npy_header(samples, channels.len(), dtype, order);
    file.reserve_exact(samples * channels.len() * dtype.size());
    match order {
        Order::C => put(&mut file, channels, dtype, 0)?,
        // One channel after the other, each as a file of its own would have it.
        Order::Fortran => {
            for (index, channel) in channels.iter().enumerate() {
                put(&mut file, std::slice::from_ref(channel), dtype, 0).map_err(|error| match error {
                    FormatError::NonFinite { channel, sample, row, column } => {
                        let channel = ChannelAt { index, ..channel };
                        FormatError::NonFinite { channel, sample, row, column }
                    }
                    error => error,
                })?;
            }
        }
    }
    Ok(file)
}

/// Writes a `<f4` file of shape `[samples, channels]` or `[batch, samples, channels]` in C order, piece by piece.
#[derive(Debug)]
pub struct Writer {
    file: Vec<u8>,
    samples: usize,
    written: usize,
}

impl Writer {
    /// A file of this size, without its samples.
    pub fn new(samples: usize, channels: usize) -> Self {
        Self::of_shape(&[samples, channels])
    }

    /// A file of a batch, without its samples.
    pub fn of_batch(batch: usize, samples: usize, channels: usize) -> Self {
        Self::of_shape(&[batch, samples, channels])
    }

    fn of_shape(shape: &[usize]) -> Self {
        let mut file = header_of("<f4", shape, Order::C);
        file.reserve_exact(shape.iter().product::<usize>() * Dtype::F4.size());
        let samples = shape[..shape.len() - 1].iter().product();
        Self { file, samples, written: 0 }
    }

    /// Adds the next samples of all channels.
    ///
    /// # Errors
    /// `run.unequal_lengths`; `run.non_finite` where a number does not fit into `<f4`, with the
    /// sample counted from the start of the file.
    pub fn write(&mut self, channels: &[Vec<f64>]) -> Result<(), FormatError> {
        let samples = check_equal(channels)?;
        put(&mut self.file, channels, Dtype::F4, self.written)?;
        self.written += samples;
        Ok(())
    }

    /// The file.
    ///
    /// # Panics
    /// If not all samples have been written, which is a defect of the caller.
    pub fn finish(self) -> Vec<u8> {
        assert_eq!(self.written, self.samples, "a file has as many samples as its header says");
        self.file
    }
}

/// Appends `[channel][sample]` as `<f4` in C order, without a header; `first` is the number of the first
/// sample.
///
/// # Errors
/// `run.non_finite` where a number does not fit into `<f4`.
pub fn put_f4(bytes: &mut Vec<u8>, channels: &[Vec<f64>], first: usize) -> Result<(), FormatError> {
    put(bytes, channels, Dtype::F4, first)
}

/// Appends `[channel][sample]` in C order; `first` is the number of the first sample.
fn put(file: &mut Vec<u8>, channels: &[Vec<f64>], dtype: Dtype, first: usize) -> Result<(), FormatError> {
    let finite = match dtype {
        Dtype::F4 => put_as(file, channels, |v| ((v as f32).to_le_bytes(), (v as f32).is_finite())),
        _ => put_as(file, channels, |v| (v.to_le_bytes(), v.is_finite())),
    };
    if finite {
        return Ok(());
    }
    let fits = |v: f64| if dtype == Dtype::F4 { (v as f32).is_finite() } else { v.is_finite() };
    let places =
        channels.iter().enumerate().filter_map(|(c, s)| Some((s.iter().position(|&v| !fits(v))?, c)));
    let (sample, index) = places.min().expect("one of them was not finite");
    let channel = ChannelAt { index, name: None };
    Err(FormatError::NonFinite { channel, sample: first + sample, row: None, column: None })
}

/// Appends numbers of `N` bytes; returns whether all were finite.
fn put_as<const N: usize>(
    file: &mut Vec<u8>,
    channels: &[Vec<f64>],
    number: impl Fn(f64) -> ([u8; N], bool),
) -> bool {
    let (samples, mut finite) = (channels[0].len(), true);
    for from in (0..samples).step_by(SAMPLES_AT_ONCE) {
        let to = samples.min(from + SAMPLES_AT_ONCE);
        let start = file.len();
        file.resize(start + (to - from) * channels.len() * N, 0);
        let (places, _) = file[start..].as_chunks_mut::<N>();
        for (c, channel) in channels.iter().enumerate() {
            for (place, &v) in places[c..].iter_mut().step_by(channels.len()).zip(&channel[from..to]) {
                let (bytes, is_finite) = number(v);
                *place = bytes;
                finite &= is_finite;
            }
        }
    }
    finite
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

/// An array of any number of dimensions that goes out, in C order.
#[derive(Debug)]
pub enum Array<'a> {
    /// `<f8`
    Real(&'a [f64]),
    /// `<c16`: real and imaginary part in turn
    Complex(&'a [Complex64]),
}

impl Array<'_> {
    /// The header of a file of arrays of this type, of shape `shape` together.
    pub fn header(&self, shape: &[usize]) -> Vec<u8> {
        let descr = match self {
            Self::Real(_) => "<f8",
            Self::Complex(_) => "<c16",
        };
        header_of(descr, shape, Order::C)
    }

    /// Appends the numbers.
    pub fn put(&self, file: &mut Vec<u8>) {
        match self {
            Self::Real(numbers) => numbers.iter().for_each(|v| file.extend(v.to_le_bytes())),
            Self::Complex(numbers) => {
                numbers.iter().flat_map(|z| [z.re, z.im]).for_each(|v| file.extend(v.to_le_bytes()));
            }
        }
    }

    /// Bytes of one number.
    pub fn size_of_number(&self) -> usize {
        match self {
            Self::Real(_) => size_of::<f64>(),
            Self::Complex(_) => size_of::<Complex64>(),
        }
    }
}

fn npy_header(samples: usize, channels: usize, dtype: Dtype, order: Order) -> Vec<u8> {
    let descr = match dtype {
        Dtype::F4 => "<f4",
        Dtype::F8 => "<f8",
        Dtype::I2 | Dtype::I4 => unreachable!("integers are only read: this is a bug"),
    };
    header_of(descr, &[samples, channels], order)
}

/// The header that NumPy writes: version 1.0, padded so that the numbers begin at a multiple of 64 bytes.
fn header_of(descr: &str, shape: &[usize], order: Order) -> Vec<u8> {
    let fortran = if order == Order::Fortran { "True" } else { "False" };
    // A tuple of one has a comma too.
    let one = if shape.len() == 1 { "," } else { "" };
    let shape = shape.iter().map(usize::to_string).collect::<Vec<_>>().join(", ");
    let mut dict = format!("{{'descr': '{descr}', 'fortran_order': {fortran}, 'shape': ({shape}{one}), }}");
    // Magic, version and length take ten bytes; a line feed ends the header.
    dict.extend(std::iter::repeat_n(' ', 63 - (10 + dict.len()) % 64));
    dict.push('\n');
    let len = u16::try_from(dict.len()).expect("some numbers fit into 64 KiB");
    [b"\x93NUMPY\x01\x00", &len.to_le_bytes()[..], dict.as_bytes()].concat()
}

#[cfg(test)]
mod tests;
