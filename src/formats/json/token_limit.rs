//! A bound on the length of names and numbers: the parser keeps each as a whole in memory.

use std::io::{self, Read};

use crate::formats::FormatError;
use crate::formats::error::excerpt;

/// Longest name or number, bytes: that of a channel in its longest spelling has fewer.
const MAX_TOKEN_BYTES: usize = 64 << 10;

/// Bytes of a token that an error may show: 40 characters.
const SHOWN_BYTES: usize = 160;

/// JSON text that ends with an error, which is a [`FormatError`], where a name or a number is too long.
#[derive(Debug)]
pub(super) struct TokenLimit<R> {
    text: R,
    /// Bytes of the current name, number or word.
    token: usize,
    /// Its beginning, without the quotation mark.
    start: Vec<u8>,
    in_string: bool,
    /// The last byte is a backslash that begins an escape.
    escape: bool,
    /// Open brackets.
    depth: usize,
    /// A colon stands before the token.
    after_colon: bool,
    row: u64,
    column: usize,
}

impl<R> TokenLimit<R> {
    pub(super) fn new(text: R) -> Self {
        Self {
            text,
            token: 0,
            start: Vec::new(),
            in_string: false,
            escape: false,
            depth: 0,
            after_colon: false,
            row: 1,
            column: 0,
        }
    }

    fn pass(&mut self, byte: u8) -> Result<(), FormatError> {
        (self.row, self.column) = if byte == b'\n' { (self.row + 1, 0) } else { (self.row, self.column + 1) };
        let ends = if self.in_string {
            let ends = byte == b'"' && !self.escape;
            self.escape = byte == b'\\' && !self.escape;
            self.in_string = !ends;
            ends
        } else {
            self.in_string = byte == b'"';
            match byte {
                b'[' | b'{' => (self.depth, self.after_colon) = (self.depth + 1, false),
                b']' | b'}' => self.depth = self.depth.saturating_sub(1),
                b',' | b':' => self.after_colon = byte == b':',
                _ => {}
            }
            matches!(byte, b',' | b':' | b'[' | b']' | b'{' | b'}' | b' ' | b'\t' | b'\r' | b'\n')
        };
        if ends {
            self.token = 0;
            self.start.clear();
            return Ok(());
        }
        self.token += 1;
        if self.start.len() < SHOWN_BYTES && (self.in_string, self.token) != (true, 1) {
            self.start.push(byte);
        }
        if self.token <= MAX_TOKEN_BYTES {
            return Ok(());
        }
        let start = excerpt(&String::from_utf8_lossy(&self.start));
        match self.depth {
            1 if self.in_string && !self.after_colon => {
                return Err(FormatError::JsonUnknownKey { key: start });
            }
            2 if self.in_string && !self.after_colon => return Err(FormatError::LongName { start }),
            _ => {}
        }
        let detail = format!("a name or a number is longer than {} KiB", MAX_TOKEN_BYTES >> 10);
        Err(FormatError::Json { row: self.row, column: self.column, detail })
    }
}

impl<R: Read> Read for TokenLimit<R> {
    fn read(&mut self, space: &mut [u8]) -> io::Result<usize> {
        let n = self.text.read(space)?;
        space[..n].iter().try_for_each(|byte| self.pass(*byte)).map_err(io::Error::other)?;
        Ok(n)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::formats::{ReadError, Spool, json};

    fn refused(text: &str) -> FormatError {
        json::read_from(text.as_bytes(), Spool::in_memory()).unwrap_err().of_bytes()
    }

    #[test]
    fn a_name_or_number_that_never_ends_is_refused_where_it_is_too_long() {
        let long = "1".repeat(2 * MAX_TOKEN_BYTES);
        for text in [
            format!("{{\n\"sample_rate_hz\": \"{long}"),
            format!("{{\n\"sample_rate_hz\": {long}"),
            format!("{{\"sample_rate_hz\": 1,\n\"channels\": {{\"a\": \"\\\"[,:{long}"),
            format!("{{\"sample_rate_hz\": 1,\n\"channels\": {{\"a\": [1, 0.{long}"),
            format!("{{\"sample_rate_hz\": 1,\n\"channels\": {{\"a\": [1, {long}"),
        ] {
            let error = refused(&text);
            assert_eq!((error.code(), error.row()), ("json.invalid", Some(2)), "{error}");
            assert!(error.to_string().contains("longer than 64 KiB"), "{error}");
            assert!(error.column().is_some_and(|column| column > MAX_TOKEN_BYTES), "{error}");
        }
    }

    #[test]
    fn a_field_or_channel_whose_name_never_ends_is_named_by_its_beginning() {
        let long = format!("b\\\"[,:{}", "a".repeat(2 * MAX_TOKEN_BYTES));
        let start: String = long.chars().take(40).collect();
        let field = refused(&format!("{{\"sample_rate_hz\": 1, \"{long}"));
        assert_eq!(field, FormatError::JsonUnknownKey { key: start.clone() });
        let channel = refused(&format!("{{\"sample_rate_hz\": 1, \"channels\": {{\"a\": [1], \"{long}"));
        assert_eq!(channel, FormatError::LongName { start });
    }

    #[test]
    fn many_short_names_numbers_and_blanks_are_read() {
        let blanks = " ".repeat(2 * MAX_TOKEN_BYTES);
        let numbers = vec!["1"; MAX_TOKEN_BYTES].join(",");
        let escaped = "\\u0061".repeat(4096);
        let text = format!(
            r#"{{"sample_rate_hz": {blanks}1, "channels": {{"{escaped}": [{numbers}], "\"\\": [{numbers}]}}}}"#
        );
        let run = json::read_from(text.as_bytes(), Spool::in_memory()).map_err(ReadError::of_bytes).unwrap();
        let names = run.names.unwrap();
        assert_eq!((names[0].len(), names[1].as_str()), (4096, "\"\\"));
        assert_eq!(run.channels.len(1), MAX_TOKEN_BYTES);
        let long = refused(&format!(r#"{{"sample_rate_hz": 1, "channels": {{"{escaped}a": [1]}}}}"#));
        assert_eq!(long.code(), "run.unknown_channel", "a name that is too long for a channel only");
    }
}
