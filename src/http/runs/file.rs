//! Turns an uploaded file into a run.

use std::path::Path;

use super::understood::Understood;
use crate::domain::Rig;
use crate::domain::run::RunMeta;
use crate::formats::Format;
use crate::http::measurement::{FileQuery, Measurement, unsuitable};
use crate::http::problem::Answer;
use crate::http::upload::Upload;
use crate::storage::{PrepareError, PreparedRun};

/// A run that is ready for the store, and the way from its file.
#[derive(Debug)]
pub struct ReadFile {
    pub run: PreparedRun,
    pub understood: Understood,
}

/// Reads the file and makes it a run of `rig`, by way of files in `scratch`. Takes processor time: call it off the
/// async threads.
///
/// # Errors
/// Those of [`FileQuery::read`]; a run that does not suit the rig; `store.full`.
pub fn prepare(
    query: FileQuery,
    rig: &Rig,
    meta: RunMeta,
    format: Option<Format>,
    upload: Upload,
    scratch: &Path,
) -> Answer<ReadFile> {
    let read = query.read(rig, format, upload, scratch)?;
    let Measurement { format, sample_rate_hz, columns, names, samples, changes, sha256 } = read;
    let run = PreparedRun::new(scratch, rig, meta, names, changes, samples, sha256);
    let run = run.map_err(|error| match error {
        PrepareError::Store(error) => error.into(),
        PrepareError::Unsuitable(found) => unsuitable(found),
    })?;
    let understood = Understood::of(format.as_str(), sample_rate_hz, columns, &run);
    Ok(ReadFile { run, understood })
}
