//! Requests whose head cannot be read never reach a route: hyper answers them itself, with a bare
//! status. This stream replaces such an answer by a problem document like any other.

use std::io::{self, IoSlice};
use std::pin::Pin;
use std::task::{Context, Poll, ready};

use axum::http::StatusCode;
use tokio::io::{AsyncRead, AsyncWrite, ReadBuf};

use crate::http::{Shared, unreadable_request};

/// Longest head that hyper writes by itself.
const MAX_BARE_HEAD: usize = 256;

/// A stream on which every refusal is a problem document.
pub(in crate::app) struct ProblemStream<S> {
    stream: S,
    http: Shared,
    /// The document written in place of hyper's own answer, and the number of bytes written so far.
    refusal: Option<(Vec<u8>, usize)>,
}

impl<S: AsyncRead + AsyncWrite + Unpin> ProblemStream<S> {
    /// Wraps the stream of a client.
    pub(in crate::app) fn new(stream: S, http: Shared) -> Self {
        Self { stream, http, refusal: None }
    }

    /// Writes the refusal that replaces `bare`, and reports `bare` as written once all of it is.
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

    /// Whether `bytes` are hyper's own answer, which a refusal then replaces.
    fn refuses(&mut self, bytes: &[u8]) -> bool {
        if self.refusal.is_none()
            && let Some(status) = bare_status(bytes)
        {
            self.refusal = Some((unreadable_request(&self.http, status), 0));
        }
        self.refusal.is_some()
    }
}

/// Status of an answer that is only a head and not from this service: ours have a request id.
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

impl<S: AsyncRead + Unpin> AsyncRead for ProblemStream<S> {
    fn poll_read(
        mut self: Pin<&mut Self>,
        cx: &mut Context<'_>,
        buffer: &mut ReadBuf<'_>,
    ) -> Poll<io::Result<()>> {
        Pin::new(&mut self.stream).poll_read(cx, buffer)
    }
}

impl<S: AsyncRead + AsyncWrite + Unpin> AsyncWrite for ProblemStream<S> {
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
