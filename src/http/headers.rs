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

/// For pages: scripts, styles, forms and requests of the service itself, nothing inline and nothing from elsewhere.
pub const PAGE: &str = "default-src 'none'; style-src 'self'; script-src 'self'; img-src 'self' data:; connect-src 'self'; form-action 'self'; frame-ancestors 'none'; base-uri 'none'";

/// In the extensions of an answer that never changes under its path, and holds no data of the lab: caches may keep it.
#[derive(Debug, Clone, Copy)]
pub struct Immutable;

/// How long caches keep such an answer: a year.
const IMMUTABLE: HeaderValue = HeaderValue::from_static("public, max-age=31536000, immutable");

/// Lets caches keep an answer that never changes.
pub fn keep(headers: &mut HeaderMap) {
    headers.insert(CACHE_CONTROL, IMMUTABLE);
}

/// Adds these headers to an answer; a handler's own policy for its page stays.
pub fn protect(headers: &mut HeaderMap) {
    for (name, value) in ALWAYS {
        headers.insert(name, HeaderValue::from_static(value));
    }
    headers.entry(CONTENT_SECURITY_POLICY).or_insert(HeaderValue::from_static(NO_PAGE));
}

/// For a document that is complete in itself: no scripts, and this one inline style.
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
        headers.insert(CONTENT_SECURITY_POLICY, HeaderValue::from_static(PAGE));
        headers.insert(CACHE_CONTROL, HeaderValue::from_static("public"));
        protect(&mut headers);
        assert_eq!(headers[CONTENT_SECURITY_POLICY], PAGE);
        assert_eq!(headers[CACHE_CONTROL], "no-store");
        let mut bare = HeaderMap::new();
        protect(&mut bare);
        assert_eq!(bare[CONTENT_SECURITY_POLICY], NO_PAGE);
        assert_eq!(bare.len(), ALWAYS.len() + 1);
    }
}
