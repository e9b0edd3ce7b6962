//! Strict JSON bodies: unknown fields, duplicate keys, NaN, numbers out of range and deep nesting are
//! refused, and the refusal points at the field. A single value is accepted in place of a list of one.

use std::borrow::Cow;

use axum::extract::{FromRequest, Request};
use axum::http::HeaderMap;
use axum::http::header::CONTENT_TYPE;
use axum::response::{IntoResponse, Response};
use serde::Serialize;
use serde::de::DeserializeOwned;
use serde_json::error::Category;
use serde_path_to_error::{Path, Track};

use super::arrays::{self, HoldsSignals};
use super::{Limited, media_type, unsupported};
use crate::compute::Class;
use crate::domain::problem::pointer;
use crate::domain::strict::Strict;
use crate::engine::wording::plain;
use crate::http::Shared;
use crate::http::problem::{Answer, FieldError, Problem, shortened};
use crate::http::{codes, errors};

/// Media type.
pub const MEDIA_TYPE: &str = "application/json";

/// Deepest nesting of arrays and objects.
const MAX_DEPTH: usize = 64;

/// Largest body without signals. Parsed, it may take thirty times its size in memory. The largest
/// sensible rig or selection of runs has a tenth of this size.
const MAX_DOCUMENT_BYTES: u64 = 1 << 20;

/// Longest part of a parser's message that a client gets; the message may quote the whole body.
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
    let found = media_type(headers);
    if !found.as_deref().is_some_and(|f| media_types.contains(&f)) {
        return Err(unsupported(found.as_deref(), media_types));
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
/// `body.syntax` (400) for text that is no JSON; `body.unknown_field`, `body.missing_field` and
/// `body.invalid_value` (422) for JSON of another form.
pub fn parse<T: DeserializeOwned>(bytes: &[u8]) -> Answer<T> {
    check_depth(bytes)?;
    // Every body of the contract is an object.
    if bytes.trim_ascii_start().first() == Some(&b'[') {
        return Err(Problem::new(codes::BODY_INVALID_VALUE, "The body is an array, it must be an object.")
            .with(FieldError::new("", "an object")));
    }
    let mut deserializer = serde_json::Deserializer::from_slice(bytes);
    // Outside of the tracker: a list of one that was written as its element is no level of the path.
    let mut track = Track::new();
    let tracked = serde_path_to_error::Deserializer::new(&mut deserializer, &mut track);
    let value = T::deserialize(Strict(tracked)).map_err(|error| refusal(&error, &track.path()))?;
    deserializer.end().map_err(|error| syntax(&error))?;
    Ok(value)
}

/// Maps a parser's error. Serde names fields only in the message, in backquotes.
fn refusal(error: &serde_json::Error, path: &Path) -> Problem {
    if error.classify() != Category::Data {
        return syntax(error);
    }
    let text = error.to_string();
    // The pointer makes line and column needless.
    let text = &*without_middle(text.split(" at line ").next().unwrap_or(&text));
    let words = plain(text);
    let words = shortened(&words, MAX_QUOTED);
    let pointer = pointer(path, text);
    let code = if text.starts_with("unknown field") {
        codes::BODY_UNKNOWN_FIELD
    } else if text.starts_with("missing field") {
        codes::BODY_MISSING_FIELD
    } else {
        codes::BODY_INVALID_VALUE
    };
    let place = if pointer.is_empty() { "The body" } else { &pointer };
    Problem::new(code, format!("{place}: {words}.")).with(FieldError::new(pointer.clone(), words.as_ref()))
}

/// A message without the middle of the text that it quotes, which may be the whole body: each copy of it takes its
/// memory.
fn without_middle(text: &str) -> Cow<'_, str> {
    const KEPT: usize = 4 * MAX_QUOTED;
    if text.len() <= 2 * KEPT {
        return Cow::Borrowed(text);
    }
    let (head, tail) = (text.floor_char_boundary(KEPT), text.ceil_char_boundary(text.len() - KEPT));
    Cow::Owned(format!("{}...{}", &text[..head], &text[tail..]))
}

fn syntax(error: &serde_json::Error) -> Problem {
    let place = FieldError {
        row: Some(error.line() as u64),
        column: Some(error.column() as u64),
        ..FieldError::default()
    };
    Problem::new(codes::BODY_SYNTAX, format!("The body is not JSON: {error}.")).with(place)
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

/// A JSON object built from parts, some of which are JSON text already.
#[derive(Debug)]
pub struct Object {
    text: Vec<u8>,
    /// Whether there is a field already.
    begun: bool,
}

impl Object {
    /// An object without fields.
    pub fn new() -> Self {
        Self { text: vec![b'{'], begun: false }
    }

    /// Adds a field.
    ///
    /// # Errors
    /// A value that JSON cannot hold.
    pub fn add(&mut self, name: &'static str, value: &impl Serialize) -> Answer<()> {
        serde_json::to_writer(self.field(name), value).map_err(Problem::internal)
    }

    /// Adds a field; the caller appends its value as JSON text, or takes the text so far and writes the value
    /// behind it.
    pub fn field(&mut self, name: &'static str) -> &mut Vec<u8> {
        if std::mem::replace(&mut self.begun, true) {
            self.text.push(b',');
        }
        self.text.extend_from_slice(format!("\"{name}\":").as_bytes());
        &mut self.text
    }

    /// Adds the fields of another object behind those of this one.
    pub fn append(&mut self, other: Self) {
        if !other.begun {
            return;
        }
        if std::mem::replace(&mut self.begun, true) {
            self.text.push(b',');
        }
        // Without its opening brace.
        self.text.extend_from_slice(&other.text[1..]);
    }

    /// The text, or what of it was not taken.
    pub fn finish(mut self) -> Vec<u8> {
        self.text.push(b'}');
        self.text
    }
}

/// A small JSON answer. Answers with signals are made by [`super::Http::off_thread`].
pub fn answer(value: &impl Serialize) -> Answer {
    let bytes = serde_json::to_vec(value).map_err(Problem::internal)?;
    Ok(respond(bytes))
}

/// An answer whose bytes are JSON already.
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
        // A list of one may be written as its element, and what is wrong with it is where it was written.
        assert_eq!(
            parse::<Outer>(br#"{"list": {"x": 1}}"#).expect("a list"),
            Outer { list: vec![Inner { x: 1.0 }] }
        );
        case(r#"{"list": {"x": "a"}}"#, "body.invalid_value", "/list/x");
        case(r#"{"list": {"y": 1}}"#, "body.unknown_field", "/list/y");
        case(r#"{"list": 5}"#, "body.invalid_value", "/list");
        case(r#"{"list": null}"#, "body.invalid_value", "/list");
    }

    #[test]
    fn a_refusal_names_no_types_of_ours() {
        let detail = |text: &str| {
            let problem = parse::<Outer>(text.as_bytes()).expect_err("refused");
            let document: serde_json::Value = serde_json::from_slice(&problem.document("")).expect("JSON");
            document["detail"].as_str().expect("a detail").to_owned()
        };
        assert_eq!(detail("3"), "The body: expected an object, found the number 3.");
        assert_eq!(detail(r#"{"list": [5]}"#), "/list/0: expected an object, found the number 5.");
        assert_eq!(
            detail(r#"{"list": [{"x": "a"}]}"#),
            r#"/list/0/x: expected a number, found the string "a"."#
        );
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
    fn an_object_whose_text_is_taken_on_the_way_is_the_same_text() {
        let mut object = Object::new();
        object.add("a", &1).expect("JSON");
        let mut text = std::mem::take(object.field("b"));
        text.extend_from_slice(b"[2]");
        object.add("c", &3).expect("JSON");
        text.extend(object.finish());
        assert_eq!(text, br#"{"a":1,"b":[2],"c":3}"#);
        assert_eq!(Object::new().finish(), b"{}");
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
