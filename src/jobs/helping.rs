//! A worker without a job of its own helps with one of another process: with the networks of a fit, or the fits of a study.
//!
//! What it makes are checkpoints of that job, under the lease of the job's own worker. It renews no lease, ends no job, and
//! leaves as soon as a job waits.

use std::sync::{Arc, MutexGuard, PoisonError};
use std::time::Duration;

use tokio::time::MissedTickBehavior;
use tracing::Instrument;

use super::control::{Control, Stop};
use super::problem::JobError;
use super::runner::Runner;
use super::spec::JobSpec;
use crate::domain::JobKind;
use crate::storage::{Claim, Lease};

/// How long a mark counts that says who is at which share; it is renewed every two seconds or more often.
pub(super) const FRESH: Duration = Duration::from_secs(10);

/// How long a helper waits for the sign that the job's own worker computes what it would compute, or for a share.
pub(super) const OPENED: Duration = Duration::from_secs(20);

/// The checkpoint by which a fit says that it has networks for others.
pub(super) const OFFER: &str = "share offer";

/// How often a worker without a job looks whether it can help.
pub(super) const HELP_EVERY: Duration = Duration::from_secs(1);

/// Jobs that a process remembers to have helped with.
const HELPED: usize = 64;

impl Runner {
    /// Helps with a job of another process until nothing of it is left, or a job waits; `false` if there is none.
    pub(super) async fn help(&self) -> bool {
        let mut not = self.helped().clone();
        let claim = loop {
            match self.store.job_to_help(&not, (OFFER, FRESH)).await {
                // Its worker and this one would share the same cores.
                Ok(Some(claim)) if self.at_work().contains_key(&claim.job.id) => not.push(claim.lease),
                Ok(Some(claim)) => break claim,
                Ok(None) => return false,
                Err(error) => {
                    error.count();
                    tracing::warn!(%error, "nobody knows which jobs want help");
                    return false;
                }
            }
        };
        {
            let mut helped = self.helped();
            helped.push(claim.lease.clone());
            // Those of jobs that have ended are of no use.
            let old = helped.len().saturating_sub(HELPED);
            helped.drain(..old);
        }
        let span = tracing::info_span!("help", job.id = %claim.job.id, rig.id = %claim.job.rig);
        self.help_with(&claim).instrument(span).await
    }

    async fn help_with(&self, claim: &Claim) -> bool {
        tracing::info!("helps with a job of another process");
        let control = Arc::new(Control::default());
        let spec = JobSpec { helps: true, ..JobSpec::from(claim) };
        let work = self.make_as(spec, &control);
        tokio::pin!(work);
        let mut ticks = tokio::time::interval(self.settings.progress_every);
        ticks.set_missed_tick_behavior(MissedTickBehavior::Delay);
        let end = loop {
            tokio::select! {
                biased;
                end = &mut work => break end,
                () = control.kept() => self.store_checkpoints(claim, &control).await,
                _ = ticks.tick() => {
                    self.store_checkpoints(claim, &control).await;
                    self.store_help_losses(claim, &control).await;
                    if *self.stopping.borrow() {
                        control.stop(Stop::Shutdown);
                    }
                    match self.store.wants_help(&claim.lease).await {
                        Ok(true) => {}
                        Ok(false) => control.stop(Stop::Yield),
                        Err(error) => {
                            error.count();
                            control.stop(Stop::Lost);
                        }
                    }
                }
            }
        };
        self.store_checkpoints(claim, &control).await;
        self.store_help_losses(claim, &control).await;
        if let Err(JobError::Failed(problem) | JobError::Retry(problem)) = &end {
            tracing::warn!(problem.code, "could not help: {}", problem.detail);
        }
        if control.stopped() == Some(Stop::Yield) {
            // It may be helped again once nothing else waits.
            self.helped().retain(|lease| *lease != claim.lease);
        }
        true
    }

    /// Of a fit, whose networks are shown wherever they are trained; a study shows those of its own worker.
    async fn store_help_losses(&self, claim: &Claim, control: &Control) {
        if claim.job.kind == JobKind::Fit {
            self.store_losses(claim, control).await;
        } else {
            drop(control.take_losses());
        }
    }

    fn helped(&self) -> MutexGuard<'_, Vec<Lease>> {
        self.helped.lock().unwrap_or_else(PoisonError::into_inner)
    }
}
