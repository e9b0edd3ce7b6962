//! NPY, the file of NumPy's `save`: `[samples, channels]`, or one channel as `[samples]`.
//!
//! The header is read here and not by the npyz crate: its parser descends into nested brackets
//! without a limit and multiplies shapes unchecked, which a file from outside must not reach. npyz
//! writes our headers, and the tests read our files with it.

mod header;

use npyz::WriterBuilder;

use super::{ChannelAt, FormatError, ParsedRun};

pub use header::{Header, header};

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

#[cfg(test)]
mod tests;
