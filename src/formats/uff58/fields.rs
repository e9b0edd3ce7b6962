//! Fields of a record, by their columns: numbers may touch each other.

use std::ops::Range;

use crate::formats::error::excerpt;
use crate::formats::{FormatError, labels};

use super::lines::Line;

impl Line<'_> {
    /// The bytes of these columns, from 0, as far as the line has them. Programs that write UTF-8 count bytes.
    fn columns(&self, columns: Range<usize>) -> &[u8] {
        let len = self.bytes.len();
        self.bytes[columns.start.min(len)..columns.end.min(len)].trim_ascii()
    }

    /// A name; empty where there is none, for which the format has the word NONE.
    pub(super) fn text(&self, columns: Range<usize>) -> String {
        let text = labels::utf8_or_windows_1252(self.columns(columns));
        if text.eq_ignore_ascii_case("none") { String::new() } else { text }
    }

    /// A whole number; an empty field is 0, as Fortran reads it.
    ///
    /// # Errors
    /// `uff58.header`, with the name of the field.
    pub(super) fn whole(&self, columns: Range<usize>, name: &str) -> Result<i64, FormatError> {
        let field = self.columns(columns.clone());
        if field.is_empty() {
            return Ok(0);
        }
        let found = std::str::from_utf8(field).ok().and_then(|text| text.parse().ok());
        found.ok_or_else(|| self.no_number(name, "whole", columns))
    }

    /// A finite number and half a unit of its last digit; an empty field is 0.
    ///
    /// # Errors
    /// `uff58.header`, with the name of the field.
    pub(super) fn real(&self, columns: Range<usize>, name: &str) -> Result<(f64, f64), FormatError> {
        let field = self.columns(columns.clone());
        if field.is_empty() {
            return Ok((0.0, 0.0));
        }
        let found = number(field).filter(|value| value.is_finite());
        let value = found.ok_or_else(|| self.no_number(name, "finite", columns))?;
        Ok((value, half_unit(field)))
    }

    fn no_number(&self, name: &str, kind: &str, columns: Range<usize>) -> FormatError {
        let text = labels::utf8_or_windows_1252(self.columns(columns.clone()));
        let (first, last) = (columns.start + 1, columns.end);
        self.refuse(format!("{name} (columns {first} to {last}) is {:?}, no {kind} number", excerpt(&text)))
    }
}

/// A number as Fortran and C write it: `-1.5E+00`, `-1.5D+00`, `-1.5+100`. NaN and infinities are read as numbers
/// and refused later.
pub(super) fn number(field: &[u8]) -> Option<f64> {
    let text = std::str::from_utf8(field).ok()?.trim();
    if let Ok(value) = text.parse() {
        return Some(value);
    }
    if text.contains(['d', 'D']) {
        return text.replace(['d', 'D'], "e").parse().ok();
    }
    // Fortran leaves out the letter before an exponent of three digits.
    let (digits, exponent) = text.split_at(text.rfind(['+', '-'])?);
    if !digits.ends_with(|last: char| last.is_ascii_digit() || last == '.') {
        return None;
    }
    format!("{digits}e{exponent}").parse().ok()
}

/// Half a unit of the last digit of a number.
fn half_unit(field: &[u8]) -> f64 {
    let letter = field.iter().position(|b| matches!(b, b'e' | b'E' | b'd' | b'D'));
    let (digits, exponent) = field.split_at(letter.unwrap_or(field.len()));
    let point = digits.iter().position(|&b| b == b'.');
    let decimals = point.map_or(0, |at| digits[at + 1..].iter().filter(|b| b.is_ascii_digit()).count());
    let exponent = exponent.get(1..).and_then(|e| std::str::from_utf8(e).ok()?.parse::<i32>().ok());
    // A field has some tens of columns.
    0.5 * 10.0_f64.powi(exponent.unwrap_or(0).saturating_sub(decimals as i32))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_are_read_as_fortran_and_c_write_them() {
        for (text, value) in [
            (" -3.81956E+00", Some(-3.81956)),
            ("0.00000E+000", Some(0.0)),
            ("0.15000D+02 ", Some(15.0)),
            ("-1.5d-02", Some(-0.015)),
            ("0.12345-102", Some(0.12345e-102)),
            ("1.+100", Some(1e100)),
            ("-1", Some(-1.0)),
            (".5", Some(0.5)),
            ("1.00000e+400", Some(f64::INFINITY)),
            ("1.0E+00-2", None),
            ("1.0 2.0", None),
            ("1.0-2.0", None),
            ("*************", None),
            ("-", None),
            ("", None),
            ("+-1", None),
        ] {
            assert_eq!(number(text.as_bytes()), value, "{text}");
        }
        assert!(number(b" NaN ").unwrap().is_nan());
        assert_eq!(number(b"\xff1"), None);
    }

    #[test]
    fn the_last_digit_says_how_well_a_number_is_known() {
        for (text, expected) in [
            ("1.52588E-05", 5e-11),
            ("0.48828E-03", 5e-9),
            ("0.48828D-03", 5e-9),
            ("0.003", 5e-4),
            ("2", 0.5),
            ("5.00000E-005", 5e-11),
            ("1e999999999999", 0.5),
        ] {
            let found = half_unit(text.as_bytes());
            assert!((found / expected - 1.0).abs() < 1e-12, "{text}: {found}");
        }
        assert_eq!(half_unit(b"1.0e-2147483648"), 0.0);
    }
}
