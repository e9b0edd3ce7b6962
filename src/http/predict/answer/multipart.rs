//! A prediction in two parts (RFC 2046, section 5.1.3): its figures as JSON, then the response as a file.

use std::iter;

use super::file::held;
use super::{Begun, Body, Setting};
use crate::http::body::pieces::{Pieces, Written};
use crate::http::json::{self, Object};
use crate::http::negotiate::MULTIPART;
use crate::http::predict::memory::Share;
use crate::http::predict::stages::Stages;
use crate::http::problem::{Answer, Problem};

/// Predicts, compares and counts; writes the beginning of the parts. Gives their `Content-Type` too.
///
/// # Errors
/// Those of the figures and of the file.
pub(super) fn write(
    setting: &Setting<'_>,
    begun: Begun,
    media_type: &str,
    mut memory: Share,
    stages: &mut Stages,
) -> Answer<(Body, String)> {
    let predicted = setting.predicted(begun, "/drive/channels")?;
    stages.end("simulate");
    let mut figures = Object::new();
    setting.add_model(&mut figures)?;
    setting.add_figures(&mut figures, &predicted)?;
    let response = predicted.response;
    memory.keep(response.n_samples() * response.n_channels() * size_of::<f64>());
    let (file, size) = setting.file(response, media_type)?;
    let answer = parts(figures.finish(), media_type, held(file, memory), size)?;
    stages.end("report");
    Ok(answer)
}

/// The beginning of both parts, and their `Content-Type`. `size` is that of the file, where it is known.
///
/// # Errors
/// The error of a piece.
pub(super) fn parts(
    figures: Vec<u8>,
    media_type: &str,
    file: Pieces,
    size: Option<u64>,
) -> Answer<(Body, String)> {
    // 74 random bits: no file holds it.
    let boundary = format!("rigcast-{}", uuid::Uuid::now_v7().simple());
    let mut head = format!(
        "--{boundary}\r\nContent-Type: {}\r\nContent-Length: {}\r\n\r\n",
        json::MEDIA_TYPE,
        figures.len()
    )
    .into_bytes();
    head.extend(figures);
    let length = size.map(|size| format!("Content-Length: {size}\r\n")).unwrap_or_default();
    head.extend(format!("\r\n--{boundary}\r\nContent-Type: {media_type}\r\n{length}\r\n").into_bytes());
    let end = format!("\r\n--{boundary}--\r\n").into_bytes();
    let total = size.map(|size| size + (head.len() + end.len()) as u64);
    let pieces = iter::once(Ok(head)).chain(file).chain(iter::once(Ok(end)));
    let written = Written::begin(Box::new(pieces)).map_err(Problem::internal)?;
    Ok(((written, total), format!("{MULTIPART}; boundary={boundary}")))
}
