//! Writing MAT of version 5 piece by piece, so that a file of any length takes the memory of a few thousand samples.

use std::io;

use super::HEADER;
use super::element::MATRIX;
use crate::engine::Samples;
use crate::formats::NUMBERS_AT_ONCE;

/// Most bytes of the samples: MATLAB reads variables of less than 2 GiB from version 5.
const MAX_DATA_BYTES: u64 = (1 << 31) - 1;

/// The pieces of a file with the variables `fs` (sample rate, Hz), `names` and `units` (a cell array of text, one a
/// channel) and `data` (`[samples, channels]`).
#[derive(Debug)]
pub struct MatPieces<S> {
    samples: S,
    head: Vec<u8>,
    /// The next samples: channel and its first sample.
    next: Option<(usize, usize)>,
}

impl<S: Samples> MatPieces<S> {
    /// The file of these samples; `None` where they are 2 GiB or more.
    pub fn new(names: &[String], units: &[String], samples: S) -> Option<Self> {
        let (rows, columns) = (samples.n_samples() as u64, samples.n_channels() as u64);
        let bytes = rows.checked_mul(columns)?.checked_mul(size_of::<f64>() as u64)?;
        let data_bytes = u32::try_from(bytes).ok().filter(|_| bytes <= MAX_DATA_BYTES)?;
        let mut head = header();
        let rate = element(DOUBLES, &samples.sample_rate_hz().to_le_bytes());
        head.extend(array(DOUBLE_CLASS, [1, 1], "fs", &rate));
        for (name, texts) in [("names", names), ("units", units)] {
            let cells: Vec<u8> = texts.iter().flat_map(|t| text(t)).collect();
            head.extend(array(CELL_CLASS, [1, texts.len() as u32], name, &cells));
        }
        // Both are less than the bytes.
        let start = array_head(DOUBLE_CLASS, [rows as u32, columns as u32], "data");
        let tag = [DOUBLES.to_le_bytes(), data_bytes.to_le_bytes()].concat();
        let size = (start.len() + tag.len()) as u32 + data_bytes;
        head.extend([MATRIX.to_le_bytes(), size.to_le_bytes()].concat());
        head.extend([start, tag].concat());
        Some(Self { samples, head, next: Some((0, 0)) })
    }

    /// Bytes of the whole file, before its first piece was taken.
    pub fn size(&self) -> u64 {
        let numbers = self.samples.n_samples() as u64 * self.samples.n_channels() as u64;
        self.head.len() as u64 + numbers * size_of::<f64>() as u64
    }
}

impl<S: Samples> Iterator for MatPieces<S> {
    type Item = io::Result<Vec<u8>>;

    fn next(&mut self) -> Option<io::Result<Vec<u8>>> {
        let (channel, from) = self.next?;
        let n = self.samples.n_samples();
        let to = n.min(from + NUMBERS_AT_ONCE);
        self.next = match (channel, to) {
            (channel, to) if to < n => Some((channel, to)),
            (channel, _) => Some((channel + 1, 0)).filter(|_| channel + 1 < self.samples.n_channels()),
        };
        let mut values = Vec::new();
        if let Err(error) = self.samples.read(channel, from..to, &mut values) {
            return Some(Err(error));
        }
        let mut bytes = std::mem::take(&mut self.head);
        bytes.extend(values.iter().flat_map(|value| value.to_le_bytes()));
        Some(Ok(bytes))
    }
}

/// The class of an array of doubles, and the type of its numbers.
const DOUBLE_CLASS: u32 = 6;
const DOUBLES: u32 = 9;

/// Classes of cells and text, and the type of text in 16 bits a character.
const CELL_CLASS: u32 = 1;
const CHAR_CLASS: u32 = 4;
const UTF16: u32 = 17;

/// The header of a file in little-endian byte order.
fn header() -> Vec<u8> {
    let mut header = format!("{:116}", "MATLAB 5.0 MAT-file, written by Rigcast").into_bytes();
    header.extend([0; 8]);
    header.extend(b"\0\x01IM");
    debug_assert_eq!(header.len(), HEADER);
    header
}

/// An element: its tag, its data, and zeros up to a multiple of 8 bytes.
fn element(kind: u32, data: &[u8]) -> Vec<u8> {
    let mut bytes = [kind.to_le_bytes(), (data.len() as u32).to_le_bytes()].concat();
    bytes.extend(data);
    bytes.resize(bytes.len().next_multiple_of(8), 0);
    bytes
}

/// What comes before the content of an array: flags, size and name.
fn array_head(class: u32, shape: [u32; 2], name: &str) -> Vec<u8> {
    let flags = element(6, &[class.to_le_bytes(), [0; 4]].concat());
    let shape = element(5, &shape.map(u32::to_le_bytes).concat());
    [flags, shape, element(1, name.as_bytes())].concat()
}

fn array(class: u32, shape: [u32; 2], name: &str, content: &[u8]) -> Vec<u8> {
    element(MATRIX, &[&array_head(class, shape, name), content].concat())
}

/// A row of text without a name, as a cell holds it.
fn text(text: &str) -> Vec<u8> {
    let units: Vec<u8> = text.encode_utf16().flat_map(u16::to_le_bytes).collect();
    let n = units.len() / 2;
    array(CHAR_CLASS, [u32::from(n > 0), n as u32], "", &element(UTF16, &units))
}

#[cfg(test)]
mod tests {
    use super::super::read;
    use super::*;
    use crate::engine::Signal;

    #[test]
    fn pieces_read_back_as_the_run_and_their_size_is_known() {
        for n in [2, 7, NUMBERS_AT_ONCE, 2 * NUMBERS_AT_ONCE + 1] {
            let channels: Vec<Vec<f64>> =
                (1..4).map(|k| (0..n).map(|i| f64::from(k) + 0.1 * i as f64).collect()).collect();
            let names = ["force x", "Weg µ", "a"].map(str::to_owned);
            let units = ["kN", "", "m/s²"].map(str::to_owned);
            let signal = Signal::new(819.2, channels.clone()).unwrap();
            let pieces = MatPieces::new(&names, &units, signal).unwrap();
            let size = pieces.size();
            let file = pieces.collect::<io::Result<Vec<_>>>().unwrap().concat();
            assert_eq!(file.len() as u64, size);
            let run = read(&file).unwrap();
            assert!(run.channels == channels, "{n} samples");
            assert_eq!((run.names.unwrap(), run.units.unwrap()), (names.to_vec(), units.to_vec()));
            assert_eq!(run.sample_rate_hz, Some(819.2));
        }
    }

    #[test]
    fn samples_of_2_gib_are_not_written() {
        /// Samples that are never read.
        struct Long(usize);

        impl Samples for Long {
            fn sample_rate_hz(&self) -> f64 {
                1.0
            }

            fn n_channels(&self) -> usize {
                2
            }

            fn n_samples(&self) -> usize {
                self.0
            }

            fn read(&mut self, _: usize, _: std::ops::Range<usize>, _: &mut Vec<f64>) -> io::Result<()> {
                unreachable!("nothing is written")
            }
        }

        let names = ["u", "y"].map(str::to_owned);
        assert!(MatPieces::new(&names, &names, Long((1 << 27) - 1)).is_some());
        assert!(MatPieces::new(&names, &names, Long(1 << 27)).is_none());
        assert!(MatPieces::new(&names, &names, Long(usize::MAX)).is_none());
    }
}
