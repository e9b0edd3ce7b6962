//! The form of an answer, which `Accept` chooses.

use axum::http::HeaderMap;

use crate::http::negotiate::{self, CSV, MAT, MULTIPART, NPY, RPC3};
use crate::http::problem::{Answer, FieldError, Problem};
use crate::http::{codes, json};

/// Forms of a response as a file.
const FILES: [&str; 4] = [NPY, CSV, RPC3, MAT];

/// The form of an answer.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Form {
    /// JSON, or the media type of the file.
    pub media_type: &'static str,
    /// Whether figures stand before the file.
    pub with_figures: bool,
}

impl Form {
    /// The form that the client prefers; `own` is that of the request, which is chosen without `Accept`.
    ///
    /// # Errors
    /// `accept.not_acceptable`.
    pub fn choose(headers: &HeaderMap, own: &'static str) -> Answer<Self> {
        let mut offers = vec![own];
        offers.extend([json::MEDIA_TYPE].iter().chain(&FILES).filter(|offer| **offer != own));
        offers.push(MULTIPART);
        let media_type = negotiate::choose(headers, &offers)?;
        if media_type != MULTIPART {
            let media_type = negotiate::with_numbers(headers, RPC3, media_type)?;
            return Ok(Self { media_type, with_figures: false });
        }
        let default = if own == json::MEDIA_TYPE { NPY } else { own };
        let asked = negotiate::parameter(headers, MULTIPART, "file");
        let file = match &asked {
            None => Some(default),
            Some(asked) => FILES.into_iter().find(|file| file == asked),
        };
        let media_type = file.ok_or_else(|| {
            let detail = format!("Accept asks for a part of the type {:?}.", asked.unwrap_or_default());
            Problem::new(codes::ACCEPT_NOT_ACCEPTABLE, detail).with(FieldError::new("", FILES.join(", ")))
        })?;
        let media_type = negotiate::with_numbers(headers, MULTIPART, media_type)?;
        Ok(Self { media_type, with_figures: true })
    }

    /// Refuses forms that hold one response only.
    ///
    /// # Errors
    /// `accept.not_acceptable`.
    pub fn check_batch(self) -> Answer<()> {
        if self.media_type == NPY {
            return Ok(());
        }
        let limit = format!("{NPY}, or {MULTIPART} with it");
        let detail = format!("The responses to a batch of drives are given as {limit}.");
        Err(Problem::new(codes::ACCEPT_NOT_ACCEPTABLE, detail).with(FieldError::new("", limit)))
    }
}

#[cfg(test)]
mod tests {
    use axum::http::HeaderValue;
    use axum::http::header::ACCEPT;

    use super::*;
    use crate::http::negotiate::RPC3_FLOATS;

    fn chosen(own: &'static str, accept: &'static str) -> Option<(&'static str, bool)> {
        let mut headers = HeaderMap::new();
        headers.insert(ACCEPT, HeaderValue::from_static(accept));
        let form = Form::choose(&headers, own).ok()?;
        Some((form.media_type, form.with_figures))
    }

    #[test]
    fn the_form_is_the_requests_unless_accept_says_otherwise() {
        assert_eq!(chosen(NPY, "*/*"), Some((NPY, false)));
        assert_eq!(chosen(NPY, "application/json"), Some((json::MEDIA_TYPE, false)));
        assert_eq!(chosen(NPY, "multipart/mixed"), Some((NPY, true)));
        assert_eq!(chosen(json::MEDIA_TYPE, "multipart/mixed"), Some((NPY, true)));
        assert_eq!(chosen(CSV, "multipart/mixed; file=\"application/x-rpc3\""), Some((RPC3, true)));
        assert_eq!(chosen(CSV, "multipart/mixed; file=text/html"), None);
        assert_eq!(chosen(CSV, "application/x-rpc3; numbers=floats"), Some((RPC3_FLOATS, false)));
        assert_eq!(
            chosen(CSV, "multipart/mixed; file=application/x-rpc3; numbers=floats"),
            Some((RPC3_FLOATS, true))
        );
        assert_eq!(chosen(CSV, "application/x-rpc3; numbers=integers"), Some((RPC3, false)));
        assert_eq!(chosen(CSV, "application/x-rpc3; numbers=text"), None);
        assert_eq!(chosen(CSV, "text/html"), None);
    }
}
