//! Problem documents (RFC 9457): the form of every answer that is not a success.
//!
//! A [`Problem`] becomes a response whose body is still empty; the outermost layer ([`super::observe`])
//! writes the document, because only that layer knows the request id.

use std::borrow::Cow;

use axum::http::header::{ALLOW, RETRY_AFTER};
use axum::http::{HeaderName, HeaderValue, StatusCode};
use axum::response::{IntoResponse, Response};
use serde::Serialize;

use super::codes::{self, Code};
use crate::domain;
pub use crate::domain::FieldError;
use crate::ui::{self, frame::Visitor, refusal::Refusal};

/// Media type of problem documents.
pub const MEDIA_TYPE: &str = "application/problem+json";

/// Longest text of a problem, characters. The text may quote the request, which can be longer.
const MAX_TEXT: usize = 2000;

/// Most places that a problem names.
const MAX_ERRORS: usize = 20;

/// Why a request was refused or failed.
#[derive(Debug, Clone)]
pub struct Problem(Box<Parts>);

/// Boxed, to keep the `Result` of successful answers small.
#[derive(Debug, Clone)]
struct Parts {
    what: domain::Problem,
    /// For the log only.
    cause: Option<String>,
    header: Option<(HeaderName, HeaderValue)>,
}

/// The document as it goes over the wire.
#[derive(Debug, Serialize)]
pub(super) struct Document<'a> {
    r#type: &'a str,
    title: &'a str,
    status: u16,
    detail: &'a str,
    code: &'a str,
    request_id: &'a str,
    errors: &'a [FieldError],
    /// The detail once more, where clients of the Open Inference Protocol look for it.
    #[serde(skip_serializing_if = "Option::is_none")]
    error: Option<&'a str>,
}

/// A handler's answer: a response, or a problem.
pub type Answer<T = Response> = Result<T, Problem>;

impl Problem {
    /// A problem of a documented kind; `detail` describes the error of this request.
    pub fn new(code: Code, detail: impl Into<String>) -> Self {
        let detail = cut(detail.into());
        domain::Problem::new(code.status, code.name, code.title, detail).into()
    }

    /// A defect of the service: the client learns only the request id; the log has the cause.
    pub fn internal(cause: impl std::fmt::Display) -> Self {
        let mut problem = Self::new(
            codes::INTERNAL,
            "The request failed by a defect of the service; its log has the cause.",
        );
        problem.0.cause = Some(cause.to_string());
        problem
    }

    /// Adds a cause for the log, which a 5xx must not tell the client.
    pub fn because(mut self, cause: impl std::fmt::Display) -> Self {
        self.0.cause = Some(cause.to_string());
        self
    }

    /// Adds a place.
    pub fn with(self, error: FieldError) -> Self {
        self.with_all([error])
    }

    /// Adds places, up to the number that an answer may name.
    pub fn with_all(mut self, errors: impl IntoIterator<Item = FieldError>) -> Self {
        let room = MAX_ERRORS.saturating_sub(self.0.what.errors.len());
        self.0.what.errors.extend(errors.into_iter().take(room).map(|error| FieldError {
            pointer: cut(error.pointer),
            channel: error.channel.map(cut),
            limit: error.limit.map(cut),
            ..error
        }));
        self
    }

    /// Sets `Retry-After`, in seconds.
    pub fn retry_after(self, seconds: u32) -> Self {
        self.with_header(RETRY_AFTER, seconds.into())
    }

    /// Sets the one additional header of the answer.
    pub fn with_header(mut self, name: HeaderName, value: HeaderValue) -> Self {
        self.0.header = Some((name, value));
        self
    }

    /// Its stable code.
    pub fn code(&self) -> &str {
        &self.0.what.code
    }

    /// Its status.
    pub(super) fn status(&self) -> StatusCode {
        StatusCode::from_u16(self.0.what.status).expect("a code's status is a valid one")
    }

    /// The additional header of the answer.
    pub(super) fn header(&self) -> Option<(HeaderName, HeaderValue)> {
        self.0.header.clone()
    }

    /// The cause, for the log only.
    pub(super) fn cause(&self) -> Option<&str> {
        self.0.cause.as_deref()
    }

    /// The document, as the bytes of a body.
    pub(super) fn document(&self, request_id: &str) -> Vec<u8> {
        self.written(request_id, None)
    }

    /// The document under `/v2`, as the bytes of a body.
    pub(super) fn inference_document(&self, request_id: &str) -> Vec<u8> {
        self.written(request_id, Some(&self.0.what.detail))
    }

    /// The problem as a page for people; with the navigation for somebody who is known.
    pub(super) fn page(&self, request_id: &str, visitor: Option<&Visitor>) -> String {
        let refusal = Refusal {
            title: &self.0.what.title,
            status: self.0.what.status,
            detail: &self.0.what.detail,
            code: &self.0.what.code,
            request_id,
        };
        ui::refusal::page(&refusal, visitor)
    }

    fn written(&self, request_id: &str, error: Option<&str>) -> Vec<u8> {
        let document = Document {
            r#type: &self.0.what.kind,
            title: &self.0.what.title,
            status: self.0.what.status,
            detail: &self.0.what.detail,
            code: &self.0.what.code,
            request_id,
            errors: &self.0.what.errors,
            error,
        };
        serde_json::to_vec(&document).expect("a document of strings and integers always serialises")
    }

    /// The problem of an answer that the framework made without one.
    pub(super) fn of_status(status: StatusCode) -> Self {
        let code = match status {
            StatusCode::NOT_FOUND => codes::ROUTE_NOT_FOUND,
            StatusCode::METHOD_NOT_ALLOWED => codes::METHOD_NOT_ALLOWED,
            StatusCode::PAYLOAD_TOO_LARGE => codes::BODY_TOO_LARGE,
            StatusCode::UNSUPPORTED_MEDIA_TYPE => codes::CONTENT_TYPE_UNSUPPORTED,
            s if s.is_client_error() => codes::REQUEST_MALFORMED,
            _ => codes::INTERNAL,
        };
        Self::new(code, format!("The request was answered with status {status}."))
    }
}

/// The first `most` characters of a text.
pub fn shortened(text: &str, most: usize) -> Cow<'_, str> {
    match text.char_indices().nth(most) {
        None => Cow::Borrowed(text),
        Some((end, _)) => Cow::Owned(format!("{}...", &text[..end])),
    }
}

fn cut(text: String) -> String {
    match shortened(&text, MAX_TEXT) {
        Cow::Owned(short) => short,
        Cow::Borrowed(_) => text,
    }
}

impl From<domain::Problem> for Problem {
    fn from(what: domain::Problem) -> Self {
        Self(Box::new(Parts { what, cause: None, header: None }))
    }
}

impl IntoResponse for Problem {
    fn into_response(self) -> Response {
        let mut response = self.status().into_response();
        if let Some((name, value)) = self.header() {
            response.headers_mut().insert(name, value);
        }
        response.extensions_mut().insert(self);
        response
    }
}

/// Answer to a path that no operation has.
pub async fn no_route(uri: axum::http::Uri) -> Problem {
    Problem::new(codes::ROUTE_NOT_FOUND, format!("There is nothing at {}.", uri.path()))
}

/// Answer to a method that a path does not have; the router adds [`ALLOW`].
pub async fn no_method(method: axum::http::Method, uri: axum::http::Uri) -> Problem {
    let detail = format!("{} does not answer to {method}; see the header {ALLOW}.", uri.path());
    Problem::new(codes::METHOD_NOT_ALLOWED, detail)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_document_carries_code_request_id_and_places_and_hides_the_cause() {
        let problem = Problem::new(codes::BODY_INVALID_VALUE, "too long")
            .with(FieldError::new("/name", "at most 200 characters"))
            .because("secret");
        let document: serde_json::Value = serde_json::from_slice(&problem.document("r-1")).expect("JSON");
        assert_eq!(
            document,
            serde_json::json!({
                "type": "about:blank",
                "title": codes::BODY_INVALID_VALUE.title,
                "status": 422, "detail": "too long", "code": "body.invalid_value", "request_id": "r-1",
                "errors": [{"pointer": "/name", "limit": "at most 200 characters"}],
            })
        );
    }

    #[test]
    fn a_problem_is_a_response_of_its_codes_status_with_its_headers() {
        let response = Problem::new(codes::BUSY, "later").retry_after(2).into_response();
        assert_eq!(response.status(), StatusCode::SERVICE_UNAVAILABLE);
        assert_eq!(response.headers()[RETRY_AFTER], "2");
    }
}
