//! The tensors of a request as the drive of a prediction. Names, shapes and sizes are held against the
//! bytes that came before any of them is used.

use bytes::Bytes;

use super::layout::{Layout, Tensor};
use super::request::{InferRequest, InputTensor};
use super::values::Values;
use crate::engine::model::RigModel;
use crate::engine::{EngineError, Signal};
use crate::http::problem::{Answer, FieldError, Problem};
use crate::http::{codes, errors};

/// Type of the numbers of a tensor.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Datatype {
    Fp32,
    Fp64,
}

/// Numbers of one tensor in row-major order.
#[derive(Debug)]
enum Numbers {
    Json(Values),
    /// Little-endian.
    Binary(Bytes),
}

/// One tensor of the drive, checked.
#[derive(Debug)]
struct Part {
    /// Place in the request.
    place: usize,
    /// Places of its columns among the model's inputs.
    channels: Vec<usize>,
    datatype: Datatype,
    numbers: Numbers,
}

/// All tensors of a model's drive.
#[derive(Debug)]
pub struct Drive {
    parts: Vec<Part>,
    /// Samples of each channel, at least one.
    pub samples: usize,
}

impl Drive {
    /// Checks the tensors of a request, whose numbers it takes, against the model and against the bytes that came.
    ///
    /// # Errors
    /// `inference.*`, `signal.empty`, `signal.unequal_lengths`, `body.*`; each points at the tensor.
    pub fn check(request: &mut InferRequest, mut binary: Bytes, layout: &Layout) -> Answer<Self> {
        let mut parts: Vec<Part> = Vec::with_capacity(layout.inputs.len());
        let mut samples = None;
        for (place, input) in request.inputs.0.iter_mut().enumerate() {
            let tensor = find(layout, input, place)?;
            if parts.iter().any(|part| part.channels == tensor.channels) {
                let detail = format!("The tensor {:?} comes twice.", input.name);
                return Err(Problem::new(codes::INFERENCE_DUPLICATE_TENSOR, detail)
                    .with(FieldError::new(format!("/inputs/{place}/name"), "each tensor once")));
            }
            let datatype = datatype(input, place)?;
            let rows = rows(input, tensor, place)?;
            if *samples.get_or_insert(rows) != rows {
                let limit = format!("{} samples, as many as the first tensor", samples.unwrap_or_default());
                let detail = format!("The tensor {:?} has {rows} samples; it must have {limit}.", input.name);
                return Err(Problem::new(codes::SIGNAL_UNEQUAL_LENGTHS, detail).with(at_shape(place, limit)));
            }
            let numbers = numbers(input, place, (rows, tensor.channels.len()), datatype, &mut binary)?;
            parts.push(Part { place, channels: tensor.channels.clone(), datatype, numbers });
        }
        let given = |tensor: &&Tensor| parts.iter().any(|part| part.channels == tensor.channels);
        if let Some(missing) = layout.inputs.iter().find(|tensor| !given(tensor)) {
            let detail = format!("The request lacks the tensor {:?}.", missing.name);
            return Err(Problem::new(codes::INFERENCE_MISSING_TENSOR, detail)
                .with(FieldError::new("/inputs", format!("a tensor {:?}", missing.name))));
        }
        if !binary.is_empty() {
            let detail = format!(
                "{} bytes follow the binary data that the inputs declare with binary_data_size.",
                binary.len()
            );
            return Err(Problem::new(codes::INFERENCE_BINARY_SIZE, detail).with(FieldError::new(
                "/inputs",
                "binary_data_size of all tensors together is what follows the JSON",
            )));
        }
        Ok(Self { parts, samples: samples.unwrap_or_default() })
    }

    /// The channels, in the order of the model's inputs.
    ///
    /// # Errors
    /// `signal.non_finite` for NaN and infinity, and for numbers beyond the range of their type.
    pub fn into_signal(self, model: &RigModel) -> Answer<Signal> {
        let mut channels = vec![Vec::new(); model.inputs.len()];
        let mut places = vec![0; model.inputs.len()];
        for part in self.parts {
            let columns = columns_of(part.numbers, part.datatype, part.channels.len(), self.samples);
            for (&channel, column) in part.channels.iter().zip(columns) {
                (channels[channel], places[channel]) = (column, part.place);
            }
        }
        Signal::new(model.sample_rate_hz, channels).map_err(|error| {
            let pointer = match &error {
                EngineError::NonFinite { channel, .. } => format!("/inputs/{}/data", places[*channel]),
                _ => "/inputs".to_owned(),
            };
            errors::engine(&error, &model.inputs, &pointer)
        })
    }
}

/// The columns of a tensor. Numbers that came as text are rounded to the type that the client declares.
fn columns_of(numbers: Numbers, datatype: Datatype, width: usize, samples: usize) -> Vec<Vec<f64>> {
    match (numbers, datatype) {
        (Numbers::Json(values), Datatype::Fp32) => {
            dealt(values.into_numbers().map(|v| f64::from(v as f32)), width, samples)
        }
        (Numbers::Json(values), Datatype::Fp64) => dealt(values.into_numbers(), width, samples),
        (Numbers::Binary(bytes), Datatype::Fp32) => {
            let numbers = bytes.as_chunks::<4>().0.iter();
            dealt(numbers.map(|b| f64::from(f32::from_le_bytes(*b))), width, samples)
        }
        (Numbers::Binary(bytes), Datatype::Fp64) => {
            let numbers = bytes.as_chunks::<8>().0.iter();
            dealt(numbers.map(|b| f64::from_le_bytes(*b)), width, samples)
        }
    }
}

/// Deals numbers out to the columns, one after the other.
fn dealt(numbers: impl Iterator<Item = f64>, width: usize, samples: usize) -> Vec<Vec<f64>> {
    let mut columns: Vec<Vec<f64>> = (0..width).map(|_| Vec::with_capacity(samples)).collect();
    let mut column = 0;
    for number in numbers {
        columns[column].push(number);
        column = if column + 1 == width { 0 } else { column + 1 };
    }
    columns
}

/// The tensor of the model that an input of the request names.
fn find<'a>(layout: &'a Layout, input: &InputTensor, place: usize) -> Answer<&'a Tensor> {
    layout
        .inputs
        .iter()
        .find(|tensor| tensor.name == input.name)
        .ok_or_else(|| unknown(&input.name, &layout.inputs, format!("/inputs/{place}/name")))
}

/// The refusal of a tensor that is none of these.
pub fn unknown(name: &str, tensors: &[Tensor], pointer: String) -> Problem {
    let names: Vec<&str> = tensors.iter().map(|tensor| tensor.name.as_str()).collect();
    let limit = format!("one of {}", names.join(", "));
    let detail = format!("The model has no tensor {name:?} here; it must be {limit}.");
    Problem::new(codes::INFERENCE_UNKNOWN_TENSOR, detail).with(FieldError::new(pointer, limit))
}

fn datatype(input: &InputTensor, place: usize) -> Answer<Datatype> {
    match input.datatype.as_str() {
        "FP32" => Ok(Datatype::Fp32),
        "FP64" => Ok(Datatype::Fp64),
        found => {
            let limit = "FP32 or FP64";
            let detail =
                format!("The tensor {:?} has the datatype {found:?}; it must be {limit}.", input.name);
            Err(Problem::new(codes::INFERENCE_DATATYPE, detail)
                .with(FieldError::new(format!("/inputs/{place}/datatype"), limit)))
        }
    }
}

fn at_shape(place: usize, limit: impl Into<String>) -> FieldError {
    FieldError::new(format!("/inputs/{place}/shape"), limit)
}

/// The samples that a shape declares, not compared with the data yet.
fn rows(input: &InputTensor, tensor: &Tensor, place: usize) -> Answer<usize> {
    let width = tensor.channels.len();
    let rows = match input.shape.0[..] {
        // Beyond the address space there are no data for it.
        [rows, columns] if columns == width as u64 => usize::try_from(rows).ok(),
        _ => None,
    };
    match rows {
        Some(0) => {
            Err(Problem::new(codes::SIGNAL_EMPTY, format!("The tensor {:?} has no samples.", input.name))
                .with(at_shape(place, "at least one sample")))
        }
        Some(rows) => Ok(rows),
        None => {
            let limit = format!("[samples, {width}]");
            let shape: Vec<String> = input.shape.0.iter().map(u64::to_string).collect();
            let detail = format!(
                "The tensor {:?} has the shape [{}]; it must be {limit}.",
                input.name,
                shape.join(", ")
            );
            Err(Problem::new(codes::INFERENCE_SHAPE, detail).with(at_shape(place, limit)))
        }
    }
}

/// The numbers of a tensor, as many as its shape declares; binary data are taken from the front of `binary`.
fn numbers(
    input: &mut InputTensor,
    place: usize,
    (rows, columns): (usize, usize),
    datatype: Datatype,
    binary: &mut Bytes,
) -> Answer<Numbers> {
    let wrong = |found: String, limit: String| {
        let detail =
            format!("The tensor {:?} has {found}; its shape [{rows}, {columns}] {limit}.", input.name);
        Problem::new(codes::INFERENCE_SHAPE, detail)
            .with(at_shape(place, format!("as many numbers as there are: {found}")))
    };
    let count = rows.checked_mul(columns);
    match (input.data.as_ref(), input.binary_data_size()) {
        (Some(_), Some(_)) => {
            let limit = "either data or binary_data_size";
            Err(Problem::new(codes::BODY_INVALID_VALUE, format!("/inputs/{place} must have {limit}."))
                .with(FieldError::new(format!("/inputs/{place}"), limit)))
        }
        (None, None) => {
            let detail =
                format!("/inputs/{place} lacks data (or binary_data_size, with the data behind the JSON).");
            Err(Problem::new(codes::BODY_MISSING_FIELD, detail).with(FieldError::new(
                format!("/inputs/{place}/data"),
                "required unless the data are binary",
            )))
        }
        (Some(values), None) => {
            if count != Some(values.len()) {
                return Err(wrong(format!("{} numbers", values.len()), "needs another number".into()));
            }
            if let Some(row) = values.row.filter(|row| *row != columns) {
                return Err(wrong(format!("rows of {row} numbers"), format!("needs rows of {columns}")));
            }
            Ok(Numbers::Json(std::mem::take(&mut input.data).unwrap_or_default()))
        }
        (None, Some(size)) => {
            let bytes_each = if datatype == Datatype::Fp32 { 4 } else { 8 };
            let needed = count.and_then(|count| count.checked_mul(bytes_each));
            if needed.map(|needed| needed as u64) != Some(size) {
                let limit =
                    needed.map_or("needs more than there can be".into(), |n| format!("needs {n} bytes"));
                return Err(wrong(format!("{size} bytes of {}", input.datatype), limit));
            }
            match usize::try_from(size) {
                Ok(size) if size <= binary.len() => Ok(Numbers::Binary(binary.split_to(size))),
                _ => {
                    let limit = format!("at most the {} bytes that are left behind the JSON", binary.len());
                    let detail =
                        format!("The tensor {:?} declares {size} bytes; it must be {limit}.", input.name);
                    let pointer = format!("/inputs/{place}/parameters/binary_data_size");
                    Err(Problem::new(codes::INFERENCE_BINARY_SIZE, detail)
                        .with(FieldError::new(pointer, limit)))
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn layout() -> Layout {
        let tensor =
            |name: &str, channels: &[usize]| Tensor { name: name.into(), channels: channels.to_vec() };
        Layout {
            inputs: vec![tensor("hub", &[0, 2]), tensor("drive", &[1])],
            outputs: vec![tensor("response", &[0])],
        }
    }

    /// The code of the refusal and its first place, or the samples.
    fn checked(json: &str, binary: &[u8]) -> Result<usize, (String, String)> {
        let mut request = InferRequest::parse(json.as_bytes()).expect("a request");
        Drive::check(&mut request, Bytes::copy_from_slice(binary), &layout())
            .map(|drive| drive.samples)
            .map_err(|problem| {
                let document: serde_json::Value =
                    serde_json::from_slice(&problem.document("")).expect("JSON");
                (
                    problem.code().to_owned(),
                    document["errors"][0]["pointer"].as_str().unwrap_or("none").to_owned(),
                )
            })
    }

    const DRIVE: &str = r#"{"name": "drive", "datatype": "FP64", "shape": [2, 1], "data": [1, 2]}"#;

    /// A request of the tensor `drive` and one more.
    fn with(hub: &str) -> String {
        format!(r#"{{"inputs": [{DRIVE}, {{"name": "hub", {hub}}}]}}"#)
    }

    #[test]
    fn what_a_client_declares_is_held_against_what_came() {
        let binary = |shape: &str, size: u64| {
            with(&format!(
                r#""datatype": "FP32", "shape": {shape}, "parameters": {{"binary_data_size": {size}}}"#
            ))
        };
        assert_eq!(checked(&binary("[2, 2]", 16), &[0; 16]), Ok(2));
        let refused = |json: &str, bytes: &[u8], code: &str, pointer: &str| {
            assert_eq!(checked(json, bytes), Err((code.to_owned(), pointer.to_owned())), "{json}");
        };
        let size_at = "/inputs/1/parameters/binary_data_size";
        refused(&binary("[2, 2]", 16), &[0; 15], "inference.binary_size", size_at);
        refused(&binary("[2, 2]", 16), &[0; 17], "inference.binary_size", "/inputs");
        refused(&binary("[2, 2]", 15), &[0; 16], "inference.shape", "/inputs/1/shape");
        let shape = "/inputs/1/shape";
        for wrong in ["[4]", "[2, 2, 1]", "[2, 3]", "[]", "[2, 18446744073709551615]"] {
            refused(&binary(wrong, 16), &[0; 16], "inference.shape", shape);
        }
        refused(&binary("[3, 2]", 24), &[0; 24], "signal.unequal_lengths", shape);
        refused(&binary("[0, 2]", 0), &[], "signal.empty", shape);
        let huge = u64::MAX;
        let overflow = format!(
            r#"{{"inputs": [{{"name": "hub", "datatype": "FP64", "shape": [{huge}, 2], "parameters": {{"binary_data_size": {huge}}}}}]}}"#
        );
        refused(&overflow, &[0; 16], "inference.shape", "/inputs/0/shape");
    }

    #[test]
    fn each_tensor_comes_once_with_its_numbers_once() {
        let refused = |json: &str, code: &str, pointer: &str| {
            assert_eq!(checked(json, &[]), Err((code.to_owned(), pointer.to_owned())), "{json}");
        };
        let two = r#""datatype": "FP32", "shape": [2, 2]"#;
        assert_eq!(checked(&with(&format!(r#"{two}, "data": [1, 2, 3, 4]"#)), &[]), Ok(2));
        assert_eq!(checked(&with(&format!(r#"{two}, "data": [[1, 2], [3, 4]]"#)), &[]), Ok(2));
        refused(&with(&format!(r#"{two}, "data": [1, 2, 3]"#)), "inference.shape", "/inputs/1/shape");
        refused(&with(&format!(r#"{two}, "data": [[1, 2, 3, 4]]"#)), "inference.shape", "/inputs/1/shape");
        refused(&with(two), "body.missing_field", "/inputs/1/data");
        let both = format!(r#"{two}, "data": [1, 2, 3, 4], "parameters": {{"binary_data_size": 16}}"#);
        refused(&with(&both), "body.invalid_value", "/inputs/1");
        refused(&format!(r#"{{"inputs": [{DRIVE}]}}"#), "inference.missing_tensor", "/inputs");
        refused(
            &format!(r#"{{"inputs": [{DRIVE}, {DRIVE}]}}"#),
            "inference.duplicate_tensor",
            "/inputs/1/name",
        );
        let wrong = DRIVE.replace("drive", "response");
        refused(&format!(r#"{{"inputs": [{wrong}]}}"#), "inference.unknown_tensor", "/inputs/0/name");
        for datatype in ["INT32", "FP16", "BYTES", "fp32", ""] {
            let wrong = DRIVE.replace("FP64", datatype);
            refused(&format!(r#"{{"inputs": [{wrong}]}}"#), "inference.datatype", "/inputs/0/datatype");
        }
    }
}
