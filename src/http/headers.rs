//! Headers that restrict what browsers may do with an answer.

use axum::http::header::{
    CACHE_CONTROL, CONTENT_SECURITY_POLICY, REFERRER_POLICY, X_CONTENT_TYPE_OPTIONS, X_FRAME_OPTIONS,
};
use axum::http::{HeaderMap, HeaderName, HeaderValue};
use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;
use sha2::{Digest, Sha256};

/// On every answer, whatever the handler says: no guessing of types, no frames, no referrer, no use by
/// other origins, and no copy in any cache, because answers are data of the lab.
const ALWAYS: [(HeaderName, &str); 5] = [
    (X_CONTENT_TYPE_OPTIONS, "nosniff"),
    (X_FRAME_OPTIONS, "DENY"),
    (REFERRER_POLICY, "no-referrer"),
    (HeaderName::from_static("cross-origin-resource-policy"), "same-origin"),
    (CACHE_CONTROL, "no-store"),
];

/// For answers that are no pages: a browser that takes one for a page loads nothing.
const NO_PAGE: &str = "default-src 'none'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'";

/// For pages without scripts and with styles of their own.
pub const SCRIPT_FREE_PAGE: &str = "default-src 'none'; style-src 'unsafe-inline'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'";

/// Adds these headers to an answer; a handler's own policy for its page stays.
pub fn protect(headers: &mut HeaderMap) {
    for (name, value) in ALWAYS {
        headers.insert(name, HeaderValue::from_static(value));
    }
    headers.entry(CONTENT_SECURITY_POLICY).or_insert(HeaderValue::from_static(NO_PAGE));
}

/// For a page that runs scripts of the service: those that it loads from here, and the one inside it.
pub fn page_with_script(html: &str) -> String {
    let script = html.split_once("<script>").and_then(|(_, rest)| Some(rest.split_once("</script>")?.0));
    let script = STANDARD.encode(Sha256::digest(script.unwrap_or_default()));
    format!(
        "default-src 'none'; script-src 'self' 'sha256-{script}'; style-src 'self' 'unsafe-inline'; \
         img-src 'self' data:; connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    )
}

/// For a page without scripts and with this one inline style.
pub fn page_with_style(style: &str) -> String {
    let style = STANDARD.encode(Sha256::digest(style));
    format!(
        "default-src 'none'; style-src 'sha256-{style}'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_handlers_policy_stays_and_its_caching_does_not() {
        let mut headers = HeaderMap::new();
        headers.insert(CONTENT_SECURITY_POLICY, HeaderValue::from_static(SCRIPT_FREE_PAGE));
        headers.insert(CACHE_CONTROL, HeaderValue::from_static("public"));
        protect(&mut headers);
        assert_eq!(headers[CONTENT_SECURITY_POLICY], SCRIPT_FREE_PAGE);
        assert_eq!(headers[CACHE_CONTROL], "no-store");
        let mut bare = HeaderMap::new();
        protect(&mut bare);
        assert_eq!(bare[CONTENT_SECURITY_POLICY], NO_PAGE);
        assert_eq!(bare.len(), ALWAYS.len() + 1);
    }

    #[test]
    fn the_script_of_a_page_is_allowed_by_its_digest() {
        // echo -n 'let x = 1;' | openssl dgst -sha256 -binary | base64
        let policy = page_with_script("<script src=\"a.js\"></script><script>let x = 1;</script>");
        assert!(policy.contains("'sha256-qtc3jf64UXA5J6U02kfQ0Cvn9Uz4wXUaN3NNUVgR2v4='"), "{policy}");
    }
}
