//! The real program, killed at random times during uploads, imports, fits and publishing: everything that
//! it has acknowledged is intact after every restart, and every job succeeds.
//!
//! `RIGCAST_TEST_KILLS=200 cargo test --test api kills -- --nocapture` kills more often.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rigcast::client::Client;
use serde_json::{Value, json};
use sha2::{Digest, Sha256};
use tempfile::TempDir;

use crate::support::{Program, bench, further, gain_weights, noise_csv, setting};

/// Uploads and imports that the program has acknowledged.
#[derive(Debug, Clone, Default)]
struct Acknowledged {
    /// Digest of each run by its id.
    runs: BTreeMap<String, String>,
    /// Digest of each imported model by its version.
    models: BTreeMap<u64, String>,
    jobs: BTreeSet<String>,
}

/// Longest time after a start in which interrupted jobs are resumed and these short ones end.
const LIMIT: Duration = Duration::from_secs(60);

type Shared = Arc<Mutex<Acknowledged>>;

const ENVIRONMENT: [(&str, &str); 4] = [
    ("RIGCAST_LEASE_S", "3"),
    ("RIGCAST_HEARTBEAT_S", "0.5"),
    ("RIGCAST_SWEEP_S", "0.5"),
    ("RIGCAST_CHECKPOINT_S", "0.3"),
];

fn random() -> ChaCha8Rng {
    let clock = std::time::SystemTime::UNIX_EPOCH.elapsed().expect("after 1970").as_millis();
    let seed = setting("RIGCAST_TEST_SEED", clock as u64 % 1_000_000);
    println!("RIGCAST_TEST_SEED={seed}");
    ChaCha8Rng::seed_from_u64(seed)
}

fn hex(bytes: &[u8]) -> String {
    Sha256::digest(bytes).iter().map(|b| format!("{b:02x}")).collect()
}

fn text(value: &Value) -> String {
    value.as_str().unwrap_or_else(|| panic!("no text: {value}")).to_owned()
}

/// Uploads until the program is gone.
async fn upload(base: String, seen: Shared, mut seed: u64) {
    let client = Client::new(&base, None).expect("a client");
    loop {
        seed += 1;
        let file = noise_csv(3000, seed).into_bytes();
        let digest = hex(&file);
        let Ok(run) = client.upload("bench", &[("kind", "noise")], "text/csv", file).await else { return };
        assert_eq!(run["sha256"], digest);
        seen.lock().expect("whole").runs.insert(text(&run["id"]), digest);
    }
}

/// Imports models until the program is gone.
async fn import(base: String, seen: Shared, seed: u64) {
    let client = Client::new(&base, None).expect("a client");
    for gain in 0.. {
        let weights = gain_weights(&["u"], &["y"], 1.0 + (seed * 1000 + gain) as f64);
        let Ok(model) = client.import("bench", weights).await else { return };
        let version = model["version"].as_u64().expect("a version");
        seen.lock().expect("whole").models.insert(version, text(&model["sha256"]));
    }
}

/// Requests fits, short and longer ones, until the program is gone, and never more than a few at once.
async fn fit(base: String, seen: Shared) {
    let client = Client::new(&base, None).expect("a client");
    let lstm = json!({"blocks": [8], "window_len": 64, "epochs": 30, "seeds": [1, 2]});
    let requests = [json!({"kind": "frf"}), json!({"kind": "hybrid2", "lstm": lstm})];
    for request in requests.iter().cycle() {
        let Ok(waiting) = client.get("/v1/jobs?state=queued").await else { return };
        if waiting["items"].as_array().map_or(0, Vec::len) < 3 {
            let Ok(job) = client.fit("bench", request).await else { return };
            seen.lock().expect("whole").jobs.insert(job);
        }
        tokio::time::sleep(Duration::from_millis(30)).await;
    }
}

/// All items of a list.
async fn all(client: &Client, path: &str) -> Vec<Value> {
    let (mut items, mut cursor) = (Vec::new(), String::new());
    loop {
        let mut page = client.get(&format!("{path}?limit=1000{cursor}")).await.expect("a list");
        items.append(page["items"].as_array_mut().expect("items"));
        match page["next"].as_str() {
            Some(next) => cursor = format!("&cursor={next}"),
            None => return items,
        }
    }
}

/// Compares everything acknowledged with the store, and reads every object that is not in `read`.
async fn check(base: &str, seen: &Acknowledged, read: &mut BTreeSet<String>) {
    let client = Client::new(base, None).expect("a client");
    let runs: BTreeMap<String, String> = all(&client, "/v1/rigs/bench/runs")
        .await
        .iter()
        .map(|run| (text(&run["id"]), text(&run["sha256"])))
        .collect();
    for (id, digest) in &seen.runs {
        assert_eq!(runs.get(id), Some(digest), "an acknowledged run");
    }
    for id in runs.keys().filter(|id| read.insert((*id).clone())) {
        client
            .get(&format!("/v1/rigs/bench/runs/{id}/data?to_s=1"))
            .await
            .expect("every listed run is whole");
    }
    let models = all(&client, "/v1/rigs/bench/models").await;
    let mut jobs = BTreeSet::new();
    let mut digests = BTreeMap::new();
    for model in &models {
        let version = model["version"].as_u64().expect("a version");
        digests.insert(version, text(&model["sha256"]));
        if read.insert(format!("model {version}")) {
            let url = format!("{base}/v1/rigs/bench/models/{version}/weights");
            let weights = reqwest::get(url).await.expect("an answer").bytes().await.expect("weights");
            assert_eq!(hex(&weights), digests[&version], "a listed model is whole");
        }
        if let Some(job) = model["job"].as_str() {
            assert!(jobs.insert(job.to_owned()), "job {job} has made two models");
        }
    }
    for (version, digest) in &seen.models {
        assert_eq!(digests.get(version), Some(digest), "an acknowledged model");
    }
    let known: BTreeSet<String> = all(&client, "/v1/jobs").await.iter().map(|job| text(&job["id"])).collect();
    assert!(seen.jobs.is_subset(&known), "an acknowledged job is gone");
    assert_eq!(client.get("/readyz?verbose").await.expect("ready")["degraded"], json!([]));
}

#[tokio::test(flavor = "multi_thread")]
async fn nothing_acknowledged_is_lost_to_kills_and_every_job_succeeds() {
    let kills = setting("RIGCAST_TEST_KILLS", 10);
    let mut random = random();
    let directory = TempDir::new().expect("a directory");
    let seen = Shared::default();
    // Objects that were read whole after a restart; at the end all are read once more.
    let mut read = BTreeSet::new();
    let mut ended_s = 0.0;
    for kill in 0..=kills {
        let program = Program::start(&directory, &ENVIRONMENT);
        let base = program.base().to_owned();
        if kill == 0 {
            let client = Client::new(&base, None).expect("a client");
            client.post("/v1/rigs", &bench()).await.expect("a rig");
            let file = noise_csv(3000, 0).into_bytes();
            client.upload("bench", &[("kind", "noise")], "text/csv", file).await.expect("a run");
        }
        let so_far = seen.lock().expect("whole").clone();
        check(&base, &so_far, &mut read).await;
        if kill == kills {
            ended_s = finish(&base).await;
            check(&base, &so_far, &mut BTreeSet::new()).await;
            program.signal("-TERM");
            assert_eq!(program.ended().0, Some(0));
            break;
        }
        let load = [
            tokio::spawn(upload(base.clone(), seen.clone(), 1_000_000 * (kill + 1))),
            tokio::spawn(import(base.clone(), seen.clone(), kill)),
            tokio::spawn(fit(base.clone(), seen.clone())),
        ];
        tokio::time::sleep(Duration::from_millis(random.random_range(20..1500))).await;
        program.kill();
        for task in load {
            task.await.expect("no acknowledgement was a lie");
        }
    }
    let seen = seen.lock().expect("whole");
    let (runs, models, jobs) = (seen.runs.len(), seen.models.len(), seen.jobs.len());
    println!(
        "{kills} kills: {runs} runs, {models} imported models and {jobs} jobs acknowledged, none lost; \
         all jobs ended {ended_s:.1} s after the last start"
    );
    assert!(runs > 0 && models > 0 && jobs > 0);
}

/// Waits until every job has succeeded; returns the seconds that it took.
async fn finish(base: &str) -> f64 {
    let client = Client::new(base, None).expect("a client");
    let started = Instant::now();
    for job in all(&client, "/v1/jobs").await {
        let job = loop {
            let found = client.get(&format!("/v1/jobs/{}", text(&job["id"]))).await.expect("the job");
            if !["queued", "running"].contains(&found["state"].as_str().unwrap_or_default()) {
                break found;
            }
            assert!(started.elapsed() < LIMIT, "{found}");
            tokio::time::sleep(Duration::from_millis(100)).await;
        };
        assert_eq!(job["state"], "succeeded", "no job is to blame for the end of the service: {job}");
        client.fitted_model(&job).await.expect("its model");
    }
    started.elapsed().as_secs_f64()
}

/// A fit of this length.
fn training(epochs: f64) -> Value {
    let lstm = json!({"blocks": [24], "window_len": 128, "epochs": epochs.ceil() as u64, "seeds": [1]});
    json!({"kind": "lstm", "lstm": lstm, "activate": "never"})
}

#[tokio::test(flavor = "multi_thread")]
async fn one_fit_outlives_all_kills_of_the_service_and_makes_the_same_model() {
    let kills = setting("RIGCAST_TEST_KILLS", 6);
    let mut random = random();
    let directory = TempDir::new().expect("a directory");
    let program = Program::start(&directory, &ENVIRONMENT);
    let client = Client::new(program.base(), None).expect("a client");
    client.post("/v1/rigs", &bench()).await.expect("a rig");
    let noise = noise_csv(6000, 11).into_bytes();
    client.upload("bench", &[("kind", "noise")], "text/csv", noise).await.expect("a run");
    // More work than can be done between the kills, which are 1.5 s apart, so that there is work to go
    // after each.
    let begin = Instant::now();
    let trial = client.fit("bench", &training(3000.0)).await.expect("a job");
    client.wait(&trial, |_| {}).await.expect("a model");
    let request = training(1.5 * 2.5 * kills as f64 / begin.elapsed().as_secs_f64() * 3000.0);
    let job = client.fit("bench", &request).await.expect("a job");

    let (mut program, mut running) = (program, 0);
    for kill in 1..=kills {
        let client = Client::new(program.base(), None).expect("a client");
        // Beside other tests the trial may be slower than the fit once they have ended: a kill comes before its share of
        // the work is done.
        let share = kill as f64 / (kills + 1) as f64;
        let delay = Duration::from_millis(random.random_range(50..2950));
        let _ = tokio::time::timeout(delay, further(&client, &job, share)).await;
        let found = client.get(&format!("/v1/jobs/{job}")).await.expect("the job");
        let state = found["state"].as_str().unwrap_or_default();
        assert!(["queued", "running"].contains(&state), "at kill {kill}: {found}");
        running += u64::from(state == "running");
        program.kill();
        program = Program::start(&directory, &ENVIRONMENT);
    }
    let client = Client::new(program.base(), None).expect("a client");
    let begin = Instant::now();
    let ended = client.wait(&job, |_| {}).await.expect("a model");
    assert_eq!(ended["attempt"], 1, "no attempt counts: {ended}");
    println!(
        "{kills} kills: one fit, at work at {running} of them, succeeded {:.1} s after the last at its first attempt",
        begin.elapsed().as_secs_f64()
    );
    assert!(2 * running > kills, "most kills met the fit at work");
    let whole = client.fit("bench", &request).await.expect("a job");
    let whole = client.wait(&whole, |_| {}).await.expect("a model");
    let digest = async |job: &Value| client.fitted_model(job).await.expect("a model")["sha256"].clone();
    assert_eq!(digest(&ended).await, digest(&whole).await, "bit for bit");
    program.signal("-TERM");
    assert_eq!(program.ended().0, Some(0));
}
