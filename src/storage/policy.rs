//! The fit policy: the fits that an accepted run starts.
//!
//! Each fit of the list is queued at most once at a time. A run that arrives while the fit is queued
//! joins it, because a job selects its runs when it starts. A run that arrives while the fit is running
//! queues it once more. The last round therefore sees all runs, and a burst of uploads costs at most two
//! rounds.

use jiff::Timestamp;

use super::StoreError;
use super::database::{Session, sql};
use super::jobs::{JobOrigin, insert};
use super::rows::json;
use crate::domain::fits::FitRequest;
use crate::domain::{FitPolicy, JobId, JobKind, Rig, RigId, Run, RunId, RunKind, Split, TokenId};

/// A run as the policy looks at it.
pub(super) struct PolicyRun {
    pub(super) kind: RunKind,
    pub(super) split: Split,
    /// An earlier run with the same bytes.
    pub(super) duplicate_of: Option<RunId>,
    /// Its length while the store does not have it yet, s; else 0.
    pub(super) unstored_s: f64,
}

/// What the policy makes of a run.
pub(super) struct Decision<'a> {
    /// Each fit once, and the queued job that the run joins, if there is one.
    pub(super) fits: Vec<(&'a FitRequest, Option<JobId>)>,
    /// The reason for no fits.
    reason: Option<String>,
}

impl<'a> Decision<'a> {
    fn none(reason: impl Into<String>) -> Self {
        Self { fits: Vec::new(), reason: Some(reason.into()) }
    }

    /// The reason for no fits, or their number; `queued` are the words for those that are new.
    pub(super) fn words(self, queued: &str) -> String {
        let joined = self.fits.iter().filter(|(_, job)| job.is_some()).count();
        self.reason.unwrap_or_else(|| outcome(self.fits.len() - joined, joined, queued))
    }
}

/// Applies the rig's policy to a run that a token has just added; its jobs are the token's. Gives the jobs that it queued or joined, and a
/// sentence: the reason for no jobs, or the number of fits.
pub(super) async fn after_run(
    connection: &mut Session,
    rig: &Rig,
    run: &Run,
    token: Option<TokenId>,
    now: Timestamp,
) -> Result<(Vec<JobId>, String), StoreError> {
    let run = PolicyRun { kind: run.kind, split: run.split, duplicate_of: run.duplicate_of, unstored_s: 0.0 };
    let decision = decide(connection, rig, &run).await?;
    let mut jobs = Vec::with_capacity(decision.fits.len());
    for (fit, queued) in &decision.fits {
        jobs.push(match queued {
            Some(id) => *id,
            None => {
                let (kind, origin) = (JobKind::Fit, JobOrigin::Policy);
                insert(connection, &rig.id, kind, fit, origin, token, now).await?.id
            }
        });
    }
    Ok((jobs, decision.words("queued")))
}

/// What the rig's policy makes of a run; changes nothing.
pub(super) async fn decide<'a>(
    connection: &mut Session,
    rig: &'a Rig,
    run: &PolicyRun,
) -> Result<Decision<'a>, StoreError> {
    let Some(policy) = &rig.fit_policy else { return Ok(Decision::none("the rig has no fit_policy")) };
    if policy.fits.is_empty() {
        return Ok(Decision::none("the rig's fit_policy names no fits"));
    }
    if let Some(reason) = does_not_count(policy, run) {
        return Ok(Decision::none(reason));
    }
    let total_s = total(connection, &rig.id, policy).await? + run.unstored_s;
    // The tolerance makes sixty runs of one second a minute, whatever the rounding of their sum.
    if total_s < policy.min_total_s * (1.0 - 1e-9) {
        let (total, wanted) = (rounded_down(total_s, policy.min_total_s), policy.min_total_s);
        return Ok(Decision::none(format!("{total} of {wanted:?} s of {}", kinds(policy))));
    }
    let mut fits: Vec<(&FitRequest, Option<JobId>)> = Vec::with_capacity(policy.fits.len());
    for fit in &policy.fits {
        // The same fit twice in a policy is one job.
        if !fits.iter().any(|(known, _)| *known == fit) {
            fits.push((fit, queued(connection, &rig.id, fit).await?));
        }
    }
    Ok(Decision { fits, reason: None })
}

/// The job of the rig's policy that is queued for this fit.
async fn queued(
    connection: &mut Session,
    rig: &RigId,
    fit: &FitRequest,
) -> Result<Option<JobId>, StoreError> {
    let id: Option<String> = sql("SELECT id FROM jobs
         WHERE rig = $1 AND state = 'queued' AND origin = 'policy' AND request = $2
         ORDER BY id LIMIT 1")
    .bind(rig.as_str())
    .bind(json(fit))
    .fetch_optional(connection)
    .await?;
    let parse = |id: String| {
        id.parse().map_err(|error: uuid::Error| StoreError::Row {
            table: "jobs",
            key: id.clone(),
            what: error.to_string(),
        })
    };
    id.map(parse).transpose()
}

/// All reasons why a run cannot start a fit, whatever other runs there are.
fn does_not_count(policy: &FitPolicy, run: &PolicyRun) -> Option<String> {
    let mut reasons = Vec::new();
    if run.split != Split::Training {
        reasons.push(format!("split {} is not training", run.split.as_str()));
    }
    if !policy.kinds.contains(&run.kind) {
        reasons.push(format!("kind {} is not among {}", run.kind.as_str(), kinds(policy)));
    }
    // A duplicate adds no data.
    if let Some(earlier) = run.duplicate_of {
        reasons.push(format!("run {earlier} has the same bytes"));
    }
    if reasons.is_empty() { None } else { Some(reasons.join("; ")) }
}

/// The policy's kinds of run.
fn kinds(policy: &FitPolicy) -> String {
    let kinds: Vec<&str> = policy.kinds.iter().map(|kind| kind.as_str()).collect();
    if kinds.is_empty() { "no kinds".into() } else { kinds.join(", ") }
}

/// Seconds, rounded down so that too few never look like enough.
fn rounded_down(total_s: f64, wanted: f64) -> String {
    let digits = if wanted >= 10.0 { 1 } else { 3 };
    let unit = 10_f64.powi(digits);
    format!("{:.*}", digits as usize, (total_s * unit).floor() / unit)
}

fn outcome(new: usize, joined: usize, queued: &str) -> String {
    let fits = |n: usize| format!("{n} fit{}", if n == 1 { "" } else { "s" });
    match (new, joined) {
        (new, 0) => format!("{} {queued}", fits(new)),
        (0, joined) => format!("{} queued already, which the run joins", fits(joined)),
        (new, joined) => format!("{} {queued}, {joined} queued already, which the run joins", fits(new)),
    }
}

/// Seconds of the rig's training runs of these kinds, each measurement once.
async fn total(connection: &mut Session, rig: &RigId, policy: &FitPolicy) -> Result<f64, StoreError> {
    let kinds: Vec<&str> = policy.kinds.iter().copied().map(RunKind::as_str).collect();
    let total_s: f64 = sql("SELECT coalesce(sum(duration_s), 0.0) FROM runs
         WHERE rig = $1 AND split = 'training' AND duplicate_of IS NULL
           AND kind IN (SELECT value FROM json_each($2))")
    .bind(rig.as_str())
    .bind(json(&kinds))
    .fetch_one(connection)
    .await?;
    Ok(total_s)
}

#[cfg(test)]
mod tests {
    use jiff::ToSpan;
    use serde_json::json;

    use super::super::testing::{TestStore, draft, meta, now};
    use super::*;
    use crate::domain::RunMeta;

    /// A rig that fits FRF and hybrid 2 from two seconds of noise (100 Hz).
    async fn rig_with_policy(store: &TestStore) -> Rig {
        let mut draft = draft("bench");
        draft.fit_policy = serde_json::from_value(json!({
            "kinds": ["noise"], "min_total_s": 2.0, "fits": [{"kind": "frf"}, {"kind": "hybrid2"}]
        }))
        .unwrap();
        store.insert_rig(&draft, None, now()).await.unwrap().unwrap()
    }

    /// An empty list of jobs, typed for comparisons.
    const NONE: [JobId; 0] = [];

    fn second(seed: f64) -> Vec<f64> {
        (0..100).map(|i| seed + f64::from(i)).collect()
    }

    #[tokio::test]
    async fn nothing_is_queued_before_the_runs_are_long_enough() {
        let store = TestStore::open().await;
        let rig = rig_with_policy(&store).await;
        assert_eq!(store.upload(&rig, &second(1.0)).await.jobs, NONE);
        let mut service = meta();
        service.kind = RunKind::Service;
        assert_eq!(store.upload_with(&rig, service, &second(2.0)).await.jobs, NONE);
        let mut test = meta();
        test.split = Split::Test;
        assert_eq!(store.upload_with(&rig, test, &second(3.0)).await.jobs, NONE);
        assert_eq!(store.upload(&rig, &second(1.0)).await.jobs, NONE, "a duplicate does not count");
        assert_eq!(store.upload(&rig, &second(4.0)).await.jobs.len(), 2);
    }

    #[tokio::test]
    async fn a_run_joins_what_is_queued_and_asks_for_one_more_round_of_what_is_running() {
        let store = TestStore::open().await;
        let rig = rig_with_policy(&store).await;
        store.upload(&rig, &second(1.0)).await;
        let first = store.upload(&rig, &second(2.0)).await.jobs;
        assert_eq!(first.len(), 2);
        assert_eq!(store.upload(&rig, &second(3.0)).await.jobs, first, "joined");
        assert_eq!(store.upload(&rig, &second(3.0)).await.jobs, NONE, "a duplicate sets nothing off");
        // The FRF starts: it is queued once more, the hybrid is joined.
        let claim = store.claim_job("w", now() + 30.seconds(), now()).await.unwrap().unwrap();
        assert_eq!(claim.job.id, first[0]);
        let second_round = store.upload(&rig, &second(4.0)).await.jobs;
        assert_eq!((second_round.len(), second_round[1]), (2, first[1]));
        assert!(!first.contains(&second_round[0]));
        assert_eq!(store.upload(&rig, &second(5.0)).await.jobs, second_round, "no third round");
        // Jobs start in the order in which they were queued.
        let next = store.claim_job("w", now() + 30.seconds(), now()).await.unwrap().unwrap();
        assert_eq!(next.job.id, first[1]);
    }

    #[tokio::test]
    async fn fits_that_a_person_asked_for_are_not_the_policys() {
        let store = TestStore::open().await;
        let rig = rig_with_policy(&store).await;
        let asked = store.queue_fit(&rig).await;
        store.upload(&rig, &second(1.0)).await;
        let jobs = store.upload(&rig, &second(2.0)).await.jobs;
        assert_eq!(jobs.len(), 2);
        assert!(!jobs.contains(&asked.id));
    }

    #[tokio::test]
    async fn many_short_runs_make_up_the_length_in_spite_of_rounding() {
        let store = TestStore::open().await;
        let rig = rig_with_policy(&store).await;
        for i in 0..19 {
            let run: Vec<f64> = (0..10).map(|k| f64::from(100 * i + k)).collect();
            assert_eq!(store.upload(&rig, &run).await.jobs, NONE);
        }
        assert_eq!(store.upload(&rig, &second(-1e3)[..10]).await.jobs.len(), 2);
    }

    #[tokio::test]
    async fn the_outcome_of_an_upload_is_told_in_words() {
        let store = TestStore::open().await;
        let plain = store.insert_rig(&draft("plain"), None, now()).await.unwrap().unwrap();
        assert_eq!(store.upload(&plain, &second(1.0)).await.policy, "the rig has no fit_policy");
        let rig = rig_with_policy(&store).await;
        let with = |kind, split| RunMeta { kind, split, ..meta() };
        let first = store.upload(&rig, &second(1.0)).await;
        assert_eq!(first.policy, "1.000 of 2.0 s of noise");
        let other = store.upload_with(&rig, with(RunKind::Other, Split::Training), &second(2.0)).await;
        assert_eq!(other.policy, "kind other is not among noise");
        let held_back = store.upload_with(&rig, with(RunKind::Sweep, Split::Validation), &second(3.0)).await;
        assert_eq!(held_back.policy, "split validation is not training; kind sweep is not among noise");
        let again = store.upload(&rig, &second(1.0)).await;
        assert_eq!(again.policy, format!("run {} has the same bytes", first.run.id));
        assert_eq!(store.upload(&rig, &second(4.0)).await.policy, "2 fits queued");
        let joined = store.upload(&rig, &second(5.0)).await;
        assert_eq!(
            (joined.jobs.len(), joined.policy.as_str()),
            (2, "2 fits queued already, which the run joins")
        );
        store.claim_job("w", now() + 30.seconds(), now()).await.unwrap().unwrap();
        let both = store.upload(&rig, &second(6.0)).await.policy;
        assert_eq!(both, "1 fit queued, 1 queued already, which the run joins");
    }

    #[test]
    fn seconds_that_are_missing_are_never_rounded_away() {
        assert_eq!(rounded_down(59.99, 60.0), "59.9");
        assert_eq!(rounded_down(42.0, 60.0), "42.0");
        assert_eq!(rounded_down(0.0499, 0.05), "0.049");
    }
}
