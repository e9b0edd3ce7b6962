//! Pages, their pictures, scripts and styles go to browsers in gzip: a picture is a third of its size then. Data do not:
//! programs ask for them, and most are on this machine.
//!
//! A page holds the session's CSRF token beside what a request can put into it. Guessing it by the size of the answer
//! (BREACH) needs requests with the session's cookie, which is `SameSite=Strict`: no other site can make a browser send it.

use axum::http::header::CONTENT_TYPE;
use axum::http::{HeaderValue, Response};
use hyper::body::Body;
use tower_http::CompressionLevel;
use tower_http::compression::{CompressionLayer, Predicate};

/// Smaller answers are not worth the time.
const LEAST: u64 = 1024;

/// Media types of what browsers show.
const SHOWN: [&str; 5] =
    ["text/html", "image/svg+xml", "text/css", "text/javascript", "application/javascript"];

/// Which answers are compressed.
#[derive(Debug, Clone, Copy)]
pub struct OfPages;

impl Predicate for OfPages {
    fn should_compress<B: Body>(&self, answer: &Response<B>) -> bool {
        let kind = answer.headers().get(CONTENT_TYPE).and_then(|kind: &HeaderValue| kind.to_str().ok());
        let kind = kind.and_then(|kind| kind.split(';').next()).unwrap_or_default();
        SHOWN.contains(&kind) && answer.body().size_hint().lower() >= LEAST
    }
}

/// The layer.
pub fn layer() -> CompressionLayer<OfPages> {
    CompressionLayer::new().quality(CompressionLevel::Fastest).compress_when(OfPages)
}
