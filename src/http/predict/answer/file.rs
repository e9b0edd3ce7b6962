//! A prediction as a measurement file: the outputs as columns of a table, as an RPC III response file, as a MAT file
//! or as an array.

use super::npy::of_response;
use super::{Body, Setting};
use crate::engine::Signal;
use crate::engine::model::Prediction;
use crate::formats::csv::{CsvPieces, TimeOfRows};
use crate::formats::mat::MatPieces;
use crate::formats::rpc3::Rpc3Pieces;
use crate::http::body::pieces::{Pieces, Written};
use crate::http::errors;
use crate::http::negotiate::{MAT, NPY, RPC3, RPC3_FLOATS, too_large_for_mat};
use crate::http::predict::memory::Share;
use crate::http::predict::stages::Stages;
use crate::http::problem::{Answer, Problem};

/// Predicts and writes the beginning of the file.
///
/// # Errors
/// A result that is not finite; a channel that CSV has no name for; the deadline.
pub(super) fn write(
    setting: &Setting<'_>,
    mut prediction: Prediction,
    media_type: &str,
    mut memory: Share,
    stages: &mut Stages,
) -> Answer<Body> {
    let response = setting.response(&mut prediction, "/drive/channels")?;
    drop(prediction);
    stages.end("simulate");
    memory.keep(response.n_samples() * response.n_channels() * size_of::<f64>());
    let (pieces, size) = setting.file(response, media_type)?;
    let written = Written::begin(held(pieces, memory)).map_err(Problem::internal)?;
    Ok((written, size))
}

/// Pieces that give the share of the memory back when the last of them has gone out.
pub(super) fn held(pieces: Pieces, memory: Share) -> Pieces {
    Box::new(pieces.inspect(move |_| {
        let _held = &memory;
    }))
}

impl Setting<'_> {
    /// A response as a file, and its size where that is known.
    ///
    /// # Errors
    /// A channel that CSV has no name for; a number beyond the range of the file.
    pub(super) fn file(&self, response: Signal, media_type: &str) -> Answer<(Pieces, Option<u64>)> {
        let names = &self.loaded.model().outputs;
        let unit =
            |name: &String| self.rig.channel(name).map(|channel| channel.unit.clone()).unwrap_or_default();
        let units: Vec<String> = names.iter().map(unit).collect();
        Ok(match media_type {
            NPY => of_response(response, names)?,
            RPC3 | RPC3_FLOATS => {
                let mut pieces = Rpc3Pieces::new(names.clone(), units, false, response);
                if media_type == RPC3_FLOATS {
                    pieces = pieces.as_floats();
                }
                let size = pieces.size() as u64;
                (Box::new(pieces), Some(size))
            }
            MAT => {
                let pieces = MatPieces::new(names, &units, response).ok_or_else(too_large_for_mat)?;
                let size = pieces.size();
                (Box::new(pieces), Some(size))
            }
            _ => {
                let time = TimeOfRows::beside(names, 0);
                let pieces = CsvPieces::new(names.clone(), units, time, response);
                (Box::new(pieces.map_err(|error| errors::format(&error, names))?), None)
            }
        })
    }
}
