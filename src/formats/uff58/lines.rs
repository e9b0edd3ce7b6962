//! The lines of a file, and the bytes between them in its binary form.

use std::io::{self, BufRead, BufReader, Read};

use crate::formats::error::excerpt;
use crate::formats::{FormatError, PIECE, ReadError, UffPlace, labels};

use super::header;

/// Bytes of a line that are kept. Records have 80 columns; nothing behind them counts, and ID lines may be longer.
const LONGEST: usize = 1024;

/// A file from its beginning to its end.
pub(super) struct Lines<R> {
    file: BufReader<R>,
    /// The line that was read last, with its end.
    line: Vec<u8>,
    /// Bytes before the next line.
    byte: u64,
    /// Lines before the next one; none behind binary numbers.
    number: Option<u64>,
    /// Data sets 58 that have begun.
    sets: usize,
    /// Whether one of them goes on.
    inside: bool,
}

impl<R: Read> Lines<R> {
    pub(super) fn new(file: R) -> Self {
        let file = BufReader::with_capacity(PIECE, file);
        Self { file, line: Vec::new(), byte: 0, number: Some(0), sets: 0, inside: false }
    }

    /// The place after what was read.
    pub(super) fn place(&self) -> UffPlace {
        UffPlace {
            set: self.inside.then_some(self.sets),
            line: self.number.map(|before| before + 1),
            byte: self.byte,
        }
    }

    /// The next line; none at the end of the file.
    pub(super) fn next(&mut self) -> io::Result<Option<Line<'_>>> {
        let at = self.place();
        self.line.clear();
        let kept = (&mut self.file).take(LONGEST as u64).read_until(b'\n', &mut self.line)?;
        if kept == 0 {
            return Ok(None);
        }
        let ends = self.line.last() == Some(&b'\n');
        let rest = if kept == LONGEST && !ends { self.file.skip_until(b'\n')? } else { 0 };
        self.byte += (kept + rest) as u64;
        self.number = self.number.map(|before| before + 1);
        Ok(Some(Line { bytes: self.line.trim_ascii_end(), at }))
    }

    /// Fills `space` with the bytes that follow; says how many there are, fewer at the end of the file.
    pub(super) fn fill(&mut self, space: &mut [u8]) -> io::Result<usize> {
        self.number = None;
        let mut filled = 0;
        while filled < space.len() {
            match self.file.read(&mut space[filled..]) {
                Ok(0) => break,
                Ok(n) => filled += n,
                Err(error) if error.kind() == io::ErrorKind::Interrupted => {}
                Err(error) => return Err(error),
            }
        }
        self.byte += filled as u64;
        Ok(filled)
    }

    /// Passes blanks, line ends and zero bytes.
    pub(super) fn skip_padding(&mut self) -> io::Result<()> {
        loop {
            let ahead = self.file.fill_buf()?;
            let padding = ahead.iter().take_while(|b| b.is_ascii_whitespace() || **b == 0).count();
            let ends = padding < ahead.len() || ahead.is_empty();
            self.file.consume(padding);
            self.byte += padding as u64;
            if ends {
                return Ok(());
            }
        }
    }

    /// Counts a data set 58.
    pub(super) fn begin_functions(&mut self) {
        self.sets += 1;
        self.inside = true;
    }

    /// Reads the `-1` after the numbers of a data set 58 and empty lines; `declared` says how many numbers there are.
    ///
    /// # Errors
    /// `uff58.size` if something else comes.
    pub(super) fn end_functions(&mut self, declared: &str) -> Result<(), ReadError> {
        let refuse = |at, found: &str| {
            let (declared, found) = (declared.to_owned(), found.to_owned());
            ReadError::from(FormatError::Uff58Size { at, declared, found })
        };
        loop {
            let end = self.place();
            let Some(line) = self.next()? else {
                return Err(refuse(end, "the file ends without a -1 after them"));
            };
            if line.is_delimiter() {
                break;
            }
            if !line.is_blank() {
                return Err(refuse(line.at, "the data set goes on after them"));
            }
        }
        self.inside = false;
        Ok(())
    }

    /// The error of a file that ends inside of `what`.
    pub(super) fn ends_early(&self, what: &str) -> FormatError {
        header(self.place(), format!("the file ends inside {what}"))
    }
}

/// A line without the blanks at its end.
#[derive(Clone, Copy)]
pub(super) struct Line<'a> {
    pub(super) bytes: &'a [u8],
    pub(super) at: UffPlace,
}

impl Line<'_> {
    pub(super) fn is_blank(&self) -> bool {
        self.bytes.is_empty()
    }

    /// Whether it is the line before and after each data set. A number in its columns reaches farther.
    pub(super) fn is_delimiter(&self) -> bool {
        self.bytes.len() <= 6 && self.bytes.trim_ascii_start() == b"-1"
    }

    /// Its beginning, for an error message.
    pub(super) fn excerpt(&self) -> String {
        excerpt(&labels::utf8_or_windows_1252(self.bytes))
    }

    pub(super) fn refuse(&self, reason: impl Into<String>) -> FormatError {
        header(self.at, reason)
    }
}
