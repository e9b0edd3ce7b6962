//! Reads request bodies: never more than the limit, never on the word of a declared size.

use axum::body::{Body, BodyDataStream};
use axum::http::HeaderMap;
use axum::http::header::{CONTENT_ENCODING, CONTENT_LENGTH, CONTENT_TYPE};
use bytes::{Bytes, BytesMut};
use futures::StreamExt;

use super::codes;
use super::problem::{Answer, FieldError, Problem};

/// A body's bytes, counted against a limit while they come.
pub struct Limited {
    stream: BodyDataStream,
    limit: u64,
    received: u64,
}

impl Limited {
    /// Starts reading; a declared length beyond the limit is refused before the first byte.
    ///
    /// # Errors
    /// `body.too_large`; `content_encoding.unsupported` for a compressed body.
    pub fn new(headers: &HeaderMap, body: Body, limit: u64) -> Answer<Self> {
        if let Some(encoding) = headers.get(CONTENT_ENCODING)
            && encoding != "identity"
        {
            let detail = format!("Bodies are taken as they are; Content-Encoding is {encoding:?}.");
            return Err(Problem::new(codes::CONTENT_ENCODING_UNSUPPORTED, detail));
        }
        let declared = headers.get(CONTENT_LENGTH).and_then(|v| v.to_str().ok()?.parse::<u64>().ok());
        if declared.is_some_and(|n| n > limit) {
            return Err(too_large(limit));
        }
        Ok(Self { stream: body.into_data_stream(), limit, received: 0 })
    }

    /// The next bytes; none at the end.
    ///
    /// # Errors
    /// `body.too_large`; `body.incomplete` when the connection ends before the declared length.
    pub async fn next(&mut self) -> Answer<Option<Bytes>> {
        match self.stream.next().await {
            None => Ok(None),
            Some(Ok(chunk)) => {
                self.received += chunk.len() as u64;
                if self.received > self.limit { Err(too_large(self.limit)) } else { Ok(Some(chunk)) }
            }
            Some(Err(error)) => {
                let detail = format!("The body ended or broke after {} bytes: {error}.", self.received);
                Err(Problem::new(codes::BODY_INCOMPLETE, detail))
            }
        }
    }

    /// All of it.
    ///
    /// # Errors
    /// As [`Limited::next`].
    pub async fn collect(mut self) -> Answer<Bytes> {
        let Some(first) = self.next().await? else { return Ok(Bytes::new()) };
        let Some(second) = self.next().await? else { return Ok(first) };
        let mut all = BytesMut::from(first);
        all.extend_from_slice(&second);
        while let Some(chunk) = self.next().await? {
            all.extend_from_slice(&chunk);
        }
        Ok(all.freeze())
    }
}

fn too_large(limit: u64) -> Problem {
    Problem::new(codes::BODY_TOO_LARGE, format!("The body is larger than the limit of {limit} bytes."))
        .with(FieldError::new("", format!("{limit} bytes")))
}

/// The media type of the body, in lower case and without parameters.
pub fn media_type(headers: &HeaderMap) -> Option<String> {
    let value = headers.get(CONTENT_TYPE)?.to_str().ok()?;
    Some(value.split(';').next().unwrap_or_default().trim().to_ascii_lowercase())
}

/// The refusal of a body of another media type.
pub fn unsupported(found: Option<&str>, offered: &[&str]) -> Problem {
    let found = found.map_or_else(|| "is missing".to_owned(), |f| format!("is {f:?}"));
    let offered = offered.join(", ");
    let detail = format!("Content-Type {found}; this operation takes {offered}.");
    Problem::new(codes::CONTENT_TYPE_UNSUPPORTED, detail).with(FieldError::new("", offered))
}

#[cfg(test)]
mod tests {
    use super::*;
    use axum::http::HeaderValue;

    async fn read(body: &'static str, declared: Option<&'static str>, limit: u64) -> Result<Bytes, String> {
        let mut headers = HeaderMap::new();
        if let Some(declared) = declared {
            headers.insert(CONTENT_LENGTH, HeaderValue::from_static(declared));
        }
        let name = |p: Problem| p.code().to_owned();
        Limited::new(&headers, Body::from(body), limit).map_err(name)?.collect().await.map_err(name)
    }

    #[tokio::test]
    async fn a_body_of_exactly_the_limit_is_read_and_one_byte_more_is_not() {
        assert_eq!(read("12345", None, 5).await, Ok(Bytes::from_static(b"12345")));
        assert_eq!(read("123456", None, 5).await, Err("body.too_large".to_owned()));
        assert_eq!(
            read("", Some("6"), 5).await,
            Err("body.too_large".to_owned()),
            "refused on the declared length"
        );
    }

    #[test]
    fn the_media_type_is_compared_without_case_and_parameters() {
        let mut headers = HeaderMap::new();
        assert_eq!(media_type(&headers), None);
        headers.insert(CONTENT_TYPE, HeaderValue::from_static("Text/CSV; charset=utf-8"));
        assert_eq!(media_type(&headers).as_deref(), Some("text/csv"));
    }
}
