//! Every problem code of the contract. `openapi.yaml` lists the same ones; a test compares.

/// A kind of problem: what stays the same however often and wherever it happens.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Code {
    /// Stable name, for programs.
    pub name: &'static str,
    /// HTTP status.
    pub status: u16,
    /// The same for every problem of this kind, for people.
    pub title: &'static str,
}

/// Defines the constants and the table of all of them in one go, so that neither lacks one.
macro_rules! codes {
    ($($constant:ident = $name:literal, $status:literal, $title:literal;)*) => {
        $(
            #[doc = concat!("`", $name, "`: ", $title, ".")]
            pub const $constant: Code = Code { name: $name, status: $status, title: $title };
        )*

        /// All codes.
        pub const ALL: &[Code] = &[$($constant),*];
    };
}

codes! {
    // The request as such.
    REQUEST_MALFORMED = "request.malformed", 400, "The request cannot be read";
    ROUTE_NOT_FOUND = "route.not_found", 404, "No such route";
    METHOD_NOT_ALLOWED = "method.not_allowed", 405, "Method not allowed";
    ACCEPT_NOT_ACCEPTABLE = "accept.not_acceptable", 406, "No acceptable representation";
    CONTENT_TYPE_UNSUPPORTED = "content_type.unsupported", 415, "Unsupported media type";
    CONTENT_ENCODING_UNSUPPORTED = "content_encoding.unsupported", 415, "Unsupported content encoding";
    QUERY_UNKNOWN_PARAMETER = "query.unknown_parameter", 422, "Unknown query parameter";
    QUERY_INVALID = "query.invalid", 422, "Invalid query parameter";

    // Its body.
    BODY_INCOMPLETE = "body.incomplete", 400, "The body ended early";
    BODY_SYNTAX = "body.syntax", 400, "The body is not JSON";
    BODY_TOO_DEEP = "body.too_deep", 400, "The body is nested too deeply";
    BODY_TOO_LARGE = "body.too_large", 413, "The body is too large";
    BODY_UNKNOWN_FIELD = "body.unknown_field", 422, "Unknown field";
    BODY_MISSING_FIELD = "body.missing_field", 422, "Missing field";
    BODY_INVALID_VALUE = "body.invalid_value", 422, "Invalid value";
    DIGEST_MALFORMED = "digest.malformed", 400, "Content-Digest cannot be read";
    DIGEST_MISMATCH = "digest.mismatch", 400, "The body is not what its digest says";

    // Preconditions.
    IF_MATCH_MALFORMED = "if_match.malformed", 400, "If-Match cannot be read";
    IF_MATCH_STALE = "if_match.stale", 412, "The resource has changed";
    IF_MATCH_MISSING = "if_match.missing", 428, "If-Match is required";

    // Our side.
    INTERNAL = "internal", 500, "Internal error";
    BUSY = "busy", 503, "Busy";
    DRAINING = "draining", 503, "Shutting down";
    STORE_UNAVAILABLE = "store.unavailable", 503, "The store is out of reach";
    STORE_FULL = "store.full", 507, "The disk is full";
}

/// The code of this name.
pub fn find(name: &str) -> Option<Code> {
    ALL.iter().copied().find(|code| code.name == name)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_are_unique_and_statuses_are_errors() {
        let mut names: Vec<_> = ALL.iter().map(|c| c.name).collect();
        names.sort_unstable();
        names.dedup();
        assert_eq!(names.len(), ALL.len());
        for code in ALL {
            assert!((400..600).contains(&code.status), "{}", code.name);
            assert!(axum::http::StatusCode::from_u16(code.status).is_ok_and(|s| s.canonical_reason().is_some()));
            assert!(code.name.bytes().all(|b| b.is_ascii_lowercase() || b.is_ascii_digit() || b == b'.' || b == b'_'));
        }
    }
}
