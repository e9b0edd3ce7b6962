//! Rows of cells with their line numbers.
//!
//! csv-core splits rows and cells. Its own line numbers lag behind in files with CRLF, and it skips empty
//! lines. This module therefore counts lines itself and finds empty ones. A row with more cells than a file
//! may have is counted and not kept. Only a piece of the file is in memory.

use std::io::Read;

use csv_core::{ReadRecordResult, Reader, ReaderBuilder};

use encoding_rs_io::{DecodeReaderBytes, DecodeReaderBytesBuilder};

use super::blanks::Blanks;
use super::layout::Layout;
use super::number::trim;
use crate::formats::labels::utf8_or_windows_1252;
use crate::formats::{FormatError, MAX_CHANNELS, PIECE, ReadError};

/// Longest row, bytes: the longest names of as many channels as a file may have take a quarter of it.
const MAX_ROW_BYTES: usize = 16 << 20;

/// Bytes of a file in which its first samples are looked for.
const LAYOUT_BYTES: usize = 1 << 20;

/// Reads row after row.
pub(super) struct Rows<R> {
    bytes: Bytes<R>,
    reader: Reader,
    layout: Layout,
    /// Text of the current row's cells, one after the other, and the end of each.
    text: Vec<u8>,
    ends: Vec<usize>,
    /// Cells of the current row, kept or not.
    len: usize,
    /// Line of the current row, from 1; 0 before the first.
    row: u64,
    /// Cells of a row of samples, once they have begun.
    width: Option<usize>,
}

/// Cells of a row; empty for a row that has too many.
#[derive(Debug, Clone, Copy)]
pub(super) struct Cells<'r> {
    text: &'r [u8],
    ends: &'r [usize],
    len: usize,
}

impl<'r> Cells<'r> {
    /// Number of cells.
    pub(super) fn len(self) -> usize {
        self.len
    }

    /// Number of cells without the empty ones at the end.
    pub(super) fn trimmed_len(self) -> usize {
        if self.ends.len() < self.len {
            return self.len;
        }
        let is_full = |&index: &usize| self.get(index).is_some_and(|cell| !trim(cell).is_empty());
        (0..self.len).rev().find(is_full).map_or(0, |last| last + 1)
    }

    /// The text of one; `None` behind the last.
    pub(super) fn get(self, index: usize) -> Option<&'r [u8]> {
        let end = *self.ends.get(index)?;
        let start = index.checked_sub(1).map_or(0, |before| self.ends[before]);
        Some(&self.text[start..end])
    }

    /// Their text.
    pub(super) fn iter(self) -> impl Iterator<Item = &'r [u8]> + Clone {
        let starts = std::iter::once(0).chain(self.ends.iter().copied());
        starts.zip(self.ends).map(move |(start, &end)| &self.text[start..end])
    }
}

impl<R: Read> Rows<R> {
    /// A reader before the first row of a file.
    ///
    /// # Errors
    /// Errors of the file system.
    pub(super) fn new(file: R) -> std::io::Result<Self> {
        let mut bytes = Bytes::new(file)?;
        let layout = bytes.layout()?;
        bytes.pass(layout.declaration);
        if layout.blanks {
            bytes.replace_blanks();
        }
        Ok(Self {
            bytes,
            reader: ReaderBuilder::new().delimiter(layout.separator).build(),
            layout,
            text: vec![0; 1024],
            // One more than allowed, so that too many are noticed.
            ends: vec![0; MAX_CHANNELS + 1],
            len: 0,
            row: 0,
            width: None,
        })
    }

    /// What separates cells, and where the samples begin.
    pub(super) fn layout(&self) -> Layout {
        self.layout
    }

    /// Says that the current row is the first of the samples, each of which has `width` cells: an empty line between
    /// them may be a lost sample.
    pub(super) fn begin_samples(&mut self, width: usize) {
        self.width = Some(width);
    }

    /// Goes to the next row; false at the end.
    ///
    /// # Errors
    /// `csv.ragged_row` for an empty line between two samples; `csv.long_row`; errors of the file system.
    pub(super) fn next(&mut self) -> Result<bool, ReadError> {
        // The csv crate ends a row at the CR of a CRLF.
        if self.bytes.after_cr && self.bytes.peek()? == Some(b'\n') {
            self.bytes.pass(1);
        }
        let empty_line = self.bytes.line()?;
        let mut empty = false;
        while matches!(self.bytes.peek()?, Some(b'\r' | b'\n')) {
            self.bytes.pass(1);
            empty = true;
        }
        let line = self.bytes.line()?;
        if !self.split(line)? {
            return Ok(false);
        }
        if let (true, Some(expected)) = (empty, self.width) {
            return Err(FormatError::CsvRagged { row: empty_line, expected, found: 0 }.into());
        }
        self.row = line;
        Ok(true)
    }

    /// Splits the next row, which begins in this line; false at the end.
    fn split(&mut self, line: u64) -> Result<bool, ReadError> {
        self.len = 0;
        let (mut kept, mut text_len) = (0, 0);
        loop {
            // No bytes tell csv-core that the file ends.
            self.bytes.peek()?;
            let (result, read, written, ended) = self.reader.read_record(
                self.bytes.left(),
                &mut self.text[text_len..],
                &mut self.ends[kept..],
            );
            self.bytes.pass(read);
            text_len += written;
            kept += ended;
            self.len += ended;
            match result {
                ReadRecordResult::InputEmpty => {}
                ReadRecordResult::OutputFull if self.len > kept => text_len = 0,
                ReadRecordResult::OutputFull if self.text.len() >= MAX_ROW_BYTES => {
                    return Err(FormatError::CsvLongRow { row: line, limit: MAX_ROW_BYTES }.into());
                }
                ReadRecordResult::OutputFull => self.text.resize(2 * self.text.len(), 0),
                ReadRecordResult::OutputEndsFull => (kept, text_len) = (0, 0),
                ReadRecordResult::Record => return Ok(true),
                ReadRecordResult::End => return Ok(false),
            }
        }
    }

    /// Cells of the current row.
    pub(super) fn cells(&self) -> Cells<'_> {
        let ends = self.ends.get(..self.len).unwrap_or_default();
        Cells { text: &self.text, ends, len: self.len }
    }

    /// Line of the current row, from 1.
    pub(super) fn row(&self) -> u64 {
        self.row
    }

    /// The cells as text, without surrounding blanks.
    pub(super) fn texts(&self) -> Vec<String> {
        self.cells().iter().map(utf8_or_windows_1252).collect()
    }
}

/// A file piece by piece; counts its lines, which end with LF, CR or CRLF.
struct Bytes<R> {
    file: DecodeReaderBytes<R, Vec<u8>>,
    piece: Vec<u8>,
    /// Bytes of the piece that were consumed.
    passed: usize,
    /// Line ends consumed, without that of a CR that was consumed last.
    lines: u64,
    after_cr: bool,
    /// Replaces the blanks of what is read, once it is known that they separate.
    blanks: Option<Blanks>,
}

impl<R: Read> Bytes<R> {
    /// A reader after the byte order mark, if there is one. UTF-16, which has one, becomes UTF-8; other bytes stay as
    /// they are.
    fn new(file: R) -> std::io::Result<Self> {
        let file = DecodeReaderBytesBuilder::new().utf8_passthru(true).build(file);
        let mut bytes = Self { file, piece: Vec::new(), passed: 0, lines: 0, after_cr: false, blanks: None };
        bytes.more()?;
        if bytes.piece.starts_with(b"\xEF\xBB\xBF") {
            bytes.passed = 3;
        }
        Ok(bytes)
    }

    /// Reads up to a piece more; false at the end of the file.
    fn more(&mut self) -> std::io::Result<bool> {
        let before = self.piece.len();
        loop {
            let read = (&mut self.file).take(PIECE as u64).read_to_end(&mut self.piece)?;
            if let Some(blanks) = &mut self.blanks {
                blanks.replace(&mut self.piece, before);
            }
            // Of a piece of blanks nothing is left.
            if read == 0 || self.piece.len() > before {
                return Ok(self.piece.len() > before);
            }
        }
    }

    /// From the next byte on, blanks stand for the separator.
    fn replace_blanks(&mut self) {
        self.blanks.insert(Blanks::default()).replace(&mut self.piece, self.passed);
    }

    /// Bytes in memory that were not consumed yet; after [`Bytes::peek`] empty only at the end.
    fn left(&self) -> &[u8] {
        &self.piece[self.passed..]
    }

    /// The next byte.
    fn peek(&mut self) -> std::io::Result<Option<u8>> {
        if self.passed == self.piece.len() {
            self.piece.clear();
            self.passed = 0;
            self.more()?;
        }
        Ok(self.left().first().copied())
    }

    /// Consumes `n` bytes in memory.
    fn pass(&mut self, n: usize) {
        for &byte in &self.piece[self.passed..self.passed + n] {
            self.lines += u64::from(byte == b'\n' || self.after_cr);
            self.after_cr = byte == b'\r';
        }
        self.passed += n;
    }

    /// Line of the next byte, from 1.
    fn line(&mut self) -> std::io::Result<u64> {
        let lone_cr = self.after_cr && self.peek()? != Some(b'\n');
        Ok(1 + self.lines + u64::from(lone_cr))
    }

    /// The layout by the beginning of the file, or by its first row where no samples are near. Reads that much into
    /// memory.
    fn layout(&mut self) -> std::io::Result<Layout> {
        let mut whole = false;
        loop {
            if let Some(layout) = Layout::of(self.left(), whole) {
                return Ok(layout);
            }
            if self.piece.len() > LAYOUT_BYTES {
                let row = self.first_row()?;
                return Ok(Layout::of_first_row(row));
            }
            whole = !self.more()?;
        }
    }

    /// The first row that is not empty, read into memory unless it is too long.
    fn first_row(&mut self) -> std::io::Result<&[u8]> {
        let (mut at, mut quoted, mut begun) = (self.passed, false, false);
        while at < MAX_ROW_BYTES && (at < self.piece.len() || self.more()?) {
            let byte = self.piece[at];
            begun |= !byte.is_ascii_whitespace();
            quoted ^= byte == b'"';
            if begun && !quoted && matches!(byte, b'\r' | b'\n') {
                break;
            }
            at += 1;
        }
        Ok(&self.piece[self.passed..at])
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::formats::tests::Pieces;

    fn rows(file: &str) -> Vec<(u64, Vec<String>)> {
        let mut rows = Rows::new(file.as_bytes()).unwrap();
        let mut all = Vec::new();
        while rows.next().unwrap() {
            let cells = rows.cells().iter().map(|c| String::from_utf8_lossy(c).into_owned()).collect();
            all.push((rows.row(), cells));
        }
        all
    }

    #[test]
    fn every_row_knows_its_line_whatever_ends_lines() {
        for end in ["\n", "\r\n", "\r"] {
            let found = rows(&["a,b", "1,2", "3,4", ""].join(end));
            let lines: Vec<u64> = found.iter().map(|(row, _)| *row).collect();
            assert_eq!(lines, [1, 2, 3], "{end:?}");
            assert_eq!(found[2].1, ["3", "4"]);
            let led = rows(&["", "", "a,b", "1,2"].join(end));
            assert_eq!(led.iter().map(|(row, _)| *row).collect::<Vec<_>>(), [3, 4], "{end:?}");
        }
    }

    #[test]
    fn quoted_names_may_hold_separators_and_line_ends() {
        let found = rows("\"force, x\",\"two\nlines\"\r\n1,2\r\n");
        assert_eq!(
            found,
            [(1, vec!["force, x".into(), "two\nlines".into()]), (3, vec!["1".into(), "2".into()])]
        );
    }

    #[test]
    fn an_empty_line_is_fine_at_the_end_only() {
        for end in ["\n", "\r\n", "\r"] {
            let trailing = rows(&["a", "1", "2", "", "", ""].join(end));
            assert_eq!(trailing.len(), 3, "{end:?}");
            let file = ["a", "1", "", "", "2"].join(end);
            let mut between = Rows::new(file.as_bytes()).unwrap();
            assert!(between.next().unwrap() && between.next().unwrap());
            between.begin_samples(1);
            let Err(ReadError::Format(error)) = between.next() else { panic!("an empty line") };
            assert_eq!(error, FormatError::CsvRagged { row: 3, expected: 1, found: 0 }, "{end:?}");
        }
    }

    #[test]
    fn a_row_that_never_ends_is_refused_at_its_line() {
        struct Letters(usize);
        impl Read for Letters {
            fn read(&mut self, space: &mut [u8]) -> std::io::Result<usize> {
                let n = space.len().min(self.0);
                space[..n].fill(b'a');
                self.0 -= n;
                Ok(n)
            }
        }
        for (start, line) in [("", 1), ("a,b\n", 2), ("a,b\n1,2\n\"", 3)] {
            let mut rows = Rows::new(start.as_bytes().chain(Letters(4 * MAX_ROW_BYTES))).unwrap();
            let refused = loop {
                match rows.next() {
                    Ok(more) => assert!(more, "line {line}"),
                    Err(error) => break error.of_bytes(),
                }
            };
            assert_eq!(refused, FormatError::CsvLongRow { row: line, limit: MAX_ROW_BYTES });
            assert!(rows.bytes.piece.capacity() <= 2 * MAX_ROW_BYTES && rows.text.len() <= MAX_ROW_BYTES);
        }
    }

    #[test]
    fn utf_16_reads_as_its_text() {
        let text = "u;Weg [µm]\r\n1,5;2\r\n";
        let utf16 = |bytes: fn(u16) -> [u8; 2]| -> Vec<u8> {
            std::iter::once('\u{feff}').chain(text.chars()).flat_map(|c| bytes(c as u16)).collect()
        };
        for file in [utf16(u16::to_le_bytes), utf16(u16::to_be_bytes), text.as_bytes().to_vec()] {
            let mut rows = Rows::new(Pieces(&file)).unwrap();
            assert!(rows.next().unwrap());
            assert_eq!(
                (rows.layout().separator, rows.texts()),
                (b';', vec!["u".into(), "Weg [µm]".to_owned()])
            );
        }
        let mut rows = Rows::new(&b"Weg [\xb5m]\n1\n"[..]).unwrap();
        assert!(rows.next().unwrap());
        assert_eq!(rows.texts(), ["Weg [µm]"]);
    }

    #[test]
    fn lines_are_the_same_wherever_the_file_is_cut_into_pieces() {
        for filling in [PIECE - 4, PIECE - 3, PIECE - 2, PIECE - 1, PIECE] {
            let name = "n".repeat(filling);
            for end in ["\n", "\r\n", "\r"] {
                let file = [&name, "1", "2", "", "", "3"].join(end);
                let mut rows = Rows::new(Pieces(file.as_bytes())).unwrap();
                for line in 1..=3 {
                    assert!(rows.next().unwrap());
                    assert_eq!(rows.row(), line, "{filling} {end:?}");
                }
                rows.begin_samples(1);
                let Err(ReadError::Format(error)) = rows.next() else { panic!("an empty line") };
                assert_eq!(error.row(), Some(4), "{filling} {end:?}");
            }
        }
    }
}
