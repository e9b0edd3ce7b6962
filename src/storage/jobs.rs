//! Jobs in the store: queue, leases, states. Claims are in [`super::turns`].
//!
//! Every change of a running job names its lease; a worker whose lease was taken changes nothing.

use std::collections::BTreeSet;

use jiff::Timestamp;
use serde::Serialize;

use super::database::{Pool, Session, postgres, sql};
use super::reserve::with_reserve;
use super::rigs::rig_in;
use super::rows::{JobRow, all, int, json, us};
use super::{IdempotencyKey, Store, StoreError, idempotency, turns};
use crate::domain::job::{JobRequest, MAX_ATTEMPTS, SUSPECT_AFTER, eta_s};
use crate::domain::turns::Urgency;
use crate::domain::{
    Created, Job, JobId, JobKind, JobResult, JobState, Page, PageRequest, Problem, RigId, TokenId, new_id,
};

/// A filter of jobs; the default is all jobs.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct JobQuery {
    /// Of this rig.
    pub rig: Option<RigId>,
    /// Of one of these rigs.
    pub among: Option<BTreeSet<RigId>>,
    /// In this state.
    pub state: Option<JobState>,
    /// Of this kind.
    pub kind: Option<JobKind>,
}

/// The right to work on a job. Every claim has a new fencing token, so that a worker that lost its lease
/// can no longer write.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Lease {
    /// The job.
    pub job: JobId,
    /// Fencing token.
    pub token: u64,
}

/// A job that was claimed.
#[derive(Debug, Clone, PartialEq)]
pub struct Claim {
    /// The right to it.
    pub lease: Lease,
    /// The job.
    pub job: Job,
    /// The request of the job.
    pub request: serde_json::Value,
}

/// Answer to a heartbeat.
#[derive(Debug, Clone, PartialEq)]
pub enum Beat {
    /// Go on.
    Held,
    /// A client asked to cancel the job.
    CancelRequested,
    /// The lease, or the job, is gone: stop and write nothing.
    Lost,
}

/// How a job ended without a result.
#[derive(Debug, Clone, PartialEq)]
pub enum Outcome {
    /// It failed.
    Failed(Problem),
    /// It was cancelled.
    Cancelled,
    /// It goes back into the queue, its attempt not counted: the service stops, or has died.
    Released,
    /// It goes back into the queue, its attempt not counted, and waits for its turn anew: a more urgent job goes first.
    Yielded,
    /// It goes back into the queue; if its attempts are used up, it has failed.
    Retry(Problem),
}

/// Outcome of a request to cancel.
#[derive(Debug, Clone, PartialEq)]
pub enum CancelOutcome {
    /// No such job.
    Missing,
    /// The job as it is now: cancelled, about to be cancelled, or finished before.
    Noted(Box<Job>),
}

/// The token that asks for a job, and how many of its jobs may wait.
#[derive(Debug, Clone, Copy)]
pub struct Asker {
    /// The token; `None` while there are none, when all requests share one limit.
    pub token: Option<TokenId>,
    /// Most jobs that were asked for and wait.
    pub max_waiting: u64,
}

/// Outcome of a request for a job.
#[derive(Debug, Clone, PartialEq)]
pub enum JobInsert {
    /// It waits for its turn.
    Queued(Box<Job>),
    /// No such rig.
    MissingRig,
    /// So many jobs of the token wait that it may have no more.
    TooManyWaiting,
}

/// The origin of a job.
#[derive(Debug, Clone, Copy)]
pub(super) enum JobOrigin {
    /// A client.
    Request,
    /// The rig's fit policy.
    Policy,
}

/// Queues a job of an existing rig for a token.
pub(super) async fn insert(
    connection: &mut Session,
    rig: &RigId,
    kind: JobKind,
    request: &impl Serialize,
    origin: JobOrigin,
    token: Option<TokenId>,
    now: Timestamp,
) -> Result<Job, StoreError> {
    let urgency = match origin {
        JobOrigin::Request => Urgency::of_request(kind),
        JobOrigin::Policy => Urgency::Background,
    };
    let row: JobRow =
        sql("INSERT INTO jobs (id, rig, kind, state, origin, request, created_us, owner, urgency)
         VALUES ($1, $2, $3, 'queued', $4, $5, $6, $7, $8) RETURNING *")
        .bind(new_id(now).to_string())
        .bind(rig.as_str())
        .bind(kind.as_str())
        .bind(match origin {
            JobOrigin::Request => "request",
            JobOrigin::Policy => "policy",
        })
        .bind(json(request))
        .bind(us(now))
        .bind(owner(token))
        .bind(urgency as i64)
        .fetch_one(connection)
        .await?;
    row.try_into()
}

/// Why a job that a client asks for is not queued, if there is a reason.
pub(super) async fn refusal(
    connection: &mut Session,
    rig: &RigId,
    asker: Asker,
    key: Option<&IdempotencyKey>,
) -> Result<Option<JobInsert>, StoreError> {
    idempotency::check_unused(&mut *connection, key).await?;
    if rig_in(&mut *connection, rig).await?.is_none() {
        return Ok(Some(JobInsert::MissingRig));
    }
    let waiting: i64 =
        sql("SELECT count(*) FROM jobs WHERE state = 'queued' AND owner = $1 AND origin = 'request'")
            .bind(owner(asker.token))
            .fetch_one(connection)
            .await?;
    Ok((waiting >= int(asker.max_waiting)).then_some(JobInsert::TooManyWaiting))
}

/// Queues a job that a client asked for, and records the answer under its key.
pub(super) async fn insert_requested<R: JobRequest>(
    connection: &mut Session,
    rig: &RigId,
    request: &R,
    asker: Asker,
    key: Option<&IdempotencyKey>,
    now: Timestamp,
) -> Result<Job, StoreError> {
    let job = insert(&mut *connection, rig, R::KIND, request, JobOrigin::Request, asker.token, now).await?;
    idempotency::record(connection, key, || Created::job(&job), now).await?;
    Ok(job)
}

/// A token as the owner of jobs; empty without tokens.
fn owner(token: Option<TokenId>) -> String {
    token.map(|id| id.to_string()).unwrap_or_default()
}

/// Ends a job with a result; `false` when the lease is lost.
pub(super) async fn succeed(
    connection: &mut Session,
    lease: &Lease,
    result: &JobResult,
    stage: &str,
    now: Timestamp,
) -> Result<bool, StoreError> {
    turns::charge(connection, lease, now).await?;
    let done =
        sql("UPDATE jobs SET state = 'succeeded', result = $3, stage = $4, progress = 1, eta_s = NULL,
                         finished_us = $5, lease_until_us = NULL, event = event + 1
         WHERE id = $1 AND lease_token = $2 AND state = 'running'")
        .bind(lease.job.to_string())
        .bind(int(lease.token))
        .bind(json(result))
        .bind(stage)
        .bind(us(now))
        .execute(connection)
        .await?;
    Ok(done == 1)
}

impl Store {
    /// Queues the job that a client asked for.
    ///
    /// # Errors
    /// The store's failures.
    pub async fn insert_job<R: JobRequest>(
        &self,
        rig: &RigId,
        request: &R,
        asker: Asker,
        key: Option<&IdempotencyKey>,
        now: Timestamp,
    ) -> Result<JobInsert, StoreError> {
        let mut tx = self.write().await?;
        if let Some(refused) = refusal(&mut tx, rig, asker, key).await? {
            return Ok(refused);
        }
        let job = insert_requested(&mut tx, rig, request, asker, key, now).await?;
        tx.commit().await?;
        Ok(JobInsert::Queued(Box::new(job)))
    }

    /// Calls `heard` with each job that any process queues or changes, and whether it waits now, until the database
    /// fails. Never returns where the registry is not shared.
    pub async fn hear_of_jobs(&self, mut heard: impl FnMut(JobId, bool)) -> StoreError {
        let Pool::Postgres(pool) = self.reader() else { return std::future::pending().await };
        let waits = JobState::Queued.as_str();
        let parse = |state: &str, id: &str| id.parse().into_iter().for_each(|id| heard(id, state == waits));
        match postgres::hear_of_jobs(pool, parse).await {
            Ok(()) => sqlx::Error::PoolClosed.into(),
            Err(error) => error.into(),
        }
    }

    /// One job.
    ///
    /// # Errors
    /// The store's failures.
    pub async fn job(&self, id: JobId) -> Result<Option<Job>, StoreError> {
        let row: Option<JobRow> = sql("SELECT * FROM jobs WHERE id = $1")
            .bind(id.to_string())
            .fetch_optional(self.reader())
            .await?;
        row.map(Job::try_from).transpose()
    }

    /// Jobs, newest first.
    ///
    /// # Errors
    /// The store's failures.
    pub async fn jobs(&self, query: &JobQuery, page: &PageRequest) -> Result<Page<Job>, StoreError> {
        let rows: Vec<JobRow> = sql("SELECT * FROM jobs
             WHERE ($1 IS NULL OR id < $1) AND ($2 IS NULL OR rig = $2)
               AND ($3 IS NULL OR state = $3) AND ($4 IS NULL OR kind = $4)
               AND ($5 IS NULL OR rig IN (SELECT value FROM json_each($5)))
             ORDER BY id DESC LIMIT $6")
        .bind(page.cursor.as_ref().map(|cursor| cursor.as_str()))
        .bind(query.rig.as_ref().map(RigId::as_str))
        .bind(query.state.map(JobState::as_str))
        .bind(query.kind.map(JobKind::as_str))
        .bind(query.among.as_ref().map(json))
        .bind(i64::from(page.limit) + 1)
        .fetch_all(self.reader())
        .await?;
        Ok(Page::cut(all(rows)?, page.limit, |job: &Job| job.id.to_string()))
    }

    /// Number of jobs in each state, zeros included.
    ///
    /// # Errors
    /// The store's failures.
    pub async fn count_jobs(&self) -> Result<Vec<(JobState, u64)>, StoreError> {
        let counts: Vec<(String, i64)> =
            sql("SELECT state, count(*) FROM jobs GROUP BY state").fetch_all(self.reader()).await?;
        let count = |state: JobState| {
            counts.iter().find(|(word, _)| word == state.as_str()).map_or(0, |(_, n)| n.unsigned_abs())
        };
        Ok(JobState::ALL.map(|state| (state, count(state))).to_vec())
    }

    /// Records the request to cancel: a queued job ends at once, a running one when its worker sees the
    /// request.
    ///
    /// # Errors
    /// The store's failures.
    pub async fn request_cancel(&self, id: JobId, now: Timestamp) -> Result<CancelOutcome, StoreError> {
        with_reserve!(self, self.cancel_row(id, now))
    }

    async fn cancel_row(&self, id: JobId, now: Timestamp) -> Result<CancelOutcome, StoreError> {
        let mut tx = self.write_with_reserve().await?;
        sql("UPDATE jobs SET state = 'cancelled', cancel_requested = 1, finished_us = $2, eta_s = NULL,
                             event = event + 1
             WHERE id = $1 AND state = 'queued'")
        .bind(id.to_string())
        .bind(us(now))
        .execute(&mut *tx)
        .await?;
        sql("UPDATE jobs SET cancel_requested = 1, stage = 'cancelling', event = event + 1
             WHERE id = $1 AND state = 'running' AND cancel_requested = 0")
        .bind(id.to_string())
        .execute(&mut *tx)
        .await?;
        let row: Option<JobRow> =
            sql("SELECT * FROM jobs WHERE id = $1").bind(id.to_string()).fetch_optional(&mut *tx).await?;
        tx.commit().await?;
        match row {
            None => Ok(CancelOutcome::Missing),
            Some(row) => Ok(CancelOutcome::Noted(Box::new(row.try_into()?))),
        }
    }

    /// Extends a lease and records the progress of the job.
    ///
    /// # Errors
    /// The store's failures.
    pub async fn heartbeat(
        &self,
        lease: &Lease,
        stage: &str,
        progress: f64,
        lease_until: Timestamp,
        now: Timestamp,
    ) -> Result<Beat, StoreError> {
        let progress = if progress.is_finite() { progress.clamp(0.0, 1.0) } else { 0.0 };
        let mut tx = self.write_with_reserve().await?;
        let held: Option<(i64, bool)> = sql(
            "UPDATE jobs SET lease_until_us = $3, progress = CASE WHEN $4 > progress THEN $4 ELSE progress END,
                             service_deaths = CASE WHEN $4 > furthest THEN 0 ELSE service_deaths END,
                             furthest = CASE WHEN $4 > furthest THEN $4 ELSE furthest END,
                             stage = CASE WHEN cancel_requested <> 0 THEN stage ELSE $5 END,
                             event = event + 1
             WHERE id = $1 AND lease_token = $2 AND state = 'running'
             RETURNING started_us, cancel_requested",
        )
        .bind(lease.job.to_string())
        .bind(int(lease.token))
        .bind(us(lease_until))
        .bind(progress)
        .bind(stage)
        .fetch_optional(&mut *tx)
        .await?;
        let Some((started_us, cancel_requested)) = held else { return Ok(Beat::Lost) };
        turns::charge(&mut tx, lease, now).await?;
        let elapsed_s = (us(now) - started_us) as f64 * 1e-6;
        sql("UPDATE jobs SET eta_s = $2 WHERE id = $1")
            .bind(lease.job.to_string())
            .bind(eta_s(progress, elapsed_s))
            .execute(&mut *tx)
            .await?;
        tx.commit_progress().await?;
        Ok(if cancel_requested { Beat::CancelRequested } else { Beat::Held })
    }

    /// Ends a job without a result; `false` when the lease is lost, and nothing was changed.
    ///
    /// A job with a request to cancel does not go back into the queue.
    ///
    /// # Errors
    /// The store's failures.
    pub async fn finish_job(
        &self,
        lease: &Lease,
        outcome: Outcome,
        now: Timestamp,
    ) -> Result<bool, StoreError> {
        let mut tx = self.write_with_reserve().await?;
        let row: Option<JobRow> =
            sql("SELECT * FROM jobs WHERE id = $1 AND lease_token = $2 AND state = 'running'")
                .bind(lease.job.to_string())
                .bind(int(lease.token))
                .fetch_optional(&mut *tx)
                .await?;
        let Some(row) = row else { return Ok(false) };
        let job: Job = row.try_into()?;
        turns::charge(&mut tx, lease, now).await?;
        leave_running(&mut tx, &job, outcome, now).await?;
        tx.commit().await?;
        Ok(true)
    }
}

/// Moves a running job to its next state. The caller holds the write transaction in which it read the
/// job.
pub(super) async fn leave_running(
    connection: &mut Session,
    job: &Job,
    outcome: Outcome,
    now: Timestamp,
) -> Result<(), StoreError> {
    let released = matches!(outcome, Outcome::Released);
    let yielded = matches!(outcome, Outcome::Yielded);
    let (state, problem, attempt) = match outcome {
        Outcome::Failed(problem) => (JobState::Failed, Some(problem), job.attempt),
        Outcome::Cancelled => (JobState::Cancelled, None, job.attempt),
        _ if job.cancel_requested => (JobState::Cancelled, None, job.attempt),
        Outcome::Released | Outcome::Yielded => (JobState::Queued, None, job.attempt.saturating_sub(1)),
        Outcome::Retry(problem) if job.attempt >= MAX_ATTEMPTS => {
            (JobState::Failed, Some(problem), job.attempt)
        }
        Outcome::Retry(_) => (JobState::Queued, None, job.attempt),
    };
    debug_assert!(JobState::Running.may_become(state));
    sql(
        "UPDATE jobs SET state = $2, problem = $3, attempt = $4, finished_us = $5, eta_s = NULL,
                         stage = CASE WHEN $2 = 'failed' THEN stage ELSE NULL END,
                         progress = CASE WHEN $2 = 'queued' THEN 0 ELSE progress END,
                         goes_on = CASE WHEN $2 = 'queued' AND $6 <> 0 AND service_deaths < $7 THEN 1 ELSE 0 END,
                         queued_us = CASE WHEN $2 = 'queued' AND $8 <> 0 THEN $9 ELSE queued_us END,
                         worker = NULL, lease_until_us = NULL, event = event + 1
         WHERE id = $1",
    )
    .bind(job.id.to_string())
    .bind(state.as_str())
    .bind(problem.as_ref().map(json))
    .bind(job.attempt.min(attempt))
    .bind(state.is_terminal().then(|| us(now)))
    .bind(released)
    .bind(SUSPECT_AFTER)
    .bind(yielded)
    .bind(us(now))
    .execute(connection)
    .await?;
    Ok(())
}

#[cfg(test)]
mod tests {
    use jiff::ToSpan;

    use super::super::testing::{TestStore, draft, now};
    use super::*;

    async fn queued(store: &TestStore, n: usize) -> Vec<Job> {
        let rig = store.insert_rig(&draft("bench"), None, now()).await.unwrap().unwrap();
        let mut jobs = Vec::new();
        for _ in 0..n {
            jobs.push(store.queue_fit(&rig).await);
        }
        jobs
    }

    async fn claim(store: &Store, at: Timestamp) -> Option<Claim> {
        store.claim_job("w", at + 30.seconds(), at).await.unwrap()
    }

    fn problem() -> Problem {
        Problem::new(422, "fit.dead_channel", "Dead channel", "u is constant")
    }

    #[tokio::test]
    async fn the_database_allows_exactly_the_domains_moves() {
        let store = TestStore::open().await;
        let id = queued(&store, 1).await[0].id.to_string();
        for from in JobState::ALL {
            for to in JobState::ALL {
                let insert = format!(
                    "INSERT INTO jobs (id, rig, kind, state, origin, request, created_us)
                     SELECT 'x', rig, kind, '{}', origin, request, 0 FROM jobs WHERE id = '{id}'",
                    from.as_str()
                );
                store.raw(insert).await.unwrap();
                let moved =
                    store.raw(format!("UPDATE jobs SET state = '{}' WHERE id = 'x'", to.as_str())).await;
                assert_eq!(moved.is_ok(), from.may_become(to), "{from:?} -> {to:?}");
                let touched = store.raw("UPDATE jobs SET event = 9 WHERE id = 'x'").await;
                store.raw("DELETE FROM jobs WHERE id = 'x'").await.unwrap();
                assert_eq!(
                    touched.is_ok(),
                    moved.is_ok() && !to.is_terminal() || moved.is_err() && !from.is_terminal()
                );
            }
        }
    }

    #[tokio::test]
    async fn jobs_of_one_rig_are_claimed_oldest_first_and_each_once() {
        let store = TestStore::open().await;
        let jobs = queued(&store, 2).await;
        let first = claim(&store, now()).await.unwrap();
        assert_eq!((first.job.id, first.job.state, first.job.attempt), (jobs[0].id, JobState::Running, 1));
        assert_eq!(first.request["kind"], "frf");
        assert_eq!(claim(&store, now()).await.unwrap().job.id, jobs[1].id);
        assert_eq!(claim(&store, now()).await, None);
        let counts = store.count_jobs().await.unwrap();
        assert!(counts.contains(&(JobState::Running, 2)) && counts.contains(&(JobState::Queued, 0)));
    }

    #[tokio::test]
    async fn a_heartbeat_notes_progress_eta_and_the_wish_to_cancel() {
        let store = TestStore::open().await;
        let id = queued(&store, 1).await[0].id;
        let lease = claim(&store, now()).await.unwrap().lease;
        let later = now() + 10.seconds();
        let beat =
            async |stage, progress| store.heartbeat(&lease, stage, progress, later, later).await.unwrap();
        assert_eq!(beat("FRF", 0.25).await, Beat::Held);
        let job = store.job(id).await.unwrap().unwrap();
        assert_eq!((job.stage.as_deref(), job.progress, job.eta_s), (Some("FRF"), 0.25, Some(30.0)));
        assert_eq!(beat("FRF", f64::NAN).await, Beat::Held);
        let after = store.job(id).await.unwrap().unwrap();
        assert_eq!(after.progress, 0.25, "progress never falls");
        assert!(after.event > job.event);
        let CancelOutcome::Noted(noted) = store.request_cancel(id, later).await.unwrap() else { panic!() };
        assert_eq!((noted.state, noted.cancel_requested), (JobState::Running, true));
        assert_eq!(beat("FRF", 0.5).await, Beat::CancelRequested);
        assert!(store.finish_job(&lease, Outcome::Cancelled, later).await.unwrap());
        assert_eq!(beat("FRF", 0.6).await, Beat::Lost);
        let done = store.job(id).await.unwrap().unwrap();
        assert_eq!((done.state, done.finished_at, done.eta_s), (JobState::Cancelled, Some(later), None));
    }

    #[tokio::test]
    async fn cancelling_is_idempotent_and_leaves_a_finished_job_alone() {
        let store = TestStore::open().await;
        let jobs = queued(&store, 2).await;
        let cancel = async |id| match store.request_cancel(id, now()).await.unwrap() {
            CancelOutcome::Noted(job) => *job,
            CancelOutcome::Missing => panic!("there is such a job"),
        };
        let once = cancel(jobs[0].id).await;
        assert_eq!(once.state, JobState::Cancelled);
        assert_eq!(cancel(jobs[0].id).await, once);
        let lease = claim(&store, now()).await.unwrap().lease;
        assert_eq!(lease.job, jobs[1].id, "a cancelled job is not claimed");
        assert!(store.finish_job(&lease, Outcome::Failed(problem()), now()).await.unwrap());
        let failed = cancel(jobs[1].id).await;
        assert_eq!((failed.state, failed.problem), (JobState::Failed, Some(problem())));
        assert_eq!(store.request_cancel(new_id(now()), now()).await.unwrap(), CancelOutcome::Missing);
    }

    #[tokio::test]
    async fn a_released_attempt_does_not_count_and_a_wish_to_cancel_outlives_it() {
        let store = TestStore::open().await;
        let id = queued(&store, 1).await[0].id;
        for _ in 0..5 {
            let lease = claim(&store, now()).await.unwrap().lease;
            assert!(store.finish_job(&lease, Outcome::Released, now()).await.unwrap());
            let job = store.job(id).await.unwrap().unwrap();
            assert_eq!((job.state, job.attempt, job.finished_at), (JobState::Queued, 0, None));
        }
        let lease = claim(&store, now()).await.unwrap().lease;
        store.request_cancel(id, now()).await.unwrap();
        assert!(store.finish_job(&lease, Outcome::Released, now()).await.unwrap());
        assert_eq!(store.job(id).await.unwrap().unwrap().state, JobState::Cancelled);
    }

    #[tokio::test]
    async fn a_retry_counts_and_ends_with_its_problem() {
        let store = TestStore::open().await;
        let id = queued(&store, 1).await[0].id;
        for _ in 0..MAX_ATTEMPTS {
            let lease = claim(&store, now()).await.unwrap().lease;
            assert!(store.finish_job(&lease, Outcome::Retry(problem()), now()).await.unwrap());
        }
        assert_eq!(store.job(id).await.unwrap().unwrap().problem, Some(problem()));
    }

    #[tokio::test]
    async fn jobs_are_listed_newest_first_by_rig_state_and_kind() {
        let store = TestStore::open().await;
        let jobs = queued(&store, 3).await;
        claim(&store, now()).await.unwrap();
        let list = async |query: JobQuery, limit, cursor: Option<&str>| {
            let cursor = cursor.map(|c| crate::domain::Cursor::parse(c).unwrap());
            let page = store.jobs(&query, &PageRequest { limit, cursor }).await.unwrap();
            (page.items.iter().map(|job| job.id).collect::<Vec<_>>(), page.next)
        };
        let (ids, next) = list(JobQuery::default(), 2, None).await;
        assert_eq!((ids, next.clone()), (vec![jobs[2].id, jobs[1].id], Some(jobs[1].id.to_string())));
        assert_eq!(list(JobQuery::default(), 2, next.as_deref()).await, (vec![jobs[0].id], None));
        let running = JobQuery { state: Some(JobState::Running), ..JobQuery::default() };
        assert_eq!(list(running, 9, None).await.0, [jobs[0].id]);
        let studies = JobQuery { kind: Some(JobKind::Study), ..JobQuery::default() };
        assert!(list(studies, 9, None).await.0.is_empty());
        let other = JobQuery { rig: "other".parse().ok(), ..JobQuery::default() };
        assert!(list(other, 9, None).await.0.is_empty());
        let among =
            |rig: &str| JobQuery { among: Some([rig.parse().unwrap()].into()), ..JobQuery::default() };
        assert!(list(among("other"), 9, None).await.0.is_empty());
        assert_eq!(list(among(jobs[0].rig.as_str()), 9, None).await.0.len(), 3);
    }
}
