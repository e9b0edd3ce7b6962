//! One fit of a study, resumable at the epoch that it was at.

use std::sync::Arc;

use crate::compute::Class;
use crate::domain::JobId;
use crate::engine::EngineError;
use crate::engine::checkpoint::{CheckpointStore, NoCheckpoints};
use crate::engine::model::{FitData, FitSettings, Fitted, try_out};
use crate::jobs::checkpoints::JobCheckpoints;
use crate::jobs::control::Control;
use crate::jobs::problem::JobError;
use crate::jobs::work_context::WorkContext;
use crate::storage::Digest;

/// What every fit of a study uses.
#[derive(Clone, Copy)]
pub(super) struct Bench<'a> {
    pub context: &'a WorkContext,
    pub job: JobId,
    pub control: &'a Arc<Control>,
    /// Digest of everything that the fits of the study depend on.
    pub fits: &'a str,
    /// Whether the study is another worker's.
    pub helps: bool,
}

impl Bench<'_> {
    /// Fits `data` for its errors. `place` tells the fits of the study apart.
    ///
    /// # Errors
    /// Within: the engine's refusal of this fit, which need not end the study. Without: the study was stopped, or the
    /// store failed.
    pub(super) async fn fit(
        &self,
        place: (usize, usize),
        settings: FitSettings,
        data: Arc<FitData>,
    ) -> Result<Result<Fitted, EngineError>, JobError> {
        // Parts of two fits have the same names: a checkpoint of another fit is none of this one.
        let fits = digest(&(self.fits, place));
        let (store, every) = (&self.context.store, self.context.checkpoint_every);
        let checkpoints = JobCheckpoints::open(store, self.job, fits, every, self.control).await?;
        let (watched, helps) = (Arc::clone(self.control), self.helps);
        let work = move || {
            // The parts of two fits of one job would take each other's place.
            let kept: &dyn CheckpointStore = if helps { &NoCheckpoints } else { &checkpoints };
            try_out(&data, &settings, kept, &|progress| watched.watch(progress))
        };
        match self.context.compute.run(Class::Fit, None, work).await? {
            Err(EngineError::Cancelled) => Err(JobError::Stopped),
            tried => Ok(tried),
        }
    }
}

/// Digest of a value.
pub(super) fn digest(all: &impl serde::Serialize) -> String {
    let json = serde_json::to_vec(all).expect("a request always serialises");
    Digest::of(&json).as_str().to_owned()
}
