//! Where the table of a file begins and what separates its cells, found before its rows are read.
//!
//! The table begins at the first line of numbers and date-times; a number alone may also be a title. The nearest row
//! above that has separators, a header or units, says which.

use super::blanks;
use super::number::{Numbers, trim};
use super::stamp::stamp;

/// Separators, the first of which a line has being the file's.
const SEPARATORS: [u8; 3] = *b"\t;,";

/// Separator where a row has none: a single column may have decimal commas.
const SINGLE_COLUMN: u8 = b';';

/// Most line ends within the quotes of a row.
const MAX_LINES_OF_ROW: usize = 16;

/// The layout of a file.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Layout {
    /// Separator of cells.
    pub(super) separator: u8,
    /// Line of the first samples, from 1, if there is one among those looked at.
    pub(super) first_samples: Option<u64>,
    /// Bytes of a first line `sep=;`.
    pub(super) declaration: usize,
    /// Whether blanks stand for the separator.
    pub(super) blanks: bool,
}

impl Layout {
    /// The layout by the beginning of a file. `None` while its first samples may still come; `whole` says that
    /// nothing follows.
    pub(super) fn of(text: &[u8], whole: bool) -> Option<Self> {
        let (declared, declaration) = declared(text);
        let lines = Lines::of(text, whole);
        let first = first_samples(text, &lines);
        match blank_separated(text, &lines, first, whole) {
            _ if declared.is_some() => {}
            Blank::No => {}
            Blank::NotYetKnown => return None,
            Blank::From(line) => {
                let first_samples = Some(line as u64 + 1);
                return Some(Self {
                    separator: blanks::SEPARATOR,
                    first_samples,
                    declaration: 0,
                    blanks: true,
                });
            }
        }
        if first.is_none() && !whole {
            return None;
        }
        let first_samples = first.map(|line| line as u64 + 1);
        let separator = declared.or_else(|| separator(above(text, &lines, first.unwrap_or(0))));
        let separator = separator.unwrap_or(SINGLE_COLUMN);
        Some(Self { separator, first_samples, declaration, blanks: false })
    }

    /// The layout by the first row of a file that has no samples near its beginning.
    pub(super) fn of_first_row(row: &[u8]) -> Self {
        let separator = separator(row).unwrap_or(SINGLE_COLUMN);
        Self { separator, first_samples: None, declaration: 0, blanks: false }
    }
}

/// The separator that spreadsheets write in a first line `sep=;`, and the line's length with its end.
fn declared(text: &[u8]) -> (Option<u8>, usize) {
    let line = text.split(|b| matches!(b, b'\r' | b'\n')).next().unwrap_or_default();
    let ended = text[line.len()..].starts_with(b"\r\n");
    let length = (line.len() + 1 + usize::from(ended)).min(text.len());
    let line = line.strip_prefix(b"\"").and_then(|l| l.strip_suffix(b"\"")).unwrap_or(line);
    match line {
        [b's' | b'S', b'e' | b'E', b'p' | b'P', b'=', mark] if SEPARATORS.contains(mark) => {
            (Some(*mark), length)
        }
        _ => (None, 0),
    }
}

/// Places of the lines in a text.
struct Lines(Vec<(usize, usize)>);

impl Lines {
    /// Lines that end with LF, CR or CRLF; the last one only if the text is whole.
    fn of(text: &[u8], whole: bool) -> Self {
        let mut lines = Vec::new();
        let mut start = 0;
        for at in memchr::memchr2_iter(b'\n', b'\r', text) {
            if text[at] == b'\n' && at > 0 && text[at - 1] == b'\r' {
                start = at + 1;
                continue;
            }
            lines.push((start, at));
            start = at + 1;
        }
        if whole && (start < text.len() || lines.is_empty()) {
            lines.push((start, text.len()));
        }
        Self(lines)
    }

    fn at(&self, line: usize) -> std::ops::Range<usize> {
        self.0.get(line).map_or(0..0, |&(start, end)| start..end)
    }
}

/// The nearest row above a line that has separators; the line itself where nothing stands above it. A row that has
/// none, as units may, says nothing: were a table taken for a single column, its separators would become decimals.
fn above<'t>(text: &'t [u8], lines: &Lines, line: usize) -> &'t [u8] {
    if (0..line).all(|above| trim(&text[lines.at(above)]).is_empty()) {
        return &text[lines.at(line)];
    }
    let mut row: &[u8] = &[];
    let mut end = line;
    while let Some(last) = end.checked_sub(1) {
        // Quotes may hold line ends.
        let from = |first: usize| &text[lines.at(first).start..lines.at(last).end];
        let is_whole = |first: &usize| from(*first).iter().filter(|&&b| b == b'"').count() % 2 == 0;
        let first = (last.saturating_sub(MAX_LINES_OF_ROW)..=last).rev().find(is_whole).unwrap_or(last);
        row = from(first);
        if separator(row).is_some() {
            return row;
        }
        end = first;
    }
    row
}

/// Index of the first line of samples: one of several cells, that another follows or that ends the file, else the
/// first at all. A number alone may be a title.
fn first_samples(text: &[u8], lines: &Lines) -> Option<usize> {
    let is_samples = |line: usize| holds_samples(&text[lines.at(line)]);
    let mut first = None;
    for line in 0..lines.0.len() {
        if !is_samples(line) {
            continue;
        }
        first.get_or_insert(line);
        let next = (line + 1..lines.0.len()).find(|&next| !trim(&text[lines.at(next)]).is_empty());
        let has_cells = trim(&text[lines.at(line)]).iter().any(|b| SEPARATORS.contains(b));
        if has_cells || next.is_none_or(is_samples) {
            return Some(line);
        }
    }
    first
}

/// Most lines that are looked at to tell columns from thousands.
const LINES_OF_BLANKS: usize = 1000;

/// Whether blanks separate the cells of a file.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Blank {
    No,
    /// The next line decides.
    NotYetKnown,
    /// The samples begin in this line.
    From(usize),
}

/// Blanks separate where they do so in two lines with as many numbers, or in the last line, unless every such line is also
/// a number whose thousands have blanks. `first` is the first line of samples with another separator.
fn blank_separated(text: &[u8], lines: &Lines, first: Option<usize>, whole: bool) -> Blank {
    let count = |line: usize| blanks::count(&text[lines.at(line)]);
    let end = first.map_or(lines.0.len(), |first| first + 1);
    for line in 0..end {
        let Some(numbers) = count(line) else { continue };
        let next = (line + 1..lines.0.len()).find(|&next| !trim(&text[lines.at(next)]).is_empty());
        match next {
            None if !whole => return Blank::NotYetKnown,
            Some(next) if count(next) != Some(numbers) => continue,
            _ => {}
        }
        let last = lines.0.len().min(line + LINES_OF_BLANKS);
        let is_row = |of: usize| count(of) == Some(numbers) && !blanks::is_one_number(&text[lines.at(of)]);
        return if (line..last).any(is_row) { Blank::From(line) } else { Blank::No };
    }
    Blank::No
}

/// Whether a line has a number, and nothing but numbers and date-times between any of the separators.
fn holds_samples(line: &[u8]) -> bool {
    let numbers = Numbers::new(b';');
    let mut found = false;
    let cell = |cell: &[u8]| {
        let cell = trim(cell);
        let cell = cell.strip_prefix(b"\"").unwrap_or(cell);
        let cell = trim(cell.strip_suffix(b"\"").unwrap_or(cell));
        let is_number = numbers.looks_like_one(cell);
        found |= is_number;
        cell.is_empty() || is_number || stamp(cell).is_some()
    };
    line.split(|b| SEPARATORS.contains(b)).all(cell) && found
}

/// The first of the separators that a row has outside quotes.
fn separator(row: &[u8]) -> Option<u8> {
    let (mut quoted, mut found) = (false, [false; SEPARATORS.len()]);
    for &byte in row {
        quoted ^= byte == b'"';
        if !quoted {
            SEPARATORS.iter().zip(&mut found).for_each(|(&s, found)| *found |= s == byte);
        }
    }
    found.iter().position(|&f| f).map(|i| SEPARATORS[i])
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_line_above_the_samples_says_what_separates() {
        for (text, separator, line) in [
            ("a,b\n1,2", b',', 2),
            ("a;b\r\n1,5;2,5\r\n", b';', 2),
            ("a\tb\n1\t2\n", b'\t', 2),
            ("a\n1,5\n", b';', 2),
            ("1,5;2,5\n1;2\n", b';', 1),
            ("\"a;b\",c\n1,2\n", b',', 2),
            ("Test, second try\nbench 3\n\nu;y\nkN;mm\n1,5;2\n2,5;3\n", b';', 6),
            ("1000\nu,y\n1,2\n3,4\n", b',', 3),
            ("a;b\n29.04.2026 21:04:45,125;1,5\n", b';', 2),
            ("a,b\n1,2\n3,x\n", b',', 2),
            ("a,b\nkN\n1,2\n", b',', 3),
            ("a,b\n#DATA\n1,2\n", b',', 3),
            ("\"x, y\ntwo\",b\n1,2\n", b',', 3),
            ("\n\n1;2\n", b';', 3),
            ("sep=;\r\nu;y\r\n1,5;2\r\n", b';', 3),
            ("sep=;\r\nu\r\n1 500\r\n", b';', 3),
            ("u y\n1 2\n3 4\n", b'\t', 2),
            ("Test 3\n\n  1.5 -2\n  3 4\n", b'\t', 3),
            ("u\n1 234,5\n12\n", b';', 2),
            ("u\n1 234,5\n2 345,6\n", b';', 2),
            ("1 200\n2 3\n", b'\t', 1),
            ("u, y\n1, 2\n3, 4\n", b',', 2),
        ] {
            let found = Layout::of(text.as_bytes(), true).unwrap();
            assert_eq!((found.separator, found.first_samples), (separator, Some(line)), "{text:?}");
        }
        assert_eq!(Layout::of(b"sep=,\r\nu", true).unwrap().declaration, 7);
        assert_eq!(Layout::of(b"a,b\n1,x\n", true).unwrap(), Layout::of_first_row(b"a,b"));
    }

    #[test]
    fn a_beginning_without_samples_decides_nothing_yet() {
        assert_eq!(Layout::of(b"a,b\n1,2", false), None);
        assert_eq!(Layout::of(b"1 2\n3 ", false), None);
        assert_eq!(Layout::of(b"a,b\n1,2\n", false).unwrap().first_samples, Some(2));
        assert_eq!(Layout::of(b"", true).unwrap().first_samples, None);
    }
}
