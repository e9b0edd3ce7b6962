//! Stores what work has made and ends its job, if the job is still ours.

use crate::storage::Claim;

use super::activate::last_words;
use super::order::{Made, MadeDiagnosis, MadeModel};
use super::problem::JobError;
use super::runner::Runner;

/// One transaction that holds only while the lease does.
pub(super) async fn publish(runner: &Runner, claim: &Claim, made: Made) -> Result<(), JobError> {
    let now = (runner.clock)();
    match made {
        Made::Model(made) => {
            let MadeModel { model, activation, why } = *made;
            let stage = move |version, active| last_words(version, active, &why);
            let published = runner.store.publish_model(&claim.lease, model, activation, stage, now).await?;
            // None: somebody else has the job now, or nobody: this work is void.
            let model = published.ok_or(JobError::Stopped)?;
            tracing::info!(model.version = model.version, model.active = model.active, "published a model");
        }
        Made::Diagnosis(made) => {
            let MadeDiagnosis { diagnosis, stage } = *made;
            let stored = runner.store.publish_diagnosis(&claim.lease, diagnosis, &stage, now).await?;
            let id = stored.ok_or(JobError::Stopped)?;
            tracing::info!(diagnosis.id = %id, stage, "stored a diagnosis");
        }
    }
    Ok(())
}
