//! Two services behind a balancer are replaced one after the other, under load.
//!
//! `RIGCAST_TEST_ROLLS=10 cargo test --test api many_machines::rolling -- --nocapture` does it more often.

use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, RwLock};
use std::time::{Duration, Instant};

use rigcast::client::Client;
use serde_json::json;

use super::{Cluster, Kind, until};
use crate::support::{bench, noise_csv};

/// Clients that predict, one request after the other.
const CLIENTS: usize = 4;

/// Pause of a client after an answer.
const PAUSE: Duration = Duration::from_millis(40);

/// What a balancer does: it sends a request to one service, and to the other one if that refuses the connection, breaks
/// it, or says that it is going.
struct Balancer {
    bases: RwLock<Vec<String>>,
    turn: AtomicU64,
    http: reqwest::Client,
}

impl Balancer {
    async fn post(&self, path: &str, body: String, key: Option<&str>) -> Result<String, String> {
        let mut why = String::new();
        let first = self.turn.fetch_add(1, Ordering::Relaxed) as usize;
        for k in 0..4 {
            let base = {
                let bases = self.bases.read().expect("whole");
                bases[(first + k) % bases.len()].clone()
            };
            let mut request = self.http.post(format!("{base}{path}")).body(body.clone());
            request = request.header("Content-Type", "application/json");
            if let Some(key) = key {
                request = request.header("Idempotency-Key", key);
            }
            match request.send().await {
                Ok(answer) if answer.status().is_success() => match answer.text().await {
                    Ok(text) => return Ok(text),
                    Err(error) => why = error.to_string(),
                },
                Ok(answer) => {
                    why = format!("{}: {}", answer.status(), answer.text().await.unwrap_or_default());
                    if !why.starts_with("503") {
                        return Err(why);
                    }
                }
                Err(error) => why = format!("{error:?}"),
            }
        }
        Err(why)
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn services_are_replaced_under_load_without_a_failed_request_or_a_lost_job() {
    let Some(cluster) = Cluster::start() else { return };
    let rolls = std::env::var("RIGCAST_TEST_ROLLS").map_or(2, |text| text.parse().expect("a number"));
    let mut machines = [cluster.machine(Kind::Serve), cluster.machine(Kind::Serve)];
    let _worker = cluster.machine(Kind::Work);
    let client = machines[0].client(None);
    client.post("/v1/rigs", &bench()).await.expect("a rig");
    let csv = noise_csv(6000, 1).into_bytes();
    let run = client.upload("bench", &[("kind", "noise")], "text/csv", csv).await.expect("a run");
    let fit = json!({"kind": "frf", "runs": [run["id"]]});
    let job = client.fit("bench", &fit).await.expect("a job");
    client.wait(&job, |_| {}).await.expect("a model");
    client.activate("bench", 1).await.expect("active");

    let bases = machines.iter().map(|machine| machine.program.base().to_owned()).collect();
    let http = reqwest::Client::builder().timeout(Duration::from_secs(20)).build().expect("a client");
    let balancer = Arc::new(Balancer { bases: RwLock::new(bases), turn: AtomicU64::new(0), http });
    let (ends, answered) = (Arc::new(AtomicBool::new(false)), Arc::new(AtomicU64::new(0)));
    let predict = json!({"drive": {"sample_rate_hz": 100.0, "channels": {"u": vec![0.5; 1000]}}}).to_string();
    let load: Vec<_> = (0..CLIENTS)
        .map(|client| {
            let (balancer, ends, answered) = (balancer.clone(), ends.clone(), answered.clone());
            let (predict, fit) = (predict.clone(), fit.to_string());
            tokio::spawn(async move {
                for k in 0.. {
                    if ends.load(Ordering::Relaxed) {
                        return;
                    }
                    balancer.post("/v1/rigs/bench/predict", predict.clone(), None).await.expect("an answer");
                    if client == 0 && k % 20 == 0 {
                        let key = format!("fit {k}");
                        let path = "/v1/rigs/bench/fits";
                        balancer.post(path, fit.clone(), Some(&key)).await.expect("a job");
                    }
                    answered.fetch_add(1, Ordering::Relaxed);
                    tokio::time::sleep(PAUSE).await;
                }
            })
        })
        .collect();
    let began = Instant::now();
    for roll in 0..rolls {
        let place = roll % 2;
        let fresh = cluster.machine(Kind::Serve);
        let at_fresh = Client::new(fresh.program.base(), None).expect("a client");
        until(Duration::from_secs(10), "a start", async || at_fresh.get("/readyz").await.is_ok()).await;
        balancer.bases.write().expect("whole")[place] = fresh.program.base().to_owned();
        let old = std::mem::replace(&mut machines[place], fresh);
        old.program.signal("-TERM");
        let (status, _) = tokio::task::spawn_blocking(|| old.program.ended()).await.expect("it ends");
        assert_eq!(status, Some(0));
    }
    let took = began.elapsed().as_secs_f64();
    ends.store(true, Ordering::Relaxed);
    for client in load {
        client.await.expect("no failed request");
    }
    let left = "SELECT count(*) FROM jobs WHERE state IN ('queued', 'running')";
    until(Duration::from_secs(60), "the end of all jobs", async || cluster.postgres.run(left).trim() == "0")
        .await;
    let lost = cluster.postgres.run("SELECT count(*) FROM jobs WHERE state <> 'succeeded'");
    assert_eq!(lost.trim(), "0");
    let jobs = cluster.postgres.run("SELECT count(*) FROM jobs");
    println!(
        "{rolls} rolling restarts in {took:.1} s: {} predictions, 0 failed; {} jobs, 0 lost",
        answered.load(Ordering::Relaxed),
        jobs.trim()
    );
}
