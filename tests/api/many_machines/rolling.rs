//! Two services behind a balancer are replaced one after the other, under half of the load that they carry.
//!
//! `RIGCAST_TEST_ROLLS=10 cargo test --test api many_machines::rolling -- --nocapture` does it more often.

use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, RwLock};
use std::time::{Duration, Instant};

use rigcast::client::Client;
use serde_json::json;
use tokio::task::JoinHandle;

use super::{Cluster, Kind, until};
use crate::support::{bench, noise_csv, setting};

/// Clients that predict, one request after the other.
const CLIENTS: usize = 8;

/// How long they do so without a pause, to find out what the services carry.
const TRIAL: Duration = Duration::from_secs(3);

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

/// The load of all clients.
struct Load {
    balancer: Balancer,
    predict: String,
    fit: String,
    ends: AtomicBool,
    answered: AtomicU64,
}

impl Load {
    /// One client: a prediction at each tick, or one after the other; the first one asks for a fit now and then.
    async fn predict(self: Arc<Self>, client: usize, every: Option<Duration>) {
        let mut ticks = every.map(tokio::time::interval);
        for k in 0.. {
            if let Some(ticks) = &mut ticks {
                ticks.tick().await;
            }
            if self.ends.load(Ordering::Relaxed) {
                return;
            }
            let path = "/v1/rigs/bench/predict";
            self.balancer.post(path, self.predict.clone(), None).await.expect("an answer");
            self.answered.fetch_add(1, Ordering::Relaxed);
            if every.is_some() && client == 0 && k % 20 == 0 {
                let key = format!("fit {k}");
                let path = "/v1/rigs/bench/fits";
                self.balancer.post(path, self.fit.clone(), Some(&key)).await.expect("a job");
            }
        }
    }

    /// All clients at once.
    fn start(self: &Arc<Self>, every: Option<Duration>) -> Vec<JoinHandle<()>> {
        self.ends.store(false, Ordering::Relaxed);
        self.answered.store(0, Ordering::Relaxed);
        (0..CLIENTS).map(|client| tokio::spawn(Arc::clone(self).predict(client, every))).collect()
    }

    /// Ends the clients; what they were answered.
    async fn end(&self, clients: Vec<JoinHandle<()>>) -> u64 {
        self.ends.store(true, Ordering::Relaxed);
        for client in clients {
            client.await.expect("no failed request");
        }
        self.answered.load(Ordering::Relaxed)
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn services_are_replaced_under_load_without_a_failed_request_or_a_lost_job() {
    let Some(cluster) = Cluster::start() else { return };
    let rolls = setting("RIGCAST_TEST_ROLLS", 2);
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
    let load = Arc::new(Load {
        balancer: Balancer { bases: RwLock::new(bases), turn: AtomicU64::new(0), http },
        predict: json!({"drive": {"sample_rate_hz": 100.0, "channels": {"u": vec![0.5; 1000]}}}).to_string(),
        fit: fit.to_string(),
        ends: AtomicBool::new(false),
        answered: AtomicU64::new(0),
    });
    let clients = load.start(None);
    tokio::time::sleep(TRIAL).await;
    let carried = load.end(clients).await as f64 / TRIAL.as_secs_f64();
    let clients = load.start(Some(Duration::from_secs_f64(CLIENTS as f64 / (0.5 * carried))));
    let began = Instant::now();
    for roll in 0..rolls {
        let place = roll % 2;
        let fresh = cluster.machine(Kind::Serve);
        let at_fresh = Client::new(fresh.program.base(), None).expect("a client");
        until(Duration::from_secs(10), "a start", async || at_fresh.get("/readyz").await.is_ok()).await;
        load.balancer.bases.write().expect("whole")[place] = fresh.program.base().to_owned();
        let old = std::mem::replace(&mut machines[place], fresh);
        old.program.signal("-TERM");
        let (status, _) = tokio::task::spawn_blocking(|| old.program.ended()).await.expect("it ends");
        assert_eq!(status, Some(0));
    }
    let took = began.elapsed().as_secs_f64();
    let answered = load.end(clients).await;
    let left = "SELECT count(*) FROM jobs WHERE state IN ('queued', 'running')";
    until(Duration::from_secs(60), "the end of all jobs", async || cluster.postgres.run(left).trim() == "0")
        .await;
    let lost = cluster.postgres.run("SELECT count(*) FROM jobs WHERE state <> 'succeeded'");
    assert_eq!(lost.trim(), "0");
    let jobs = cluster.postgres.run("SELECT count(*) FROM jobs");
    println!(
        "{rolls} rolling restarts in {took:.1} s: {answered} predictions, 0 failed, {:.0} a second of the {carried:.0} that two \
         services carry here; {} jobs, 0 lost",
        answered as f64 / took,
        jobs.trim()
    );
}
