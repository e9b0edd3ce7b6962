//! Signals as NPY files (format 1.0): `<f8`, Fortran order, shape `[samples, channels]`.
//!
//! In Fortran order one channel follows the other, as in memory. The store reads only files that it has
//! written, so reading means comparing the header with the expected one.

use std::io::{self, Write};

use crate::engine::samples::{Samples, each_block};

/// The header of a signal: 64-byte aligned, as NumPy writes it.
pub(super) fn header(samples: usize, channels: usize) -> Vec<u8> {
    let mut dict = format!("{{'descr': '<f8', 'fortran_order': True, 'shape': ({samples}, {channels}), }}");
    // Magic, version and length take ten bytes; a line feed ends the header.
    let padding = 63 - (10 + dict.len()) % 64;
    dict.extend(std::iter::repeat_n(' ', padding));
    dict.push('\n');
    let len = u16::try_from(dict.len()).expect("two numbers fit into 64 KiB");
    let mut header = b"\x93NUMPY\x01\x00".to_vec();
    header.extend(len.to_le_bytes());
    header.extend(dict.as_bytes());
    header
}

/// Writes samples as an NPY file, some at a time.
///
/// # Errors
/// Those of the file that holds the samples, and of the one that is written.
pub(super) fn encode(samples: &mut impl Samples, file: &mut impl Write) -> io::Result<()> {
    file.write_all(&header(samples.n_samples(), samples.n_channels()))?;
    let mut bytes: Vec<u8> = Vec::new();
    for channel in 0..samples.n_channels() {
        each_block(samples, channel, |block| {
            bytes.clear();
            bytes.extend(block.iter().flat_map(|value| value.to_le_bytes()));
            file.write_all(&bytes)
        })?;
    }
    Ok(())
}

/// Bytes of a file of this shape, header included.
pub(super) fn size(samples: usize, channels: usize) -> Option<u64> {
    let numbers = (samples as u64).checked_mul(channels as u64)?;
    numbers.checked_mul(8)?.checked_add(header(samples, channels).len() as u64)
}

/// Channels of an NPY file that [`encode`] made; `None` when it is not one of this shape.
pub(super) fn decode(bytes: &[u8], samples: usize, channels: usize) -> Option<Vec<Vec<f64>>> {
    let data = bytes.strip_prefix(header(samples, channels).as_slice())?;
    let per_channel = samples.checked_mul(8)?;
    if data.len() != per_channel.checked_mul(channels)? || per_channel == 0 {
        return None;
    }
    let (values, _) = data.as_chunks::<8>();
    Some(values.chunks(samples).map(|c| c.iter().map(|b| f64::from_le_bytes(*b)).collect()).collect())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::engine::Signal;

    fn encode(channels: Vec<Vec<f64>>) -> Vec<u8> {
        let mut bytes = Vec::new();
        super::encode(&mut Signal::new(1.0, channels).unwrap(), &mut bytes).unwrap();
        bytes
    }

    #[test]
    fn a_signal_survives_bit_for_bit() {
        let channels = vec![vec![0.1, -0.0, f64::MAX], vec![f64::MIN_POSITIVE, 5e-324, 1.0]];
        let bytes = encode(channels.clone());
        let back = decode(&bytes, 3, 2).unwrap();
        let bits = |c: &[Vec<f64>]| c.iter().flatten().map(|v| v.to_bits()).collect::<Vec<_>>();
        assert_eq!(bits(&back), bits(&channels));
        assert_eq!(back.len(), 2);
    }

    #[test]
    fn the_file_is_what_other_programs_call_npy() {
        let bytes = encode(vec![vec![1.0, 2.0], vec![3.0, 4.0], vec![5.0, 6.0]]);
        let npy = npyz::NpyFile::new(&bytes[..]).unwrap();
        assert_eq!((npy.shape(), npy.order()), (&[2u64, 3][..], npyz::Order::Fortran));
        assert_eq!(npy.into_vec::<f64>().unwrap(), [1.0, 2.0, 3.0, 4.0, 5.0, 6.0]);
        for samples in 0..2000 {
            assert_eq!(header(samples, 6).len() % 64, 0);
        }
    }

    #[test]
    fn another_shape_or_length_is_refused() {
        let bytes = encode(vec![vec![1.0, 2.0], vec![3.0, 4.0]]);
        assert!(decode(&bytes, 4, 1).is_none());
        assert!(decode(&bytes[..bytes.len() - 1], 2, 2).is_none());
        assert!(decode(&[], 2, 2).is_none());
    }
}
