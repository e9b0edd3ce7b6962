//! Columns of numbers as a reader finds them: in memory, or in a temporary file with the memory of a few
//! thousand numbers a column.

use std::io;
use std::ops::Range;
use std::os::unix::fs::FileExt;
use std::path::{Path, PathBuf};

use tempfile::NamedTempFile;

use crate::engine::{Samples, first_not_finite};

/// Numbers of a column that are written to the file at once.
const BLOCK: usize = 1 << 12;

/// Columns that grow side by side.
#[derive(Debug, Default)]
pub struct Spool {
    /// The place for the file; without one, all numbers stay in memory.
    directory: Option<PathBuf>,
    /// Made for the first block, deleted with the spool.
    file: Option<NamedTempFile>,
    /// Bytes of the file.
    end: u64,
    columns: Vec<Column>,
}

#[derive(Debug, Default)]
struct Column {
    /// First byte of each block in the file.
    blocks: Vec<u64>,
    /// Numbers after those of the blocks.
    rest: Vec<f64>,
    /// The first number of the blocks that is NaN or infinite.
    not_finite: Option<usize>,
}

impl Column {
    fn len(&self) -> usize {
        BLOCK * self.blocks.len() + self.rest.len()
    }
}

impl Spool {
    /// Keeps all numbers in memory.
    pub fn in_memory() -> Self {
        Self::default()
    }

    /// Keeps long columns in a temporary file in `directory`.
    pub fn in_file(directory: &Path) -> Self {
        Self { directory: Some(directory.to_owned()), ..Self::default() }
    }

    /// A spool without columns, in the same place.
    pub fn another(&self) -> Self {
        Self { directory: self.directory.clone(), ..Self::default() }
    }

    /// Adds empty columns.
    pub fn add_columns(&mut self, n: usize) {
        self.columns.resize_with(self.columns.len() + n, Column::default);
    }

    /// Number of columns.
    pub fn n_columns(&self) -> usize {
        self.columns.len()
    }

    /// Numbers of a column.
    ///
    /// # Panics
    /// If there is no such column.
    pub fn len(&self, column: usize) -> usize {
        self.columns[column].len()
    }

    /// Reserves memory for columns of `n` numbers that stay in memory. Columns that grow side by side would
    /// leave as much freed memory behind as they hold.
    pub(super) fn reserve(&mut self, n: usize) {
        if self.directory.is_none() {
            self.columns.iter_mut().for_each(|column| column.rest.reserve_exact(n));
        }
    }

    /// Appends a number to a column.
    ///
    /// # Errors
    /// Those of the file.
    ///
    /// # Panics
    /// If there is no such column.
    pub fn push(&mut self, column: usize, value: f64) -> io::Result<()> {
        self.columns[column].rest.push(value);
        self.write_blocks(column)
    }

    /// Appends numbers to a column.
    ///
    /// # Errors
    /// Those of the file.
    ///
    /// # Panics
    /// If there is no such column.
    pub fn extend(&mut self, column: usize, values: impl IntoIterator<Item = f64>) -> io::Result<()> {
        self.columns[column].rest.extend(values);
        self.write_blocks(column)
    }

    /// Writes the numbers of a column that fill a block.
    fn write_blocks(&mut self, column: usize) -> io::Result<()> {
        let column = &mut self.columns[column];
        let Some(directory) = self.directory.as_ref().filter(|_| column.rest.len() >= BLOCK) else {
            return Ok(());
        };
        if self.file.is_none() {
            self.file = Some(NamedTempFile::new_in(directory)?);
        }
        let file = self.file.as_ref().expect("made above").as_file();
        let (blocks, _) = column.rest.as_chunks::<BLOCK>();
        for block in blocks {
            if column.not_finite.is_none() {
                let before = BLOCK * column.blocks.len();
                column.not_finite = first_not_finite(block).map(|at| before + at);
            }
            file.write_all_at(bytemuck::cast_slice(block), self.end)?;
            column.blocks.push(self.end);
            self.end += size_of_val(block) as u64;
        }
        let written = BLOCK * blocks.len();
        column.rest.drain(..written);
        Ok(())
    }

    /// Shortens all columns to their first `n` numbers.
    ///
    /// # Errors
    /// Those of the file.
    pub(super) fn truncate(&mut self, n: usize) -> io::Result<()> {
        for index in 0..self.columns.len() {
            if self.len(index) <= n {
                continue;
            }
            let blocks = (n / BLOCK).min(self.columns[index].blocks.len());
            let mut rest = Vec::new();
            self.read(index, BLOCK * blocks..n, &mut rest)?;
            let column = &mut self.columns[index];
            column.blocks.truncate(blocks);
            column.rest = rest;
            column.not_finite = column.not_finite.filter(|&at| at < BLOCK * blocks);
        }
        Ok(())
    }

    /// Index of the first NaN or infinity of a column.
    ///
    /// # Panics
    /// If there is no such column.
    pub fn first_not_finite(&self, column: usize) -> Option<usize> {
        let column = &self.columns[column];
        column.not_finite.or_else(|| Some(BLOCK * column.blocks.len() + first_not_finite(&column.rest)?))
    }

    /// Appends a range of a column to `to`.
    ///
    /// # Errors
    /// Those of the file.
    ///
    /// # Panics
    /// If there is no such column, or the range leaves it.
    pub fn read(&self, column: usize, range: Range<usize>, to: &mut Vec<f64>) -> io::Result<()> {
        let column = &self.columns[column];
        assert!(range.end <= column.len(), "{range:?} leaves a column of {}", column.len());
        to.reserve(range.len());
        let mut at = range.start;
        while at < range.end {
            let (block, first) = (at / BLOCK, at % BLOCK);
            match (column.blocks.get(block), &self.file) {
                (Some(start), Some(file)) => {
                    let n = (range.end - at).min(BLOCK - first);
                    let place = to.len();
                    to.resize(place + n, 0.0);
                    let bytes = bytemuck::cast_slice_mut(&mut to[place..]);
                    file.as_file().read_exact_at(bytes, start + (size_of::<f64>() * first) as u64)?;
                    at += n;
                }
                _ => {
                    let written = BLOCK * column.blocks.len();
                    to.extend_from_slice(&column.rest[at - written..range.end - written]);
                    at = range.end;
                }
            }
        }
        Ok(())
    }

    /// One number of a column.
    ///
    /// # Errors
    /// Those of the file.
    ///
    /// # Panics
    /// If there is no such number.
    pub(super) fn at(&self, column: usize, index: usize) -> io::Result<f64> {
        let mut found = Vec::new();
        self.read(column, index..index + 1, &mut found)?;
        Ok(found[0])
    }

    /// Index of the first number of a column that is wanted, all before it having been asked for in order.
    ///
    /// # Errors
    /// Those of the file.
    ///
    /// # Panics
    /// If there is no such column.
    pub(super) fn position(
        &self,
        column: usize,
        mut wanted: impl FnMut(usize, f64) -> bool,
    ) -> io::Result<Option<usize>> {
        let (len, mut block) = (self.len(column), Vec::new());
        for from in (0..len).step_by(BLOCK) {
            block.clear();
            self.read(column, from..len.min(from + BLOCK), &mut block)?;
            if let Some(at) = block.iter().enumerate().position(|(i, &value)| wanted(from + i, value)) {
                return Ok(Some(from + at));
            }
        }
        Ok(None)
    }

    /// The columns of a spool in memory.
    ///
    /// # Panics
    /// If there is a file.
    pub(super) fn into_columns(self) -> Vec<Vec<f64>> {
        assert!(self.file.is_none(), "the columns are in a file");
        self.columns.into_iter().map(|column| column.rest).collect()
    }

    /// The columns as channels at this sample rate. They must be equally long and finite.
    pub fn at_rate(self, sample_rate_hz: f64) -> SpooledSamples {
        let columns = (0..self.n_columns()).map(|column| (column, 1.0)).collect();
        SpooledSamples { spool: self, sample_rate_hz, columns }
    }

    /// Index of the first number of a column that is not finite once it is multiplied by `factor`.
    ///
    /// # Errors
    /// Those of the file.
    ///
    /// # Panics
    /// If there is no such column.
    pub fn first_overflow(&self, column: usize, factor: f64) -> io::Result<Option<usize>> {
        self.position(column, |_, value| !(value * factor).is_finite())
    }
}

/// The channels of a measurement, out of a spool.
#[derive(Debug)]
pub struct SpooledSamples {
    spool: Spool,
    sample_rate_hz: f64,
    /// Column and factor of each channel.
    columns: Vec<(usize, f64)>,
}

impl SpooledSamples {
    /// The columns with these indices as channels, each multiplied by its factor.
    pub fn of_columns(self, columns: Vec<(usize, f64)>) -> Self {
        Self { columns, ..self }
    }
}

impl Samples for SpooledSamples {
    fn sample_rate_hz(&self) -> f64 {
        self.sample_rate_hz
    }

    fn n_channels(&self) -> usize {
        self.columns.len()
    }

    fn n_samples(&self) -> usize {
        self.spool.len(0)
    }

    fn read(&mut self, channel: usize, samples: Range<usize>, to: &mut Vec<f64>) -> io::Result<()> {
        let (column, factor) = self.columns[channel];
        let before = to.len();
        self.spool.read(column, samples, to)?;
        if factor != 1.0 {
            to[before..].iter_mut().for_each(|value| *value *= factor);
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn columns_read_the_same_from_memory_and_from_a_file_that_goes_with_them() {
        let directory = tempfile::tempdir().unwrap();
        let files = || std::fs::read_dir(directory.path()).unwrap().count();
        let n = 2 * BLOCK + 100;
        let sent: Vec<Vec<f64>> =
            (0..3).map(|c| (0..n + c).map(|i| (i as f64 * (c + 1) as f64).sin()).collect()).collect();
        let filled = |mut spool: Spool| {
            spool.add_columns(3);
            // Numbers one by one, a few, and many at once.
            for (c, step) in [1, 700, 3 * BLOCK].into_iter().enumerate() {
                sent[c].chunks(step).for_each(|some| match some {
                    [one] => spool.push(c, *one).unwrap(),
                    some => spool.extend(c, some.iter().copied()).unwrap(),
                });
            }
            spool
        };
        let (memory, file) = (filled(Spool::in_memory()), filled(Spool::in_file(directory.path())));
        assert_eq!(files(), 1);
        for spool in [&memory, &file] {
            assert_eq!((spool.n_columns(), spool.len(2)), (3, n + 2));
            for range in [0..n, 5..6, BLOCK - 1..BLOCK + 1, 2 * BLOCK..n, n - 1..n, n..n] {
                for (c, sent) in sent.iter().enumerate() {
                    let mut found = vec![7.0];
                    spool.read(c, range.clone(), &mut found).unwrap();
                    assert_eq!((found[0], &found[1..]), (7.0, &sent[range.clone()]), "{c} {range:?}");
                }
            }
            assert_eq!(spool.at(1, BLOCK).unwrap(), sent[1][BLOCK]);
            let wanted = sent[2][BLOCK + 3];
            assert_eq!(spool.position(2, |i, v| i > 1 && v == wanted).unwrap(), Some(BLOCK + 3));
            assert_eq!(spool.position(2, |_, v| v > 1.0).unwrap(), None);
        }
        assert_eq!(memory.into_columns(), sent);
        drop(file);
        assert_eq!(files(), 0, "the file is deleted");
    }

    #[test]
    fn the_first_number_that_is_not_finite_is_found_in_every_block() {
        let directory = tempfile::tempdir().unwrap();
        for at in [0, BLOCK - 1, BLOCK, 2 * BLOCK + 5] {
            let mut spool = Spool::in_file(directory.path());
            spool.add_columns(2);
            spool.extend(0, vec![0.5; 3 * BLOCK]).unwrap();
            let bad = (0..2 * BLOCK + 10).map(|i| if i < at { 0.5 } else { f64::NAN });
            bad.for_each(|v| spool.push(1, v).unwrap());
            assert_eq!((spool.first_not_finite(0), spool.first_not_finite(1)), (None, Some(at)));
        }
    }

    #[test]
    fn few_numbers_make_no_file() {
        let directory = tempfile::tempdir().unwrap();
        let mut spool = Spool::in_file(directory.path());
        spool.add_columns(1);
        spool.extend(0, vec![1.0; BLOCK - 1]).unwrap();
        assert_eq!(std::fs::read_dir(directory.path()).unwrap().count(), 0);
        assert_eq!(spool.another().n_columns(), 0);
    }
}
