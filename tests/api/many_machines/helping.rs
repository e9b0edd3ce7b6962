//! A study whose trials, and a fit whose networks, are spread over two workers, each on a core of its own, as on one.
//!
//! `RIGCAST_TEST_TRIAL_EPOCHS=60 cargo test --test api many_machines::helping -- --nocapture` makes the trials long enough
//! for the ratio of the times to mean something.

use std::time::{Duration, Instant};

use rigcast::client::Client;
use serde_json::{Value, json};

use super::{Cluster, Machine, until};
use crate::support::{bench, lag_csv, setting};

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

/// A service with a rig, its runs and its client; `None` where a worker cannot be kept to one core.
async fn started(cluster: &Cluster) -> Option<(Machine, Client)> {
    if !std::process::Command::new("taskset").arg("-V").output().is_ok_and(|done| done.status.success()) {
        println!("skipped: no taskset on this machine");
        return None;
    }
    let service = cluster.serve();
    let client = service.client(None);
    client.post("/v1/rigs", &bench()).await.expect("a rig");
    for seed in 0..4 {
        let csv = lag_csv(4000, seed).into_bytes();
        client.upload("bench", &[("kind", "noise")], "text/csv", csv).await.expect("a run");
    }
    Some((service, client))
}

/// Ends a worker; what it has logged.
fn log_of(worker: Machine) -> String {
    worker.program.signal("-TERM");
    let (status, log) = worker.program.ended();
    assert_eq!(status, Some(0));
    log.join("\n")
}

#[tokio::test(flavor = "multi_thread")]
async fn the_trials_of_a_study_are_spread_and_come_out_alike() {
    let Some(cluster) = Cluster::start() else { return };
    let Some((_service, client)) = started(&cluster).await else { return };
    let epochs = setting("RIGCAST_TEST_TRIAL_EPOCHS", 40);
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
    // Whoever claimed it, the other one helped.
    let log = [log_of(first), log_of(second)].concat();
    assert!(log.contains("helps with a job of another process"), "{log}");
    println!(
        "a study of {TRIALS} trials took {alone:.1} s on one worker and {both:.1} s on two: {:.2} of the time",
        both / alone
    );
}

/// Does a fit of three networks; its seconds and its version.
async fn fitted(client: &Client, epochs: u64) -> (f64, Value) {
    let began = Instant::now();
    let lstm = json!({"blocks": [24], "window_len": 64, "epochs": epochs, "seeds": [1, 2, 3]});
    let job = client.fit("bench", &json!({"kind": "lstm", "lstm": lstm})).await.expect("a job");
    let job = client.wait(&job, |_| {}).await.expect("a model");
    assert_eq!(job["attempt"], 1, "{job}");
    let model = client.get(job["result"]["href"].as_str().expect("a link")).await.expect("a model");
    (began.elapsed().as_secs_f64(), model)
}

#[tokio::test(flavor = "multi_thread")]
async fn the_networks_of_a_fit_are_spread_and_it_comes_out_alike_even_if_a_helper_dies() {
    let Some(cluster) = Cluster::start() else { return };
    let Some((_service, client)) = started(&cluster).await else { return };
    let epochs = setting("RIGCAST_TEST_FIT_EPOCHS", 1200);
    let first = cluster.work_on_core(0);
    let (alone, model) = fitted(&client, epochs).await;
    let second = cluster.work_on_core(1);
    let (both, again) = fitted(&client, epochs).await;
    let same = |again: &Value| {
        assert_eq!(again["sha256"], model["sha256"], "bit for bit");
        assert_eq!(again["report"]["seeds"], model["report"]["seeds"]);
    };
    same(&again);
    println!(
        "a fit of three networks took {alone:.1} s on one worker and {both:.1} s on two: {:.2} of the time",
        both / alone
    );

    // The helper is gone in the middle of its network.
    first.program.signal("-TERM");
    assert_eq!(first.program.ended().0, Some(0));
    let helper = {
        let fit = fitted(&client, epochs);
        let dies = async {
            until(Duration::from_secs(30), "a job at the worker", async || {
                cluster.postgres.run("SELECT count(*) FROM jobs WHERE state = 'running'").trim() == "1"
            })
            .await;
            let helper = cluster.work_on_core(0);
            let given = "SELECT count(*) FROM checkpoints WHERE part LIKE 'share given%'";
            until(Duration::from_secs(60), "a gift", async || cluster.postgres.run(given).trim() != "0")
                .await;
            tokio::time::sleep(Duration::from_secs(1)).await;
            helper.program.signal("-KILL");
            helper.program.ended().1.join("\n")
        };
        let ((_, again), log) = tokio::join!(fit, dies);
        same(&again);
        log
    };
    assert!(helper.contains("was given a network to train"), "{helper}");
    let log = log_of(second);
    assert!(log.contains("gives a network to another worker"), "{log}");
}
