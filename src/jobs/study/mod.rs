//! The study job: many fits, one after another, to a table and for a search one model version.
//!
//! Where processes share a registry, workers without a job of their own help with the fits ([`shares`]).
//!
//! The table so far is a checkpoint of the job. A worker that dies or gives its turn to a more urgent job goes on at
//! the fit that it was at, and a training within that goes on from its own checkpoints, to the same table.

mod attempt;
mod curve;
mod linear;
mod plan;
mod problem;
mod search;
mod shares;
mod table;

use std::sync::Arc;

use super::control::Control;
use super::problem::JobError;
use super::spec::{JobSpec, StudyOutput};
use super::work_context::WorkContext;
use crate::domain::{JobId, Rig, StudyRequest};

use plan::Task;

pub(super) use plan::check;
pub use problem::StudyProblem;

/// The job that does a study.
struct Making<'a> {
    context: &'a WorkContext,
    rig: &'a Rig,
    job: JobId,
    control: &'a Arc<Control>,
    /// Whether the study is another worker's.
    helps: bool,
}

/// Does a study, from the request to what it publishes.
pub(super) async fn make(
    context: &WorkContext,
    spec: &JobSpec,
    control: &Arc<Control>,
) -> Result<StudyOutput, JobError> {
    let request: StudyRequest = spec.request()?;
    let rig = context.store.rig(&spec.rig).await?.ok_or(StudyProblem::RigGone)?;
    // Checked again, because runs may have come and gone since the job was queued.
    let plan = check(&context.store, &rig, &request).await?;
    let making = Making { context, rig: &rig, job: spec.job, control, helps: spec.helps };
    match &plan.task {
        Task::Search(task) => search::make(&making, &plan, task).await,
        Task::LearningCurve(curve, fit) => curve::make(&making, &plan, curve, fit).await,
        // It has no fits that could be shared.
        Task::Linear(..) if spec.helps => Err(JobError::Stopped),
        Task::Linear(study, model) => linear::make(&making, &plan, study, model).await,
    }
}

#[cfg(test)]
mod tests;
