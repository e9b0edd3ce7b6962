//! Answers to requests and connections that never reach a route, as the bytes that are written.

use axum::http::{HeaderMap, StatusCode};

use super::headers::protect;
use super::problem::{self, Problem};
use super::{Shared, codes};
use crate::telemetry::names;

/// The whole answer to a request whose head could not be read; hyper closes the connection after it.
pub fn unreadable_request(http: &Shared, status: StatusCode) -> Vec<u8> {
    let id = http.new_id().to_string();
    let code = code(status);
    tracing::debug!(request.id = id, problem.code = code.name, "a request could not be read");
    let labels = [("route", "unmatched"), ("method", "other"), ("status", status.as_str())];
    let labels = labels.map(|(name, value)| metrics::Label::new(name, value.to_owned()));
    metrics::counter!(names::REQUESTS, labels.to_vec()).increment(1);
    let detail = match code {
        codes::REQUEST_HEAD_TOO_LARGE => "There are more than 100 headers, or they are too long.",
        codes::REQUEST_URI_TOO_LONG => "The path and the query are longer than 65,534 bytes.",
        _ => "The request line and the headers cannot be read as HTTP/1.1.",
    };
    written(&Problem::new(code, detail), &id)
}

/// The whole answer to a connection beyond the limits, which is closed after it.
pub fn too_many_connections(http: &Shared) -> Vec<u8> {
    let detail = "Too many connections are open; try again.";
    written(&Problem::new(codes::BUSY, detail).retry_after(1), &http.new_id().to_string())
}

/// A problem as the bytes of a last answer.
fn written(problem: &Problem, id: &str) -> Vec<u8> {
    let document = problem.document(id);
    let status = problem.status();
    let reason = status.canonical_reason();
    let mut head = format!(
        "HTTP/1.1 {} {}\r\nconnection: close\r\nx-request-id: {id}\r\ncontent-type: {}\r\ncontent-length: {}\r\n",
        status.as_str(),
        reason.unwrap_or_default(),
        problem::MEDIA_TYPE,
        document.len()
    );
    let mut fields: HeaderMap = problem.header().into_iter().collect();
    protect(&mut fields);
    for (name, value) in &fields {
        head.push_str(&format!("{name}: {}\r\n", value.to_str().unwrap_or_default()));
    }
    [head.as_bytes(), b"\r\n", &document].concat()
}

fn code(status: StatusCode) -> codes::Code {
    match status {
        StatusCode::REQUEST_HEADER_FIELDS_TOO_LARGE => codes::REQUEST_HEAD_TOO_LARGE,
        StatusCode::URI_TOO_LONG => codes::REQUEST_URI_TOO_LONG,
        _ => codes::REQUEST_MALFORMED,
    }
}
