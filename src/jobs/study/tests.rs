//! Studies that are interrupted: by the end of the service, and by a job that is more urgent.

use std::time::Duration;

use serde_json::json;

use crate::domain::study::SearchReport;
use crate::domain::{DiagnosisRequest, Job, JobId, JobState, Rig, StudyReport, StudyRequest};
use crate::engine::model::fit_resumable;
use crate::jobs::Jobs;
use crate::jobs::tests::{noise, start};
use crate::storage::testing::{TestStore, draft, now};
use crate::storage::{Asker, JobInsert};

/// Trials that take some tenths of a second together, and a last fit.
fn request() -> StudyRequest {
    let lstm = json!({"window_len": 32, "hop": 16, "epochs": 40, "seeds": [1]});
    let fit = json!({"kind": "lstm", "lstm": lstm, "activate": "never"});
    let space = json!({"cells": {"min": 3, "max": 8}, "learning_rate": {"min": 1e-3, "max": 1e-2}});
    serde_json::from_value(json!({"kind": "search", "trials": 6, "fit": fit, "space": space})).unwrap()
}

struct Bench {
    store: TestStore,
    rig: Rig,
}

impl Bench {
    async fn new() -> Self {
        let store = TestStore::open().await;
        let rig = store.insert_rig(&draft("bench"), None, now()).await.unwrap().unwrap();
        store.upload(&rig, &noise(1, 4000)).await;
        Self { store, rig }
    }

    async fn submit(&self, jobs: &Jobs) -> JobId {
        jobs.submit_study(&self.rig, &request(), None, None).await.unwrap().id
    }

    async fn table(&self, id: JobId) -> Option<SearchReport> {
        match self.store.study(&self.rig.id, id).await.unwrap().unwrap().report? {
            StudyReport::Search(report) => Some(report),
            other => panic!("{other:?}"),
        }
    }

    /// Waits until so many trials are in the table.
    async fn with_trials(&self, id: JobId, n: usize) -> SearchReport {
        loop {
            if let Some(table) = self.table(id).await
                && table.trials.len() >= n
            {
                return table;
            }
            tokio::time::sleep(Duration::from_millis(2)).await;
        }
    }

    async fn job(&self, id: JobId) -> Job {
        self.store.job(id).await.unwrap().unwrap()
    }

    async fn ended(&self, id: JobId) -> Job {
        loop {
            let job = self.job(id).await;
            if job.state.is_terminal() {
                return job;
            }
            tokio::time::sleep(Duration::from_millis(5)).await;
        }
    }

    /// The weights of the model that the study has published.
    async fn weights(&self, id: JobId) -> bytes::Bytes {
        let study = self.store.study(&self.rig.id, id).await.unwrap().unwrap();
        let model = self.store.model(&self.rig.id, study.summary.model.unwrap()).await.unwrap().unwrap();
        self.store.weights(&model).await.unwrap()
    }
}

#[tokio::test]
async fn a_study_that_is_interrupted_goes_on_to_the_same_table_and_the_same_model() {
    let whole = Bench::new().await;
    let jobs = start(&whole.store, fit_resumable).await;
    let id = whole.submit(&jobs).await;
    assert_eq!(whole.ended(id).await.state, JobState::Succeeded);
    let (table, weights) = (whole.table(id).await.unwrap(), whole.weights(id).await);
    assert_eq!(table.trials.len(), 6);
    jobs.shutdown().await;

    let cut = Bench::new().await;
    let jobs = start(&cut.store, fit_resumable).await;
    let id = cut.submit(&jobs).await;
    let before = cut.with_trials(id, 2).await;
    jobs.shutdown().await;
    assert_eq!(cut.job(id).await.state, JobState::Queued);
    let kept = cut.table(id).await.unwrap();
    assert!(kept.trials.starts_with(&before.trials), "what was seen is kept: {kept:?}");
    let jobs = start(&cut.store, fit_resumable).await;
    let job = cut.ended(id).await;
    assert_eq!((job.state, job.attempt), (JobState::Succeeded, 1), "{job:?}");
    assert_eq!(cut.table(id).await.unwrap(), table);
    assert!(cut.weights(id).await == weights, "bit for bit");
    assert_eq!(cut.store.count_checkpoints().await, 0);
    jobs.shutdown().await;
}

#[tokio::test]
async fn a_diagnosis_that_somebody_waits_for_goes_before_a_running_study() {
    let bench = Bench::new().await;
    let jobs = start(&bench.store, fit_resumable).await;
    let id = bench.submit(&jobs).await;
    let before = bench.with_trials(id, 1).await;
    // It names no run of the rig, so it fails as soon as it is its turn.
    let asker = Asker { token: None, max_waiting: 9 };
    let diagnosis: DiagnosisRequest = serde_json::from_value(json!({"runs": []})).unwrap();
    let queued = bench.store.insert_job(&bench.rig.id, &diagnosis, asker, None, now()).await.unwrap();
    let JobInsert::Queued(diagnosis) = queued else { panic!("{queued:?}") };
    assert_eq!(bench.ended(diagnosis.id).await.state, JobState::Failed);
    let between = bench.job(id).await;
    assert!(!between.state.is_terminal(), "the study was not waited for: {between:?}");
    let job = bench.ended(id).await;
    assert_eq!((job.state, job.attempt), (JobState::Succeeded, 1), "{job:?}");
    let after = bench.table(id).await.unwrap();
    assert!(after.trials.starts_with(&before.trials) && after.trials.len() == 6, "{after:?}");
    jobs.shutdown().await;
}
