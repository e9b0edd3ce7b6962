//! Each fault raises its metric, in a program of its own.

use std::collections::BTreeSet;
use std::io::Write;
use std::net::TcpStream;
use std::time::Duration;

use rigcast::client::{Client, ClientError};
use rigcast::engine::model::to_safetensors;
use rigcast::telemetry::names::{self, Kind};
use serde_json::{Value, json};
use tempfile::TempDir;

use super::slow_weights;
use crate::support::{Program, SAFETENSORS, bench, gain_model, noise_csv, npy, read_all};

/// A running program with a rig.
struct Service {
    program: Program,
    client: Client,
    http: reqwest::Client,
    directory: TempDir,
}

impl Service {
    async fn start(environment: &[(&str, &str)]) -> Self {
        let directory = TempDir::new().expect("a directory");
        let program = Program::start(&directory, environment);
        let client = Client::new(program.base(), None).expect("a client");
        client.post("/v1/rigs", &bench()).await.expect("a rig");
        // Each request has a connection of its own, so that none is closed under it.
        let http = reqwest::Client::builder().pool_max_idle_per_host(0).build().expect("a client");
        Self { program, client, http, directory }
    }

    fn connect(&self) -> TcpStream {
        let address = self.program.base().strip_prefix("http://").expect("a URL");
        TcpStream::connect(address).expect("a connection")
    }

    /// Sends a file; returns the status.
    async fn post(&self, path: &str, media_type: &str, body: impl Into<reqwest::Body>) -> u16 {
        let request = self.http.post(format!("{}{path}", self.program.base()));
        let reply = request.header("content-type", media_type).body(body).send().await;
        reply.expect("an answer").status().as_u16()
    }

    async fn activate(&self, weights: Vec<u8>) {
        assert_eq!(self.post("/v1/rigs/bench/models", SAFETENSORS, weights).await, 201);
        let models = self.client.get("/v1/rigs/bench/models").await.expect("models");
        let newest = models["items"].as_array().expect("items").iter().map(|m| m["version"].as_u64()).max();
        let put = self.http.put(format!("{}/v1/rigs/bench/active-model", self.program.base()));
        let put = put.header("if-match", "*").json(&json!({"version": newest})).send().await;
        assert_eq!(put.expect("an answer").status(), 200);
    }

    async fn text(&self) -> String {
        let reply = self.http.get(format!("{}/metrics", self.program.base())).send().await;
        reply.expect("an answer").text().await.expect("text")
    }

    /// The sum of the series of a metric that have these labels.
    async fn value(&self, name: &str, labels: &[(&str, &str)]) -> f64 {
        let labels: Vec<String> = labels.iter().map(|(key, value)| format!("{key}=\"{value}\"")).collect();
        let text = self.text().await;
        let series = text.lines().filter(|line| {
            let rest = line.strip_prefix(name);
            rest.is_some_and(|rest| rest.starts_with([' ', '{'])) && labels.iter().all(|l| line.contains(l))
        });
        series.filter_map(|line| line.rsplit(' ').next()?.parse::<f64>().ok()).sum()
    }

    /// Waits until a metric is as expected, at most a minute or two.
    async fn until(&self, name: &str, labels: &[(&str, &str)], expected: impl Fn(f64) -> bool) {
        let mut found = f64::NAN;
        for _ in 0..3000 {
            found = self.value(name, labels).await;
            if expected(found) {
                return;
            }
            tokio::time::sleep(Duration::from_millis(20)).await;
        }
        panic!("{name} {labels:?} is {found}, which was not expected");
    }

    async fn fit(&self, rig: &str) -> Result<Value, ClientError> {
        let job = self.client.fit(rig, &json!({"kind": "frf"})).await.expect("a job");
        self.client.wait(&job, |_| {}).await
    }
}

#[tokio::test]
async fn files_that_cannot_be_read_are_counted_by_format_and_reason() {
    let service = Service::start(&[]).await;
    let runs = "/v1/rigs/bench/runs";
    for (path, media_type, body, format, reason) in [
        (runs, "text/csv", "u,y\n1,x\n", "csv", "csv.not_a_number"),
        (runs, "application/x-npy", "\u{93}NUMPY", "npy", "npy.header"),
        (runs, "application/json", "{]", "json", "json.invalid"),
        ("/v1/rigs", "application/json", "{]", "json", "body.syntax"),
        ("/v1/rigs/bench/models", SAFETENSORS, "{}", "safetensors", "weights.malformed"),
    ] {
        let labels = [("format", format), ("reason", reason)];
        assert_eq!(service.value(names::PARSE_ERRORS, &labels).await, 0.0);
        let status = service.post(path, media_type, body).await;
        assert!((400..500).contains(&status), "{status}");
        assert_eq!(service.value(names::PARSE_ERRORS, &labels).await, 1.0, "{format} {reason}");
    }
}

#[tokio::test]
async fn slow_connections_are_counted() {
    let service = Service::start(&[("RIGCAST_HEAD_TIMEOUT_S", "2"), ("RIGCAST_BODY_WINDOW_S", "0.5")]).await;
    let post = "POST /v1/rigs HTTP/1.1\r\nHost: localhost\r\nContent-Type: application/json\r\nContent-Length: 9\r\n\r\n{";
    for (sent, slow_in) in [("", "idle"), ("GET /livez HTTP/1.1\r\n", "head"), (post, "body")] {
        let before = service.value(names::CONNECTIONS_ENDED, &[("slow_in", slow_in)]).await;
        let mut stream = service.connect();
        stream.write_all(sent.as_bytes()).expect("sent");
        read_all(stream);
        // It is counted when it is over, which is a moment after its client has read the end.
        service.until(names::CONNECTIONS_ENDED, &[("slow_in", slow_in)], |ended| ended > before).await;
    }
    assert!(service.value(names::CONNECTIONS, &[]).await >= 1.0, "the one that asks");
}

#[tokio::test]
async fn refused_connections_are_counted() {
    // No open connection ends for idleness before the last one asks, however busy the machine is.
    let limits = [
        ("RIGCAST_CONNECTIONS", "8"),
        ("RIGCAST_CONNECTIONS_PER_ADDRESS", "8"),
        ("RIGCAST_HEAD_TIMEOUT_S", "60"),
    ];
    let service = Service::start(&limits).await;
    let open: Vec<TcpStream> = (0..8).map(|_| service.connect()).collect();
    let answer = read_all(service.connect());
    assert!(answer.starts_with("HTTP/1.1 503"), "{answer:?}");
    drop(open);
    service.until(names::CONNECTIONS_REFUSED, &[("limit", "all")], |refused| refused >= 1.0).await;
}

#[tokio::test]
async fn queues_refusals_deadlines_and_stages_are_measured() {
    let service = Service::start(&[
        ("RIGCAST_UPLOAD_TURNS", "1:1:60"),
        ("RIGCAST_LONG_TURNS", "1:0:60"),
        ("RIGCAST_PREDICT_DEADLINE_S", "0.5"),
    ])
    .await;
    let upload = [("class", "upload")];
    let mut first = service.connect();
    let head = "POST /v1/rigs/bench/runs HTTP/1.1\r\nHost: localhost\r\nContent-Type: text/csv\r\n\
                Content-Length: 8\r\nConnection: close\r\n\r\nu,y\n";
    first.write_all(head.as_bytes()).expect("sent");
    service.until(names::TURNS, &upload, |found| found == 1.0).await;
    let url = format!("{}/v1/rigs/bench/runs", service.program.base());
    let second = service.http.post(url).header("content-type", "text/csv").body("u,y\n1,2\n");
    let second = tokio::spawn(second.send());
    service.until(names::QUEUE_DEPTH, &upload, |found| found == 1.0).await;
    assert_eq!(service.post("/v1/rigs/bench/runs", "text/csv", "u,y\n1,2\n").await, 503);
    assert_eq!(service.value(names::SHED, &[("class", "upload"), ("reason", "full")]).await, 1.0);
    first.write_all(b"1,2\n").expect("sent");
    assert!(read_all(first).starts_with("HTTP/1.1 201"));
    assert_eq!(second.await.expect("no panic").expect("an answer").status(), 201);
    service.until(names::TURNS, &upload, |found| found == 0.0).await;
    assert_eq!(service.value(names::QUEUE_DEPTH, &upload).await, 0.0);
    assert!(service.value("rigcast_queue_wait_seconds_count", &upload).await >= 1.0);

    assert_eq!(service.value(names::DEADLINES, &[]).await, 0.0);
    service.activate(slow_weights()).await;
    let drive = npy("<f4", false, "(4000000, 1)", &vec![0; 16_000_000]);
    let predict = "/v1/rigs/bench/predict?sample_rate_hz=100";
    assert_eq!(service.post(predict, "application/x-npy", drive).await, 504);
    assert_eq!(service.value(names::DEADLINES, &[]).await, 1.0);

    service.activate(to_safetensors(&gain_model(&["u"], &["y"], 2.0))).await;
    let drive = json!({"drive": {"sample_rate_hz": 100.0, "channels": {"u": [0.0, 1.0]}}}).to_string();
    assert_eq!(service.post("/v1/rigs/bench/predict", "application/json", drive).await, 200);
    for stage in ["receive", "load", "wait", "simulate", "report"] {
        let count = service.value("rigcast_prediction_stage_seconds_count", &[("stage", stage)]).await;
        assert!(count >= 1.0, "{stage}");
    }
    assert!(service.value(names::LOADED_MODELS, &[]).await >= 1.0);
}

#[tokio::test]
async fn work_whose_client_has_gone_is_counted() {
    let service = Service::start(&[("RIGCAST_PREDICT_DEADLINE_S", "600")]).await;
    service.activate(slow_weights()).await;
    assert_eq!(service.value(names::ABANDONED, &[]).await, 0.0);
    let drive = npy("<f4", false, "(4000000, 1)", &vec![0; 16_000_000]);
    let mut client = service.connect();
    let head = "POST /v1/rigs/bench/predict?sample_rate_hz=100 HTTP/1.1\r\nHost: localhost\r\n\
                Content-Type: application/x-npy\r\nContent-Length: ";
    client.write_all(format!("{head}{}\r\n\r\n", drive.len()).as_bytes()).expect("sent");
    client.write_all(&drive).expect("sent");
    service.until(names::TURNS, &[("class", "long")], |found| found == 1.0).await;
    drop(client);
    service.until(names::ABANDONED, &[], |found| found == 1.0).await;
    service.until(names::TURNS, &[("class", "long")], |found| found == 0.0).await;
}

#[tokio::test]
async fn damage_of_the_store_is_counted() {
    let service = Service::start(&[]).await;
    service.activate(to_safetensors(&gain_model(&["u"], &["y"], 2.0))).await;
    assert_eq!(
        service.value(names::STORE_ERRORS, &[]).await + service.value(names::DEGRADED, &[]).await,
        0.0
    );
    let objects = service.directory.path().join("objects");
    std::fs::remove_dir_all(&objects).expect("removed");
    std::fs::create_dir(&objects).expect("made");
    let drive = json!({"drive": {"sample_rate_hz": 100.0, "channels": {"u": [0.0, 1.0]}}}).to_string();
    assert_eq!(service.post("/v1/rigs/bench/predict", "application/json", drive).await, 500);
    assert!(service.value(names::STORE_ERRORS, &[("kind", "damaged")]).await >= 1.0);
    assert_eq!(service.value(names::DEGRADED, &[]).await, 1.0);
}

#[tokio::test]
async fn attempts_of_jobs_are_counted_by_their_outcome_and_a_fits_error_is_shown() {
    let service = Service::start(&[("RIGCAST_TEST_FAULT", "abort@poison")]).await;
    let mut poison = bench();
    poison["id"] = json!("poison");
    service.client.post("/v1/rigs", &poison).await.expect("a rig");
    let noise = || noise_csv(6000, 3).into_bytes();
    service.client.upload("poison", &[("kind", "noise")], "text/csv", noise()).await.expect("a run");
    let failed = service.fit("poison").await;
    assert!(matches!(failed, Err(ClientError::Job { .. })), "its worker aborts: {failed:?}");
    assert_eq!(service.value(names::ATTEMPTS, &[("kind", "fit"), ("outcome", "retry")]).await, 3.0);
    assert_eq!(service.value(names::VALIDATION_ERROR, &[("rig", "bench")]).await, 0.0);
    service.client.upload("bench", &[("kind", "noise")], "text/csv", noise()).await.expect("a run");
    service.fit("bench").await.expect("a model");
    assert_eq!(service.value(names::ATTEMPTS, &[("kind", "fit"), ("outcome", "succeeded")]).await, 1.0);
    let error = service.value(names::VALIDATION_ERROR, &[("rig", "bench")]).await;
    assert!(error > 0.0 && error < 0.1, "{error}");
    let deleted = service.http.delete(format!("{}/v1/rigs/bench", service.program.base())).send().await;
    assert_eq!(deleted.expect("an answer").status(), 204);
    assert!(!service.text().await.contains("rig=\"bench\""), "a rig that is gone has no series");
}

#[tokio::test]
async fn a_lost_lease_is_counted() {
    let service = Service::start(&[("RIGCAST_HEARTBEAT_S", "0.2")]).await;
    let noise = noise_csv(6000, 3).into_bytes();
    service.client.upload("bench", &[("kind", "noise")], "text/csv", noise).await.expect("a run");
    let endless = json!({"kind": "lstm", "lstm": {"blocks": [39], "epochs": 1_000_000, "seeds": [1]}});
    let job = service.client.fit("bench", &endless).await.expect("a job");
    // Well under way: a job that finds no rig at its start fails for that reason.
    while service.client.get(&format!("/v1/jobs/{job}")).await.expect("the job")["progress"] == 0.0 {
        tokio::time::sleep(Duration::from_millis(20)).await;
    }
    assert_eq!(service.value(names::LEASES_LOST, &[]).await, 0.0);
    let deleted = service.http.delete(format!("{}/v1/rigs/bench", service.program.base())).send().await;
    assert_eq!(deleted.expect("an answer").status(), 204);
    service.until(names::LEASES_LOST, &[], |found| found == 1.0).await;
    service.until(names::ATTEMPTS, &[("outcome", "lost")], |found| found == 1.0).await;
}

#[tokio::test]
async fn every_metric_has_a_name_of_the_table_and_the_page_says_what_it_means() {
    let service = Service::start(&[]).await;
    let text = service.text().await;
    assert!(text.lines().filter(|line| !line.starts_with('#')).count() < 5000);
    let known: BTreeSet<&str> = names::ALL.iter().map(|metric| metric.1).collect();
    for line in text.lines().filter_map(|line| line.strip_prefix("# TYPE ")) {
        let name = line.split(' ').next().unwrap_or_default();
        assert!(known.contains(name), "{name} is not in the table");
    }
    let page = include_str!("../../../docs/operations.md");
    for (kind, name, _) in names::ALL {
        assert!(page.contains(&format!("`{name}")), "docs/operations.md does not say what {name} means");
        assert_eq!(*kind == Kind::Counter, name.ends_with("_total"), "{name}");
    }
}
