//! Machines whose way to the database is cut: nobody is told, and what they had begun there stays open. The others go on, what is
//! asked at the machine itself is answered, and it is back when the way is.
//!
//! `RIGCAST_TEST_CUTS=20 cargo test --test api many_machines::partitions -- --nocapture` cuts more often.

use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use reqwest::StatusCode;
use serde_json::json;

use super::{Cluster, Kind, until};
use crate::support::{Weather, bench, setting};

/// Longest time until a service answers, whatever has become of its database.
const ANSWER: Duration = Duration::from_secs(30);

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
                let mut longest = self.longest.lock().expect("whole");
                *longest = longest.max(asked.elapsed());
                match answer.status() {
                    StatusCode::CREATED => break,
                    status => assert_eq!(status, StatusCode::SERVICE_UNAVAILABLE),
                }
                self.refused.fetch_add(1, Ordering::Relaxed);
            }
            self.made.lock().expect("whole").push(id);
        }
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn a_service_that_is_cut_off_in_the_middle_of_its_writes_holds_up_nobody() {
    let Some(cluster) = Cluster::start_behind_weather() else { return };
    let cuts = setting("RIGCAST_TEST_CUTS", 1);
    let (cut, other) = (cluster.machine(Kind::Serve), cluster.machine(Kind::Serve));
    let writer = |name: usize| {
        Arc::new(Writer {
            base: cut.program.base().to_owned(),
            name,
            ends: AtomicBool::default(),
            made: Mutex::default(),
            longest: Mutex::default(),
            refused: AtomicU64::default(),
        })
    };
    let writers: Vec<_> = (0..16).map(writer).collect();
    let writing: Vec<_> = writers.iter().map(|writer| tokio::spawn(writer.clone().write())).collect();
    let clients = [cut.client(None), other.client(None)];
    let (mut held_up, mut back) = (Duration::ZERO, Duration::ZERO);
    for k in 0..cuts {
        tokio::time::sleep(Duration::from_millis(700 + 37 * k)).await;
        cut.set_way(Weather::Lost);
        let mut body = bench();
        body["id"] = json!(format!("other-{k}"));
        let wrote = until(HELD_UP, "a write of the other service", async || {
            clients[1].post("/v1/rigs", &body).await.is_ok()
        });
        held_up = held_up.max(wrote.await);
        // Longer than anything is waited for.
        tokio::time::sleep(ANSWER).await;
        cut.set_way(Weather::Fair);
        let ready = until(Duration::from_secs(10), "the way back", async || {
            clients[0].get("/readyz").await.is_ok_and(|ready| ready["status"] == "ready")
        });
        back = back.max(ready.await);
    }
    for writer in &writers {
        writer.ends.store(true, Ordering::Relaxed);
    }
    for writing in writing {
        writing.await.expect("201 or 503");
    }
    let longest = writers.iter().map(|w| *w.longest.lock().expect("whole")).max().unwrap_or_default();
    assert!(longest < ANSWER, "an answer took {longest:?}");
    let refused: u64 = writers.iter().map(|w| w.refused.load(Ordering::Relaxed)).sum();
    let made: Vec<String> =
        writers.iter().flat_map(|w| std::mem::take(&mut *w.made.lock().expect("whole"))).collect();
    for id in &made {
        clients[1].get(&format!("/v1/rigs/{id}")).await.expect("an acknowledged rig");
    }
    println!(
        "{cuts} partitions of a service that writes: {} rigs acknowledged, 0 lost; another one wrote after {:.1} s at most, the \
         service answered within {:.1} s ({refused} times with 503) and was back after {:.1} s",
        made.len(),
        held_up.as_secs_f64(),
        longest.as_secs_f64(),
        back.as_secs_f64(),
    );
}
