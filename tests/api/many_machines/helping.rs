//! A study whose trials are spread over two workers, each on a core of its own, as on one.
//!
//! `RIGCAST_TEST_TRIAL_EPOCHS=60 cargo test --test api many_machines::helping -- --nocapture` makes the trials long enough
//! for the ratio of the times to mean something.

use std::time::Instant;

use rigcast::client::Client;
use serde_json::{Value, json};

use super::Cluster;
use crate::support::{bench, lag_csv};

/// Trials of the study.
const TRIALS: usize = 16;

/// Does a study; its seconds, its rows and the digest of its model.
async fn studied(client: &Client, request: &Value) -> (f64, Value, Value) {
    let began = Instant::now();
    let job = client.post("/v1/rigs/bench/studies", request).await.expect("a job");
    let id = job["id"].as_str().expect("an id");
    let job = client.wait(id, |_| {}).await.expect("a study");
    let took = began.elapsed().as_secs_f64();
    let study = client.get(job["result"]["href"].as_str().expect("a link")).await.expect("a study");
    let model = client.get(&format!("/v1/rigs/bench/models/{}", study["model"])).await.expect("a model");
    (took, study["search"]["trials"].clone(), model["sha256"].clone())
}

#[tokio::test(flavor = "multi_thread")]
async fn the_trials_of_a_study_are_spread_and_come_out_alike() {
    let Some(cluster) = Cluster::start() else { return };
    if !std::process::Command::new("taskset").arg("-V").output().is_ok_and(|done| done.status.success()) {
        println!("skipped: no taskset on this machine");
        return;
    }
    let epochs = std::env::var("RIGCAST_TEST_TRIAL_EPOCHS").map_or(4, |text| text.parse().expect("a number"));
    let service = cluster.serve();
    let client = service.client(None);
    client.post("/v1/rigs", &bench()).await.expect("a rig");
    for seed in 0..4 {
        let csv = lag_csv(4000, seed).into_bytes();
        client.upload("bench", &[("kind", "noise")], "text/csv", csv).await.expect("a run");
    }
    let lstm = json!({"blocks": [16], "window_len": 64, "epochs": epochs, "seeds": [1]});
    let request = json!({
        "kind": "search", "trials": TRIALS, "trial_seeds": [1, 2, 3], "fit": {"kind": "lstm", "lstm": lstm},
        "space": {"learning_rate": {"min": 1e-3, "max": 1e-2}},
    });
    let first = cluster.work_on_core(0);
    let (alone, rows, model) = studied(&client, &request).await;
    let second = cluster.work_on_core(1);
    let (both, again, same) = studied(&client, &request).await;
    assert_eq!(rows.as_array().map(Vec::len), Some(TRIALS));
    assert_eq!(again, rows);
    assert_eq!(same, model, "bit for bit");
    second.program.signal("-TERM");
    let (status, log) = second.program.ended();
    assert_eq!(status, Some(0));
    // Whoever claimed it, the other one helped.
    first.program.signal("-TERM");
    let log = [log, first.program.ended().1].concat().join("\n");
    assert!(log.contains("helps with a job of another process"), "{log}");
    println!(
        "a study of {TRIALS} trials took {alone:.1} s on one worker and {both:.1} s on two: {:.2} of the time",
        both / alone
    );
}
