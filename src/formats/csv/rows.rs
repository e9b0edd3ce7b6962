//! Rows of cells with their line numbers.
//!
//! csv-core splits rows and cells. Its own line numbers lag behind in files with CRLF, and it skips empty
//! lines. This module therefore counts lines itself and finds empty ones. A row with more cells than a file
//! may have is counted and not kept. Only a piece of the file is in memory.

use std::io::Read;

use csv_core::{ReadRecordResult, Reader, ReaderBuilder};

use super::number::trim;
use crate::formats::{FormatError, MAX_CHANNELS, PIECE, ReadError};

/// Longest row, bytes: the longest names of as many channels as a file may have take a quarter of it.
const MAX_ROW_BYTES: usize = 16 << 20;

/// Reads row after row.
pub(super) struct Rows<R> {
    bytes: Bytes<R>,
    reader: Reader,
    separator: u8,
    /// Text of the current row's cells, one after the other, and the end of each.
    text: Vec<u8>,
    ends: Vec<usize>,
    /// Cells of the current row, kept or not.
    len: usize,
    /// Line of the current row, from 1; 0 before the first.
    row: u64,
    /// Cells of the first row.
    width: usize,
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
        let separator = bytes.separator()?;
        Ok(Self {
            bytes,
            reader: ReaderBuilder::new().delimiter(separator).build(),
            separator,
            text: vec![0; 1024],
            // One more than allowed, so that too many are noticed.
            ends: vec![0; MAX_CHANNELS + 1],
            len: 0,
            row: 0,
            width: 0,
        })
    }

    /// Separator of cells.
    pub(super) fn separator(&self) -> u8 {
        self.separator
    }

    /// Goes to the next row; false at the end.
    ///
    /// # Errors
    /// `csv.ragged_row` for an empty line between two rows; `csv.long_row`; errors of the file system.
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
        if self.row == 0 {
            self.width = self.len;
        } else if empty {
            return Err(FormatError::CsvRagged { row: empty_line, expected: self.width, found: 0 }.into());
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

    /// Text of a cell of the current row, without surrounding blanks.
    ///
    /// # Errors
    /// `csv.encoding`.
    pub(super) fn text<'c>(&self, cell: &'c [u8]) -> Result<&'c str, FormatError> {
        std::str::from_utf8(trim(cell)).map_err(|_| FormatError::CsvEncoding { row: self.row })
    }
}

/// A file piece by piece; counts its lines, which end with LF, CR or CRLF.
struct Bytes<R> {
    file: R,
    piece: Vec<u8>,
    /// Bytes of the piece that were consumed.
    passed: usize,
    /// Line ends consumed, without that of a CR that was consumed last.
    lines: u64,
    after_cr: bool,
}

impl<R: Read> Bytes<R> {
    /// A reader after the byte order mark, if there is one.
    fn new(file: R) -> std::io::Result<Self> {
        let mut bytes = Self { file, piece: Vec::new(), passed: 0, lines: 0, after_cr: false };
        bytes.more()?;
        if bytes.piece.starts_with(b"\xEF\xBB\xBF") {
            bytes.passed = 3;
        }
        Ok(bytes)
    }

    /// Reads up to a piece more; false at the end of the file.
    fn more(&mut self) -> std::io::Result<bool> {
        let before = self.piece.len();
        let read = (&mut self.file).take(PIECE as u64).read_to_end(&mut self.piece);
        read.map(|_| self.piece.len() > before)
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

    /// The first of tab, `;` and `,` that the first row has outside quotes; `;` where it has none, so that a
    /// single column may have decimal commas. Reads the first row into memory, unless it is too long.
    fn separator(&mut self) -> std::io::Result<u8> {
        const SEPARATORS: [u8; 3] = *b"\t;,";
        let (mut at, mut quoted, mut begun) = (self.passed, false, false);
        let mut found = [false; 3];
        while at < MAX_ROW_BYTES && (at < self.piece.len() || self.more()?) {
            let byte = self.piece[at];
            at += 1;
            begun |= !byte.is_ascii_whitespace();
            match byte {
                _ if !begun => {}
                b'"' => quoted = !quoted,
                b'\r' | b'\n' if !quoted => break,
                _ if quoted => {}
                _ => SEPARATORS.iter().zip(&mut found).for_each(|(&s, found)| *found |= s == byte),
            }
        }
        Ok(found.iter().position(|&f| f).map_or(b';', |i| SEPARATORS[i]))
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
    fn the_first_row_says_what_separates() {
        for (first, separator) in [
            ("a,b", b','),
            ("a;b", b';'),
            ("a\tb", b'\t'),
            ("a", b';'),
            ("\"a;b\",c", b','),
            ("1,5;2,5", b';'),
        ] {
            let file = format!("{first}\n1;1,1\t1");
            assert_eq!(Rows::new(file.as_bytes()).unwrap().separator(), separator, "{first}");
        }
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
                let Err(ReadError::Format(error)) = rows.next() else { panic!("an empty line") };
                assert_eq!(error.row(), Some(4), "{filling} {end:?}");
            }
        }
    }
}
