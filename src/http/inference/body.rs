//! The body of an inference request: JSON, and behind it the bytes of the tensors that are binary.

use axum::body::Body;
use axum::http::{HeaderMap, HeaderName};
use bytes::Bytes;

use super::request::InferRequest;
use crate::compute::Class;
use crate::http::body::json::{MEDIA_TYPE, PARSE_HERE_BYTES};
use crate::http::body::{Limited, media_type, unsupported};
use crate::http::problem::{Answer, FieldError, Problem};
use crate::http::{Shared, codes, errors};

/// Header with the length of the JSON before the binary data, in requests and answers.
pub static JSON_LENGTH: HeaderName = HeaderName::from_static("inference-header-content-length");

/// Media type of JSON with binary data behind it.
pub const BINARY: &str = "application/octet-stream";

/// A request, and the bytes behind its JSON.
#[derive(Debug)]
pub struct Received {
    /// The document.
    pub request: InferRequest,
    /// All binary data, in the order of the inputs.
    pub binary: Bytes,
}

/// Reads a request: at most the limit of JSON bodies or, where binary data follow, that of NPY drives.
/// Clients of the protocol leave out `Content-Type` or say either media type whatever they send.
///
/// # Errors
/// `content_type.unsupported`, `inference.header_length`, `body.*`
pub async fn receive(headers: &HeaderMap, body: Body, http: &Shared) -> Answer<Received> {
    let found = media_type(headers);
    if found.as_deref().is_some_and(|found| ![MEDIA_TYPE, BINARY].contains(&found)) {
        return Err(unsupported(found.as_deref(), &[MEDIA_TYPE, BINARY]));
    }
    let declared = json_length(headers)?;
    let limit = if declared.is_some() { http.limits.drive_bytes } else { http.limits.json_bytes };
    let mut document = Limited::new(headers, body, limit, http.limits.pace)?.collect().await?;
    let length = declared.unwrap_or(document.len());
    if length > document.len() {
        let detail = format!("{JSON_LENGTH} is {length}, but the body has {} bytes.", document.len());
        let limit = format!("at most the {} bytes of the body", document.len());
        return Err(Problem::new(codes::INFERENCE_HEADER_LENGTH, detail).with(FieldError::new("", limit)));
    }
    let binary = document.split_off(length);
    if document.len() as u64 > http.limits.json_bytes {
        let limit = format!("{} bytes", http.limits.json_bytes);
        let detail = format!("The JSON of the body is larger than the limit of {limit}.");
        return Err(Problem::new(codes::BODY_TOO_LARGE, detail).with(FieldError::new("", limit)));
    }
    let size = document.len();
    let parse = move || {
        let parsed = InferRequest::parse(&document);
        parsed.inspect_err(|problem| errors::count_unreadable("json", problem))
    };
    let request = if size <= PARSE_HERE_BYTES {
        parse()?
    } else {
        http.off_thread(Class::of_bytes(size), parse).await??
    };
    Ok(Received { request, binary })
}

/// The length of the JSON that the client declares, if binary data may follow.
fn json_length(headers: &HeaderMap) -> Answer<Option<usize>> {
    let mut values = headers.get_all(&JSON_LENGTH).iter();
    let Some(value) = values.next() else { return Ok(None) };
    let digits = value.to_str().ok().filter(|text| text.bytes().all(|byte| byte.is_ascii_digit()));
    match digits.and_then(|digits| digits.parse().ok()) {
        Some(length) if values.next().is_none() => Ok(Some(length)),
        _ => {
            let limit = "one number of bytes";
            let detail = format!("{JSON_LENGTH} must be {limit}.");
            Err(Problem::new(codes::INFERENCE_HEADER_LENGTH, detail).with(FieldError::new("", limit)))
        }
    }
}

#[cfg(test)]
mod tests {
    use axum::http::HeaderValue;

    use super::*;

    #[test]
    fn the_length_of_the_json_is_one_number_or_absent() {
        let read = |values: &[&'static str]| {
            let mut headers = HeaderMap::new();
            for value in values {
                headers.append(&JSON_LENGTH, HeaderValue::from_static(value));
            }
            json_length(&headers).map_err(|problem| problem.code().to_owned())
        };
        assert_eq!((read(&[]), read(&["0"]), read(&["120"])), (Ok(None), Ok(Some(0)), Ok(Some(120))));
        for values in
            [&["-1"][..], &["+1"], &["1.5"], &["x"], &[""], &["99999999999999999999999"], &["1", "1"]]
        {
            assert_eq!(read(values), Err("inference.header_length".to_owned()), "{values:?}");
        }
    }
}
