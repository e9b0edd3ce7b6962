//! One array of an FRF as an NPY file, piece by piece.

use std::io;

use super::arrays::Arrays;
use super::query::Part;
use crate::http::problem::{Answer, Problem};

/// The pieces of the file.
#[derive(Debug)]
pub struct FrfNpyPieces {
    arrays: Arrays,
    part: Part,
    head: Vec<u8>,
    size: u64,
    /// The next line.
    at: usize,
}

impl FrfNpyPieces {
    /// The file of one part.
    ///
    /// # Errors
    /// None that a query can cause.
    pub fn new(arrays: Arrays, part: Part) -> Answer<Self> {
        let (lines, at) = (arrays.lines.len(), arrays.lines.start);
        let shape = [vec![lines], arrays.axes(part)].concat();
        let first = arrays.numbers(part, at..at + 1).map_err(Problem::internal)?;
        let head = first.as_array().header(&shape);
        let numbers = first.as_array().size_of_number() * lines * arrays.width(part);
        drop(first);
        let size = (head.len() + numbers) as u64;
        Ok(Self { arrays, part, head, size, at })
    }

    /// Bytes of the file.
    pub fn size(&self) -> u64 {
        self.size
    }
}

impl Iterator for FrfNpyPieces {
    type Item = io::Result<Vec<u8>>;

    fn next(&mut self) -> Option<io::Result<Vec<u8>>> {
        if self.at == self.arrays.lines.end {
            return None;
        }
        let lines = self.arrays.piece(self.at, self.arrays.width(self.part));
        self.at = lines.end;
        let mut bytes = std::mem::take(&mut self.head);
        Some(self.arrays.numbers(self.part, lines).map(|numbers| {
            numbers.as_array().put(&mut bytes);
            bytes
        }))
    }
}
