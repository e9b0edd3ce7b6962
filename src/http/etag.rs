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

/// The content of `If-Match`.
#[derive(Debug, PartialEq, Eq)]
pub struct Tags(Vec<String>);

impl Tags {
    /// Checks the change against the current state, and returns the tag that the store must still find
    /// when it writes. Weak tags match nothing, because they do not promise the same bytes.
    ///
    /// # Errors
    /// `if_match.stale` when the client has seen another state.
    pub fn check(&self, current: &str) -> Answer<&str> {
        if self.0.iter().any(|tag| tag == "*") {
            return Ok("*");
        }
        self.0.iter().find(|tag| *tag == current).map(String::as_str).ok_or_else(|| stale(current))
    }
}

/// The refusal of a change that starts from another state than the current one.
pub fn stale(current: &str) -> Problem {
    let detail =
        format!("The resource has changed: its ETag is {current} now. Read it again, then change it.");
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
        let check = |value| {
            tags(value).expect("tags").check("\"a2\"").map(str::to_owned).map_err(|p| p.code().to_owned())
        };
        assert_eq!(check("\"a1\", \"a2\""), Ok("\"a2\"".into()));
        assert_eq!(check("*"), Ok("*".into()));
        assert_eq!(check("\"a1\""), Err("if_match.stale".into()));
        assert_eq!(check("W/\"a2\""), Err("if_match.stale".into()), "weak tags match nothing");
    }

    #[test]
    fn a_missing_header_and_an_unquoted_tag_are_told_apart() {
        assert_eq!(if_match(&HeaderMap::new()).expect_err("missing").code(), "if_match.missing");
        assert_eq!(tags("a2").expect_err("unquoted").code(), "if_match.malformed");
        assert_eq!(tags("\"").expect_err("half quoted").code(), "if_match.malformed");
    }
}
