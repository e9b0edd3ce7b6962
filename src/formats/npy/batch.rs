//! A batch of signals in one file: `[batch, samples, channels]`.

use super::header::batch_header;
use super::{Order, numbers};
use crate::formats::{FormatError, ParsedRun, ReadError, Spool};

/// The signals of a file, each `[channel][sample]`.
#[derive(Debug, PartialEq)]
pub struct Batch {
    /// The signals, in their order.
    pub signals: Vec<Vec<Vec<f64>>>,
    /// Whether the file has the dimension of the batch, with one signal too.
    pub is_batch: bool,
}

/// Reads a file of one signal or of a batch.
///
/// # Errors
/// Those of [`batch_header`]; `run.non_finite` with channel and sample, and of a batch with the signal.
pub fn read_batch(file: &[u8]) -> Result<Batch, FormatError> {
    let (header, batch) = batch_header(file)?;
    let read = numbers(&header, &file[header.data_offset..], Spool::in_memory());
    let run = read.map(ParsedRun::into_memory).map_err(ReadError::of_bytes);
    let Some(batch) = batch else {
        return Ok(Batch { signals: vec![run?.channels], is_batch: false });
    };
    let samples = header.samples / batch;
    // In Fortran order the index of the batch runs fastest.
    let place = |row: usize| match header.order {
        Order::C => (row / samples, row % samples),
        Order::Fortran => (row % batch, row / batch),
    };
    let run = run.map_err(|error| match error {
        FormatError::NonFinite { channel, sample, .. } => {
            let (signal, sample) = place(sample);
            FormatError::NonFiniteInBatch { signal, channel, sample }
        }
        error => error,
    })?;
    let mut signals: Vec<Vec<Vec<f64>>> = (0..batch).map(|_| Vec::with_capacity(header.channels)).collect();
    for channel in run.channels {
        for (index, signal) in signals.iter_mut().enumerate() {
            signal.push(match header.order {
                Order::C => channel[index * samples..][..samples].to_vec(),
                Order::Fortran => channel[index..].iter().step_by(batch).copied().collect(),
            });
        }
    }
    Ok(Batch { signals, is_batch: true })
}

#[cfg(test)]
mod tests {
    use super::super::{Dtype, header_of, write};
    use super::*;

    /// A `<f8` file of the numbers in the order of the file.
    fn file(shape: &[usize], order: Order, numbers: impl IntoIterator<Item = f64>) -> Vec<u8> {
        let mut file = header_of("<f8", shape, order);
        file.extend(numbers.into_iter().flat_map(f64::to_le_bytes));
        file
    }

    /// Number of signal `b`, sample `t` and channel `c`.
    fn value(b: usize, t: usize, c: usize) -> f64 {
        (100 * b + 10 * t + c) as f64
    }

    #[test]
    fn a_batch_is_read_in_either_order() {
        let indices = || (0..2).flat_map(|b| (0..3).flat_map(move |t| (0..2).map(move |c| (b, t, c))));
        let expected: Vec<Vec<Vec<f64>>> =
            (0..2).map(|b| (0..2).map(|c| (0..3).map(|t| value(b, t, c)).collect()).collect()).collect();
        let c = file(&[2, 3, 2], Order::C, indices().map(|(b, t, c)| value(b, t, c)));
        let reversed = (0..2).flat_map(|c| (0..3).flat_map(move |t| (0..2).map(move |b| value(b, t, c))));
        let fortran = file(&[2, 3, 2], Order::Fortran, reversed);
        for file in [c, fortran] {
            let batch = read_batch(&file).expect("a batch");
            assert_eq!(batch, Batch { signals: expected.clone(), is_batch: true });
        }
        let one = read_batch(&write(&expected[1], Dtype::F8, Order::C).expect("a file")).expect("a signal");
        assert_eq!(one, Batch { signals: vec![expected[1].clone()], is_batch: false });
    }

    #[test]
    fn a_number_that_is_none_is_found_in_its_signal() {
        let at = |order, row: usize| {
            let numbers = (0..12).map(|i| if i == row { f64::NAN } else { 0.5 });
            match read_batch(&file(&[2, 3, 2], order, numbers)) {
                Err(FormatError::NonFiniteInBatch { signal, channel, sample }) => {
                    (signal, sample, channel.index)
                }
                other => panic!("{other:?}"),
            }
        };
        // The index (1, 2, 0).
        assert_eq!(at(Order::C, 10), (1, 2, 0));
        assert_eq!(at(Order::Fortran, 5), (1, 2, 0));
    }

    #[test]
    fn sizes_that_do_not_suit_are_refused() {
        let read = |shape: &[usize], n: usize| read_batch(&file(shape, Order::C, vec![0.0; n])).unwrap_err();
        assert!(matches!(read(&[0, 3, 2], 0), FormatError::Empty));
        assert!(matches!(read(&[2, 0, 2], 0), FormatError::Empty));
        assert!(matches!(read(&[2, 3, 0], 0), FormatError::NoChannels));
        assert!(matches!(read(&[2, 3, 2], 11), FormatError::NpyTruncated { .. }));
        assert!(matches!(read(&[2, 3, 2], 13), FormatError::NpyTrailing { .. }));
        assert!(matches!(read(&[usize::MAX, 2, 1], 1), FormatError::NpyShape { .. }));
        assert!(matches!(read(&[1, 1, 1, 1], 1), FormatError::NpyShape { .. }));
    }
}
