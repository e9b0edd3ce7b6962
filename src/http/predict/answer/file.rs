//! A prediction as a measurement file: the outputs as columns of a table, as an RPC III response file or as a MAT file.

use super::{Begun, refusal};
use crate::engine::Progress;
use crate::formats::csv::{CsvPieces, TimeOfRows};
use crate::formats::mat::MatPieces;
use crate::formats::rpc3::Rpc3Pieces;
use crate::http::body::pieces::{Pieces, Written};
use crate::http::errors;
use crate::http::negotiate::{MAT, RPC3, too_large_for_mat};
use crate::http::predict::stages::Stages;
use crate::http::problem::{Answer, Problem};

/// Predicts and writes the beginning of the file; returns its size where it is known.
///
/// # Errors
/// A result that is not finite; a channel that CSV has no name for; the deadline.
pub(super) fn write(
    begun: Begun<'_>,
    media_type: &str,
    stages: &mut Stages,
) -> Answer<(Written, Option<u64>)> {
    let Begun { rig, loaded, mut prediction, mut memory, deadline, .. } = begun;
    let names = &loaded.model().outputs;
    let watch = |progress: Progress<'_>| deadline.watch(progress);
    let response = loaded.predictor.rest(&mut prediction, &watch).map_err(|error| refusal(&error, names))?;
    drop(prediction);
    stages.end("simulate");
    memory.keep(response.n_samples() * response.n_channels() * size_of::<f64>());
    let unit = |name: &String| rig.channel(name).map(|channel| channel.unit.clone()).unwrap_or_default();
    let units: Vec<String> = names.iter().map(unit).collect();
    let (pieces, size): (Pieces, _) = match media_type {
        RPC3 => {
            let pieces = Rpc3Pieces::new(names.clone(), units, false, response);
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
    };
    let pieces = pieces.inspect(move |_| {
        // The share of the memory is given back when the last piece has gone out.
        let _held = &memory;
    });
    let written = Written::begin(Box::new(pieces)).map_err(Problem::internal)?;
    Ok((written, size))
}
