//! A prediction as NPY: the outputs as columns of `<f4`.

use std::io;

use super::{Begun, refusal};
use crate::formats;
use crate::http::body::pieces::Written;
use crate::http::errors;
use crate::http::predict::stages::Stages;
use crate::http::problem::{Answer, Problem};

/// Bytes that go out at once.
const PIECE_BYTES: usize = 256 << 10;

/// Predicts; returns the file and its size. Each piece of the response is written and dropped, so that
/// samples are in memory once, with four bytes each.
///
/// # Errors
/// A result that is not finite; the deadline.
pub(super) fn write(begun: Begun<'_>, stages: &mut Stages) -> Answer<(Written, u64)> {
    let Begun { loaded, mut prediction, mut memory, deadline, .. } = begun;
    let (outputs, predictor) = (&loaded.model().outputs, &loaded.predictor);
    let mut npy = formats::npy::Writer::new(prediction.n_samples(), outputs.len());
    let watch = |progress: crate::engine::Progress<'_>| deadline.watch(progress);
    while let Some(piece) =
        predictor.next(&mut prediction, &watch).map_err(|error| refusal(&error, outputs))?
    {
        npy.write(piece.channels()).map_err(|error| errors::format(&error, outputs))?;
    }
    drop(prediction);
    stages.end("simulate");
    let file = npy.finish();
    let size = file.len();
    memory.keep(size);
    let pieces = (0..size).step_by(PIECE_BYTES).map(move |from| {
        // The share of the memory is given back when the last piece has gone out.
        let _held = &memory;
        io::Result::Ok(file[from..size.min(from + PIECE_BYTES)].to_vec())
    });
    let written = Written::begin(Box::new(pieces)).map_err(Problem::internal)?;
    Ok((written, size as u64))
}
