//! The answer to an inference: JSON, and behind it the bytes of the tensors that are binary. Both are written
//! piece by piece, as the client reads them.

use std::io;

use serde_json::{Map, Value, json};

use super::layout::{Layout, Tensor};
use crate::domain::RigId;
use crate::engine::Signal;
use crate::engine::model::Trust;
use crate::formats::npy;
use crate::http::body::pieces::Written;
use crate::http::errors;
use crate::http::predict::memory::Share;
use crate::http::problem::{Answer, Problem};
use crate::models::LoadedModel;

/// Bytes of binary data that go out at once.
const PIECE_BYTES: usize = 256 << 10;

/// Bytes of numbers that become one piece of text, some 200 KiB.
const TEXT_PIECE_BYTES: usize = 64 << 10;

/// Longest text of a number of 32 bits, with the comma before it: `-1.17549435e-38`.
const NUMBER_BYTES: usize = 17;

/// Most spans outside the training that an answer names.
const MAX_SPANS: usize = 8;

/// What an answer repeats of its request.
#[derive(Debug)]
pub struct Answering {
    /// The rig, which is the model's name.
    pub rig: RigId,
    /// The client's name for the request.
    pub id: Option<String>,
    /// The tensors of the model.
    pub layout: Layout,
    /// Places of the wanted tensors among the outputs, and whether each is binary.
    pub wanted: Vec<(usize, bool)>,
}

/// An answer, but for its headers.
#[derive(Debug)]
pub struct Tensors {
    /// The body.
    pub written: Written,
    /// Length of the JSON, if binary data follow it.
    pub json_length: Option<usize>,
    /// Size of the body, where binary data follow.
    pub size: Option<usize>,
}

/// The wanted tensors while they are predicted, each as FP32 in row-major order, little-endian.
#[derive(Debug)]
pub struct Rows {
    tensors: Vec<(Tensor, Vec<u8>)>,
    written: usize,
}

impl Rows {
    /// Adds the next samples of all outputs, whose names are `outputs`.
    ///
    /// # Errors
    /// `run.non_finite` where a number does not fit into 32 bits.
    pub fn write(&mut self, piece: Signal, outputs: &[String]) -> Answer<()> {
        let samples = piece.n_samples();
        let mut channels = piece.into_channels();
        for (tensor, bytes) in &mut self.tensors {
            let columns: Vec<Vec<f64>> =
                tensor.channels.iter().map(|&place| std::mem::take(&mut channels[place])).collect();
            npy::put_f4(bytes, &columns, self.written).map_err(|error| {
                let names: Vec<String> =
                    tensor.channels.iter().map(|&place| outputs[place].clone()).collect();
                errors::format(&error, &names)
            })?;
        }
        self.written += samples;
        Ok(())
    }

    /// Bytes of all tensors.
    pub fn size(&self) -> usize {
        self.tensors.iter().map(|(_, bytes)| bytes.len()).sum()
    }
}

impl Answering {
    /// The wanted tensors, of so many samples, still empty.
    pub fn rows(&self, samples: usize) -> Rows {
        let tensors = self.wanted.iter().map(|&(place, _)| {
            let tensor = self.layout.outputs[place].clone();
            let bytes = Vec::with_capacity(samples * tensor.channels.len() * size_of::<f32>());
            (tensor, bytes)
        });
        Rows { tensors: tensors.collect(), written: 0 }
    }

    /// Writes the beginning of the answer, or all of a short one. The share of the memory is given back when
    /// the last piece has gone out.
    ///
    /// # Errors
    /// None that a client could cause.
    pub fn finish(self, loaded: &LoadedModel, trust: Trust, rows: Rows, memory: Share) -> Answer<Tensors> {
        let mut text = json!({
            "model_name": self.rig, "model_version": loaded.version.to_string(), "parameters": about(loaded, trust),
        });
        if let Some(id) = self.id {
            text["id"] = id.into();
        }
        let mut text = text.to_string();
        text.truncate(text.len() - 1);
        text.push_str(",\"outputs\":[");
        let samples = rows.written;
        let (mut parts, mut binary) = (Vec::new(), Vec::new());
        for (at, ((tensor, bytes), (_, is_binary))) in rows.tensors.into_iter().zip(self.wanted).enumerate() {
            let mut head = json!({
                "name": tensor.name, "datatype": "FP32", "shape": [samples, tensor.channels.len()],
            });
            if is_binary {
                head["parameters"] = json!({"binary_data_size": bytes.len()});
            }
            let head = head.to_string();
            text.push_str(if at > 0 { "," } else { "" });
            if is_binary {
                text.push_str(&head);
                binary.push(Part::Binary(bytes));
            } else {
                text.push_str(&head[..head.len() - 1]);
                text.push_str(",\"data\":[");
                parts.push(Part::Text(std::mem::take(&mut text)));
                parts.push(Part::Numbers(bytes));
                text.push_str("]}");
            }
        }
        text.push_str("]}");
        parts.push(Part::Text(text));
        let (json_length, size) = if binary.is_empty() {
            (None, None)
        } else {
            let length: usize = parts.iter().map(Part::length).sum();
            let behind: usize = binary.iter().map(Part::length).sum();
            (Some(length), Some(length + behind))
        };
        let pieces = parts.into_iter().chain(binary).flat_map(Part::into_pieces).map(move |piece| {
            let _held = &memory;
            io::Result::Ok(piece)
        });
        let written = Written::begin(Box::new(pieces)).map_err(Problem::internal)?;
        Ok(Tensors { written, json_length, size })
    }
}

/// The parameters of the answer. The protocol allows texts, numbers and booleans.
fn about(loaded: &LoadedModel, trust: Trust) -> Map<String, Value> {
    let model = loaded.model();
    let mut found = Map::new();
    found.insert("model_sha256".into(), loaded.sha256.clone().into());
    found.insert("sample_rate_hz".into(), model.sample_rate_hz.into());
    if !model.range.is_empty() {
        found.insert("trust_inside".into(), trust.inside.into());
    }
    if !trust.spans.is_empty() {
        let named = trust.spans.iter().take(MAX_SPANS);
        let mut spans: Vec<String> = named
            .map(|span| {
                format!("{} from {} s to {} s: {}", span.channel, span.from_s, span.to_s, span.reason)
            })
            .collect();
        let more = trust.spans.len().saturating_sub(MAX_SPANS);
        if more > 0 {
            spans.push(format!("{more} more"));
        }
        found.insert("trust_outside".into(), spans.join("; ").into());
    }
    found
}

/// A part of the body.
enum Part {
    Text(String),
    /// FP32 that goes out as text, commas between the numbers.
    Numbers(Vec<u8>),
    Binary(Vec<u8>),
}

impl Part {
    /// Bytes that go out. Numbers are written once to count them: their text takes four times their memory.
    fn length(&self) -> usize {
        match self {
            Self::Text(text) => text.len(),
            Self::Numbers(bytes) => {
                ranges(bytes.len(), TEXT_PIECE_BYTES).map(|range| text_of(bytes, range).len()).sum()
            }
            Self::Binary(bytes) => bytes.len(),
        }
    }

    fn into_pieces(self) -> Box<dyn Iterator<Item = Vec<u8>> + Send> {
        match self {
            Self::Text(text) => Box::new(std::iter::once(text.into_bytes())),
            Self::Numbers(bytes) => {
                Box::new(ranges(bytes.len(), TEXT_PIECE_BYTES).map(move |range| text_of(&bytes, range)))
            }
            Self::Binary(bytes) => {
                Box::new(ranges(bytes.len(), PIECE_BYTES).map(move |range| bytes[range].to_vec()))
            }
        }
    }
}

fn ranges(length: usize, step: usize) -> impl Iterator<Item = std::ops::Range<usize>> {
    (0..length).step_by(step).map(move |from| from..length.min(from + step))
}

/// Numbers in the shortest form that reads back as the same 32-bit one, a comma before each but the first of
/// the tensor.
fn text_of(bytes: &[u8], range: std::ops::Range<usize>) -> Vec<u8> {
    let first = range.start == 0;
    let numbers = bytes[range].as_chunks::<4>().0;
    let mut text = Vec::with_capacity(numbers.len() * NUMBER_BYTES);
    let mut buffer = zmij::Buffer::new();
    for (at, number) in numbers.iter().enumerate() {
        if at > 0 || !first {
            text.push(b',');
        }
        text.extend_from_slice(buffer.format_finite(f32::from_le_bytes(*number)).as_bytes());
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_are_the_same_list_in_one_piece_or_in_many_and_their_length_is_known() {
        let numbers: Vec<f32> = (0..3 * TEXT_PIECE_BYTES / 4 + 5)
            .map(|i| (i as f32).sin() * 10f32.powi(i as i32 % 70 - 35))
            .chain([f32::MAX, f32::MIN_POSITIVE, -f32::MIN_POSITIVE, 1e-45, -0.0])
            .collect();
        let bytes: Vec<u8> = numbers.iter().flat_map(|number| number.to_le_bytes()).collect();
        let length = Part::Numbers(bytes.clone()).length();
        let pieces: Vec<Vec<u8>> = Part::Numbers(bytes).into_pieces().collect();
        assert_eq!(pieces.len(), 4);
        let text = pieces.concat();
        assert_eq!(text.len(), length);
        assert!(text.len() <= numbers.len() * NUMBER_BYTES);
        let read: Vec<f32> = serde_json::from_slice(&[b"[", &text[..], b"]"].concat()).expect("a list");
        let bits = |numbers: &[f32]| numbers.iter().map(|number| number.to_bits()).collect::<Vec<_>>();
        assert_eq!(bits(&read), bits(&numbers));
    }
}
