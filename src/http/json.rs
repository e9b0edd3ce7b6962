//! JSON bodies, strictly: unknown fields, keys that come twice, NaN, numbers out of range and deep
//! nesting are refused, and a refusal points at the field.

use axum::extract::{FromRequest, Request};
use axum::http::HeaderMap;
use axum::http::header::CONTENT_TYPE;
use axum::response::{IntoResponse, Response};
use serde::Serialize;
use serde::de::DeserializeOwned;
use serde_json::error::Category;
use serde_path_to_error::Path;

use super::Shared;
use super::arrays::{self, HoldsSignals};
use super::body::{self, Limited};
use super::problem::{Answer, FieldError, Problem, shortened};
use super::strict::Strict;
use super::{codes, errors};
use crate::compute::Class;
use crate::domain::problem::pointer;

/// Media type.
pub const MEDIA_TYPE: &str = "application/json";

/// Deepest nesting of arrays and objects.
const MAX_DEPTH: usize = 64;

/// Largest body without signals. What it becomes may take thirty times its size in memory; the largest
/// rig or selection of runs that makes sense has a tenth of this.
const MAX_DOCUMENT_BYTES: u64 = 1 << 20;

/// Longest part of a parser's message that a client gets back: it may quote all that was sent.
const MAX_QUOTED: usize = 300;

/// Larger bodies are parsed off the async threads: a quarter MiB takes about a millisecond.
pub const PARSE_HERE_BYTES: usize = 256 << 10;

/// A request's JSON body.
#[derive(Debug)]
pub struct Json<T>(pub T);

impl<T: DeserializeOwned + Send + 'static> FromRequest<Shared> for Json<T> {
    type Rejection = Problem;

    async fn from_request(request: Request, http: &Shared) -> Result<Self, Problem> {
        let (parts, body) = request.into_parts();
        take(&parts.headers, body, http, &[MEDIA_TYPE]).await.map(Self)
    }
}

/// A request's JSON body that holds signals.
#[derive(Debug)]
pub struct SignalsJson<T>(pub T);

impl<T: HoldsSignals + Send + 'static> FromRequest<Shared> for SignalsJson<T> {
    type Rejection = Problem;

    async fn from_request(request: Request, http: &Shared) -> Result<Self, Problem> {
        let (parts, body) = request.into_parts();
        take_signals(&parts.headers, body, http).await.map(Self)
    }
}

/// Reads a body without signals of one of these media types.
///
/// # Errors
/// `content_type.unsupported`, `body.*`.
pub async fn take<T: DeserializeOwned + Send + 'static>(
    headers: &HeaderMap,
    body: axum::body::Body,
    http: &Shared,
    media_types: &[&str],
) -> Answer<T> {
    let limit = http.limits.json_bytes.min(MAX_DOCUMENT_BYTES);
    read(headers, body, http, media_types, limit, parse).await
}

/// Reads a body that may hold signals.
///
/// # Errors
/// As [`take`].
pub async fn take_signals<T: HoldsSignals + Send + 'static>(
    headers: &HeaderMap,
    body: axum::body::Body,
    http: &Shared,
) -> Answer<T> {
    read(headers, body, http, &[MEDIA_TYPE], http.limits.json_bytes, arrays::parse).await
}

async fn read<T: Send + 'static>(
    headers: &HeaderMap,
    body: axum::body::Body,
    http: &Shared,
    media_types: &[&str],
    limit: u64,
    parse: fn(&[u8]) -> Answer<T>,
) -> Answer<T> {
    let found = body::media_type(headers);
    if !found.as_deref().is_some_and(|f| media_types.contains(&f)) {
        return Err(body::unsupported(found.as_deref(), media_types));
    }
    let bytes = Limited::new(headers, body, limit, http.limits.pace)?.collect().await?;
    let size = bytes.len();
    let parse = move || {
        let parsed = parse(&bytes);
        parsed.inspect_err(|problem| errors::count_unreadable("json", problem))
    };
    if size <= PARSE_HERE_BYTES { parse() } else { http.off_thread(Class::of_bytes(size), parse).await? }
}

/// Parses a document.
///
/// # Errors
/// `body.syntax` (400) for what is no JSON, `body.unknown_field`, `body.missing_field` and
/// `body.invalid_value` (422) for JSON that says something else than was asked for.
pub fn parse<T: DeserializeOwned>(bytes: &[u8]) -> Answer<T> {
    check_depth(bytes)?;
    // All our bodies are objects, those of free JSON too.
    if bytes.trim_ascii_start().first() == Some(&b'[') {
        return Err(Problem::new(codes::BODY_INVALID_VALUE, "The body is an array, it must be an object.")
            .with(FieldError::new("", "an object")));
    }
    let mut deserializer = serde_json::Deserializer::from_slice(bytes);
    let value = serde_path_to_error::deserialize(Strict(&mut deserializer)).map_err(|error| {
        let path = error.path().clone();
        refusal(error.into_inner(), &path)
    })?;
    deserializer.end().map_err(|error| syntax(&error))?;
    Ok(value)
}

/// Maps a parser's error; serde names fields in backquotes, which is all it tells about them.
fn refusal(error: serde_json::Error, path: &Path) -> Problem {
    if error.classify() != Category::Data {
        return syntax(&error);
    }
    let text = error.to_string();
    // Line and column of a field that has a pointer say nothing more.
    let text = shortened(text.split(" at line ").next().unwrap_or(&text), MAX_QUOTED);
    let text = text.as_ref();
    let named = text.split('`').nth(1).unwrap_or_default();
    let pointer = pointer(path);
    let (code, pointer) = if text.starts_with("unknown field") {
        (codes::BODY_UNKNOWN_FIELD, beside(pointer, named))
    } else if text.starts_with("missing field") {
        (codes::BODY_MISSING_FIELD, beside(pointer, named))
    } else if text.starts_with("duplicate field") {
        (codes::BODY_INVALID_VALUE, beside(pointer, named))
    } else {
        (codes::BODY_INVALID_VALUE, pointer)
    };
    let place = if pointer.is_empty() { "The body" } else { &pointer };
    Problem::new(code, format!("{place}: {text}.")).with(FieldError::new(pointer.clone(), text))
}

fn syntax(error: &serde_json::Error) -> Problem {
    let place = FieldError {
        row: Some(error.line() as u64),
        column: Some(error.column() as u64),
        ..FieldError::default()
    };
    Problem::new(codes::BODY_SYNTAX, format!("The body is not JSON: {error}.")).with(place)
}

/// The pointer of a field that is missing or too many, however much of it the path already says.
fn beside(pointer: String, name: &str) -> String {
    let last = format!("/{}", name.replace('~', "~0").replace('/', "~1"));
    if pointer.ends_with(&last) { pointer } else { pointer + &last }
}

/// Refuses nesting beyond the limit before the parser recurses into it.
fn check_depth(bytes: &[u8]) -> Answer<()> {
    let (mut depth, mut in_string, mut escaped) = (0_usize, false, false);
    for &byte in bytes {
        match byte {
            _ if escaped => escaped = false,
            b'\\' if in_string => escaped = true,
            b'"' => in_string = !in_string,
            _ if in_string => {}
            b'[' | b'{' => {
                depth += 1;
                if depth > MAX_DEPTH {
                    let limit = format!("at most {MAX_DEPTH} levels");
                    return Err(Problem::new(
                        codes::BODY_TOO_DEEP,
                        format!("The body is nested deeper than {limit}."),
                    )
                    .with(FieldError::new("", limit)));
                }
            }
            b']' | b'}' => depth = depth.saturating_sub(1),
            _ => {}
        }
    }
    Ok(())
}

/// An object that is put together from parts, some of which are JSON already.
#[derive(Debug)]
pub struct Object(Vec<u8>);

impl Object {
    /// An object without fields.
    pub fn new() -> Self {
        Self(vec![b'{'])
    }

    /// Adds a field.
    ///
    /// # Errors
    /// A value that JSON cannot hold.
    pub fn add(&mut self, name: &'static str, value: &impl Serialize) -> Answer<()> {
        serde_json::to_writer(self.field(name), value).map_err(Problem::internal)
    }

    /// Adds a field whose value, one of JSON, is to be appended.
    pub fn field(&mut self, name: &'static str) -> &mut Vec<u8> {
        if self.0.len() > 1 {
            self.0.push(b',');
        }
        self.0.extend_from_slice(format!("\"{name}\":").as_bytes());
        &mut self.0
    }

    /// The text.
    pub fn finish(mut self) -> Vec<u8> {
        self.0.push(b'}');
        self.0
    }
}

/// A small JSON answer; what holds signals goes through [`super::Http::off_thread`] instead.
pub fn answer(value: &impl Serialize) -> Answer {
    let bytes = serde_json::to_vec(value).map_err(Problem::internal)?;
    Ok(respond(bytes))
}

/// Bytes that are JSON already.
pub fn respond(bytes: Vec<u8>) -> Response {
    ([(CONTENT_TYPE, MEDIA_TYPE)], bytes).into_response()
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde::Deserialize;

    #[derive(Debug, PartialEq, Deserialize)]
    #[serde(deny_unknown_fields)]
    struct Outer {
        list: Vec<Inner>,
    }

    #[derive(Debug, PartialEq, Deserialize)]
    #[serde(deny_unknown_fields)]
    struct Inner {
        x: f64,
    }

    /// Code and first pointer of the refusal.
    fn refused(text: &str) -> (String, String) {
        let problem = parse::<Outer>(text.as_bytes()).expect_err("refused");
        let document: serde_json::Value = serde_json::from_slice(&problem.document("")).expect("JSON");
        (problem.code().to_owned(), document["errors"][0]["pointer"].as_str().unwrap_or("none").to_owned())
    }

    #[test]
    fn a_refusal_points_at_the_field() {
        let case = |text, code: &str, pointer: &str| {
            assert_eq!(refused(text), (code.to_owned(), pointer.to_owned()), "{text}");
        };
        case(r#"{"list": [{"x": 1}, {"x": "a"}]}"#, "body.invalid_value", "/list/1/x");
        case(r#"{"list": [{"x": 1, "y": 2}]}"#, "body.unknown_field", "/list/0/y");
        case(r#"{"list": [], "a/b": 2}"#, "body.unknown_field", "/a~1b");
        case(r#"{"list": [{}]}"#, "body.missing_field", "/list/0/x");
        case("{}", "body.missing_field", "/list");
        case("[1]", "body.invalid_value", "");
        case("3", "body.invalid_value", "");
        case(r#"{"list": [], "list": []}"#, "body.invalid_value", "/list");
        case(r#"{"list": [[1]]}"#, "body.invalid_value", "/list/0");
    }

    #[test]
    fn a_key_that_comes_twice_is_pointed_at_in_free_json_too() {
        let text = r#"{"a": [{"b": 1, "b": 1}]}"#;
        let problem = parse::<serde_json::Value>(text.as_bytes()).expect_err("refused");
        let document: serde_json::Value = serde_json::from_slice(&problem.document("")).expect("JSON");
        assert_eq!(document["code"], "body.invalid_value");
        assert_eq!(document["errors"][0]["pointer"], "/a/0/b");
    }

    #[test]
    fn what_is_no_json_is_a_syntax_error() {
        for text in ["", "{", r#"{"list": [{"x": NaN}]}"#, r#"{"list": [{"x": 1e400}]}"#, r#"{"list": []} x"#]
        {
            assert_eq!(refused(text).0, "body.syntax", "{text}");
        }
        assert_eq!(parse::<Outer>(b"{\"list\": []\xff}").expect_err("bad UTF-8").code(), "body.syntax");
    }

    #[test]
    fn nesting_beyond_the_limit_is_refused_and_brackets_in_strings_are_not_nesting() {
        assert_eq!(refused(&"[".repeat(65)).0, "body.too_deep");
        assert_eq!(refused(&"[".repeat(250_000)).0, "body.too_deep");
        assert_eq!(
            refused(&"[".repeat(64)).0,
            "body.invalid_value",
            "an array is no object, but not too deep"
        );
        let text = format!("\"{}\\\"{}\"", "[".repeat(100), "{".repeat(100));
        assert_eq!(parse::<String>(text.as_bytes()).expect("a string").len(), 201);
    }
}
