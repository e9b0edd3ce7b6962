//! The JSON of an inference request. Fields that the service does not know are ignored, as the protocol asks.

use std::fmt;
use std::marker::PhantomData;

use memchr::memchr_iter;
use serde::de::{Error, SeqAccess, Visitor};
use serde::{Deserialize, Deserializer};

use super::values::Values;
use crate::http::body::json;
use crate::http::codes;
use crate::http::problem::{Answer, FieldError, Problem};

/// Most numbers of all tensors in JSON: with them, and with the same numbers as channels, a request takes
/// about as much memory as the largest JSON of [`super::super::predict`].
const MAX_VALUES: usize = 15_500_000;

/// Most tensors of a list; no model has as many channels.
const MAX_TENSORS: usize = 256;

/// Most dimensions of a shape.
const MAX_DIMENSIONS: usize = 8;

/// Longest id of a request, characters; the answer repeats it.
const MAX_ID_CHARS: usize = 1000;

/// The document.
#[derive(Debug, Deserialize)]
pub struct InferRequest {
    /// The client's name for the request, which the answer repeats.
    #[serde(default)]
    pub id: Option<String>,
    /// The drive.
    pub inputs: AtMost<InputTensor, MAX_TENSORS>,
    /// The tensors that are wanted; without any, all.
    #[serde(default)]
    outputs: Option<AtMost<WantedTensor, MAX_TENSORS>>,
    #[serde(default)]
    parameters: Option<RequestParameters>,
}

/// One tensor of the drive.
#[derive(Debug, Deserialize)]
pub struct InputTensor {
    /// Name.
    pub name: String,
    /// `FP32` or `FP64`.
    pub datatype: String,
    /// `[samples, channels]`.
    pub shape: AtMost<u64, MAX_DIMENSIONS>,
    /// Its numbers, unless they are binary.
    #[serde(default)]
    pub data: Option<Values>,
    #[serde(default)]
    parameters: Option<InputParameters>,
}

/// A tensor that is wanted.
#[derive(Debug, Deserialize)]
pub struct WantedTensor {
    /// Name.
    pub name: String,
    #[serde(default)]
    parameters: Option<OutputParameters>,
}

#[derive(Debug, Default, Deserialize)]
struct RequestParameters {
    #[serde(default)]
    binary_data_output: Option<bool>,
    #[serde(default)]
    sample_rate_hz: Option<f64>,
}

#[derive(Debug, Deserialize)]
struct InputParameters {
    #[serde(default)]
    binary_data_size: Option<u64>,
}

#[derive(Debug, Deserialize)]
struct OutputParameters {
    #[serde(default)]
    binary_data: Option<bool>,
}

/// A list of at most so many elements: what a client sends beyond takes no memory.
#[derive(Debug)]
pub struct AtMost<T, const N: usize>(pub Vec<T>);

impl<'de, T: Deserialize<'de>, const N: usize> Deserialize<'de> for AtMost<T, N> {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        deserializer.deserialize_seq(AtMostVisitor::<T, N>(PhantomData)).map(Self)
    }
}

struct AtMostVisitor<T, const N: usize>(PhantomData<T>);

impl<'de, T: Deserialize<'de>, const N: usize> Visitor<'de> for AtMostVisitor<T, N> {
    type Value = Vec<T>;

    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("a list")
    }

    fn visit_seq<A: SeqAccess<'de>>(self, mut list: A) -> Result<Vec<T>, A::Error> {
        let mut found = Vec::new();
        while let Some(element) = list.next_element()? {
            if found.len() == N {
                return Err(A::Error::custom(format_args!("more than {N} elements")));
            }
            found.push(element);
        }
        Ok(found)
    }
}

impl InputTensor {
    /// Bytes of its binary data.
    pub fn binary_data_size(&self) -> Option<u64> {
        self.parameters.as_ref()?.binary_data_size
    }
}

impl InferRequest {
    /// Parses the document.
    ///
    /// # Errors
    /// `body.*`
    pub fn parse(bytes: &[u8]) -> Answer<Self> {
        if bytes.len() >= 2 * MAX_VALUES && memchr_iter(b',', bytes).count() >= MAX_VALUES {
            let limit = format!("{MAX_VALUES} values");
            return Err(Problem::new(codes::BODY_TOO_LARGE, format!("The body holds more than {limit}."))
                .with(FieldError::new("", limit)));
        }
        let request: Self = json::parse(bytes)?;
        if request.id.as_ref().is_some_and(|id| id.chars().nth(MAX_ID_CHARS).is_some()) {
            let limit = format!("at most {MAX_ID_CHARS} characters");
            return Err(Problem::new(codes::BODY_INVALID_VALUE, format!("/id must have {limit}."))
                .with(FieldError::new("/id", limit)));
        }
        Ok(request)
    }

    /// Sample rate of the drive, if the client tells it.
    pub fn sample_rate_hz(&self) -> Option<f64> {
        self.parameters.as_ref()?.sample_rate_hz
    }

    /// Names of the tensors that are wanted, and whether each is binary; `None`: all of them.
    pub fn wanted(&self) -> Option<impl Iterator<Item = (&str, bool)>> {
        let wanted = self.outputs.as_ref().filter(|wanted| !wanted.0.is_empty())?;
        Some(wanted.0.iter().map(|tensor| {
            let binary = tensor.parameters.as_ref().and_then(|parameters| parameters.binary_data);
            (tensor.name.as_str(), binary.unwrap_or(self.binary()))
        }))
    }

    /// Whether tensors are binary for which nothing else is said.
    pub fn binary(&self) -> bool {
        self.parameters.as_ref().and_then(|parameters| parameters.binary_data_output).unwrap_or(false)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn wanted(text: &str) -> Option<Vec<(String, bool)>> {
        let request = InferRequest::parse(text.as_bytes()).expect("a request");
        let wanted = request.wanted()?.map(|(name, binary)| (name.to_owned(), binary));
        Some(wanted.collect())
    }

    #[test]
    fn the_form_of_an_output_is_its_own_or_that_of_the_request() {
        let all = r#""parameters": {"binary_data_output": true, "priority": 1}"#;
        let some = r#""outputs": [{"name": "a"}, {"name": "b", "parameters": {"binary_data": false}}]"#;
        let pair = |name: &str, binary| (name.to_owned(), binary);
        assert_eq!(wanted(r#"{"inputs": [], "later": {"a": [1]}}"#), None);
        assert_eq!(wanted(r#"{"inputs": [], "outputs": []}"#), None);
        assert_eq!(
            wanted(&format!(r#"{{"inputs": [], {some}}}"#)),
            Some(vec![pair("a", false), pair("b", false)])
        );
        assert_eq!(
            wanted(&format!(r#"{{"inputs": [], {some}, {all}}}"#)),
            Some(vec![pair("a", true), pair("b", false)])
        );
    }

    #[test]
    fn lists_end_at_the_most_that_makes_sense() {
        let code =
            |text: String| InferRequest::parse(text.as_bytes()).map(|_| ()).map_err(|p| p.code().to_owned());
        let tensors = |n: usize| vec![r#"{"name":"a"}"#; n].join(",");
        let outputs = |n: usize| code(format!(r#"{{"inputs": [], "outputs": [{}]}}"#, tensors(n)));
        assert_eq!(
            (outputs(MAX_TENSORS), outputs(MAX_TENSORS + 1)),
            (Ok(()), Err("body.invalid_value".into()))
        );
        let shape = |n: usize| {
            let shape = vec!["1"; n].join(",");
            code(format!(r#"{{"inputs": [{{"name": "a", "datatype": "FP32", "shape": [{shape}]}}]}}"#))
        };
        assert_eq!(
            (shape(MAX_DIMENSIONS), shape(MAX_DIMENSIONS + 1)),
            (Ok(()), Err("body.invalid_value".into()))
        );
    }

    #[test]
    fn an_id_that_is_too_long_to_be_repeated_is_refused() {
        let parse = |n: usize| {
            InferRequest::parse(format!(r#"{{"inputs": [], "id": "{}"}}"#, "x".repeat(n)).as_bytes())
        };
        assert!(parse(MAX_ID_CHARS).is_ok());
        assert_eq!(parse(MAX_ID_CHARS + 1).expect_err("too long").code(), "body.invalid_value");
    }
}
