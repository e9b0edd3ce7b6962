//! Worker processes: the end of one costs one attempt of its job and affects nothing else.

use std::time::{Duration, Instant};

use rigcast::client::{Client, ClientError};
use serde_json::{Value, json};
use tempfile::TempDir;

use crate::support::{Program, bench, noise_csv, setting};

/// A program on a directory, with rigs `bench` and `good` that have noise.
struct Lab {
    program: Program,
    client: Client,
    directory: TempDir,
}

impl Lab {
    async fn start(environment: &[(&str, &str)]) -> Self {
        let directory = TempDir::new().expect("a directory");
        let program = Program::start(&directory, environment);
        let client = Client::new(program.base(), None).expect("a client");
        for id in ["bench", "good"] {
            let mut rig = bench();
            rig["id"] = id.into();
            client.post("/v1/rigs", &rig).await.expect("a rig");
            let noise = noise_csv(6000, 11).into_bytes();
            client.upload(id, &[("kind", "noise")], "text/csv", noise).await.expect("a run");
        }
        Self { program, client, directory }
    }

    /// Stops the program as a service manager does, and starts it again; returns the log of the first.
    async fn restart(self) -> (Self, Vec<String>) {
        self.program.signal("-TERM");
        let (code, log) = self.program.ended();
        assert_eq!(code, Some(0), "{log:?}");
        let program = Program::start(&self.directory, &[]);
        let client = Client::new(program.base(), None).expect("a client");
        (Self { program, client, ..self }, log)
    }

    /// Code of the problem with which a job fails.
    async fn failure(&self, job: &str) -> (String, Value) {
        match self.client.wait(job, |_| {}).await {
            Err(ClientError::Job { problem, .. }) => {
                let job = self.client.get(&format!("/v1/jobs/{job}")).await.expect("the job");
                (problem["code"].as_str().unwrap_or_default().to_owned(), job)
            }
            other => panic!("it should have failed: {other:?}"),
        }
    }

    /// Waits until the job has come so far.
    async fn once(&self, job: &str, progress: f64) {
        loop {
            let found = self.client.get(&format!("/v1/jobs/{job}")).await.expect("the job");
            assert!(
                !["succeeded", "failed"].contains(&found["state"].as_str().unwrap_or_default()),
                "{found}"
            );
            if found["state"] == "running" && found["progress"].as_f64() >= Some(progress) {
                return;
            }
            tokio::time::sleep(Duration::from_millis(20)).await;
        }
    }

    async fn fit(&self, rig: &str, request: &Value) -> String {
        self.client.fit(rig, request).await.expect("a job")
    }

    /// A network on the rig `good`, and service loads that take some seconds to evaluate.
    async fn with_loads(&self) {
        let network = json!({"kind": "lstm",
            "lstm": {"blocks": [39, 39], "window_len": 128, "epochs": 1, "seeds": [1]}});
        let job = self.fit("good", &network).await;
        self.client.wait(&job, |_| {}).await.expect("a model");
        for seed in 20..26 {
            let load = noise_csv(60_000, seed).into_bytes();
            let query = [("kind", "service"), ("split", "test")];
            self.client.upload("good", &query, "text/csv", load).await.expect("a run");
        }
    }

    async fn evaluation(&self) -> String {
        let job = self.client.post("/v1/rigs/good/evaluations", &json!({"models": ["active"]})).await;
        job.expect("a job")["id"].as_str().expect("an id").to_owned()
    }

    /// The job at its end, and its report without what tells one evaluation from another.
    async fn evaluated(&self, job: &str) -> (Value, Value) {
        let job = self.client.wait(job, |_| {}).await.expect("a report");
        let href = job["result"]["href"].as_str().expect("a report");
        let mut report = self.client.get(href).await.expect("a report");
        for name in ["id", "job", "created_at", "elapsed_s"] {
            report.as_object_mut().expect("an object").remove(name);
        }
        (job, report)
    }
}

fn frf() -> Value {
    json!({"kind": "frf"})
}

/// Some seconds of training, long enough to be interrupted.
fn seconds() -> Value {
    json!({"kind": "lstm", "lstm": {"blocks": [24], "window_len": 128, "epochs": 3000, "seeds": [1]}})
}

fn endless() -> Value {
    json!({"kind": "lstm", "lstm": {"blocks": [39], "epochs": 1_000_000, "seeds": [1]}})
}

#[tokio::test]
async fn a_job_that_kills_its_worker_fails_after_three_attempts_and_other_jobs_do_not_notice() {
    for (fault, code) in [("abort", "job.crashed"), ("overflow", "job.crashed"), ("hoard", "job.memory")] {
        let fault = format!("{fault}@bench");
        let environment = [("RIGCAST_TEST_FAULT", &*fault), ("RIGCAST_JOB_MEMORY_MIB", "300")];
        let lab = Lab::start(&environment).await;
        let poison = lab.fit("bench", &frf()).await;
        let good = lab.fit("good", &frf()).await;
        let (found, job) = lab.failure(&poison).await;
        assert_eq!((found.as_str(), &job["attempt"]), (code, &json!(3)), "{job}");
        lab.client.wait(&good, |_| {}).await.expect("the other job succeeds");
        assert_eq!(lab.client.get("/readyz").await.expect("it lives")["status"], "ready");
        lab.program.signal("-TERM");
        assert_eq!(lab.program.ended().0, Some(0));
    }
}

#[tokio::test]
async fn a_job_that_never_ends_is_cut_and_one_that_does_not_listen_is_cancelled_all_the_same() {
    let environment = [("RIGCAST_TEST_FAULT", "deaf@bench"), ("RIGCAST_JOB_TIME_LIMIT_S", "1")];
    let lab = Lab::start(&environment).await;
    let job = lab.fit("bench", &frf()).await;
    let (code, job) = lab.failure(&job).await;
    assert_eq!((code.as_str(), &job["attempt"]), ("job.time_limit", &json!(3)), "{job}");
    let lab = Lab::start(&environment[..1]).await;
    let job = lab.fit("bench", &frf()).await;
    lab.once(&job, 0.0).await;
    let asked = Instant::now();
    lab.client.post(&format!("/v1/jobs/{job}/cancel"), &json!({})).await.expect("noted");
    while lab.client.get(&format!("/v1/jobs/{job}")).await.expect("the job")["state"] != "cancelled" {
        assert!(asked.elapsed() < Duration::from_secs(10), "a cancel takes ten seconds at most");
        tokio::time::sleep(Duration::from_millis(50)).await;
    }
    assert_eq!(lab.program.children(), [] as [u32; 0], "its process is gone");
}

#[tokio::test]
async fn a_worker_that_is_killed_costs_one_attempt_and_the_model_is_the_same() {
    let lab = Lab::start(&[("RIGCAST_CHECKPOINT_S", "0.1")]).await;
    let whole = lab.fit("good", &seconds()).await;
    let whole = lab.client.wait(&whole, |_| {}).await.expect("a model");
    let job = lab.fit("good", &seconds()).await;
    lab.once(&job, 0.3).await;
    for pid in lab.program.children() {
        crate::support::signal("-KILL", pid);
    }
    let resumed = lab.client.wait(&job, |_| {}).await.expect("a model");
    assert_eq!((&whole["attempt"], &resumed["attempt"]), (&json!(1), &json!(2)));
    let digest = async |job: &Value| lab.client.fitted_model(job).await.expect("a model")["sha256"].clone();
    assert_eq!(digest(&whole).await, digest(&resumed).await, "bit for bit");
}

#[tokio::test]
async fn an_evaluation_whose_worker_is_killed_is_done_again_to_the_same_report() {
    let lab = Lab::start(&[]).await;
    lab.with_loads().await;
    let (whole, expected) = lab.evaluated(&lab.evaluation().await).await;
    assert_eq!(expected["runs"].as_array().map(Vec::len), Some(6), "{expected}");
    let job = lab.evaluation().await;
    // As soon as it is at work: on a quiet machine it is done before its progress is told.
    lab.once(&job, 0.0).await;
    let began = Instant::now();
    while !lab.program.children().into_iter().any(|pid| crate::support::try_signal("-KILL", pid)) {
        assert!(began.elapsed() < Duration::from_secs(10), "no worker was seen");
        tokio::time::sleep(Duration::from_millis(5)).await;
    }
    let (again, found) = lab.evaluated(&job).await;
    assert_eq!((&whole["attempt"], &again["attempt"]), (&json!(1), &json!(2)));
    assert_eq!(found, expected);
    let listed = lab.client.get("/v1/rigs/good/evaluations").await.expect("a list");
    assert_eq!(listed["items"].as_array().map(Vec::len), Some(2), "one report a job");
}

#[tokio::test]
async fn an_evaluation_that_is_cancelled_leaves_no_report() {
    let lab = Lab::start(&[]).await;
    lab.with_loads().await;
    let job = lab.evaluation().await;
    lab.once(&job, 0.0).await;
    lab.client.post(&format!("/v1/jobs/{job}/cancel"), &json!({})).await.expect("noted");
    let asked = Instant::now();
    while lab.client.get(&format!("/v1/jobs/{job}")).await.expect("the job")["state"] != "cancelled" {
        assert!(asked.elapsed() < Duration::from_secs(10), "a cancel takes ten seconds at most");
        tokio::time::sleep(Duration::from_millis(20)).await;
    }
    let listed = lab.client.get("/v1/rigs/good/evaluations").await.expect("a list");
    assert_eq!(listed["items"], json!([]));
}

#[tokio::test]
async fn a_stop_puts_the_running_fit_by_and_the_next_start_goes_on_with_it() {
    let lab = Lab::start(&[]).await;
    let whole = lab.fit("good", &seconds()).await;
    let whole = lab.client.wait(&whole, |_| {}).await.expect("a model");
    let job = lab.fit("good", &seconds()).await;
    lab.once(&job, 0.3).await;
    let (lab, _) = lab.restart().await;
    let resumed = lab.client.wait(&job, |_| {}).await.expect("a model");
    assert_eq!(resumed["attempt"], 1, "a stop is no failure");
    let digest = async |job: &Value| lab.client.fitted_model(job).await.expect("a model")["sha256"].clone();
    assert_eq!(digest(&whole).await, digest(&resumed).await, "bit for bit");
    let (_, log) = lab.restart().await;
    assert!(log.iter().any(|line| line.contains("goes on from its checkpoints")), "{log:?}");
}

#[tokio::test]
async fn workers_end_with_a_server_that_is_killed_frozen_ones_too() {
    for frozen in [false, true] {
        let lab = Lab::start(&[]).await;
        let job = lab.fit("bench", &endless()).await;
        lab.once(&job, 0.0).await;
        // A job is claimed a moment before its worker starts.
        let mut children = lab.program.children();
        while children.is_empty() {
            tokio::time::sleep(Duration::from_millis(20)).await;
            children = lab.program.children();
        }
        assert_eq!(children.len(), 1);
        // Its first act is to tie its life to the server's; what it does next shows that it has.
        let tied = format!("/proc/{}/oom_score_adj", children[0]);
        while std::fs::read_to_string(&tied).expect("it lives").trim() != "1000" {
            tokio::time::sleep(Duration::from_millis(20)).await;
        }
        if frozen {
            crate::support::signal("-STOP", children[0]);
        }
        lab.program.kill();
        let killed = Instant::now();
        while crate::support::lives(children[0]) {
            assert!(killed.elapsed() < Duration::from_secs(5), "it outlives its server");
            tokio::time::sleep(Duration::from_millis(20)).await;
        }
    }
}

#[tokio::test]
async fn a_worker_that_freezes_past_its_lease_never_makes_a_second_model() {
    let rounds: usize = setting("RIGCAST_TEST_FREEZES", 2);
    let environment =
        [("RIGCAST_LEASE_S", "1.5"), ("RIGCAST_HEARTBEAT_S", "0.5"), ("RIGCAST_SWEEP_S", "0.5")];
    let lab = Lab::start(&environment).await;
    for round in 1..=rounds {
        let job = lab.fit("good", &seconds()).await;
        lab.once(&job, 0.05 + 0.4 * (round as f64 / rounds as f64)).await;
        // The worker, or every other time the server itself.
        let server = round % 2 == 0;
        let frozen = if server { vec![lab.program.id()] } else { lab.program.children() };
        frozen.iter().for_each(|pid| crate::support::signal("-STOP", *pid));
        tokio::time::sleep(Duration::from_millis(2500)).await;
        for pid in frozen {
            // A worker is gone by now.
            crate::support::try_signal("-CONT", pid);
        }
        let ended = lab.client.wait(&job, |_| {}).await.expect("a model");
        assert_eq!(ended["attempt"], if server { 1 } else { 2 }, "{ended}");
        let models = lab.client.get("/v1/rigs/good/models?limit=1000").await.expect("models");
        assert_eq!(models["items"].as_array().map(Vec::len), Some(round), "one model a job");
    }
    println!("a worker or its server frozen past the lease {rounds} times: one model a job");
}

#[test]
fn a_worker_that_nobody_tells_what_to_do_says_so() {
    let mut alone = crate::support::rigcast(&["job"]);
    let ended = alone.stdin(std::process::Stdio::null()).output().expect("it ends");
    assert_eq!(ended.status.code(), Some(1));
    assert!(String::from_utf8_lossy(&ended.stderr).contains("rigcast serve"), "{ended:?}");
}
