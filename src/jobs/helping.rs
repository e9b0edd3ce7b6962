//! A worker without a job of its own helps with one of another process: with the networks of a fit, or the fits of a study.
//!
//! What it makes are checkpoints of that job, under the lease of the job's own worker. It renews no lease, ends no job, and
//! leaves as soon as a job waits.

use std::sync::{Arc, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

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

/// How soon a worker looks again that found neither a job nor one to help with: another may be taking what was announced.
pub(super) const HELP_SOON: Duration = Duration::from_millis(100);

/// How often it looks from then on.
pub(super) const HELP_EVERY: Duration = Duration::from_secs(1);

/// Time from the end of help with a job, because nothing of it was left, until it is asked again whether it wants help.
const AGAIN: Duration = Duration::from_secs(30);

impl Runner {
    /// Helps with a job of another process until nothing of it is left, or a job waits; `false` if there is none.
    pub(super) async fn help(&self) -> bool {
        let mut not: Vec<Lease> = {
            let mut helped = self.helped();
            helped.retain(|(_, since)| since.elapsed() < AGAIN);
            helped.iter().map(|(lease, _)| lease.clone()).collect()
        };
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
                // Before the checkpoints, which a slow store takes long for.
                _ = ticks.tick() => {
                    self.store_checkpoints(claim, &control).await;
                    self.store_help_losses(claim, &control).await;
                    if *self.stopping.borrow() {
                        control.stop(Stop::Shutdown);
                    }
                    match self.store.wants_help(&claim.lease).await {
                        Ok(true) => {}
                        Ok(false) => control.stop(Stop::Yield),
                        // What it makes is of use once the store is back.
                        Err(error) => error.count(),
                    }
                }
                () = control.kept() => self.store_checkpoints(claim, &control).await,
            }
        };
        self.store_checkpoints(claim, &control).await;
        self.store_help_losses(claim, &control).await;
        if let Err(JobError::Failed(problem) | JobError::Retry(problem)) = &end {
            tracing::warn!(problem.code, "could not help: {}", problem.detail);
        }
        if control.stopped() != Some(Stop::Yield) {
            // Nothing of it was left. It may be helped at once where only another job had to be done.
            self.helped().push((claim.lease.clone(), Instant::now()));
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

    fn helped(&self) -> MutexGuard<'_, Vec<(Lease, Instant)>> {
        self.helped.lock().unwrap_or_else(PoisonError::into_inner)
    }
}
