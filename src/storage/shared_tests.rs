//! Two processes on one registry. Skipped unless the tests have a PostgreSQL (`RIGCAST_TEST_DATABASE`).

use std::collections::BTreeSet;
use std::time::{Duration, Instant};

use bytes::Bytes;
use jiff::{Timestamp, ToSpan};

use super::testing::{TestStore, draft, imported, now};
use super::{Activation, Asker, Checkpoint, Digest, Store, StoreError, StoreSettings};
use crate::domain::job::MAX_SERVICE_DEATHS;
use crate::domain::{JobId, JobState, Rig, StudyRequest};

/// Two processes.
async fn two() -> Option<[TestStore; 2]> {
    let store = TestStore::open().await;
    if !store.is_shared() {
        println!("skipped: RIGCAST_TEST_DATABASE names no PostgreSQL");
        return None;
    }
    let other = store.beside().await;
    Some([store, other])
}

#[tokio::test(flavor = "multi_thread")]
async fn each_job_is_claimed_once_whoever_asks() {
    let Some([a, b]) = two().await else { return };
    let rig = a.insert_rig(&draft("bench"), None, now()).await.unwrap().unwrap();
    let mut queued = BTreeSet::new();
    for _ in 0..20 {
        queued.insert(a.queue_fit(&rig).await.id);
    }
    let claim_all = async |store: &Store| {
        let mut claimed: Vec<JobId> = Vec::new();
        while let Some(claim) = store.claim_job("w", now() + 30.seconds(), now()).await.unwrap() {
            claimed.push(claim.lease.job);
        }
        claimed
    };
    let (one, other) = tokio::join!(claim_all(&a), claim_all(&b));
    assert_eq!(one.len() + other.len(), 20);
    assert_eq!(one.into_iter().chain(other).collect::<BTreeSet<_>>(), queued);
}

#[tokio::test]
async fn a_lease_that_ends_is_the_death_of_its_process_and_costs_no_attempt() {
    let Some([a, b]) = two().await else { return };
    let rig = a.insert_rig(&draft("bench"), None, now()).await.unwrap().unwrap();
    let id = a.queue_fit(&rig).await.id;
    for _ in 0..MAX_SERVICE_DEATHS {
        let claimed = a.claim_job("w", now() + 30.seconds(), now()).await.unwrap().unwrap();
        assert_eq!(claimed.job.attempt, 1);
        assert_eq!(b.requeue_expired(now(), &[], now()).await.unwrap().len(), 0, "its lease lasts");
        assert_eq!(a.requeue_expired(Timestamp::MAX, &[id], now()).await.unwrap().len(), 0, "at work here");
        assert_eq!(b.requeue_expired(Timestamp::MAX, &[], now()).await.unwrap(), [id]);
        assert!(!a.finish_job(&claimed.lease, super::Outcome::Cancelled, now()).await.unwrap());
    }
    a.claim_job("w", now() + 30.seconds(), now()).await.unwrap().unwrap();
    b.requeue_expired(Timestamp::MAX, &[], now()).await.unwrap();
    let job = b.job(id).await.unwrap().unwrap();
    assert_eq!((job.state, job.problem.unwrap().code.as_str()), (JobState::Failed, "job.interrupted"));
}

#[tokio::test(flavor = "multi_thread")]
async fn an_object_that_one_process_stores_is_not_removed_by_another() {
    let Some([a, b]) = two().await else { return };
    let rig = a.insert_rig(&draft("bench"), None, now()).await.unwrap().unwrap();
    let bytes = Bytes::from_static(b"weights");
    let digest = Digest::of(&bytes);
    // Nothing names the object yet, and the other process would remove it.
    let kept = a.keep_object(&digest).await.unwrap();
    a.objects().put(&digest, bytes.clone()).await.unwrap();
    let before = Instant::now();
    b.discard_unreferenced(vec![digest.as_str().to_owned()]).await;
    assert_eq!(a.objects().get(digest.as_str()).await.unwrap(), bytes);
    // However long that takes, other objects come and go.
    let model = imported(b"others");
    let others = b.insert_model(&rig.id, model, Activation::Leave, None, now()).await.unwrap().unwrap();
    b.delete_model(&rig.id, others.version).await.unwrap();
    let read = b.beside().await.objects().get(&others.sha256).await;
    assert!(matches!(read, Err(StoreError::ObjectMissing { .. })), "{read:?}");
    assert!(before.elapsed() < Duration::from_secs(4), "{:?}", before.elapsed());
    drop(kept);
    let model = imported(b"weights");
    let inserted = a.insert_model(&rig.id, model, Activation::Leave, None, now()).await.unwrap().unwrap();
    assert_eq!(b.weights(&inserted).await.unwrap(), bytes);
    // The last row takes it along, for every process.
    b.delete_model(&rig.id, inserted.version).await.unwrap();
    let fresh = a.beside().await;
    let read = fresh.objects().get(digest.as_str()).await;
    assert!(matches!(read, Err(StoreError::ObjectMissing { .. })), "{read:?}");
}

#[tokio::test(flavor = "multi_thread")]
async fn changes_of_jobs_are_heard_by_every_process() {
    let Some([a, b]) = two().await else { return };
    let rig = a.insert_rig(&draft("bench"), None, now()).await.unwrap().unwrap();
    let (told, mut heard) = tokio::sync::mpsc::unbounded_channel();
    let listening = tokio::spawn(async move {
        b.hear_of_jobs(|id, waits| told.send((id, waits)).unwrap()).await;
    });
    let mut queued = BTreeSet::new();
    let first = loop {
        // It listens from some moment on.
        queued.insert(a.queue_fit(&rig).await.id);
        if let Ok(first) = tokio::time::timeout(Duration::from_millis(100), heard.recv()).await {
            break first.unwrap();
        }
    };
    assert!(queued.contains(&first.0) && first.1);
    let claimed = a.claim_job("w", now() + 30.seconds(), now()).await.unwrap().unwrap();
    while heard.recv().await.unwrap() != (claimed.lease.job, false) {}
    listening.abort();
}

#[tokio::test]
async fn one_process_at_a_time_judges_runs() {
    let Some([a, b]) = two().await else { return };
    let turn = a.drift_turn().await.unwrap();
    assert!(turn.is_some() && b.drift_turn().await.unwrap().is_none());
    drop(turn);
    for _ in 0..100 {
        if b.drift_turn().await.unwrap().is_some() {
            return;
        }
        tokio::time::sleep(Duration::from_millis(20)).await;
    }
    panic!("the turn is never given back");
}

async fn queue_study(store: &Store, rig: &Rig) {
    let study = serde_json::json!({"kind": "search", "fit": {"kind": "lstm"}});
    let study: StudyRequest = serde_json::from_value(study).unwrap();
    let asker = Asker { token: None, max_waiting: 9 };
    store.insert_job(&rig.id, &study, asker, None, now()).await.unwrap();
}

/// The checkpoint that says that a fit has shares, and how long it counts.
const OFFER: (&str, Duration) = ("share offer", Duration::from_secs(10));

#[tokio::test]
async fn a_fit_is_helped_while_it_offers_shares_and_before_a_study() {
    let Some([a, b]) = two().await else { return };
    let rig = a.insert_rig(&draft("bench"), None, now()).await.unwrap().unwrap();
    queue_study(&a, &rig).await;
    a.claim_job("w", now() + 30.seconds(), now()).await.unwrap().unwrap();
    a.queue_fit(&rig).await;
    let fit = a.claim_job("w", now() + 30.seconds(), now()).await.unwrap().unwrap();
    let to_help = async || b.job_to_help(&[], OFFER).await.unwrap().unwrap().lease;
    assert_ne!(to_help().await, fit.lease, "it offers nothing");
    let time = a.shared_time().await.unwrap().unwrap();
    for (part, at, is_open) in [
        ("seed 1", time, false),
        ("share offer", time - 11.seconds(), false),
        ("share offer", time, true),
        ("share offer", time - 12.seconds(), false),
    ] {
        let share = Checkpoint { part: part.into(), fits: "fit".into(), state: Bytes::from_static(b"{}") };
        assert!(a.keep_checkpoint(&fit.lease, &share, at).await.unwrap());
        assert_eq!(to_help().await == fit.lease, is_open, "{part} at {at}");
    }
}

#[tokio::test]
async fn a_running_study_is_helped_until_it_ends_or_a_job_waits() {
    let Some([a, b]) = two().await else { return };
    let rig = a.insert_rig(&draft("bench"), None, now()).await.unwrap().unwrap();
    queue_study(&a, &rig).await;
    assert_eq!(b.job_to_help(&[], OFFER).await.unwrap(), None, "it only waits");
    let claimed = a.claim_job("w", now() + 30.seconds(), now()).await.unwrap().unwrap();
    let found = b.job_to_help(&[], OFFER).await.unwrap().unwrap();
    assert_eq!((&found.lease, &found.request), (&claimed.lease, &claimed.request));
    assert_eq!(b.job_to_help(std::slice::from_ref(&found.lease), OFFER).await.unwrap(), None);
    assert!(b.wants_help(&found.lease).await.unwrap());

    // What the helper makes are checkpoints under the lease of the job's own worker.
    let state = Bytes::from_static(b"{}");
    let share = Checkpoint { part: "share 3-0".into(), fits: "study".into(), state: state.clone() };
    let at = a.shared_time().await.unwrap().unwrap();
    assert!(b.keep_checkpoint(&found.lease, &share, at).await.unwrap());
    let shares = a.shares(claimed.job.id, "study").await.unwrap();
    assert_eq!((shares.len(), &*shares[0].0, &shares[0].1[..]), (1, "share 3-0", &state[..]));
    assert!(shares[0].2 < Duration::from_secs(60), "{:?}", shares[0].2);
    assert_eq!(a.shares(claimed.job.id, "another study").await.unwrap(), []);

    a.queue_fit(&rig).await;
    assert!(!b.wants_help(&found.lease).await.unwrap(), "a job waits");
    b.claim_job("w", now() + 30.seconds(), now()).await.unwrap().unwrap();
    assert!(b.wants_help(&found.lease).await.unwrap());
    a.finish_job(&claimed.lease, super::Outcome::Cancelled, now()).await.unwrap();
    assert!(!b.wants_help(&found.lease).await.unwrap());
    assert!(!b.keep_checkpoint(&found.lease, &share, at).await.unwrap(), "it has ended");
}

#[tokio::test]
async fn the_process_of_a_job_reads_and_cannot_write() {
    let Some([a, _]) = two().await else { return };
    a.insert_rig(&draft("bench"), None, now()).await.unwrap();
    let settings = StoreSettings { bucket: None, ..a.settings().clone() };
    let reader = Store::open_to_read(a.data_dir(), &settings).await.unwrap();
    assert!(reader.rig(&"bench".parse().unwrap()).await.unwrap().is_some());
    assert!(reader.insert_rig(&draft("other"), None, now()).await.unwrap_err().is_unavailable());
    let time = reader.shared_time().await.unwrap().unwrap();
    assert!(time.duration_since(Timestamp::now()).abs() < jiff::SignedDuration::from_secs(5));
}
