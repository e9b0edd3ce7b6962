//! Processes that are killed, stand still or are cut off from the database, a database that restarts, a storage that fails
//! or is silent: what was acknowledged stays, each job has its one model, and everything is back soon.
//!
//! `RIGCAST_TEST_CLUSTER_FAULTS=50 RIGCAST_TEST_AWAY_S=30 cargo test --test api many_machines -- --nocapture` makes more
//! faults, and longer ones of the storage.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rigcast::client::Client;
use serde_json::{Value, json};

use super::{Cluster, Kind, Machine, until};
use crate::support::{Weather, bench, noise_csv, setting, signal};

/// Longest time after a fault until every service answers again.
const BACK: Duration = Duration::from_secs(10);

/// Longest time after the last fault in which no job ends while some wait: clients may have been faster than the workers.
const JOBS: Duration = Duration::from_secs(60);

/// What the services have acknowledged.
#[derive(Debug, Default)]
struct Acknowledged {
    /// Digest of each run by its id.
    runs: BTreeMap<String, String>,
    jobs: BTreeSet<String>,
}

/// What the clients share.
struct Load {
    bases: Vec<String>,
    seen: Mutex<Acknowledged>,
    /// Uploads that were refused with 503, and others.
    refused: [AtomicU64; 2],
    ends: AtomicBool,
}

/// Uploads a run, and asks for a fit of it, until it is acknowledged: each under its key, at one service and then another.
async fn uploads(load: Arc<Load>, first: u64) {
    let http = reqwest::Client::builder().timeout(Duration::from_secs(15)).build().expect("a client");
    for seed in (first..).step_by(10) {
        let file = noise_csv(3000, seed);
        let path = "/v1/rigs/bench/runs?kind=noise";
        let Some(run) = acknowledged(&load, &http, path, "text/csv", file, seed).await else { return };
        let (id, digest) = (&run["id"], &run["sha256"]);
        let (id, digest) = (id.as_str().expect("an id"), digest.as_str().expect("a digest"));
        load.seen.lock().expect("whole").runs.insert(id.into(), digest.into());
        let fit = json!({"kind": "frf", "runs": [id]}).to_string();
        let path = "/v1/rigs/bench/fits";
        let Some(job) = acknowledged(&load, &http, path, "application/json", fit, seed + 5).await else {
            return;
        };
        load.seen.lock().expect("whole").jobs.insert(job["id"].as_str().expect("an id").into());
        tokio::time::sleep(Duration::from_millis(100)).await;
    }
}

/// Sends a request under a key until one of the services acknowledges it; `None` when the load ends before.
async fn acknowledged(
    load: &Load,
    http: &reqwest::Client,
    path: &str,
    content_type: &str,
    body: String,
    key: u64,
) -> Option<Value> {
    for base in load.bases.iter().cycle().skip(key as usize) {
        if load.ends.load(Ordering::Relaxed) {
            return None;
        }
        let request = http.post(format!("{base}{path}")).header("Content-Type", content_type);
        let sent = request.header("Idempotency-Key", key.to_string()).body(body.clone()).send().await;
        match sent {
            Ok(answer) if answer.status().is_success() => {
                if let Ok(made) = answer.json().await {
                    return Some(made);
                }
            }
            Ok(answer) => {
                let status = answer.status().as_u16();
                assert!([429, 502, 503, 504].contains(&status), "{status}: {:?}", answer.text().await);
                load.refused[usize::from(status != 503)].fetch_add(1, Ordering::Relaxed);
            }
            // It was killed, or stands still.
            Err(_) => {}
        }
        tokio::time::sleep(Duration::from_millis(50)).await;
    }
    unreachable!("there are services")
}

#[tokio::test(flavor = "multi_thread")]
async fn nothing_acknowledged_is_lost_whatever_fails() {
    let Some(cluster) = Cluster::start_behind_weather() else { return };
    let faults = setting("RIGCAST_TEST_CLUSTER_FAULTS", 8);
    let away = Duration::from_secs(setting("RIGCAST_TEST_AWAY_S", 3));
    let seed = setting("RIGCAST_TEST_SEED", 1);
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    let mut machines: Vec<Machine> =
        [Kind::Serve, Kind::Serve, Kind::Work, Kind::Work].map(|kind| cluster.machine(kind)).into();
    let clients: Vec<Client> = machines[..2].iter().map(|machine| machine.client(None)).collect();
    clients[0].post("/v1/rigs", &bench()).await.expect("a rig");
    let drive = json!({"drive": {"sample_rate_hz": 100.0, "channels": {"u": [0.5, 1.0]}}});

    let bases = machines[..2].iter().map(|machine| machine.program.base().to_owned()).collect();
    let (refused, ends) = (Default::default(), AtomicBool::default());
    let load = Arc::new(Load { bases, seen: Mutex::default(), refused, ends });
    let clients_at_work: Vec<_> = (0..3).map(|k| tokio::spawn(uploads(load.clone(), k))).collect();
    until(Duration::from_secs(60), "the first model", async || clients[1].activate("bench", 1).await.is_ok())
        .await;
    let mut longest = Duration::ZERO;
    for k in 0..faults {
        tokio::time::sleep(Duration::from_millis(random.random_range(200..1500))).await;
        let one = random.random_range(0..machines.len());
        let what = match k % 8 {
            0..=2 => {
                cluster.kill_and_start(&mut machines[one]);
                format!("a killed {:?}", machines[one].kind)
            }
            3 => {
                // Past the lease, so that what it had is another's when it goes on.
                signal("-STOP", machines[one].program.id());
                tokio::time::sleep(Duration::from_secs(5)).await;
                signal("-CONT", machines[one].program.id());
                format!("a {:?} that stood still", machines[one].kind)
            }
            4 => {
                machines[one].set_way(Weather::Lost);
                tokio::time::sleep(Duration::from_secs(5)).await;
                machines[one].set_way(Weather::Fair);
                format!("a {:?} that was cut off from the database", machines[one].kind)
            }
            5 => {
                cluster.postgres.restart();
                "a database that restarted".into()
            }
            which => {
                let weather = if which == 6 { Weather::Failing } else { Weather::Silent };
                for client in &clients {
                    client.post("/v1/rigs/bench/predict", &drive).await.expect("its model is loaded");
                }
                cluster.set_weather(weather);
                let until = Instant::now() + away;
                let (mut predicted, uploaded) = (0_u64, load.seen.lock().expect("whole").runs.len());
                while Instant::now() < until {
                    for client in &clients {
                        client.post("/v1/rigs/bench/predict", &drive).await.expect("from the cache");
                        predicted += 1;
                    }
                    tokio::time::sleep(Duration::from_millis(20)).await;
                }
                let more = load.seen.lock().expect("whole").runs.len() - uploaded;
                cluster.set_weather(Weather::Fair);
                format!("a {weather:?} storage ({predicted} predictions, {more} runs that were on their way)")
            }
        };
        let back = until(BACK, &what, async || {
            let mut all = true;
            for client in &clients {
                let asked = tokio::time::timeout(Duration::from_secs(2), client.get("/readyz")).await;
                all &= asked.is_ok_and(|ready| ready.is_ok_and(|ready| ready["bucket"] == "ok"));
            }
            all
        })
        .await;
        longest = longest.max(back);
        println!("{what}: all services answer after {:.2} s", back.as_secs_f64());
    }

    load.ends.store(true, Ordering::Relaxed);
    for client in clients_at_work {
        client.await.expect("no other answer");
    }
    let seen = std::mem::take(&mut *load.seen.lock().expect("whole"));
    let left = "SELECT count(*) FROM jobs WHERE state IN ('queued', 'running')";
    let mut fewest = u64::MAX;
    while fewest > 0 {
        until(JOBS, "the end of another job", async || {
            let left = cluster.postgres.run(left).trim().parse().expect("a number");
            let fewer = left < fewest;
            fewest = fewest.min(left);
            fewer
        })
        .await;
    }
    for (id, digest) in &seen.runs {
        let run = clients[0].get(&format!("/v1/rigs/bench/runs/{id}")).await.expect("an acknowledged run");
        assert_eq!(run["sha256"], digest.as_str());
        let samples = format!("/v1/rigs/bench/runs/{id}/data?from_s=0&to_s=0.1");
        clients[1].get(&samples).await.expect("its samples");
    }
    for id in &seen.jobs {
        let job = clients[1].get(&format!("/v1/jobs/{id}")).await.expect("an acknowledged job");
        assert_eq!(job["state"], "succeeded", "{job}");
    }
    let twice = "SELECT count(*) FROM (SELECT job FROM models GROUP BY job HAVING count(*) > 1) AS twice";
    assert_eq!(cluster.postgres.run(twice).trim(), "0", "a job with two models");
    let (jobs, models) = (
        cluster.postgres.run("SELECT count(*) FROM jobs WHERE state = 'succeeded'"),
        cluster.postgres.run("SELECT count(*) FROM models"),
    );
    assert_eq!(jobs, models, "each job has its model");
    println!(
        "{faults} faults, {} runs and {} jobs acknowledged, 0 lost, {} models; longest way back {:.1} s; {} requests got 503, \
         {} others were refused",
        seen.runs.len(),
        seen.jobs.len(),
        models.trim(),
        longest.as_secs_f64(),
        load.refused[0].load(Ordering::Relaxed),
        load.refused[1].load(Ordering::Relaxed),
    );
}

/// Keys that each come several times, at both services at once.
#[tokio::test(flavor = "multi_thread")]
async fn a_key_makes_one_thing_at_whichever_service_it_comes() {
    const CLIENTS: u64 = 64;
    let Some(cluster) = Cluster::start() else { return };
    let keys = setting("RIGCAST_TEST_KEYS", 200);
    let machines = [cluster.machine(Kind::Serve), cluster.machine(Kind::Serve)];
    let bases: Arc<Vec<String>> =
        Arc::new(machines.iter().map(|machine| machine.program.base().to_owned()).collect());
    let next = Arc::new(AtomicU64::new(0));
    let made: Arc<Mutex<BTreeMap<u64, String>>> = Arc::default();
    let began = Instant::now();
    let clients: Vec<_> = (0..CLIENTS)
        .map(|client| {
            let (bases, next, made) = (bases.clone(), next.clone(), made.clone());
            tokio::spawn(async move {
                let http = reqwest::Client::new();
                loop {
                    // Each key is drawn three times, mostly by different clients.
                    let drawn = next.fetch_add(1, Ordering::Relaxed);
                    if drawn >= 3 * keys {
                        return;
                    }
                    let key = drawn / 3;
                    let mut body = bench();
                    body["id"] = json!(format!("rig-{key}"));
                    for base in bases.iter().cycle().skip((drawn + client) as usize) {
                        let request = http.post(format!("{base}/v1/rigs")).json(&body);
                        let sent = request.header("Idempotency-Key", format!("key-{key}")).send().await;
                        let answer = sent.expect("an answer");
                        if answer.status().as_u16() == 201 {
                            let answer = answer.text().await.expect("text");
                            let before = made.lock().expect("whole").insert(key, answer.clone());
                            assert!(before.is_none_or(|before| before == answer), "two answers");
                            break;
                        }
                        // More wait at once than a token may have; nothing was done.
                        assert!([429, 503].contains(&answer.status().as_u16()), "{}", answer.status());
                        tokio::time::sleep(Duration::from_millis(20)).await;
                    }
                }
            })
        })
        .collect();
    for client in clients {
        client.await.expect("no other answer");
    }
    assert_eq!(made.lock().expect("whole").len() as u64, keys);
    assert_eq!(cluster.postgres.run("SELECT count(*) FROM rigs").trim(), keys.to_string());
    let took = began.elapsed().as_secs_f64();
    println!(
        "{keys} keys, each three times by {CLIENTS} clients over two services: 0 duplicates, {took:.1} s"
    );
}
