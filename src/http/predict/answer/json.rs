//! A prediction as JSON: the response, and the figures that were asked for.

use std::iter;

use super::{Begun, Setting};
use crate::http::body::pieces::Written;
use crate::http::body::signal_pieces::JsonPieces;
use crate::http::body::signals::write_json;
use crate::http::json::Object;
use crate::http::predict::memory::Share;
use crate::http::predict::stages::Stages;
use crate::http::problem::{Answer, Problem};

/// Most values of a response that is written by all threads at once, before the answer begins to go out:
/// ten seconds of a large rig, some 2.5 MB of text.
const WRITTEN_AT_ONCE: usize = 1 << 17;

/// Predicts, compares and counts; writes the beginning of the document, or all of a short one.
///
/// # Errors
/// A result that is not finite, settings outside their limits; the deadline.
pub(super) fn write(
    setting: &Setting<'_>,
    begun: Begun,
    mut memory: Share,
    stages: &mut Stages,
) -> Answer<Written> {
    let outputs = &setting.loaded.model().outputs;
    let predicted = setting.predicted(begun, "/drive/channels")?;
    let response = &predicted.response;
    stages.end("simulate");
    let mut answer = Object::new();
    setting.add_model(&mut answer)?;
    let mut before = None;
    let mut figures = Object::new();
    if setting.include.response {
        let text = answer.field("response");
        if response.n_samples() * outputs.len() <= WRITTEN_AT_ONCE {
            // The figures are counted while the response is written.
            let ((), counted) = rayon::join(
                || write_json(text, outputs, response),
                || setting.add_figures(&mut figures, &predicted),
            );
            counted?;
        } else {
            setting.add_figures(&mut figures, &predicted)?;
            before = Some(std::mem::take(text));
        }
    } else {
        setting.add_figures(&mut figures, &predicted)?;
    }
    answer.append(figures);
    let response = predicted.response;
    let written = match before {
        None => Written::Whole(answer.finish()),
        Some(before) => {
            let after = answer.finish();
            memory.keep(response.n_samples() * outputs.len() * size_of::<f64>());
            let response = JsonPieces::new(outputs.clone(), response);
            let pieces = iter::once(Ok(before)).chain(response).chain(iter::once(Ok(after)));
            // The share of the memory is given back when the last piece has gone out.
            let held = pieces.inspect(move |_| {
                let _held = &memory;
            });
            Written::begin(Box::new(held)).map_err(Problem::internal)?
        }
    };
    stages.end("report");
    Ok(written)
}
