//! Texts that clients choose: names, labels and tags.

use super::FieldError;

/// Longest name.
pub const MAX_NAME_CHARS: usize = 1000;

/// What a text of at least so many characters must be, if it is not. U+0000 ends texts in files and databases that
/// others read, so that no text has it.
pub fn limit_of(text: &str, least: usize) -> Option<String> {
    let chars = text.chars().count();
    match least {
        0 if chars > MAX_NAME_CHARS => Some(format!("at most {MAX_NAME_CHARS} characters")),
        _ if chars < least || chars > MAX_NAME_CHARS => {
            Some(format!("{least} to {MAX_NAME_CHARS} characters"))
        }
        _ if text.contains('\0') => Some("without the character U+0000".into()),
        _ => None,
    }
}

/// Adds what is wrong with a text of at least so many characters to `errors`.
pub fn check_text(errors: &mut Vec<FieldError>, pointer: impl Into<String>, text: &str, least: usize) {
    if let Some(limit) = limit_of(text, least) {
        errors.push(FieldError::new(pointer, limit));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_text_has_its_length_and_no_end_within_it() {
        assert_eq!(limit_of("", 0), None);
        assert_eq!(limit_of("", 1).as_deref(), Some("1 to 1000 characters"));
        assert_eq!(limit_of(&"ü".repeat(1000), 1), None);
        assert_eq!(limit_of(&"ü".repeat(1001), 0).as_deref(), Some("at most 1000 characters"));
        assert_eq!(limit_of("run\0", 0).as_deref(), Some("without the character U+0000"));
    }
}
