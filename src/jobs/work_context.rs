//! The store and the processor that a job's work uses. It does not store results.

use std::sync::Arc;
use std::time::Duration;

use crate::compute::{Class, Compute};
use crate::domain::{JobKind, Model};
use crate::engine::EngineError;
use crate::engine::model::{RigModel, from_safetensors};
use crate::storage::Store;

use super::control::Control;
use super::diagnosis;
use super::evaluation;
use super::fit::{self, FitFunction};
use super::iteration;
use super::problem::{JobError, unreadable};
use super::spec::{JobOutput, JobSpec};
use super::study;

/// Everything that the work of a job may use.
#[derive(Debug)]
pub(super) struct WorkContext {
    pub store: Store,
    pub compute: Compute,
    pub fit: FitFunction,
    /// Most time between two checkpoints of a fit.
    pub checkpoint_every: Duration,
    /// Memory that a job may take.
    pub memory_bytes: u64,
}

impl WorkContext {
    /// Reads the weights of a version, and makes of its model what is wanted.
    ///
    /// # Errors
    /// The store's failures, and weights of which it cannot be made.
    pub async fn read_model<T: Send + 'static>(
        &self,
        model: &Model,
        make: impl FnOnce(RigModel) -> Result<T, EngineError> + Send + 'static,
    ) -> Result<T, JobError> {
        let weights = self.store.weights(model).await?;
        let read = move || from_safetensors(&weights).and_then(make);
        let made = self.compute.run(Class::Fit, None, read).await?;
        made.map_err(|error| unreadable(model.version, &error))
    }

    /// Does the work of a job.
    pub(super) async fn make(&self, spec: &JobSpec, control: &Arc<Control>) -> Result<JobOutput, JobError> {
        let made = match spec.kind {
            JobKind::Fit => JobOutput::Model(Box::new(fit::make(self, spec, control).await?)),
            JobKind::Diagnosis => JobOutput::Diagnosis(Box::new(diagnosis::make(self, spec, control).await?)),
            JobKind::Iteration => JobOutput::Iteration(Box::new(iteration::make(self, spec, control).await?)),
            JobKind::Evaluation => {
                JobOutput::Evaluation(Box::new(evaluation::make(self, spec, control).await?))
            }
            JobKind::Study => JobOutput::Study(Box::new(study::make(self, spec, control).await?)),
        };
        if control.stopped().is_some() { Err(JobError::Stopped) } else { Ok(made) }
    }
}
