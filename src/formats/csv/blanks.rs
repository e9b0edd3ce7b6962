//! Tables whose cells are separated by blanks, as numeric programs write them (`np.savetxt`, `save -ascii`): each row of
//! blanks becomes one tab before the rows are split.

use super::number::{Numbers, trim};

/// What stands in place of blanks.
pub(super) const SEPARATOR: u8 = b'\t';

/// Replaces blanks piece by piece. Those in quotes stay, and those at both ends of a line go. A mark of comments before a
/// line goes too: the names of the columns may stand in one.
#[derive(Debug, Default)]
pub(super) struct Blanks {
    /// Whether the line has more than blanks so far.
    begun: bool,
    /// Whether blanks came last.
    pending: bool,
    quoted: bool,
}

impl Blanks {
    /// Replaces the blanks of the text from this byte on, which goes on where the text of the last call ended.
    pub(super) fn replace(&mut self, text: &mut Vec<u8>, from: usize) {
        for byte in text.split_off(from) {
            match byte {
                b'\n' | b'\r' if !self.quoted => {
                    *self = Self::default();
                    text.push(byte);
                }
                b' ' if !self.quoted => self.pending = self.begun,
                b'#' | b'%' if !self.begun => {}
                _ => {
                    if self.pending {
                        text.push(SEPARATOR);
                    }
                    text.push(byte);
                    self.quoted ^= byte == b'"';
                    (self.begun, self.pending) = (true, false);
                }
            }
        }
    }
}

/// Numbers of a line that blanks separate: two or more, and nothing else that may separate.
pub(super) fn count(line: &[u8]) -> Option<usize> {
    if line.iter().any(|byte| matches!(byte, b'\t' | b';' | b'"')) {
        return None;
    }
    let numbers = Numbers::new(SEPARATOR);
    let mut cells = trim(line).split(|byte| *byte == b' ').filter(|cell| !cell.is_empty());
    // A comma at an end separates.
    let is_number =
        |cell: &[u8]| !cell.starts_with(b",") && !cell.ends_with(b",") && numbers.looks_like_one(cell);
    let n = cells.try_fold(0, |n, cell| is_number(cell).then_some(n + 1))?;
    (n > 1).then_some(n)
}

/// Whether a line is also one number, whose blanks group thousands.
pub(super) fn is_one_number(line: &[u8]) -> bool {
    Numbers::new(b';').looks_like_one(line)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn blanks_become_one_tab_wherever_the_text_is_cut() {
        let text = b"  # t  u \"a  b\"\r\n 1   2  3  \n\n%4 5\n";
        let expected = b"t\tu\t\"a  b\"\r\n1\t2\t3\n\n4\t5\n";
        for cut in 0..=text.len() {
            let (mut blanks, mut found) = (Blanks::default(), b"x".to_vec());
            for piece in [&text[..cut], &text[cut..]] {
                let from = found.len();
                found.extend_from_slice(piece);
                blanks.replace(&mut found, from);
            }
            assert_eq!(found[1..], expected[..], "cut at {cut}");
        }
    }

    #[test]
    fn a_line_of_numbers_is_told_from_one_that_something_else_separates() {
        for (line, n) in [
            ("1 2", Some(2)),
            ("  1.5e-3   -2  +3 ", Some(3)),
            ("1,5 2,5", Some(2)),
            ("1", None),
            ("1, 2", None),
            ("1 ,2", None),
            ("1; 2", None),
            ("1\t2", None),
            ("1 kN", None),
            ("", None),
        ] {
            assert_eq!(count(line.as_bytes()), n, "{line:?}");
        }
        assert!(is_one_number(b"1 234,5") && !is_one_number(b"1 23"));
    }
}
