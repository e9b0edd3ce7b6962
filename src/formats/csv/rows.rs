//! Rows of cells with the line on which each stands.
//!
//! csv-core splits rows and cells. Its own line numbers lag behind in files with CRLF, and it passes
//! over empty lines; so lines are counted here, from the byte at which each row begins. A row of more
//! cells than a file may have is counted and not kept.

use csv_core::{ReadRecordResult, Reader, ReaderBuilder};

use super::number::trim;
use crate::formats::{FormatError, MAX_CHANNELS};

/// Reads row after row.
pub(super) struct Rows<'a> {
    file: &'a [u8],
    reader: Reader,
    separator: u8,
    /// Text of the current row's cells, one behind the other, and where each ends.
    text: Vec<u8>,
    ends: Vec<usize>,
    /// Cells of the current row, be they kept or not.
    len: usize,
    /// Line of the current row, from 1; 0 before the first.
    row: u64,
    /// Cells of the first row.
    width: usize,
    /// Where csv-core stopped reading.
    end: usize,
    /// Line of the byte at `counted`, from 1.
    line: u64,
    counted: usize,
}

/// Cells of a row; none of a row that has too many.
#[derive(Debug, Clone, Copy)]
pub(super) struct Cells<'r> {
    text: &'r [u8],
    ends: &'r [usize],
    len: usize,
}

impl<'r> Cells<'r> {
    /// How many the row has.
    pub(super) fn len(self) -> usize {
        self.len
    }

    /// Their text.
    pub(super) fn iter(self) -> impl Iterator<Item = &'r [u8]> + Clone {
        let starts = std::iter::once(0).chain(self.ends.iter().copied());
        starts.zip(self.ends).map(move |(start, &end)| &self.text[start..end])
    }
}

impl<'a> Rows<'a> {
    /// Before the first row of `file`.
    pub(super) fn new(file: &'a [u8]) -> Self {
        let separator = separator(file);
        Self {
            file,
            reader: ReaderBuilder::new().delimiter(separator).build(),
            separator,
            text: vec![0; 1024],
            // One more than may be, to see that it is too many.
            ends: vec![0; MAX_CHANNELS + 1],
            len: 0,
            row: 0,
            width: 0,
            end: 0,
            line: 1,
            counted: 0,
        }
    }

    /// What separates cells.
    pub(super) fn separator(&self) -> u8 {
        self.separator
    }

    /// Goes to the next row; false at the end.
    ///
    /// # Errors
    /// `csv.ragged_row` for an empty line between two rows.
    pub(super) fn next(&mut self) -> Result<bool, FormatError> {
        let mut start = self.end;
        // The csv crate ends a row at the CR of a CRLF.
        if self.file[..start].ends_with(b"\r") && self.file[start..].starts_with(b"\n") {
            start += 1;
        }
        let empty_line = self.count_lines_to(start);
        let empty = self.file[start..].iter().take_while(|b| matches!(b, b'\r' | b'\n')).count();
        if !self.split() {
            return Ok(false);
        }
        if self.row == 0 {
            self.width = self.len;
        } else if empty > 0 {
            return Err(FormatError::CsvRagged { row: empty_line, expected: self.width, found: 0 });
        }
        self.row = self.count_lines_to(start + empty);
        Ok(true)
    }

    /// Takes the next row apart; false at the end.
    fn split(&mut self) -> bool {
        self.len = 0;
        let (mut kept, mut text_len) = (0, 0);
        loop {
            let (result, read, written, ended) = self.reader.read_record(
                &self.file[self.end..],
                &mut self.text[text_len..],
                &mut self.ends[kept..],
            );
            self.end += read;
            text_len += written;
            kept += ended;
            self.len += ended;
            match result {
                ReadRecordResult::InputEmpty => {}
                ReadRecordResult::OutputFull if self.len > kept => text_len = 0,
                ReadRecordResult::OutputFull => self.text.resize(2 * self.text.len(), 0),
                ReadRecordResult::OutputEndsFull => (kept, text_len) = (0, 0),
                ReadRecordResult::Record => return true,
                ReadRecordResult::End => return false,
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

    /// Text of a cell of the current row, without the blanks around it.
    ///
    /// # Errors
    /// `csv.encoding`.
    pub(super) fn text<'c>(&self, cell: &'c [u8]) -> Result<&'c str, FormatError> {
        std::str::from_utf8(trim(cell)).map_err(|_| FormatError::CsvEncoding { row: self.row })
    }

    /// Line of the byte at `to`, which lies at or behind where counting stopped.
    fn count_lines_to(&mut self, to: usize) -> u64 {
        for i in self.counted..to {
            let lone_cr = self.file[i] == b'\r' && self.file.get(i + 1) != Some(&b'\n');
            self.line += u64::from(self.file[i] == b'\n' || lone_cr);
        }
        self.counted = to;
        self.line
    }
}

/// The first of tab, `;` and `,` that the first row has outside quotes; `;` where it has none, so
/// that one column may have decimal commas.
fn separator(file: &[u8]) -> u8 {
    let mut quoted = false;
    let mut found = [false; 3];
    const SEPARATORS: [u8; 3] = *b"\t;,";
    for &byte in file.trim_ascii_start() {
        match byte {
            b'"' => quoted = !quoted,
            b'\r' | b'\n' if !quoted => break,
            _ if quoted => {}
            _ => {
                if let Some(i) = SEPARATORS.iter().position(|&s| s == byte) {
                    found[i] = true;
                }
            }
        }
    }
    found.iter().position(|&f| f).map_or(b';', |i| SEPARATORS[i])
}

#[cfg(test)]
mod tests {
    use super::*;

    fn rows(file: &str) -> Vec<(u64, Vec<String>)> {
        let mut rows = Rows::new(file.as_bytes());
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
            let mut between = Rows::new(file.as_bytes());
            assert!(between.next().unwrap() && between.next().unwrap());
            assert_eq!(
                between.next(),
                Err(FormatError::CsvRagged { row: 3, expected: 1, found: 0 }),
                "{end:?}"
            );
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
            assert_eq!(super::separator(format!("{first}\n1;1,1\t1").as_bytes()), separator, "{first}");
        }
    }
}
