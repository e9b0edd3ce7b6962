//! Numbers in cells, as English and as German programs write them.
//!
//! A file writes its decimals with a point or with a comma, and may group thousands with the other mark, with
//! blanks or with apostrophes. The first cell that can be read in one way only decides for the file: `2.5`,
//! `0,125` or `1.234,5`. `1.234` decides nothing. It is read as a decimal, and refused when a later cell shows
//! that its mark groups thousands.

use std::borrow::Cow;

use crate::formats::labels::utf8_or_windows_1252;

/// A cell without surrounding blanks.
pub(super) fn trim(cell: &[u8]) -> &[u8] {
    cell.trim_ascii()
}

/// The reader of a file's numbers.
#[derive(Debug, Clone)]
pub(super) struct Numbers {
    /// Mark of the decimals, once it is known.
    decimal: Option<char>,
    /// The first cell that was read as a decimal and may be thousands.
    doubtful: Option<Doubtful>,
}

/// A number with one mark before exactly three digits.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Doubtful {
    pub(super) row: u64,
    pub(super) column: usize,
    pub(super) text: String,
    mark: char,
}

/// The reason why a cell gives no number.
#[derive(Debug, PartialEq)]
pub(super) enum Fault {
    NotANumber,
    /// An earlier cell, or this one, may be either of two numbers.
    Ambiguous(Doubtful),
}

impl Numbers {
    /// For a file with this separator of cells. Where it is the comma, decimals have a point.
    pub(super) fn new(separator: u8) -> Self {
        Self { decimal: (separator == b',').then_some('.'), doubtful: None }
    }

    /// The number in a cell of this row and column, from 1. NaN and infinities are read as numbers and refused
    /// later.
    pub(super) fn read(&mut self, cell: &[u8], row: u64, column: usize) -> Result<f64, Fault> {
        let cell = trim(cell);
        if self.decimal == Some('.')
            && let Some(value) = parse(cell)
        {
            return Ok(value);
        }
        let text = plain(cell);
        let (points, commas) = (count(&text, '.'), count(&text, ','));
        let decimal = match self.decimal {
            Some(mark) => mark,
            None => match (points, commas) {
                (0, 0) => return text.parse().map_err(|_| Fault::NotANumber),
                (1, 0) | (0, 1) => {
                    let mark = if points == 1 { '.' } else { ',' };
                    let value = with_decimal(&text, mark).ok_or(Fault::NotANumber)?;
                    if is_grouped(&text, mark) {
                        self.doubt(Doubtful { row, column, text: text.into_owned(), mark })?;
                    } else {
                        self.decide(mark)?;
                    }
                    return Ok(value);
                }
                (_, 0) => ',',
                (0, _) => '.',
                _ if text.rfind('.') > text.rfind(',') => '.',
                _ => ',',
            },
        };
        let value = with_decimal(&text, decimal).ok_or(Fault::NotANumber)?;
        self.decide(decimal)?;
        Ok(value)
    }

    /// Whether a cell looks like a number in any of the ways.
    pub(super) fn looks_like_one(&self, cell: &[u8]) -> bool {
        Self { decimal: self.decimal, doubtful: None }.read(cell, 0, 0).is_ok()
    }

    fn doubt(&mut self, found: Doubtful) -> Result<(), Fault> {
        match &self.doubtful {
            Some(first) if first.mark != found.mark => Err(Fault::Ambiguous(found)),
            Some(_) => Ok(()),
            None => {
                self.doubtful = Some(found);
                Ok(())
            }
        }
    }

    fn decide(&mut self, decimal: char) -> Result<(), Fault> {
        self.decimal = Some(decimal);
        match self.doubtful.take() {
            Some(first) if first.mark != decimal => Err(Fault::Ambiguous(first)),
            _ => Ok(()),
        }
    }
}

/// Digits after the decimal mark of a time, and digits from its first that is not zero; `None` for no plain number.
pub(super) fn digits(cell: &[u8]) -> Option<(i32, i32)> {
    let text = plain(trim(cell));
    let (mantissa, exponent) = match text.split_once(['e', 'E']) {
        Some((mantissa, exponent)) => (mantissa, exponent.parse::<i32>().ok()?),
        None => (&*text, 0),
    };
    let all = |text: &str| i32::try_from(text.bytes().filter(u8::is_ascii_digit).count()).unwrap_or(i32::MAX);
    let decimals = mantissa.rfind(['.', ',']).map_or(0, |at| all(&mantissa[at..]));
    let significant = mantissa.find(|c: char| ('1'..='9').contains(&c)).map_or(0, |at| all(&mantissa[at..]));
    Some((decimals.saturating_sub(exponent), significant))
}

fn parse(cell: &[u8]) -> Option<f64> {
    std::str::from_utf8(cell).ok()?.parse().ok()
}

/// The text with a plain minus, without the blanks and apostrophes that group thousands.
fn plain(cell: &[u8]) -> Cow<'_, str> {
    if cell.is_ascii() && !cell.iter().any(|b| matches!(b, b' ' | b'\'')) {
        return std::str::from_utf8(cell).expect("ASCII").into();
    }
    let mut text = utf8_or_windows_1252(cell).replace('\u{2212}', "-");
    for mark in ['\u{a0}', '\u{202f}', '\u{2009}', ' ', '\'', '\u{2019}'] {
        let end = text.find(['.', ',']).unwrap_or(text.len());
        if is_grouped(&text[..end], mark) {
            text = text.replace(mark, "");
        }
    }
    text.into()
}

/// The number with this mark of decimals; the other one must group thousands before it.
fn with_decimal(text: &str, decimal: char) -> Option<f64> {
    let group = if decimal == '.' { ',' } else { '.' };
    if !text.contains(group) {
        return if decimal == '.' { text.parse().ok() } else { text.replace(',', ".").parse().ok() };
    }
    let (whole, rest) = text.split_at(text.find(decimal).unwrap_or(text.len()));
    if !is_grouped(whole, group) || rest.contains(group) {
        return None;
    }
    format!("{}{}", whole.replace(group, ""), rest.replace(',', ".")).parse().ok()
}

/// Whether a whole number is written in groups of three digits behind one to three that begin with no zero.
fn is_grouped(text: &str, mark: char) -> bool {
    let mut groups = text.strip_prefix(['-', '+']).unwrap_or(text).split(mark);
    let digits = |group: &str| group.bytes().all(|b| b.is_ascii_digit());
    let first = groups.next().unwrap_or_default();
    let starts = (1..=3).contains(&first.len()) && digits(first) && !first.starts_with('0');
    let mut rest = groups.peekable();
    starts && rest.peek().is_some() && rest.all(|group| group.len() == 3 && digits(group))
}

fn count(text: &str, mark: char) -> usize {
    text.matches(mark).count()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn alone(cell: &str, separator: u8) -> Option<f64> {
        Numbers::new(separator).read(cell.as_bytes(), 1, 1).ok()
    }

    #[test]
    fn a_number_has_a_point_or_a_comma_and_groups_of_thousands() {
        for (cell, value) in [
            ("1.5", Some(1.5)),
            (" -2e-3 ", Some(-2e-3)),
            ("+7", Some(7.0)),
            (".5", Some(0.5)),
            ("1,5", Some(1.5)),
            ("-1,5e3", Some(-1500.0)),
            ("1.000,5", Some(1000.5)),
            ("1,000.5", Some(1000.5)),
            ("-12.345.678,25", Some(-12_345_678.25)),
            ("1.234.567", Some(1_234_567.0)),
            ("1\u{a0}234,5", Some(1234.5)),
            ("1\u{202f}234\u{202f}567", Some(1_234_567.0)),
            ("1'234.5", Some(1234.5)),
            ("1 234,5", Some(1234.5)),
            ("\u{2212}3,5", Some(-3.5)),
            ("1,000,5", None),
            ("10.00,5", None),
            ("0.000,5", None),
            ("1.000,5.5", None),
            ("1 5", None),
            ("1 23", None),
            ("", None),
            ("0x10", None),
            ("kN", None),
        ] {
            assert_eq!(alone(cell, b';'), value, "{cell}");
        }
        assert_eq!(Numbers::new(b';').read(b"1\xa0234,5", 1, 1), Ok(1234.5));
        for (cell, value) in
            [("1,5", None), ("1,234", Some(1234.0)), ("1,234.5", Some(1234.5)), ("1.234", Some(1.234))]
        {
            assert_eq!(alone(cell, b','), value, "{cell}");
        }
        assert_eq!(alone("1e999", b','), Some(f64::INFINITY));
        assert!(alone("NaN", b',').unwrap().is_nan());
        assert_eq!(Numbers::new(b',').read(b"\xFF1", 1, 1), Err(Fault::NotANumber));
    }

    /// What each cell gives, in order; `None` for a cell that is no number.
    fn all(cells: &[&str]) -> Result<Vec<Option<f64>>, (u64, String)> {
        let mut numbers = Numbers::new(b';');
        let mut found = Vec::new();
        for (row, cell) in (1..).zip(cells) {
            match numbers.read(cell.as_bytes(), row, 1) {
                Ok(value) => found.push(Some(value)),
                Err(Fault::NotANumber) => found.push(None),
                Err(Fault::Ambiguous(first)) => return Err((first.row, first.text)),
            }
        }
        Ok(found)
    }

    #[test]
    fn a_file_writes_all_its_numbers_in_one_way() {
        assert_eq!(all(&["1.234", "2.5"]), Ok(vec![Some(1.234), Some(2.5)]));
        assert_eq!(all(&["1.234", "2,5"]), Err((1, "1.234".into())));
        assert_eq!(all(&["7", "1,234", "1,234.5"]), Err((2, "1,234".into())));
        assert_eq!(all(&["1.234", "1,234"]), Err((2, "1,234".into())));
        assert_eq!(all(&["2,5", "1.234", "1.5"]), Ok(vec![Some(2.5), Some(1234.0), None]));
        assert_eq!(all(&["2.5", "1,234", "1,5"]), Ok(vec![Some(2.5), Some(1234.0), None]));
        assert_eq!(all(&["0.125", "1,234"]), Ok(vec![Some(0.125), Some(1234.0)]));
    }

    #[test]
    fn the_digits_of_a_time_are_counted() {
        for (cell, found) in [
            ("0.0010", (4, 2)),
            ("12,34", (2, 4)),
            ("10.00", (2, 4)),
            ("7", (0, 1)),
            ("1.000e-03", (6, 4)),
            ("1E+2", (-2, 1)),
            ("0", (0, 0)),
        ] {
            assert_eq!(digits(cell.as_bytes()), Some(found), "{cell}");
        }
    }
}
