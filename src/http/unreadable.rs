//! Requests whose head cannot be read never reach a route: hyper answers them by itself, with a bare
//! status. On its way out such an answer becomes a problem document like any other.

use std::io::{self, IoSlice};
use std::pin::Pin;
use std::task::{Context, Poll, ready};

use axum::http::{HeaderMap, StatusCode};
use tokio::io::{AsyncRead, AsyncWrite, ReadBuf};

use super::headers::protect;
use super::problem::{self, Problem};
use super::{Shared, codes};
use crate::telemetry::names;

/// Longest head that hyper writes by itself.
const MAX_BARE_HEAD: usize = 256;

/// A connection on which every refusal is a problem document.
pub struct Connection<S> {
    stream: S,
    http: Shared,
    /// What is being written in place of hyper's own answer, and how far.
    refusal: Option<(Vec<u8>, usize)>,
}

impl<S: AsyncRead + AsyncWrite + Unpin> Connection<S> {
    /// Wraps what a client is connected to.
    pub fn new(stream: S, http: Shared) -> Self {
        Self { stream, http, refusal: None }
    }

    /// Writes the refusal that stands for `bare`, and says that `bare` is written when all of it is.
    fn poll_refuse(&mut self, cx: &mut Context<'_>, bare: &[u8]) -> Poll<io::Result<usize>> {
        let Some((bytes, written)) = &mut self.refusal else { return Poll::Ready(Ok(0)) };
        while *written < bytes.len() {
            let n = ready!(Pin::new(&mut self.stream).poll_write(cx, &bytes[*written..]))?;
            if n == 0 {
                return Poll::Ready(Err(io::ErrorKind::WriteZero.into()));
            }
            *written += n;
        }
        self.refusal = None;
        Poll::Ready(Ok(bare.len()))
    }

    /// Whether `bytes` are hyper's own answer, whose place a refusal then takes.
    fn refuses(&mut self, bytes: &[u8]) -> bool {
        if self.refusal.is_none()
            && let Some(status) = bare_status(bytes)
        {
            let id = self.http.new_id().to_string();
            let code = code(status);
            tracing::debug!(request.id = id, problem.code = code.name, "a request could not be read");
            let labels = [("route", "unmatched"), ("method", "other"), ("status", status.as_str())];
            let labels = labels.map(|(name, value)| metrics::Label::new(name, value.to_owned()));
            metrics::counter!(names::REQUESTS, labels.to_vec()).increment(1);
            self.refusal = Some((refusal(status, &id), 0));
        }
        self.refusal.is_some()
    }
}

/// Status of an answer that is nothing but a head, and none of ours: ours have a request id.
fn bare_status(bytes: &[u8]) -> Option<StatusCode> {
    let head = bytes.get(..bytes.len().min(MAX_BARE_HEAD + 1))?;
    if head.len() > MAX_BARE_HEAD || !head.starts_with(b"HTTP/1.1 4") {
        return None;
    }
    let head = std::str::from_utf8(head).ok()?.strip_suffix("\r\n\r\n")?.to_ascii_lowercase();
    let (status, fields) = head.split_once("\r\n")?;
    let ours = fields.contains("x-request-id:");
    let empty = fields.split("\r\n").any(|field| field == "content-length: 0");
    let status = StatusCode::from_bytes(status.as_bytes().get(9..12)?).ok()?;
    (empty && !ours && !fields.contains("\r\n\r\n")).then_some(status)
}

fn code(status: StatusCode) -> codes::Code {
    match status {
        StatusCode::REQUEST_HEADER_FIELDS_TOO_LARGE => codes::REQUEST_HEAD_TOO_LARGE,
        StatusCode::URI_TOO_LONG => codes::REQUEST_URI_TOO_LONG,
        _ => codes::REQUEST_MALFORMED,
    }
}

/// The whole answer; hyper closes the connection after it.
fn refusal(status: StatusCode, id: &str) -> Vec<u8> {
    let code = code(status);
    let detail = match code {
        codes::REQUEST_HEAD_TOO_LARGE => "There are more than 100 headers, or they are too long.",
        codes::REQUEST_URI_TOO_LONG => "The path and the query are longer than 65,534 bytes.",
        _ => "The request line and the headers cannot be read as HTTP/1.1.",
    };
    written(&Problem::new(code, detail), id)
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

impl<S: AsyncRead + Unpin> AsyncRead for Connection<S> {
    fn poll_read(
        mut self: Pin<&mut Self>,
        cx: &mut Context<'_>,
        buffer: &mut ReadBuf<'_>,
    ) -> Poll<io::Result<()>> {
        Pin::new(&mut self.stream).poll_read(cx, buffer)
    }
}

impl<S: AsyncRead + AsyncWrite + Unpin> AsyncWrite for Connection<S> {
    fn poll_write(mut self: Pin<&mut Self>, cx: &mut Context<'_>, bytes: &[u8]) -> Poll<io::Result<usize>> {
        if self.refuses(bytes) {
            return self.poll_refuse(cx, bytes);
        }
        Pin::new(&mut self.stream).poll_write(cx, bytes)
    }

    fn poll_write_vectored(
        mut self: Pin<&mut Self>,
        cx: &mut Context<'_>,
        slices: &[IoSlice<'_>],
    ) -> Poll<io::Result<usize>> {
        // A head without a body comes alone.
        if let [bytes] = slices
            && self.refuses(bytes)
        {
            return self.poll_refuse(cx, bytes);
        }
        Pin::new(&mut self.stream).poll_write_vectored(cx, slices)
    }

    fn is_write_vectored(&self) -> bool {
        self.stream.is_write_vectored()
    }

    fn poll_flush(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.stream).poll_flush(cx)
    }

    fn poll_shutdown(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.stream).poll_shutdown(cx)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_a_bare_head_that_is_none_of_ours_is_replaced() {
        let bare = b"HTTP/1.1 431 Request Header Fields Too Large\r\ncontent-length: 0\r\ndate: now\r\n\r\n";
        assert_eq!(bare_status(bare), Some(StatusCode::REQUEST_HEADER_FIELDS_TOO_LARGE));
        let upper = b"HTTP/1.1 400 Bad Request\r\nContent-Length: 0\r\n\r\n";
        assert_eq!(bare_status(upper), Some(StatusCode::BAD_REQUEST));
        for other in [
            &b"HTTP/1.1 404 Not Found\r\nx-request-id: 1\r\ncontent-length: 0\r\n\r\n"[..],
            b"HTTP/1.1 200 OK\r\ncontent-length: 0\r\n\r\n",
            b"HTTP/1.1 400 Bad Request\r\ncontent-length: 10\r\n\r\n",
            b"HTTP/1.1 400 Bad Request\r\ncontent-length: 0\r\n\r\nmore",
            b"HTTP/1.1 400 Bad Request\r\ncontent-length: 0\r\n",
            b"HTTP/1.1 4",
            b"",
        ] {
            assert_eq!(bare_status(other), None, "{}", String::from_utf8_lossy(other));
        }
    }
}
