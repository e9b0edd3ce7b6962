//! Names and units as measurement programs write them: text of a fixed width, often in Windows-1252, for people.

use std::collections::HashSet;

/// Text in Windows-1252 up to the first zero byte, without blanks around it. Bytes after it may be left over from
/// another text.
pub(super) fn windows_1252(bytes: &[u8]) -> String {
    encoding_rs::WINDOWS_1252.decode_without_bom_handling(up_to_zero(bytes)).0.trim().to_owned()
}

/// [`windows_1252`] for files that may be UTF-8: text that is valid UTF-8 is hardly ever anything else.
pub(super) fn utf8_or_windows_1252(bytes: &[u8]) -> String {
    match std::str::from_utf8(up_to_zero(bytes)) {
        Ok(text) => text.trim().to_owned(),
        Err(_) => windows_1252(bytes),
    }
}

fn up_to_zero(bytes: &[u8]) -> &[u8] {
    &bytes[..memchr::memchr(0, bytes).unwrap_or(bytes.len())]
}

/// Names of channels in the order of the file. A channel is its place in the file: a name that comes again gets its
/// number, from 1.
pub(super) fn distinct(names: impl IntoIterator<Item = String>) -> Vec<String> {
    let mut seen = HashSet::new();
    let name = |(index, mut name): (usize, String)| {
        while !seen.insert(name.clone()) {
            name = format!("{name} ({})", index + 1);
        }
        name
    };
    names.into_iter().enumerate().map(name).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn text_is_utf8_where_it_can_be() {
        assert_eq!(utf8_or_windows_1252(b" m/s\xc2\xb2 \0junk"), "m/s²");
        assert_eq!(utf8_or_windows_1252(b"m/s\xb2 "), "m/s²");
        assert_eq!(windows_1252(b"m/s\xb2\0\xc2"), "m/s²");
    }

    #[test]
    fn a_name_that_comes_again_gets_its_number() {
        let names = ["a", "a", "b", "a (2)", "a"].map(str::to_owned);
        assert_eq!(distinct(names), ["a", "a (2)", "b", "a (2) (4)", "a (5)"]);
    }
}
