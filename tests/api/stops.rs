//! The real program, stopped by a service manager's signal under load: every connection gets an answer,
//! everything acknowledged is there after the next start, and the running fit goes on.
//!
//! `RIGCAST_TEST_STOPS=20 cargo test --test api stops -- --nocapture` stops more often.

use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use rigcast::client::Client;
use serde_json::json;
use tempfile::TempDir;

use crate::support::{Program, bench, further, gain_weights, noise_csv, npy, setting};

/// Clients that ask for predictions, each as soon as it has its answer.
const CLIENTS: usize = 4;

/// Longest stop.
const LIMIT: Duration = Duration::from_secs(30);

/// Observations of the clients of one program.
#[derive(Debug, Default)]
struct Seen {
    answered: AtomicUsize,
    /// Connections that were made and had no answer.
    broken: Mutex<Vec<String>>,
    runs: Mutex<Vec<String>>,
}

impl Seen {
    /// Sends until the program no longer listens; passes each answer to `take`.
    async fn send_until_refused(
        &self,
        request: impl Fn(&reqwest::Client) -> reqwest::RequestBuilder,
        take: impl Fn(u16, Vec<u8>),
    ) {
        // One connection per request: a kept one may be closed while a request is on its way.
        let http = reqwest::Client::builder().pool_max_idle_per_host(0).build().expect("a client");
        loop {
            let answer = async {
                let reply = request(&http).send().await?;
                let status = reply.status().as_u16();
                Ok::<_, reqwest::Error>((status, reply.bytes().await?.to_vec()))
            };
            match answer.await {
                Ok((status, bytes)) => {
                    self.answered.fetch_add(1, Ordering::Relaxed);
                    take(status, bytes);
                }
                Err(error) if error.is_connect() => return,
                Err(error) => self.broken.lock().expect("whole").push(format!("{error:?}")),
            }
        }
    }

    async fn predict(&self, base: &str) {
        let drive = npy("<f4", false, "(1000, 1)", &[0; 4000]);
        let url = format!("{base}/v1/rigs/bench/predict?sample_rate_hz=100&model=1");
        let request = |http: &reqwest::Client| {
            http.post(&url).header("content-type", "application/x-npy").body(drive.clone())
        };
        self.send_until_refused(request, |status, _| assert!([200, 503].contains(&status), "{status}")).await;
    }

    async fn upload(&self, base: &str) {
        let file = noise_csv(500, 1);
        let url = format!("{base}/v1/rigs/bench/runs?kind=other");
        let request =
            |http: &reqwest::Client| http.post(&url).header("content-type", "text/csv").body(file.clone());
        self.send_until_refused(request, |status, bytes| {
            assert_eq!(status, 201, "{}", String::from_utf8_lossy(&bytes));
            let run: serde_json::Value = serde_json::from_slice(&bytes).expect("JSON");
            self.runs.lock().expect("whole").push(run["id"].as_str().expect("an id").to_owned());
        })
        .await;
    }
}

#[tokio::test]
async fn stops_under_load_break_no_answer_lose_nothing_and_the_fit_goes_on() {
    let rounds: usize = setting("RIGCAST_TEST_STOPS", 2);
    let directory = TempDir::new().expect("a directory");
    let start = || Program::start(&directory, &[("RIGCAST_CHECKPOINT_S", "1")]);
    let mut program = start();
    let client = Client::new(program.base(), None).expect("a client");
    client.post("/v1/rigs", &bench()).await.expect("a rig");
    client.import("bench", gain_weights(&["u"], &["y"], 2.0)).await.expect("a model");
    client
        .upload("bench", &[("kind", "noise")], "text/csv", noise_csv(6000, 11).into_bytes())
        .await
        .expect("a run");
    let lstm = json!({"blocks": [39], "epochs": 1_000_000, "seeds": [1]});
    let job = client.fit("bench", &json!({"kind": "lstm", "lstm": lstm})).await.expect("a job");

    let (mut progress, mut longest) = (0.0, Duration::ZERO);
    let (mut answered, mut runs) = (0, Vec::new());
    for _ in 0..rounds {
        let client = Client::new(program.base(), None).expect("a client");
        progress = further(&client, &job, progress).await;
        let seen = Arc::new(Seen::default());
        let base = program.base().to_owned();
        let mut clients = tokio::task::JoinSet::new();
        for i in 0..=CLIENTS {
            let (seen, base) = (Arc::clone(&seen), base.clone());
            clients.spawn(async move {
                if i < CLIENTS { seen.predict(&base).await } else { seen.upload(&base).await }
            });
        }
        tokio::time::sleep(Duration::from_millis(1500)).await;
        let begin = Instant::now();
        program.signal("-TERM");
        let (code, log) = tokio::task::spawn_blocking(move || program.ended()).await.expect("no panic");
        longest = longest.max(begin.elapsed());
        assert_eq!(code, Some(0), "{log:?}");
        clients.join_all().await;
        let broken = std::mem::take(&mut *seen.broken.lock().expect("whole"));
        assert!(broken.is_empty(), "{} of {:?}: {broken:?}", broken.len(), seen.answered);
        answered += seen.answered.load(Ordering::Relaxed);
        runs.append(&mut seen.runs.lock().expect("whole"));

        program = start();
        let client = Client::new(program.base(), None).expect("a client");
        for run in &runs {
            client.get(&format!("/v1/rigs/bench/runs/{run}")).await.expect("an acknowledged run");
        }
    }
    let client = Client::new(program.base(), None).expect("a client");
    further(&client, &job, progress).await;
    client.post(&format!("/v1/jobs/{job}/cancel"), &json!({})).await.expect("noted");
    program.signal("-TERM");
    assert_eq!(program.ended().0, Some(0));
    assert!(
        answered > 10 * rounds && !runs.is_empty(),
        "there was load: {answered} answers, {} runs",
        runs.len()
    );
    assert!(longest < LIMIT);
    println!(
        "{rounds} stops under load: {:.1} s at most, {answered} answers, 0 broken, 0 of {} runs lost, the fit went on",
        longest.as_secs_f64(),
        runs.len()
    );
}
