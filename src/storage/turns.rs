//! Claims of jobs in turns, and the time of workers that the turns go by.

use std::time::Duration;

use jiff::{Timestamp, ToSpan};

use super::database::{Session, either, sql};
use super::jobs::{Claim, Lease};
use super::rows::{JobRow, int, parsed, us};
use super::{Store, StoreError};
use crate::domain::turns::{self, Urgency, WaitingJobs, WorkerTime, seconds_between};
use crate::domain::{Job, RigId};

/// Charged for the start of a job, so that many short jobs count for something and a token that has just
/// had a turn is behind one that has had none.
const START_S: f64 = 1.0;

/// Most time that is charged at once. Heartbeats come more often; a longer time is a clock that has jumped
/// or a service that stood still.
const MOST: Duration = Duration::from_secs(60);

/// Hours after which the time of a worker is forgotten; next to nothing of it still counts.
const KEPT_HOURS: i64 = 24;

impl Store {
    /// Claims the queued job whose turn it is for `worker`, until `lease_until` unless a heartbeat extends
    /// it.
    ///
    /// # Errors
    /// The store's failures.
    pub async fn claim_job(
        &self,
        worker: &str,
        lease_until: Timestamp,
        now: Timestamp,
    ) -> Result<Option<Claim>, StoreError> {
        let mut tx = self.write().await?;
        let Some(next) = next(&mut tx, now).await? else { return Ok(None) };
        let row: JobRow =
            sql("UPDATE jobs SET state = 'running', worker = $1, lease_until_us = $2, started_us = $3,
                             charged_us = $3, lease_token = lease_token + 1, attempt = attempt + 1,
                             progress = 0, stage = NULL, eta_s = NULL, problem = NULL, goes_on = 0,
                             event = event + 1
             WHERE id = $4 AND state = 'queued'
             RETURNING *")
            .bind(worker)
            .bind(us(lease_until))
            .bind(us(now))
            .bind(next.oldest.to_string())
            .fetch_one(&mut *tx)
            .await?;
        add(&mut tx, &next.owner, &next.rig, START_S, now).await?;
        tx.commit().await?;
        let (request, token) = (row.request()?, row.lease_token.unsigned_abs());
        let job: Job = row.try_into()?;
        Ok(Some(Claim { lease: Lease { job: job.id, token }, job, request }))
    }
}

impl Store {
    /// How urgent the waiting job is that would go before this running one, if that waited from now on; `None`: none
    /// would, or the lease is lost.
    ///
    /// # Errors
    /// The store's failures.
    pub async fn goes_before(&self, lease: &Lease, now: Timestamp) -> Result<Option<Urgency>, StoreError> {
        let mut tx = self.snapshot().await?;
        let row: Option<WaitingRow> = sql("SELECT owner, rig, urgency, 0, id, $3 FROM jobs
             WHERE id = $1 AND lease_token = $2 AND state = 'running'")
        .bind(lease.job.to_string())
        .bind(int(lease.token))
        .bind(us(now))
        .fetch_optional(&mut tx)
        .await?;
        let Some(running) = row.map(waiting_jobs).transpose()? else { return Ok(None) };
        let mut waiting = waiting(&mut tx).await?;
        if waiting.is_empty() {
            return Ok(None);
        }
        waiting.push(running);
        let times = times(&mut tx).await?;
        let first = turns::next(&waiting, &times, now);
        Ok(first.filter(|first| first.oldest != lease.job).map(|first| first.urgency))
    }
}

/// The jobs of which the oldest is next.
async fn next(connection: &mut Session, now: Timestamp) -> Result<Option<WaitingJobs>, StoreError> {
    let waiting = waiting(connection).await?;
    if waiting.is_empty() {
        return Ok(None);
    }
    Ok(turns::next(&waiting, &times(connection).await?, now).cloned())
}

/// All waiting jobs, by token, rig and urgency. SQLite must be told which index has all that is asked for.
macro_rules! select_waiting {
    ($index:literal) => {
        concat!(
            "SELECT owner, rig, urgency, goes_on, min(id), min(coalesce(queued_us, created_us))
             FROM jobs ",
            $index,
            " WHERE state = 'queued' GROUP BY owner, rig, urgency, goes_on"
        )
    };
}

/// All waiting jobs, by token, rig and urgency.
async fn waiting(connection: &mut Session) -> Result<Vec<WaitingJobs>, StoreError> {
    let rows: Vec<WaitingRow> = sql(either(select_waiting!("INDEXED BY jobs_waiting"), select_waiting!("")))
        .fetch_all(connection)
        .await?;
    rows.into_iter().map(waiting_jobs).collect()
}

async fn times(connection: &mut Session) -> Result<Vec<WorkerTime>, StoreError> {
    let rows: Vec<TimeRow> =
        sql("SELECT owner, rig, used_s, at_us FROM worker_time").fetch_all(connection).await?;
    rows.into_iter().map(worker_time).collect()
}

/// Owner, rig, urgency, whether they go on, oldest job, its time in microseconds.
type WaitingRow = (String, String, i64, bool, String, i64);

fn waiting_jobs(row: WaitingRow) -> Result<WaitingJobs, StoreError> {
    let (owner, rig, urgency, go_on, oldest, since_us) = row;
    let urgency = Urgency::ALL.into_iter().find(|known| *known as i64 == urgency);
    Ok(WaitingJobs {
        rig: parsed("jobs", &oldest, &rig)?,
        urgency: urgency.ok_or_else(|| bad("jobs", &oldest, "an unknown urgency"))?,
        since: Timestamp::from_microsecond(since_us).map_err(|error| bad("jobs", &oldest, error))?,
        oldest: parsed("jobs", &oldest, &oldest)?,
        owner,
        go_on,
    })
}

/// Owner, rig, seconds, time in microseconds.
type TimeRow = (String, String, f64, i64);

fn worker_time((owner, rig, used_s, at_us): TimeRow) -> Result<WorkerTime, StoreError> {
    let at = Timestamp::from_microsecond(at_us).map_err(|error| bad("worker_time", &owner, error))?;
    Ok(WorkerTime { rig: parsed("worker_time", &owner, &rig)?, used_s, at, owner })
}

fn bad(table: &'static str, key: &str, what: impl ToString) -> StoreError {
    StoreError::Row { table, key: key.to_owned(), what: what.to_string() }
}

/// Charges a token and rig for the time since the last charge of a running job. Does nothing if the lease
/// is lost.
pub(super) async fn charge(
    connection: &mut Session,
    lease: &Lease,
    now: Timestamp,
) -> Result<(), StoreError> {
    let found: Option<(String, String, Option<i64>)> = sql(
        "SELECT owner, rig, charged_us FROM jobs WHERE id = $1 AND lease_token = $2 AND state = 'running'",
    )
    .bind(lease.job.to_string())
    .bind(int(lease.token))
    .fetch_optional(&mut *connection)
    .await?;
    let Some((owner, rig, charged_us)) = found else { return Ok(()) };
    sql("UPDATE jobs SET charged_us = $2 WHERE id = $1")
        .bind(lease.job.to_string())
        .bind(us(now))
        .execute(&mut *connection)
        .await?;
    let since = charged_us.and_then(|us| Timestamp::from_microsecond(us).ok()).unwrap_or(now);
    let seconds = seconds_between(since, now).min(MOST.as_secs_f64());
    let rig = parsed("jobs", &lease.job.to_string(), &rig)?;
    add(connection, &owner, &rig, seconds, now).await
}

/// Adds to the time of a token and rig, and forgets old times.
async fn add(
    connection: &mut Session,
    owner: &str,
    rig: &RigId,
    seconds: f64,
    now: Timestamp,
) -> Result<(), StoreError> {
    let row: Option<TimeRow> =
        sql("SELECT owner, rig, used_s, at_us FROM worker_time WHERE owner = $1 AND rig = $2")
            .bind(owner)
            .bind(rig.as_str())
            .fetch_optional(&mut *connection)
            .await?;
    let before = row.map(worker_time).transpose()?;
    sql("INSERT INTO worker_time (owner, rig, used_s, at_us) VALUES ($1, $2, $3, $4)
         ON CONFLICT (owner, rig) DO UPDATE SET used_s = excluded.used_s, at_us = excluded.at_us")
    .bind(owner)
    .bind(rig.as_str())
    .bind(before.map_or(0.0, |time| time.left_at(now)) + seconds)
    .bind(us(now))
    .execute(&mut *connection)
    .await?;
    let oldest = now.checked_sub(KEPT_HOURS.hours()).unwrap_or(Timestamp::MIN);
    sql("DELETE FROM worker_time WHERE at_us < $1").bind(us(oldest)).execute(connection).await?;
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::super::testing::{TestStore, draft, now};
    use super::super::{Asker, JobInsert, Outcome};
    use super::*;
    use crate::domain::fits::FitRequest;
    use crate::domain::study::StudyRequest;
    use crate::domain::{DiagnosisRequest, JobId, JobKind, Rig, TokenId, new_id};

    async fn rig(store: &TestStore, id: &str) -> Rig {
        store.insert_rig(&draft(id), None, now()).await.unwrap().unwrap()
    }

    async fn fit(store: &Store, rig: &Rig, token: Option<TokenId>) -> JobId {
        let request: FitRequest = serde_json::from_value(serde_json::json!({"kind": "frf"})).unwrap();
        let asker = Asker { token, max_waiting: 10_000 };
        match store.insert_job(&rig.id, &request, asker, None, now()).await.unwrap() {
            JobInsert::Queued(job) => job.id,
            other => panic!("{other:?}"),
        }
    }

    async fn claim(store: &Store, at: Timestamp) -> Claim {
        store.claim_job("w", at + 30.seconds(), at).await.unwrap().expect("a job waits")
    }

    /// The worker has the job for so many seconds.
    async fn work(store: &Store, claim: &Claim, from: Timestamp, seconds: i64) {
        let end = from + seconds.seconds();
        store.heartbeat(&claim.lease, "", 0.5, end + 30.seconds(), end).await.unwrap();
        assert!(store.finish_job(&claim.lease, Outcome::Cancelled, end).await.unwrap());
    }

    #[tokio::test]
    async fn a_tokens_single_fit_starts_next_whatever_another_token_has_queued() {
        let store = TestStore::open().await;
        let (rig, [many, one]) = (rig(&store, "bench").await, [new_id(now()), new_id(now())]);
        for _ in 0..1000 {
            fit(&store, &rig, Some(many)).await;
        }
        let running = claim(&store, now()).await;
        let single = fit(&store, &rig, Some(one)).await;
        assert_eq!(claim(&store, now()).await.lease.job, single, "it waits for the job at work only");
        work(&store, &running, now(), 10).await;
        // Both wait again: the one that has used less has its turn.
        let single = fit(&store, &rig, Some(one)).await;
        assert_eq!(claim(&store, now() + 10.seconds()).await.lease.job, single);
    }

    #[tokio::test]
    async fn turns_go_by_the_time_that_was_used_not_by_the_number_of_jobs() {
        let store = TestStore::open().await;
        let (rig, [long, short]) = (rig(&store, "bench").await, [new_id(now()), new_id(now())]);
        let mut at = now();
        let mut counts = [0; 2];
        let long_ones: Vec<JobId> = {
            let mut ids = Vec::new();
            for _ in 0..20 {
                ids.push(fit(&store, &rig, Some(long)).await);
                fit(&store, &rig, Some(short)).await;
            }
            ids
        };
        for _ in 0..20 {
            let claimed = claim(&store, at).await;
            let is_long = long_ones.contains(&claimed.lease.job);
            counts[usize::from(is_long)] += 1;
            let seconds = if is_long { 49 } else { 9 };
            work(&store, &claimed, at, seconds).await;
            at += seconds.seconds();
        }
        // With the second for the start a long one takes five times as long as a short one.
        assert_eq!(counts, [16, 4]);
    }

    #[tokio::test]
    async fn without_tokens_turns_go_round_between_rigs() {
        let store = TestStore::open().await;
        let (a, b) = (rig(&store, "a").await, rig(&store, "b").await);
        for _ in 0..3 {
            fit(&store, &a, None).await;
        }
        assert_eq!(claim(&store, now()).await.job.rig, a.id);
        fit(&store, &b, None).await;
        let turns = [claim(&store, now()).await.job.rig, claim(&store, now()).await.job.rig];
        assert_eq!(turns, [b.id, a.id]);
    }

    #[tokio::test]
    async fn a_diagnosis_comes_before_fits_of_a_policy_and_studies() {
        let store = TestStore::open().await;
        let mut draft = draft("bench");
        let policy = serde_json::json!({"min_total_s": 0.01, "fits": [{"kind": "frf"}]});
        draft.fit_policy = serde_json::from_value(policy).unwrap();
        let rig = store.insert_rig(&draft, None, now()).await.unwrap().unwrap();
        let by_policy = store.upload(&rig, &[1.0, 2.0]).await.jobs[0];
        let fit = fit(&store, &rig, None).await;
        let request: DiagnosisRequest = serde_json::from_value(serde_json::json!({"runs": []})).unwrap();
        let asker = Asker { token: Some(new_id(now())), max_waiting: 1 };
        let diagnosis = store.insert_job(&rig.id, &request, asker, None, now()).await.unwrap();
        let JobInsert::Queued(diagnosis) = diagnosis else { panic!("{diagnosis:?}") };
        assert_eq!(diagnosis.kind, JobKind::Diagnosis);
        // The token of the diagnosis has used more time than the others.
        let time = async |owner: String| {
            let mut tx = store.write().await.unwrap();
            add(&mut tx, &owner, &rig.id, 5.0, now()).await.unwrap();
            tx.commit().await.unwrap();
        };
        time(asker.token.unwrap().to_string()).await;
        let turns = [claim(&store, now()).await, claim(&store, now()).await, claim(&store, now()).await];
        assert_eq!(turns.map(|claim| claim.lease.job), [fit, diagnosis.id, by_policy]);
    }

    #[tokio::test]
    async fn a_running_study_gives_its_turn_to_what_is_more_urgent_and_then_waits_anew() {
        let store = TestStore::open().await;
        let rig = rig(&store, "bench").await;
        let asker = Asker { token: None, max_waiting: 9 };
        let study = serde_json::json!({"kind": "search", "fit": {"kind": "lstm"}});
        let study: StudyRequest = serde_json::from_value(study).unwrap();
        store.insert_job(&rig.id, &study, asker, None, now()).await.unwrap();
        let claimed = claim(&store, now()).await;
        let later = now() + 50.minutes();
        assert_eq!(store.goes_before(&claimed.lease, later).await.unwrap(), None);
        let fit = fit(&store, &rig, None).await;
        assert_eq!(store.goes_before(&claimed.lease, later).await.unwrap(), Some(Urgency::Requested));
        let request: DiagnosisRequest = serde_json::from_value(serde_json::json!({"runs": []})).unwrap();
        store.insert_job(&rig.id, &request, asker, None, now()).await.unwrap();
        assert_eq!(store.goes_before(&claimed.lease, later).await.unwrap(), Some(Urgency::Awaited));
        let lost = Lease { token: claimed.lease.token + 1, ..claimed.lease.clone() };
        assert_eq!(store.goes_before(&lost, later).await.unwrap(), None);
        // It was asked for long ago, but has waited from its last turn on only.
        assert!(store.finish_job(&claimed.lease, Outcome::Yielded, later).await.unwrap());
        assert_eq!(claim(&store, later).await.job.kind, JobKind::Diagnosis);
        assert_eq!(claim(&store, later).await.lease.job, fit);
        let again = claim(&store, later).await;
        assert_eq!((again.lease.job, again.job.attempt), (claimed.lease.job, 1), "no attempt was counted");
    }

    #[tokio::test]
    async fn a_clock_that_jumps_charges_a_minute_at_most() {
        let store = TestStore::open().await;
        let rig = rig(&store, "bench").await;
        fit(&store, &rig, None).await;
        let claimed = claim(&store, now()).await;
        work(&store, &claimed, now(), 10 * 365 * 86400).await;
        let used: f64 = sql("SELECT used_s FROM worker_time").fetch_one(store.reader()).await.unwrap();
        assert!((used - MOST.as_secs_f64()).abs() < 1.5, "{used}");
    }

    #[tokio::test]
    async fn a_token_may_have_so_many_waiting_jobs_and_no_more() {
        let store = TestStore::open().await;
        let rig = rig(&store, "bench").await;
        let [full, other] = [new_id(now()), new_id(now())];
        let request: FitRequest = serde_json::from_value(serde_json::json!({"kind": "frf"})).unwrap();
        let queue = async |token| {
            let asker = Asker { token: Some(token), max_waiting: 2 };
            store.insert_job(&rig.id, &request, asker, None, now()).await.unwrap()
        };
        for _ in 0..2 {
            assert!(matches!(queue(full).await, JobInsert::Queued(_)));
        }
        assert_eq!(queue(full).await, JobInsert::TooManyWaiting);
        assert!(matches!(queue(other).await, JobInsert::Queued(_)), "it has a limit of its own");
        claim(&store, now()).await;
        assert!(matches!(queue(full).await, JobInsert::Queued(_)), "a running job does not wait");
    }
}
