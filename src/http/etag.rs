//! Changes that must name the state they start from (RFC 9110, section 13.1.1).

use axum::http::HeaderMap;
use axum::http::header::IF_MATCH;

use super::codes;
use super::problem::{Answer, Problem};

/// The tags of `If-Match`.
///
/// # Errors
/// `if_match.missing` without the header, `if_match.malformed` for a header that is no list of tags.
pub fn if_match(headers: &HeaderMap) -> Answer<Tags> {
    let mut tags = Vec::new();
    for value in headers.get_all(IF_MATCH) {
        let text = value.to_str().map_err(|_| malformed())?;
        for tag in text.split(',').map(str::trim) {
            let quoted = tag.strip_prefix("W/").unwrap_or(tag);
            if tag != "*" && (quoted.len() < 2 || !quoted.starts_with('"') || !quoted.ends_with('"')) {
                return Err(malformed());
            }
            tags.push(tag.to_owned());
        }
    }
    if tags.is_empty() {
        let detail = "This change needs If-Match with the ETag of the state that it starts from.";
        return Err(Problem::new(codes::IF_MATCH_MISSING, detail));
    }
    Ok(Tags(tags))
}

/// What `If-Match` said.
#[derive(Debug, PartialEq, Eq)]
pub struct Tags(Vec<String>);

impl Tags {
    /// Whether the current state is one that the client has seen. Weak tags match nothing: they
    /// do not promise the same bytes.
    pub fn allow(&self, current: &str) -> bool {
        self.0.iter().any(|tag| tag == "*" || tag == current)
    }
}

/// The refusal of a change that starts from another state than the current one.
pub fn stale(current: &str) -> Problem {
    let detail = format!("The resource has changed: its ETag is {current} now. Read it again, then change it.");
    Problem::new(codes::IF_MATCH_STALE, detail)
}

fn malformed() -> Problem {
    Problem::new(codes::IF_MATCH_MALFORMED, "If-Match must be * or a list of quoted tags, like \"3\".")
}

#[cfg(test)]
mod tests {
    use super::*;
    use axum::http::HeaderValue;

    fn tags(value: &'static str) -> Answer<Tags> {
        let mut headers = HeaderMap::new();
        headers.insert(IF_MATCH, HeaderValue::from_static(value));
        if_match(&headers)
    }

    #[test]
    fn only_a_tag_that_is_current_or_a_star_allows_the_change() {
        assert!(tags("\"a1\", \"a2\"").expect("tags").allow("\"a2\""));
        assert!(!tags("\"a1\"").expect("tags").allow("\"a2\""));
        assert!(!tags("W/\"a2\"").expect("tags").allow("\"a2\""), "weak tags match nothing");
        assert!(tags("*").expect("tags").allow("\"a2\""));
    }

    #[test]
    fn a_missing_header_and_an_unquoted_tag_are_told_apart() {
        assert_eq!(if_match(&HeaderMap::new()).expect_err("missing").code(), "if_match.missing");
        assert_eq!(tags("a2").expect_err("unquoted").code(), "if_match.malformed");
        assert_eq!(tags("\"").expect_err("half quoted").code(), "if_match.malformed");
    }
}
