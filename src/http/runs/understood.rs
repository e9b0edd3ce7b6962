//! The answer to a dry run: what the service understood of a file.

use serde::Serialize;

use crate::domain::columns::Column;
use crate::domain::{Quality, RunOutlook};
use crate::storage::PreparedRun;

/// The answer.
#[derive(Debug, Serialize)]
pub struct DryRun {
    #[serde(flatten)]
    pub understood: Understood,
    #[serde(flatten)]
    pub outlook: RunOutlook,
}

/// What a file was taken for, before anything is stored.
#[derive(Debug, Serialize)]
pub struct Understood {
    /// Format that was read.
    format: &'static str,
    /// Sample rate of the file.
    sample_rate_hz: f64,
    /// Samples of each channel of the run, at the rig's rate.
    samples: u64,
    duration_s: f64,
    columns: Vec<Column>,
    quality: Quality,
}

impl Understood {
    /// Of a file with these columns.
    pub fn of(format: &'static str, sample_rate_hz: f64, columns: Vec<Column>, run: &PreparedRun) -> Self {
        let (samples, duration_s, quality) = (run.samples(), run.duration_s(), run.quality().clone());
        Self { format, sample_rate_hz, samples, duration_s, columns, quality }
    }
}
