//! Jobs that other workers help with, where processes share the registry.

use std::time::Duration;

use jiff::Timestamp;

use super::database::sql;
use super::rows::{JobRow, int, us};
use super::{Claim, Digest, Lease, Store, StoreError};
use crate::domain::{Job, JobId};

impl Store {
    /// A running job that a worker without a job of its own may help with, and that is not among `not`: a fit that has
    /// renewed the checkpoint `offer` within the time `fresh`, or else a study, the oldest. None while a job waits. Its
    /// lease stays with its worker; checkpoints may be written under it.
    ///
    /// # Errors
    /// The store's failures.
    pub async fn job_to_help(
        &self,
        not: &[Lease],
        (offer, fresh): (&str, Duration),
    ) -> Result<Option<Claim>, StoreError> {
        let Some(now) = self.shared_time().await? else { return Ok(None) };
        let rows: Vec<JobRow> = sql("SELECT * FROM jobs
             WHERE state = 'running' AND cancel_requested = 0
               AND NOT EXISTS (SELECT 1 FROM jobs WHERE state = 'queued')
               AND (kind = 'study'
                    OR EXISTS (SELECT 1 FROM checkpoints WHERE job = jobs.id AND part = $1 AND written_us > $2))
             ORDER BY kind = 'study', id")
        .bind(offer)
        .bind(us(now.checked_sub(fresh).unwrap_or(Timestamp::MIN)))
        .fetch_all(self.reader())
        .await?;
        for row in rows {
            let (request, token) = (row.request()?, row.lease_token.unsigned_abs());
            let job: Job = row.try_into()?;
            let lease = Lease { job: job.id, token };
            if !not.contains(&lease) {
                return Ok(Some(Claim { lease, job, request }));
            }
        }
        Ok(None)
    }

    /// Whether help with a job is still wanted: the job runs under the same lease, nobody has cancelled it, and no job
    /// waits for a worker.
    ///
    /// # Errors
    /// The store's failures.
    pub async fn wants_help(&self, lease: &Lease) -> Result<bool, StoreError> {
        Ok(sql("SELECT EXISTS (SELECT 1 FROM jobs WHERE id = $1 AND lease_token = $2 AND state = 'running'
                                                    AND cancel_requested = 0)
                AND NOT EXISTS (SELECT 1 FROM jobs WHERE state = 'queued')")
        .bind(lease.job.to_string())
        .bind(int(lease.token))
        .fetch_one(self.reader())
        .await?)
    }

    /// Parts and states of the checkpoints of a job with this digest and with names that begin with `share`, and how long
    /// ago each was written. None where the registry is not shared.
    ///
    /// # Errors
    /// The store's failures.
    pub async fn shares(
        &self,
        job: JobId,
        fits: &str,
    ) -> Result<Vec<(String, Vec<u8>, Duration)>, StoreError> {
        let Some(now) = self.shared_time().await? else { return Ok(Vec::new()) };
        let rows: Vec<(String, String, Vec<u8>, i64)> =
            sql("SELECT part, sha256, state, written_us FROM checkpoints
             WHERE job = $1 AND fits = $2 AND part LIKE 'share%' ORDER BY part")
            .bind(job.to_string())
            .bind(fits)
            .fetch_all(self.reader())
            .await?;
        let whole = rows.into_iter().filter(|(_, sha256, state, _)| Digest::of(state).as_str() == sha256);
        let age = |written_us: i64| {
            let us = now.as_microsecond().saturating_sub(written_us);
            Duration::from_micros(us.try_into().unwrap_or_default())
        };
        Ok(whole.map(|(part, _, state, written_us)| (part, state, age(written_us))).collect())
    }
}
