//! Stores the output of work and ends its job, if this worker still holds the lease.

use crate::storage::Claim;

use super::activate::last_words;
use super::problem::JobError;
use super::runner::Runner;
use super::spec::{DiagnosisOutput, EvaluationOutput, IterationOutput, JobOutput, ModelOutput, StudyOutput};

/// Publishes in one transaction, which succeeds only while the lease is held.
pub(super) async fn publish(runner: &Runner, claim: &Claim, made: JobOutput) -> Result<(), JobError> {
    let now = (runner.clock)();
    match made {
        JobOutput::Model(made) => {
            let ModelOutput { model, activation, why } = *made;
            let stage = move |version, active| last_words(version, active, &why);
            let published = runner.store.publish_model(&claim.lease, model, activation, stage, now).await?;
            // `None`: the lease is lost, and this output is dropped.
            let model = published.ok_or(JobError::Stopped)?;
            tracing::info!(model.version = model.version, model.active = model.active, "published a model");
        }
        JobOutput::Diagnosis(made) => {
            let DiagnosisOutput { diagnosis, stage } = *made;
            let stored = runner.store.publish_diagnosis(&claim.lease, diagnosis, &stage, now).await?;
            let id = stored.ok_or(JobError::Stopped)?;
            tracing::info!(diagnosis.id = %id, stage, "stored a diagnosis");
        }
        JobOutput::Iteration(made) => {
            let IterationOutput { iteration, stage } = *made;
            let rig = &claim.job.rig;
            let stored = runner.store.publish_iteration(&claim.lease, rig, iteration, &stage, now).await?;
            let id = stored.ok_or(JobError::Stopped)?;
            tracing::info!(iteration.id = %id, stage, "stored an iteration");
        }
        JobOutput::Evaluation(made) => {
            let EvaluationOutput { evaluation, stage } = *made;
            let stored = runner.store.publish_evaluation(&claim.lease, evaluation, &stage, now).await?;
            let id = stored.ok_or(JobError::Stopped)?;
            tracing::info!(evaluation.id = %id, stage, "stored an evaluation");
        }
        JobOutput::Study(made) => {
            let StudyOutput { study, said, why, no_bytes: _ } = *made;
            let stage = move |published: Option<(u32, bool)>| match published {
                Some((version, active)) => format!("{said}; {}", last_words(version, active, &why)),
                None => said,
            };
            let rig = &claim.job.rig;
            let stored = runner.store.publish_study(&claim.lease, rig, study, stage, now).await?;
            let id = stored.ok_or(JobError::Stopped)?;
            tracing::info!(study.id = %id, "stored a study");
        }
    }
    Ok(())
}
