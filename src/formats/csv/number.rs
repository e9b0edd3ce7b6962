//! Numbers in cells.

/// A cell without surrounding blanks.
pub(super) fn trim(cell: &[u8]) -> &[u8] {
    cell.trim_ascii()
}

/// The number in a cell. NaN and infinities are read as numbers and refused later.
pub(super) fn number(cell: &[u8], decimal_comma: bool) -> Option<f64> {
    let cell = trim(cell);
    let text = std::str::from_utf8(cell).ok()?;
    if !decimal_comma || !cell.contains(&b',') {
        return text.parse().ok();
    }
    // 1.234,5 may be a thousand or a typing error, so that it is refused.
    if cell.contains(&b'.') || cell.iter().filter(|&&b| b == b',').count() > 1 {
        return None;
    }
    text.replace(',', ".").parse().ok()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_have_a_point_or_a_comma_but_not_both() {
        for (cell, value) in [
            ("1.5", Some(1.5)),
            (" -2e-3 ", Some(-2e-3)),
            ("+7", Some(7.0)),
            (".5", Some(0.5)),
            ("1,5", Some(1.5)),
            ("-1,5e3", Some(-1500.0)),
            ("1.000,5", None),
            ("1,000,5", None),
            ("1 5", None),
            ("", None),
            ("0x10", None),
            ("kN", None),
        ] {
            assert_eq!(number(cell.as_bytes(), true), value, "{cell}");
        }
        assert_eq!(number(b"1,5", false), None);
        assert_eq!(number(b"1e999", false), Some(f64::INFINITY));
        assert!(number(b"NaN", false).unwrap().is_nan());
        assert_eq!(number(b"\xFF1", false), None);
    }
}
