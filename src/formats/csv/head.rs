//! The rows above the samples: titles, names of columns, units.

use std::io::Read;
use std::ops::RangeInclusive;

use super::number::Numbers;
use super::rows::Rows;
use super::stamp::stamp;
use crate::domain::units;
use crate::formats::{FormatError, ReadError, check_channel_count, check_name};

/// Most rows above the samples.
const MAX_ROWS: usize = 1000;

/// Most bytes of the rows above the samples.
const MAX_BYTES: usize = 16 << 20;

/// Names and units of the columns.
#[derive(Debug, Clone, Default, PartialEq)]
pub(super) struct Head {
    pub(super) names: Option<Vec<String>>,
    pub(super) units: Option<Vec<String>>,
    /// Line of the names, or of the first row.
    pub(super) row: u64,
}

/// A row above the samples without the empty cells at its end.
struct HeadRow {
    row: u64,
    cells: Vec<String>,
    /// Cells with the empty ones at the end.
    len: usize,
}

/// Reads up to the first row of samples, which is then the current one. Where no
/// samples were found near the beginning, the first row has the names and a second one without numbers the units.
///
/// # Errors
/// `run.empty` where no row of samples follows; `csv.header`, `csv.ragged_row`, `csv.long_row`; errors of the file system.
pub(super) fn read(rows: &mut Rows<impl Read>, numbers: &Numbers) -> Result<Head, ReadError> {
    let first_samples = rows.layout().first_samples;
    let mut above: Vec<HeadRow> = Vec::new();
    let mut bytes = 0;
    let mut more = rows.next()?;
    if !more {
        return Err(FormatError::Empty.into());
    }
    while more {
        let is_above = match first_samples {
            Some(first) => rows.row() < first,
            None => above.is_empty() || above.len() == 1 && may_hold_units(rows, numbers),
        };
        if is_above || above.is_empty() {
            check_channel_count(rows.cells().len() as u64)?;
        }
        if !is_above {
            break;
        }
        let row = HeadRow { row: rows.row(), cells: trimmed(rows.texts()), len: rows.cells().len() };
        bytes += row.cells.iter().map(String::len).sum::<usize>();
        if above.len() == MAX_ROWS || bytes > MAX_BYTES {
            let reason = "no row of samples follows";
            return Err(FormatError::CsvHeader { row: row.row, column: 1, reason }.into());
        }
        // A row of blanks has neither names nor units.
        if !row.cells.is_empty() {
            above.push(row);
        }
        more = rows.next()?;
    }
    if !more {
        return Err(FormatError::Empty.into());
    }
    let width = rows.cells().trimmed_len()..=rows.cells().len();
    Ok(head(&above, &width, rows.row())?)
}

/// Whether the current row has no number. The cells of a row that is too long are not known.
fn may_hold_units(rows: &Rows<impl Read>, numbers: &Numbers) -> bool {
    let mut cells = rows.cells().iter().peekable();
    cells.peek().is_some() && cells.all(|cell| !numbers.looks_like_one(cell))
}

/// Names and units among the rows above samples that have as many cells as `width` says, without and with the empty
/// ones at the end.
fn head(above: &[HeadRow], width: &RangeInclusive<usize>, samples_row: u64) -> Result<Head, FormatError> {
    let Some(last) = above.last() else { return Ok(Head { row: samples_row, ..Head::default() }) };
    if let Some(tagged) = tagged(above) {
        return tagged;
    }
    let fits = |row: &HeadRow| width.contains(&row.cells.len());
    let names = above.iter().rev().nth(1).filter(|row| fits(row) && fault(row).is_none());
    // Two rows of words may be a title over names, too. The units of longer heads must be some that are known.
    let holds_units = !last.cells.iter().any(|cell| is_value(cell))
        && (above.len() == 2 || !fits(last) || last.cells.iter().any(|cell| is_unit(cell)));
    let Some(names) = names.filter(|_| holds_units) else {
        check_titles(&above[..above.len() - 1], last)?;
        return Head::of(last, None);
    };
    check_titles(&above[..above.len() - 2], names)?;
    let expected = names.cells.len();
    if last.cells.len() > expected || last.len < expected {
        return Err(FormatError::CsvRagged { row: last.row, expected, found: last.len });
    }
    Head::of(names, Some(last))
}

/// # Errors
/// `csv.header` for a row of samples among those above the names, as where a header comes again.
fn check_titles(titles: &[HeadRow], names: &HeadRow) -> Result<(), FormatError> {
    let holds_samples =
        |row: &&HeadRow| row.cells.len() == names.cells.len() && row.cells.iter().all(|cell| is_value(cell));
    match titles.iter().find(holds_samples) {
        None => Ok(()),
        Some(row) => {
            Err(FormatError::CsvHeader { row: row.row, column: 1, reason: "samples stand above the header" })
        }
    }
}

impl Head {
    fn of(names: &HeadRow, units: Option<&HeadRow>) -> Result<Self, FormatError> {
        if let Some((column, reason)) = fault(names) {
            return Err(FormatError::CsvHeader { row: names.row, column, reason });
        }
        let mut own = names.cells.clone();
        // As programs mark a header that others shall skip.
        if let Some(bare) = own[0].strip_prefix('#').map(str::trim).filter(|bare| !bare.is_empty()) {
            own[0] = bare.to_owned();
        }
        for (i, name) in own.iter().enumerate() {
            check_name(name)?;
            if own[..i].contains(name) {
                return Err(FormatError::DuplicateChannel { name: name.clone() });
            }
        }
        let units = units.map(|units| {
            let mut cells: Vec<String> =
                units.cells.iter().map(|unit| without_brackets(unit).to_owned()).collect();
            cells.resize(own.len(), String::new());
            cells
        });
        Ok(Self { names: Some(own), units, row: names.row })
    }
}

/// Names and units by the tags `#TITLES` and `#UNITS` of nCode's text files.
fn tagged(above: &[HeadRow]) -> Option<Result<Head, FormatError>> {
    let after = |tag: &str| {
        let at = above.iter().position(|row| row.cells[0].eq_ignore_ascii_case(tag))?;
        above.get(at + 1).filter(|row| !row.cells[0].starts_with('#'))
    };
    let (names, units) = (after("#TITLES")?, after("#UNITS"));
    Some(Head::of(names, units))
}

/// The first cell of a row that is no name, from 1, and why.
fn fault(row: &HeadRow) -> Option<(usize, &'static str)> {
    let reason = |cell: &String| {
        if cell.is_empty() {
            Some("a channel needs a name")
        } else if is_value(cell) {
            Some("a header row holds names only, a row of samples numbers only")
        } else {
            None
        }
    };
    (1..).zip(&row.cells).find_map(|(column, cell)| Some((column, reason(cell)?)))
}

/// Whether a text would read back as a number or a date-time.
pub(super) fn is_value(text: &str) -> bool {
    Numbers::new(b';').looks_like_one(text.as_bytes()) || stamp(text.as_bytes()).is_some()
}

/// Whether a cell can hardly be anything but a unit.
fn is_unit(cell: &str) -> bool {
    without_brackets(cell) != cell || units::known(cell)
}

pub(super) fn without_brackets(unit: &str) -> &str {
    [('[', ']'), ('(', ')')]
        .iter()
        .find_map(|(open, close)| unit.strip_prefix(*open)?.strip_suffix(*close))
        .unwrap_or(unit)
        .trim()
}

fn trimmed(mut cells: Vec<String>) -> Vec<String> {
    while cells.pop_if(|cell| cell.is_empty()).is_some() {}
    cells
}
