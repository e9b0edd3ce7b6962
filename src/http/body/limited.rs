//! Reads request bodies: never more than the limit, without trust in a declared size, and not from
//! clients that send too slowly.

use std::error::Error;
use std::time::Duration;

use axum::body::{Body, BodyDataStream};
use axum::http::header::{CONNECTION, CONTENT_ENCODING, CONTENT_LENGTH, CONTENT_TYPE};
use axum::http::{HeaderMap, HeaderValue};
use bytes::{Bytes, BytesMut};
use futures::StreamExt;
use tokio::time::{Instant, timeout};

use crate::compute::fair_queue::Refused;
use crate::http::codes;
use crate::http::problem::{Answer, FieldError, Problem};
use crate::telemetry::names;

/// The slowest body that is accepted.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Pace {
    /// Least bytes a second.
    pub bytes_per_s: u64,
    /// Time over which bytes are counted; a body may pause for this long.
    pub window: Duration,
}

impl Default for Pace {
    /// 1 KiB a second over 30 s.
    fn default() -> Self {
        Self { bytes_per_s: 1 << 10, window: Duration::from_secs(30) }
    }
}

impl Pace {
    /// Bytes that must come within the window.
    fn least(&self) -> u64 {
        (self.bytes_per_s as f64 * self.window.as_secs_f64()) as u64
    }
}

/// A body's bytes, counted against a limit while they come.
pub struct Limited {
    stream: BodyDataStream,
    limit: u64,
    received: u64,
    pace: Pace,
    /// Waiting time left in this window, and bytes that have come in it.
    patience: Duration,
    in_window: u64,
}

impl Limited {
    /// Starts reading; a declared length beyond the limit is refused before the first byte.
    ///
    /// # Errors
    /// `body.too_large`; `content_encoding.unsupported` for a compressed body.
    pub fn new(headers: &HeaderMap, body: Body, limit: u64, pace: Pace) -> Answer<Self> {
        if let Some(encoding) = headers.get(CONTENT_ENCODING)
            && encoding != "identity"
        {
            let detail = format!("Compressed bodies are not read; Content-Encoding is {encoding:?}.");
            return Err(Problem::new(codes::CONTENT_ENCODING_UNSUPPORTED, detail));
        }
        let declared = headers.get(CONTENT_LENGTH).and_then(|v| v.to_str().ok()?.parse::<u64>().ok());
        if declared.is_some_and(|n| n > limit) {
            return Err(too_large(limit));
        }
        let stream = body.into_data_stream();
        Ok(Self { stream, limit, received: 0, pace, patience: pace.window, in_window: 0 })
    }

    /// The next bytes; none at the end.
    ///
    /// # Errors
    /// `body.too_large`; `body.too_slow`; `body.incomplete` when the connection ends before the declared
    /// length; the refusal of the permit that is waited for at the end.
    pub async fn next(&mut self) -> Answer<Option<Bytes>> {
        match self.wait().await? {
            None => Ok(None),
            Some(Ok(chunk)) => {
                self.received += chunk.len() as u64;
                self.in_window += chunk.len() as u64;
                if self.received > self.limit { Err(too_large(self.limit)) } else { Ok(Some(chunk)) }
            }
            Some(Err(error)) => {
                if let Some(why) = refused(&error) {
                    return Err(why.into());
                }
                let detail = format!("The body ended or broke after {} bytes: {error}.", self.received);
                Err(Problem::new(codes::BODY_INCOMPLETE, detail))
            }
        }
    }

    /// Waits for the next bytes. Only waiting counts as the client's time, not what is done with the
    /// bytes.
    async fn wait(&mut self) -> Answer<Option<Result<Bytes, axum::Error>>> {
        loop {
            let started = Instant::now();
            if let Ok(next) = timeout(self.patience, self.stream.next()).await {
                self.patience = self.patience.saturating_sub(started.elapsed());
                return Ok(next);
            }
            if self.in_window < self.pace.least() {
                return Err(too_slow(self.pace, self.received));
            }
            (self.patience, self.in_window) = (self.pace.window, 0);
        }
    }

    /// All of it.
    ///
    /// # Errors
    /// As [`Limited::next`].
    pub async fn collect(mut self) -> Answer<Bytes> {
        let Some(first) = self.next().await? else { return Ok(Bytes::new()) };
        let second = loop {
            match self.next().await? {
                None => return Ok(first),
                // The end of the wait for a permit.
                Some(chunk) if chunk.is_empty() => {}
                Some(chunk) => break chunk,
            }
        };
        let mut all = BytesMut::from(first);
        all.extend_from_slice(&second);
        while let Some(chunk) = self.next().await? {
            all.extend_from_slice(&chunk);
        }
        Ok(all.freeze())
    }
}

/// The refusal of the permit, if that ended the body.
fn refused(error: &axum::Error) -> Option<Refused> {
    let mut cause: Option<&(dyn Error + 'static)> = Some(error);
    while let Some(found) = cause {
        if let Some(why) = found.downcast_ref::<Refused>() {
            return Some(*why);
        }
        cause = found.source();
    }
    None
}

fn too_slow(pace: Pace, received: u64) -> Problem {
    metrics::counter!(names::CONNECTIONS_ENDED, "slow_in" => "body").increment(1);
    let limit = format!("{} bytes within {} s", pace.least(), pace.window.as_secs_f64());
    let detail =
        format!("The body comes too slowly: {received} bytes so far, at least {limit} are expected.");
    // The rest of the body would be taken for the next request.
    Problem::new(codes::BODY_TOO_SLOW, detail)
        .with(FieldError::new("", limit))
        .with_header(CONNECTION, HeaderValue::from_static("close"))
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
        Limited::new(&headers, Body::from(body), limit, Pace::default())
            .map_err(name)?
            .collect()
            .await
            .map_err(name)
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

    const PACE: Pace = Pace { bytes_per_s: 200, window: Duration::from_millis(100) };

    /// A body that sends ten bytes after each of these times, and then ends or stays open.
    async fn dribble(milliseconds: &'static [u64], ends: bool) -> Result<usize, String> {
        let stream = futures::stream::iter(milliseconds).then(|time| async move {
            tokio::time::sleep(Duration::from_millis(*time)).await;
            Ok::<_, std::io::Error>(Bytes::from_static(b"0123456789"))
        });
        let rest = if ends { futures::stream::empty().boxed() } else { futures::stream::pending().boxed() };
        let body = Limited::new(&HeaderMap::new(), Body::from_stream(stream.chain(rest)), 1000, PACE);
        let name = |p: Problem| p.code().to_owned();
        body.map_err(name)?.collect().await.map(|bytes| bytes.len()).map_err(name)
    }

    #[tokio::test]
    async fn a_slow_body_is_waited_for_as_long_as_it_keeps_its_pace() {
        let slow = Err("body.too_slow".to_owned());
        assert_eq!(dribble(&[25; 12], true).await, Ok(120), "forty bytes in each window");
        assert_eq!(dribble(&[50], true).await, Ok(10), "it ends within the window");
        assert_eq!(dribble(&[], false).await, slow);
        assert_eq!(dribble(&[10], false).await, slow, "ten of twenty bytes");
        assert_eq!(dribble(&[10, 10, 110], false).await, slow, "ten in the second window");
    }

    #[tokio::test]
    async fn the_time_that_we_take_ourselves_makes_no_client_slow() {
        let chunks = [b"01", b"23", b"45"].map(|bytes| Ok::<_, std::io::Error>(Bytes::from_static(bytes)));
        let body = Body::from_stream(futures::stream::iter(chunks));
        let mut body = Limited::new(&HeaderMap::new(), body, 100, PACE).expect("a body");
        let mut chunks = 0;
        while body.next().await.expect("it came in time").is_some() {
            tokio::time::sleep(2 * PACE.window).await;
            chunks += 1;
        }
        assert_eq!(chunks, 3);
    }

    #[test]
    fn the_media_type_is_compared_without_case_and_parameters() {
        let mut headers = HeaderMap::new();
        assert_eq!(media_type(&headers), None);
        headers.insert(CONTENT_TYPE, HeaderValue::from_static("Text/CSV; charset=utf-8"));
        assert_eq!(media_type(&headers).as_deref(), Some("text/csv"));
    }
}
