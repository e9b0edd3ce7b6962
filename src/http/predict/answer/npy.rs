//! A prediction as NPY: the outputs as columns of `<f4`.

use std::io;

use super::file::held;
use super::{Body, Setting};
use crate::engine::model::Prediction;
use crate::engine::{Progress, Signal};
use crate::formats::npy::Writer;
use crate::http::body::pieces::{Pieces, Written};
use crate::http::errors;
use crate::http::predict::memory::Share;
use crate::http::predict::stages::Stages;
use crate::http::problem::{Answer, Problem};

/// Bytes that go out at once.
const PIECE_BYTES: usize = 256 << 10;

/// Predicts and writes the file. Each piece of the response is written and dropped, so that samples are in memory once,
/// with four bytes each.
///
/// # Errors
/// A result that is not finite; the deadline.
pub(super) fn write(
    setting: &Setting<'_>,
    mut prediction: Prediction,
    mut memory: Share,
    stages: &mut Stages,
) -> Answer<Body> {
    let outputs = &setting.loaded.model().outputs;
    let mut npy = Writer::new(prediction.n_samples(), outputs.len());
    append(setting, &mut npy, &mut prediction, "/drive/channels")?;
    drop(prediction);
    stages.end("simulate");
    let (pieces, size) = pieces(npy);
    memory.keep(size as usize);
    let written = Written::begin(held(pieces, memory)).map_err(Problem::internal)?;
    Ok((written, Some(size)))
}

/// Predicts the response to the drive at `pointer` and appends it.
///
/// # Errors
/// A result that is not finite; the deadline.
pub(super) fn append(
    setting: &Setting<'_>,
    npy: &mut Writer,
    prediction: &mut Prediction,
    pointer: &str,
) -> Answer<()> {
    let watch = |progress: Progress<'_>| setting.deadline.watch(progress);
    let mut next = || {
        let piece = setting.loaded.predictor.next(prediction, &watch);
        piece.map_err(|error| setting.refusal(&error, pointer))
    };
    while let Some(piece) = next()? {
        put(npy, &piece, &setting.loaded.model().outputs)?;
    }
    Ok(())
}

/// Appends samples of all outputs.
///
/// # Errors
/// A number beyond the range of `<f4`.
pub(super) fn put(npy: &mut Writer, samples: &Signal, outputs: &[String]) -> Answer<()> {
    npy.write(samples.channels()).map_err(|error| errors::format(&error, outputs))
}

/// The file of a response, and its size.
///
/// # Errors
/// As [`put`].
pub(super) fn of_response(response: Signal, outputs: &[String]) -> Answer<(Pieces, Option<u64>)> {
    let mut npy = Writer::new(response.n_samples(), outputs.len());
    put(&mut npy, &response, outputs)?;
    let (pieces, size) = pieces(npy);
    Ok((pieces, Some(size)))
}

/// A whole file, cut into pieces, and its size.
pub(super) fn pieces(npy: Writer) -> (Pieces, u64) {
    let file = npy.finish();
    let size = file.len();
    let piece = move |from: usize| io::Result::Ok(file[from..size.min(from + PIECE_BYTES)].to_vec());
    (Box::new((0..size).step_by(PIECE_BYTES).map(piece)), size as u64)
}
