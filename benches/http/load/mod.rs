//! The service under overload, on one machine with its clients.
//!
//! - `load`: C, the highest rate with a 99th percentile of at most 100 ms; twice, five and ten times that;
//! - `fair`: one token at ten times its share, and the latency of the others;
//! - `soak`: two hours at 0.6 C with runs and fits beside it, and what the service then holds;
//! - `departed`: one prediction behind twenty whose clients have gone;
//! - `slow`: 2,000 connections that send a byte now and then, and the latency of an honest client.
//!
//! Each ends with an error where a bar is missed.

mod arrivals;
mod bars;
mod client;
mod departed;
mod soak;

use std::sync::Arc;
use std::time::{Duration, Instant};

use rigcast::engine::lstm::Recombine;
use rigcast::formats::npy::Dtype;
use rustix::process::{Resource, Rlimit, getrlimit, setrlimit};
use serde_json::{Value, json};
use tokio::io::AsyncWriteExt;
use tokio::net::TcpStream;
use tokio::runtime::Runtime;

use crate::ready;
use crate::rig::npy_request;
use crate::service::Service;
use arrivals::{Outcome, accepted, arrivals, quantile, shed};
use client::{Target, request};

pub use bars::Bars;
pub use departed::departed;
pub use soak::soak;

/// Samples of a request: 10 s.
const SAMPLES: usize = 10_000;

/// Longest 99th percentile at the rate C, seconds.
const LIMIT_S: f64 = 0.1;

/// Time to settle at a rate, and time to measure it.
const TRIAL: Duration = Duration::from_secs(6);
const MEASURE: Duration = Duration::from_secs(10);

/// A service with its model, and its clients.
struct Lab {
    service: Service,
    runtime: Runtime,
    target: Arc<Target>,
}

impl Lab {
    fn start() -> Self {
        let maximum = getrlimit(Resource::Nofile).maximum;
        setrlimit(Resource::Nofile, Rlimit { current: maximum, maximum }).expect("more file handles");
        let service = ready(Recombine::Welch, None);
        let runtime = tokio::runtime::Builder::new_multi_thread().worker_threads(2).enable_all().build();
        let target = Arc::new(Target::new(service.address().parse().expect("an address")));
        Self { service, runtime: runtime.expect("a runtime"), target }
    }

    fn predict(&self, per_s: f64, length: Duration, token: Option<&str>) -> Vec<Outcome> {
        self.runtime.block_on(self.predicting(per_s, length, token))
    }

    fn predicting(
        &self,
        per_s: f64,
        length: Duration,
        token: Option<&str>,
    ) -> impl Future<Output = Vec<Outcome>> + Send + use<> {
        let (head, body) = npy_request(SAMPLES, Dtype::F4);
        let request = Arc::new(request(&head, token, &body));
        arrivals(Arc::clone(&self.target), request, per_s, length, (per_s * 1e3) as u64)
    }

    /// Requests at a low rate while others run.
    fn probing(&self, head: &str, length: Duration) -> impl Future<Output = Vec<Outcome>> + Send + use<> {
        arrivals(Arc::clone(&self.target), Arc::new(request(head, None, b"")), 20.0, length, 7)
    }

    /// Requests one after the other.
    fn alone(&self) -> Vec<Outcome> {
        let (head, body) = npy_request(SAMPLES, Dtype::F4);
        let request = request(&head, None, &body);
        self.runtime.block_on(async {
            let mut outcomes = Vec::new();
            for _ in 0..300 {
                let begin = Instant::now();
                let status = self.target.send(&request).await.unwrap_or_default();
                outcomes.push(Outcome { took: begin.elapsed(), status });
            }
            outcomes.split_off(100)
        })
    }

    /// The highest rate that meets the bound.
    fn capacity(&self) -> f64 {
        let borne = |per_s: f64| {
            let outcomes = self.predict(per_s, TRIAL, None);
            let all = accepted(&outcomes).len() == outcomes.len();
            let p99 = quantile(&outcomes, 0.99);
            tell("trial", &json!({"per_s": per_s, "all_answered": all, "p99_s": p99}));
            all && p99 <= LIMIT_S
        };
        let mut low = 0.0;
        let mut high = 25.0;
        while borne(high) {
            (low, high) = (high, 2.0 * high);
        }
        while high - low > 0.05 * high && high > 2.0 {
            let middle = 0.5 * (low + high);
            if borne(middle) { low = middle } else { high = middle }
        }
        assert!(low > 0.0, "it bears not even {high} requests a second");
        low
    }
}

fn tell(work: &str, figures: &Value) {
    println!("{}", json!({"work": work, "figures": figures}));
}

/// A job that has ended: cancelling it is answered and changes nothing.
fn ended_job(service: &Service) -> String {
    let mut connection = service.connect();
    let head = "POST /v1/rigs/bench/runs?kind=other HTTP/1.1\r\nContent-Type: text/csv";
    let rows: String = (0..200).map(|i| format!("{},{}\n", i % 7, i % 5)).collect();
    connection.call(head, format!("drive_x,force_x\n{rows}").as_bytes(), 201);
    let fit =
        json!({"kind": "frf", "inputs": ["drive_x"], "outputs": ["force_x"], "runs": {"kinds": ["other"]}});
    let job = connection.json("POST /v1/rigs/bench/fits", "", &fit, 202);
    let path = format!("/v1/jobs/{}", job["id"].as_str().expect("an id"));
    while ["queued", "running"].contains(&connection.get(&path)["state"].as_str().unwrap_or_default()) {
        std::thread::sleep(Duration::from_millis(50));
    }
    path
}

/// C and beyond.
pub fn load() -> Bars {
    let lab = Lab::start();
    let cancel = format!("POST {}/cancel HTTP/1.1", ended_job(&lab.service));
    let alone = lab.alone();
    let alone_s = quantile(&alone, 0.99);
    tell("alone", &json!({"p50_s": quantile(&alone, 0.5), "p99_s": alone_s}));
    let c = lab.capacity();
    let at_c = lab.predict(c, MEASURE, None);
    let at_c_s = quantile(&at_c, 0.99);
    tell("c", &json!({"c_per_s": c, "p50_s": quantile(&at_c, 0.5), "p99_s": at_c_s}));
    let mut bars = Bars::default();
    for times in [2.0, 5.0, 10.0] {
        let (outcomes, health, cancels) = lab.runtime.block_on(async {
            let health = tokio::spawn(lab.probing("GET /readyz HTTP/1.1", MEASURE));
            let cancels = tokio::spawn(lab.probing(&cancel, MEASURE));
            let outcomes = lab.predicting(times * c, MEASURE, None).await;
            (outcomes, health.await.expect("no panic"), cancels.await.expect("no panic"))
        });
        let over = Instant::now();
        let recovered_s = recovery(&lab, 0.5 * c, over);
        let (accepted, shed) = (accepted(&outcomes), shed(&outcomes));
        let answered =
            |outcomes: &[Outcome]| outcomes.iter().all(|outcome| (200..300).contains(&outcome.status));
        tell(
            &format!("{times}c"),
            &json!({
                "offered_per_s": outcomes.len() as f64 / MEASURE.as_secs_f64(),
                "goodput_of_c": accepted.len() as f64 / MEASURE.as_secs_f64() / c,
                "accepted_p50_s": quantile(&accepted, 0.5), "accepted_p99_s": quantile(&accepted, 0.99),
                "accepted_p99_of_alone": quantile(&accepted, 0.99) / alone_s,
                "shed": shed.len(), "shed_p50_s": quantile(&shed, 0.5), "shed_p99_s": quantile(&shed, 0.99),
                "without_answer": outcomes.len() - accepted.len() - shed.len(),
                "health_p99_s": quantile(&health, 0.99), "health_all_answered": answered(&health),
                "cancel_p99_s": quantile(&cancels, 0.99), "cancel_all_answered": answered(&cancels),
                "recovered_s": recovered_s, "peak_resident_bytes": lab.service.peak_resident(),
            }),
        );
        let goodput = accepted.len() as f64 / MEASURE.as_secs_f64() / c;
        bars.at_least(&format!("{times} C: goodput, of C"), goodput, 0.9);
        let of_c = quantile(&accepted, 0.99) / at_c_s;
        bars.at_most(&format!("{times} C: p99 answered, of that at C"), of_c, 3.0);
        if !shed.is_empty() {
            bars.at_most(&format!("{times} C: p99 refused, s"), quantile(&shed, 0.99), 0.05);
        }
        bars.at_most(&format!("{times} C: p99 of health, s"), quantile(&health, 0.99), 0.1);
        bars.at_most(&format!("{times} C: p99 of cancelling, s"), quantile(&cancels, 0.99), 0.1);
    }
    bars
}

/// Seconds from the end of an overload to the first half second in which all requests meet the bound.
fn recovery(lab: &Lab, per_s: f64, over: Instant) -> f64 {
    loop {
        let began = over.elapsed().as_secs_f64();
        let outcomes = lab.predict(per_s, Duration::from_millis(500), None);
        if accepted(&outcomes).len() == outcomes.len() && quantile(&outcomes, 0.99) <= LIMIT_S {
            return began;
        }
        assert!(began < 60.0, "it does not recover");
    }
}

/// Four tokens at a sixth of C each, then one of them at ten times its quarter.
pub fn fair() -> Bars {
    let lab = Lab::start();
    let c = lab.capacity();
    let mut connection = lab.service.connect();
    let admin = connection.json("POST /v1/tokens", "", &json!({"role": "admin"}), 201);
    let admin = format!("\r\nAuthorization: Bearer {}", admin["secret"].as_str().expect("a secret"));
    let tokens: Vec<String> = (0..4)
        .map(|_| {
            let token = connection.json("POST /v1/tokens", &admin, &json!({"role": "reader"}), 201);
            token["secret"].as_str().expect("a secret").to_owned()
        })
        .collect();
    let round = |first_per_s: f64| {
        lab.runtime.block_on(async {
            let first = tokio::spawn(lab.predicting(first_per_s, MEASURE, Some(&tokens[0])));
            let others: Vec<_> = tokens[1..]
                .iter()
                .enumerate()
                .map(|(i, token)| tokio::spawn(lab.predicting(c / 6.0 + i as f64, MEASURE, Some(token))))
                .collect();
            let mut outcomes = Vec::new();
            for other in others {
                outcomes.extend(other.await.expect("no panic"));
            }
            (first.await.expect("no panic"), outcomes)
        })
    };
    let (_, before) = round(c / 6.0);
    let (greedy, beside) = round(10.0 * c / 4.0);
    let share = |outcomes: &[Outcome]| accepted(outcomes).len() as f64 / outcomes.len() as f64;
    let ratio = quantile(&accepted(&beside), 0.99) / quantile(&accepted(&before), 0.99);
    tell(
        "fair",
        &json!({
            "c_per_s": c, "others_p99_before_s": quantile(&accepted(&before), 0.99),
            "others_p99_beside_s": quantile(&accepted(&beside), 0.99),
            "ratio": ratio,
            "others_accepted_before": share(&before), "others_accepted_beside": share(&beside),
            "greedy_offered_per_s": greedy.len() as f64 / MEASURE.as_secs_f64(),
            "greedy_accepted": share(&greedy),
        }),
    );
    let mut bars = Bars::default();
    bars.at_most("others' p99 beside a greedy token, of that before", ratio, 1.5);
    bars
}

/// Honest requests with and without 2,000 connections that never finish a request.
pub fn slow() -> Bars {
    let lab = Lab::start();
    let c = lab.capacity();
    let address = lab.service.address().to_owned();
    let honest = |name: &str| {
        let outcomes = lab.predict(0.5 * c, MEASURE, None);
        let p99_s = quantile(&accepted(&outcomes), 0.99);
        let share = accepted(&outcomes).len() as f64 / outcomes.len() as f64;
        tell(
            name,
            &json!({"per_s": 0.5 * c, "p50_s": quantile(&outcomes, 0.5), "p99_s": p99_s, "accepted": share}),
        );
        p99_s
    };
    let without = honest("without_slow");
    let slow = lab.runtime.spawn(async move {
        let connections = (0..2000).map(|i| crawl(address.clone(), i));
        futures::future::join_all(connections).await.len()
    });
    std::thread::sleep(Duration::from_secs(3));
    let with = honest("with_2000_slow");
    slow.abort();
    tell("slow", &json!({"c_per_s": c, "ratio": with / without}));
    let mut bars = Bars::default();
    bars.at_most("honest p99 beside 2,000 slow connections, of that without", with / without, 2.0);
    bars
}

/// Half of the connections are slow in the head, half in the body; one that is cut reconnects.
async fn crawl(address: String, i: usize) {
    let head = "POST /v1/rigs/bench/predict?sample_rate_hz=1000 HTTP/1.1\r\nHost: localhost\r\n\
                Content-Type: application/x-npy\r\nContent-Length: 120000\r\n";
    let begin = if i.is_multiple_of(2) { head.to_owned() } else { format!("{head}\r\n") };
    tokio::time::sleep(Duration::from_micros(500 * i as u64)).await;
    loop {
        let Ok(mut stream) = TcpStream::connect(&address).await else { continue };
        let mut alive = stream.write_all(begin.as_bytes()).await.is_ok();
        while alive {
            tokio::time::sleep(Duration::from_secs(1)).await;
            alive = stream.write_all(b"x").await.is_ok();
        }
        // A refused one waits before it reconnects.
        tokio::time::sleep(Duration::from_secs(1)).await;
    }
}
