//! Problem documents (RFC 9457), in answers and in the rows of failed jobs.

use serde::{Deserialize, Serialize};

/// One error in a request, with the place and the limit that a client needs to correct it.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct FieldError {
    /// JSON pointer (RFC 6901) to the field, `""` for the whole body.
    pub pointer: String,
    /// Channel name.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub channel: Option<String>,
    /// Sample index, from 0.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub sample: Option<u64>,
    /// Row of a file, from 1.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub row: Option<u64>,
    /// Column of a file, from 1.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub column: Option<u64>,
    /// What is allowed, in words.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub limit: Option<String>,
}

impl FieldError {
    /// A field that leaves its limit.
    pub fn new(pointer: impl Into<String>, limit: impl Into<String>) -> Self {
        Self { pointer: pointer.into(), limit: Some(limit.into()), ..Self::default() }
    }

    /// The same, about one channel.
    #[must_use]
    pub fn on_channel(mut self, channel: impl Into<String>) -> Self {
        self.channel = Some(channel.into());
        self
    }
}

/// A problem document without its request id, which only an answer has.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Problem {
    /// `about:blank`: the code says it all.
    #[serde(rename = "type")]
    pub kind: String,
    /// Title, the same for every problem of this code.
    pub title: String,
    /// HTTP status that it has, or would have, as an answer.
    pub status: u16,
    /// Description of this case.
    pub detail: String,
    /// Stable code for programs.
    pub code: String,
    /// The errors in detail.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub errors: Vec<FieldError>,
}

impl Problem {
    /// A problem without named fields.
    pub fn new(status: u16, code: &str, title: &str, detail: impl Into<String>) -> Self {
        Self {
            kind: "about:blank".into(),
            title: title.into(),
            status,
            detail: detail.into(),
            code: code.into(),
            errors: Vec::new(),
        }
    }

    /// The same with named fields.
    #[must_use]
    pub fn with(mut self, errors: Vec<FieldError>) -> Self {
        self.errors = errors;
        self
    }
}

/// The JSON pointer of the place that serde's message is about: where deserialisation stopped, and the
/// field there that is missing, unknown or a duplicate, which only the message names.
pub fn pointer(path: &serde_path_to_error::Path, message: &str) -> String {
    let pointer = pointer_of_path(path);
    let about_field = ["unknown field", "missing field", "duplicate field"];
    match message.split('`').nth(1) {
        Some(name) if about_field.iter().any(|prefix| message.starts_with(prefix)) => {
            let last = format!("/{}", name.replace('~', "~0").replace('/', "~1"));
            // However much of it the path already says.
            if pointer.ends_with(&last) { pointer } else { pointer + &last }
        }
        _ => pointer,
    }
}

fn pointer_of_path(path: &serde_path_to_error::Path) -> String {
    use serde_path_to_error::Segment;
    let mut pointer = String::new();
    for segment in path {
        match segment {
            Segment::Seq { index } => pointer += &format!("/{index}"),
            Segment::Map { key } => pointer += &format!("/{}", key.replace('~', "~0").replace('/', "~1")),
            // Variants are no level of the document; an unknown segment has no name.
            Segment::Enum { .. } | Segment::Unknown => {}
        }
    }
    pointer
}
