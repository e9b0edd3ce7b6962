//! The table of a study as a checkpoint: written after each fit, read when the study goes on.

use std::sync::Arc;

use crate::domain::{JobId, StudyReport};
use crate::jobs::control::Control;
use crate::jobs::problem::JobError;
use crate::storage::{Checkpoint, STUDY_PART, Store};

/// The checkpoint of one study.
pub(super) struct Table {
    control: Arc<Control>,
    /// Digest of everything that the table depends on.
    fits: String,
    /// Whether the study is another worker's, which keeps its table itself.
    helps: bool,
}

impl Table {
    /// The table that an interrupted attempt has left, if it is of this study by this program.
    pub(super) async fn open(
        store: &Store,
        job: JobId,
        fits: String,
        control: &Arc<Control>,
        helps: bool,
    ) -> Result<(Self, Option<StudyReport>), JobError> {
        let kept = store.checkpoints(job, &fits).await?;
        let report = kept.into_iter().find(|one| one.part == STUDY_PART);
        let report = report.and_then(|one| serde_json::from_slice(&one.state).ok());
        Ok((Self { control: Arc::clone(control), fits, helps }, report))
    }

    /// Stores the table so far.
    pub(super) fn keep(&self, report: &StudyReport) {
        if self.helps {
            return;
        }
        let state = serde_json::to_vec(report).expect("a report always serialises").into();
        self.control.keep(Checkpoint { part: STUDY_PART.into(), fits: self.fits.clone(), state });
    }
}
