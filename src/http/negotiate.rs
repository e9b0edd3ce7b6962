//! Content negotiation: the offered representation that the client prefers (RFC 9110, section 12.5.1).

use axum::http::HeaderMap;
use axum::http::header::ACCEPT;

use super::codes;
use super::problem::{Answer, FieldError, Problem};

/// Media type of tables of text.
pub const CSV: &str = "text/csv";

/// Media type of pages for people.
pub const HTML: &str = "text/html";

/// Media type of NumPy arrays.
pub const NPY: &str = "application/x-npy";

/// Media type of archives of NumPy arrays.
pub const NPZ: &str = "application/x-npz";

/// Media type of MATLAB's files of any version.
pub const MAT: &str = "application/x-matlab-data";

/// Media type of HDF5.
pub const HDF5: &str = "application/x-hdf5";

/// Media type of RPC III time histories.
pub const RPC3: &str = "application/x-rpc3";

/// [`RPC3`] with single floats in place of 16-bit integers.
pub const RPC3_FLOATS: &str = "application/x-rpc3; numbers=floats";

/// Media type of Universal File Format, data sets 58.
pub const UFF58: &str = "application/x-uff58";

/// Media type of answers in parts: figures as JSON, then a file.
pub const MULTIPART: &str = "multipart/mixed";

/// The offer with the highest quality in `Accept`; without `Accept`, and among equals, the first.
///
/// # Errors
/// `accept.not_acceptable` if `Accept` allows none of them.
pub fn choose(headers: &HeaderMap, offers: &[&'static str]) -> Answer<&'static str> {
    let accept: Vec<&str> = headers.get_all(ACCEPT).iter().filter_map(|v| v.to_str().ok()).collect();
    if accept.iter().all(|v| v.trim().is_empty()) {
        return Ok(offers[0]);
    }
    let ranges: Vec<Range> = accept.iter().flat_map(|v| v.split(',')).filter_map(Range::parse).collect();
    let mut best: Option<(&'static str, f32)> = None;
    for offer in offers {
        let quality = quality(&ranges, offer);
        if quality > 0.0 && best.is_none_or(|(_, q)| quality > q) {
            best = Some((offer, quality));
        }
    }
    best.map(|(offer, _)| offer).ok_or_else(|| {
        let offered = offers.join(", ");
        let detail = format!("Accept allows none of the representations on offer: {offered}.");
        Problem::new(codes::ACCEPT_NOT_ACCEPTABLE, detail).with(FieldError::new("", offered))
    })
}

/// A parameter of the range of `Accept` that names a media type whole, as `file` of `multipart/mixed; file="text/csv"`.
pub fn parameter(headers: &HeaderMap, media_type: &str, name: &str) -> Option<String> {
    let accept = headers.get_all(ACCEPT).iter().filter_map(|v| v.to_str().ok());
    let mut ranges = accept.flat_map(|v| v.split(','));
    let parameters = ranges.find_map(|range| {
        let (of, parameters) = range.split_once(';')?;
        of.trim().eq_ignore_ascii_case(media_type).then_some(parameters)
    })?;
    parameters.split(';').find_map(|parameter| {
        let (key, value) = parameter.split_once('=')?;
        let value = value.trim().trim_matches('"');
        key.trim().eq_ignore_ascii_case(name).then(|| value.to_ascii_lowercase())
    })
}

/// The chosen file with the numbers that the range of `Accept` with this media type asks for: RPC III has 16-bit
/// integers, or floats.
///
/// # Errors
/// `accept.not_acceptable` for other numbers.
pub fn with_numbers(headers: &HeaderMap, range: &str, file: &'static str) -> Answer<&'static str> {
    if file != RPC3 {
        return Ok(file);
    }
    match parameter(headers, range, "numbers").as_deref() {
        None | Some("integers") => Ok(RPC3),
        Some("floats") => Ok(RPC3_FLOATS),
        Some(other) => {
            let detail = format!("Accept asks for an RPC III file with the numbers {other:?}.");
            let limit = "numbers=integers or numbers=floats";
            Err(Problem::new(codes::ACCEPT_NOT_ACCEPTABLE, detail).with(FieldError::new("", limit)))
        }
    }
}

/// One element of an `Accept` header.
struct Range {
    kind: String,
    subtype: String,
    quality: f32,
}

impl Range {
    fn parse(element: &str) -> Option<Self> {
        let mut parts = element.split(';').map(str::trim);
        let (kind, subtype) = parts.next()?.split_once('/')?;
        let quality = parts.find_map(|p| p.strip_prefix("q=")).map_or(Some(1.0), |q| q.parse().ok())?;
        Some(Self { kind: kind.to_ascii_lowercase(), subtype: subtype.to_ascii_lowercase(), quality })
    }

    /// Specificity of the range: 2 for a whole media type, 1 for `type/*`, 0 for `*/*`.
    fn specificity(&self, offer: &str) -> Option<u8> {
        let (kind, subtype) = offer.split_once('/')?;
        match (self.kind.as_str(), self.subtype.as_str()) {
            ("*", "*") => Some(0),
            (k, "*") if k == kind => Some(1),
            (k, s) if k == kind && s == subtype => Some(2),
            _ => None,
        }
    }
}

/// Quality of an offer by the most specific range that covers it; 0 if none does.
fn quality(ranges: &[Range], offer: &str) -> f32 {
    ranges
        .iter()
        .filter_map(|r| r.specificity(offer).map(|s| (s, r.quality)))
        .max_by_key(|&(s, _)| s)
        .map_or(0.0, |(_, q)| q)
}

/// The problem of samples that a MAT file of version 5 cannot hold.
pub fn too_large_for_mat() -> Problem {
    let limit = "less than 2 GiB of samples";
    let detail = "The samples are 2 GiB or more, which a MAT file of version 5 cannot hold. Ask for less \
                  of them, or for another format.";
    Problem::new(codes::ACCEPT_NOT_ACCEPTABLE, detail).with(FieldError::new("", limit))
}

#[cfg(test)]
mod tests {
    use super::*;
    use axum::http::HeaderValue;

    const OFFERS: [&str; 3] = ["application/json", "text/csv", "application/x-npy"];

    fn chosen(accept: &'static str) -> Option<&'static str> {
        let mut headers = HeaderMap::new();
        headers.insert(ACCEPT, HeaderValue::from_static(accept));
        choose(&headers, &OFFERS).ok()
    }

    #[test]
    fn the_best_liked_offer_wins_and_the_first_among_equals() {
        assert_eq!(chosen("*/*"), Some("application/json"));
        assert_eq!(chosen("text/*;q=0.5, application/x-npy"), Some("application/x-npy"));
        assert_eq!(chosen("text/csv, application/json"), Some("application/json"));
        assert_eq!(chosen("Text/CSV; charset=utf-8; q=0.3, */*;q=0.1"), Some("text/csv"));
        assert_eq!(chosen("*/*, application/json;q=0"), Some("text/csv"));
        assert_eq!(choose(&HeaderMap::new(), &OFFERS).ok(), Some("application/json"));
    }

    #[test]
    fn a_parameter_belongs_to_its_media_type() {
        let file = |accept: &'static str| {
            let mut headers = HeaderMap::new();
            headers.insert(ACCEPT, HeaderValue::from_static(accept));
            parameter(&headers, MULTIPART, "file")
        };
        assert_eq!(file("multipart/mixed; file=\"text/CSV\"").as_deref(), Some("text/csv"));
        assert_eq!(
            file("text/html;file=x, Multipart/Mixed;q=0.5; File = text/csv").as_deref(),
            Some("text/csv")
        );
        assert_eq!(file("multipart/mixed, text/csv; file=text/html"), None);
        assert_eq!(file("multipart/mixed; profile=text/csv"), None);
    }

    #[test]
    fn an_accept_that_takes_nothing_on_offer_is_refused() {
        assert_eq!(chosen("text/html"), None);
        assert_eq!(chosen("application/json;q=0"), None);
        assert_eq!(chosen("nonsense"), None);
    }
}
