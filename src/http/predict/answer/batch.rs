//! Predictions for a batch of drives as one array `[batch, samples, outputs]`.

use super::file::held;
use super::npy::{append, pieces, put};
use super::shares::Shares;
use super::{Body, Setting, multipart};
use crate::engine::Signal;
use crate::formats::npy::Writer;
use crate::http::body::pieces::Written;
use crate::http::json::Object;
use crate::http::negotiate::NPY;
use crate::http::predict::form::Form;
use crate::http::predict::memory::Share;
use crate::http::predict::stages::Stages;
use crate::http::problem::{Answer, Problem};

/// Predicts the response to each drive, with its figures where the form has room for them. Gives the body, its
/// `Content-Type` and the shares of the worst drive.
///
/// # Errors
/// A result that is not finite, by its drive; settings outside their limits; the deadline.
pub(super) fn write(
    setting: &Setting<'_>,
    drives: Vec<Signal>,
    form: Form,
    mut memory: Share,
    stages: &mut Stages,
) -> Answer<(Body, String, Shares)> {
    let outputs = &setting.loaded.model().outputs;
    let mut npy = Writer::of_batch(drives.len(), drives[0].n_samples(), outputs.len());
    let (mut figures, mut shares) =
        (Vec::new(), Shares { inside: 1.0, fallback: setting.fallback.then_some(0.0) });
    for (index, drive) in drives.into_iter().enumerate() {
        setting.deadline.check()?;
        let pointer = format!("/{index}");
        let mut begun = setting.begin(drive, &pointer)?;
        shares = shares.or_worse(Shares::of(&begun));
        if form.with_figures {
            let predicted = setting.predicted(begun, &pointer)?;
            put(&mut npy, &predicted.response, outputs)?;
            let mut of_drive = Object::new();
            setting.add_figures(&mut of_drive, &predicted)?;
            figures.push(if index == 0 { b'[' } else { b',' });
            figures.extend(of_drive.finish());
        } else {
            append(setting, &mut npy, &mut begun.prediction, &pointer)?;
        }
    }
    stages.end("simulate");
    let (file, size) = pieces(npy);
    memory.keep(size as usize);
    let file = held(file, memory);
    if !form.with_figures {
        let written = Written::begin(file).map_err(Problem::internal)?;
        return Ok(((written, Some(size)), NPY.to_owned(), shares));
    }
    figures.push(b']');
    let mut answer = Object::new();
    setting.add_model(&mut answer)?;
    answer.field("drives").extend(figures);
    let (body, content_type) = multipart::parts(answer.finish(), NPY, file, Some(size))?;
    stages.end("report");
    Ok((body, content_type, shares))
}
