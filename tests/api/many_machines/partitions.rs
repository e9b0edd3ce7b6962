//! What happens in the middle of writes: the way of a machine to the database is cut, a machine stands still, the database
//! restarts. Nobody is told of the first two, and what had begun stays open. The others go on, what is asked at the machine itself
//! is answered, nothing acknowledged is lost, and everything is back soon.
//!
//! `RIGCAST_TEST_CUTS=20 cargo test --test api many_machines::partitions -- --nocapture` cuts more often.

use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use reqwest::StatusCode;
use rigcast::client::Client;
use serde_json::json;
use tokio::task::JoinHandle;

use super::{Cluster, Kind, Machine, until};
use crate::support::{Weather, bench, setting, signal};

/// Longest time until a service answers, whatever has become of its database.
const ANSWER: Duration = Duration::from_secs(30);

/// How long the way is cut: longer than the database has for a statement.
const CUT: Duration = Duration::from_secs(20);

/// Longest time in which a service cannot write because of what another one had begun.
const HELD_UP: Duration = Duration::from_secs(10);

/// A client of one service that makes rigs, each under its name and key, until it is told to end.
struct Writer {
    base: String,
    name: usize,
    ends: AtomicBool,
    made: Mutex<Vec<String>>,
    longest: Mutex<Duration>,
    /// Answers with 503.
    refused: AtomicU64,
}

impl Writer {
    async fn write(self: Arc<Self>) {
        let http = reqwest::Client::new();
        for k in 0.. {
            let id = format!("rig-{}-{k}", self.name);
            let mut body = bench();
            body["id"] = json!(id);
            loop {
                if self.ends.load(Ordering::Relaxed) {
                    return;
                }
                let asked = Instant::now();
                let request = http.post(format!("{}/v1/rigs", self.base)).json(&body);
                let answer = request.header("Idempotency-Key", &id).send().await.expect("an answer");
                {
                    let mut longest = self.longest.lock().expect("whole");
                    *longest = longest.max(asked.elapsed());
                }
                match answer.status() {
                    StatusCode::CREATED => break,
                    status => {
                        let said = answer.text().await.unwrap_or_default();
                        assert_eq!(status, StatusCode::SERVICE_UNAVAILABLE, "{said}");
                    }
                }
                self.refused.fetch_add(1, Ordering::Relaxed);
            }
            self.made.lock().expect("whole").push(id);
        }
    }
}

/// Clients that write at a service.
struct Load {
    writers: Vec<Arc<Writer>>,
    writing: Vec<JoinHandle<()>>,
}

impl Load {
    fn at(service: &Machine) -> Self {
        let writer = |name: usize| {
            Arc::new(Writer {
                base: service.program.base().to_owned(),
                name,
                ends: AtomicBool::default(),
                made: Mutex::default(),
                longest: Mutex::default(),
                refused: AtomicU64::default(),
            })
        };
        let writers: Vec<_> = (0..16).map(writer).collect();
        let writing = writers.iter().map(|writer| tokio::spawn(writer.clone().write())).collect();
        Self { writers, writing }
    }

    /// Ends it, and checks that another service has what was acknowledged; what came of it, for people.
    async fn ended(self, other: &Client) -> String {
        for writer in &self.writers {
            writer.ends.store(true, Ordering::Relaxed);
        }
        for writing in self.writing {
            writing.await.expect("201 or 503");
        }
        let (mut longest, mut refused, mut made) = (Duration::ZERO, 0, 0);
        for writer in &self.writers {
            longest = longest.max(*writer.longest.lock().expect("whole"));
            refused += writer.refused.load(Ordering::Relaxed);
            let ids = std::mem::take(&mut *writer.made.lock().expect("whole"));
            for id in &ids {
                other.get(&format!("/v1/rigs/{id}")).await.expect("an acknowledged rig");
            }
            made += ids.len();
        }
        assert!(longest < ANSWER, "an answer took {longest:?}");
        format!(
            "{made} rigs acknowledged, 0 lost; the service answered within {:.1} s ({refused} times with 503)",
            longest.as_secs_f64()
        )
    }
}

/// How long another service cannot write.
async fn held_up(other: &Client, id: String) -> Duration {
    let mut body = bench();
    body["id"] = json!(id);
    until(HELD_UP, "a write of the other service", async || other.post("/v1/rigs", &body).await.is_ok()).await
}

/// How long a service needs until it is ready.
async fn back(client: &Client) -> Duration {
    until(Duration::from_secs(10), "the way back", async || {
        client.get("/readyz").await.is_ok_and(|ready| ready["status"] == "ready")
    })
    .await
}

/// Takes a service that writes away, so many times for so long, and checks that another one writes soon, that it is back
/// soon, and that nothing acknowledged is lost; what came of it, for people.
async fn taken_away(
    service: &Machine,
    other: &Machine,
    (times, long): (u64, Duration),
    [away, here]: [&dyn Fn(); 2],
) -> String {
    let (client, other) = (service.client(None), other.client(None));
    let load = Load::at(service);
    let mut longest = [Duration::ZERO; 2];
    for k in 0..times {
        tokio::time::sleep(Duration::from_millis(700 + 37 * k)).await;
        away();
        longest[0] = longest[0].max(held_up(&other, format!("other-{k}")).await);
        tokio::time::sleep(long).await;
        here();
        longest[1] = longest[1].max(back(&client).await);
    }
    let [held_up, back] = longest.map(|longest| longest.as_secs_f64());
    let ended = load.ended(&other).await;
    format!(
        "of a service that writes: {ended}; another one wrote after {held_up:.1} s at most, and it was back after {back:.1} s"
    )
}

#[tokio::test(flavor = "multi_thread")]
async fn a_service_that_is_cut_off_in_the_middle_of_its_writes_holds_up_nobody() {
    let Some(cluster) = Cluster::start_behind_weather() else { return };
    let cuts = setting("RIGCAST_TEST_CUTS", 1);
    let (cut, other) = (cluster.machine(Kind::Serve), cluster.machine(Kind::Serve));
    let way = [Weather::Lost, Weather::Fair].map(|weather| {
        let cut = &cut;
        move || cut.set_way(weather)
    });
    println!("{cuts} partitions {}", taken_away(&cut, &other, (cuts, CUT), [&way[0], &way[1]]).await);
}

#[tokio::test(flavor = "multi_thread")]
async fn a_service_that_stands_still_in_the_middle_of_its_writes_holds_up_nobody() {
    let Some(cluster) = Cluster::start() else { return };
    let pauses = setting("RIGCAST_TEST_PAUSES", 1);
    let (paused, other) = (cluster.machine(Kind::Serve), cluster.machine(Kind::Serve));
    let long = Duration::from_secs(2);
    let [stop, go] = ["-STOP", "-CONT"].map(|what| {
        let id = paused.program.id();
        move || signal(what, id)
    });
    println!("{pauses} pauses {}", taken_away(&paused, &other, (pauses, long), [&stop, &go]).await);
}

#[tokio::test(flavor = "multi_thread")]
async fn a_database_that_restarts_in_the_middle_of_writes_is_away_for_them_and_nothing_else() {
    let Some(cluster) = Cluster::start() else { return };
    let restarts = setting("RIGCAST_TEST_RESTARTS", 2);
    let (service, other) = (cluster.machine(Kind::Serve), cluster.machine(Kind::Serve));
    let (client, other) = (service.client(None), other.client(None));
    let load = Load::at(&service);
    let mut longest = Duration::ZERO;
    for k in 0..restarts {
        tokio::time::sleep(Duration::from_millis(700 + 37 * k)).await;
        cluster.postgres.restart();
        longest = longest.max(back(&client).await);
    }
    let ended = load.ended(&other).await;
    println!(
        "{restarts} restarts of the database beneath a service that writes: {ended}; back after {:.1} s",
        longest.as_secs_f64()
    );
}
