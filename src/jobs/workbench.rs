//! Where work is done: what it reads from and computes on. It stores nothing.

use std::sync::Arc;
use std::time::Duration;

use crate::compute::Compute;
use crate::domain::{JobKind, Problem};
use crate::storage::Store;

use super::control::Control;
use super::diagnosis;
use super::fit::{self, FitFunction};
use super::order::{Made, Order};
use super::problem::{JobError, codes};

/// Everything that work may use.
#[derive(Debug)]
pub(super) struct Workbench {
    pub store: Store,
    pub compute: Compute,
    pub fit: FitFunction,
    /// Most time between two checkpoints of a fit.
    pub checkpoint_every: Duration,
}

impl Workbench {
    /// Makes what is ordered.
    pub(super) async fn make(&self, order: &Order, control: &Arc<Control>) -> Result<Made, JobError> {
        let made = match order.kind {
            JobKind::Fit => Made::Model(Box::new(fit::make(self, order, control).await?)),
            JobKind::Diagnosis => Made::Diagnosis(Box::new(diagnosis::make(self, order, control).await?)),
            JobKind::Evaluation | JobKind::Iteration | JobKind::Study => {
                let detail = "A newer version of the program queued this job.";
                let title = "The job cannot be read";
                return Err(JobError::failed(Problem::new(500, codes::JOB_UNKNOWN, title, detail)));
            }
        };
        if control.stopped().is_some() { Err(JobError::Stopped) } else { Ok(made) }
    }
}
