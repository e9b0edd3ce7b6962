//! Queues: the form of a refusal, and the order of requests.

use std::io::Write;
use std::net::TcpStream;
use std::time::Duration;

use rigcast::compute::fair_queue::QueueSettings;
use rigcast::config::Config;
use serde_json::json;
use tokio::task::JoinHandle;

use super::{predict_npy, refusal, slow_weights, until};
use crate::support::{Reply, TestApp, bench, gain_weights, npy, read_all};

const CSV: &str = "u,y\n1,2\n3,4\n";

/// A service with one upload at once, and some that may wait.
fn one_upload(queue: usize) -> TestApp {
    TestApp::start_as(move |mut config: Config| {
        config.admission.upload = QueueSettings::new(1, queue, Duration::from_secs(60));
        config
    })
}

/// An upload that has its permit and keeps it until the rest of its body is sent.
fn half_an_upload(app: &TestApp, token: &str) -> TcpStream {
    let mut stream = TcpStream::connect(app.address()).expect("a connection");
    let authorization =
        if token.is_empty() { String::new() } else { format!("Authorization: Bearer {token}\r\n") };
    let head = format!(
        "POST /v1/rigs/bench/runs?name=first HTTP/1.1\r\nHost: localhost\r\n{authorization}\
         Content-Type: text/csv\r\nContent-Length: {}\r\nConnection: close\r\n\r\nu,y\n",
        CSV.len()
    );
    stream.write_all(head.as_bytes()).expect("sent");
    stream
}

fn finish(mut upload: TcpStream) -> String {
    upload.write_all(CSV.strip_prefix("u,y\n").expect("its head was sent").as_bytes()).expect("sent");
    read_all(upload)
}

/// A service with two operators' tokens, the first of which has the only permit for uploads.
async fn two_tokens(queue: usize) -> (TestApp, String, String, TcpStream) {
    let mut app = one_upload(queue);
    app.rig(&bench()).await;
    app.close_doors().await;
    let (many, _) = app.token(&json!({"role": "operator"})).await;
    let (few, _) = app.token(&json!({"role": "operator"})).await;
    let first = half_an_upload(&app, &many);
    until(&app, "upload", (1, 0)).await;
    (app, many, few, first)
}

/// An upload on a task of its own.
fn upload(app: &TestApp, token: &str, name: &str) -> JoinHandle<Reply> {
    let call = app.call_as(
        Some(token).filter(|t| !t.is_empty()),
        "POST",
        &format!("/v1/rigs/bench/runs?name={name}"),
    );
    tokio::spawn(call.body("text/csv", CSV).send())
}

async fn names(app: &TestApp) -> Vec<String> {
    let runs = app.get("/v1/rigs/bench/runs").await.expect(200).json();
    let runs = runs["items"].as_array().expect("items").clone();
    runs.iter().map(|run| run["name"].as_str().expect("a name").to_owned()).collect()
}

#[tokio::test]
async fn who_finds_the_queue_full_is_told_when_to_come_again_and_nothing_is_done() {
    let app = one_upload(0);
    app.rig(&bench()).await;
    let first = half_an_upload(&app, "");
    until(&app, "upload", (1, 0)).await;
    for _ in 0..3 {
        refusal(app.post_file("/v1/rigs/bench/runs", "text/csv", CSV).await, 503, "busy");
    }
    // Other classes are not affected.
    app.get("/v1/rigs/bench").await.expect(200);
    app.post_json("/v1/rigs/bench/fits", &json!({"kind": "frf"})).await.problem(409, "fit.no_runs");
    assert!(finish(first).starts_with("HTTP/1.1 201"));
    until(&app, "upload", (0, 0)).await;
    app.post_file("/v1/rigs/bench/runs?name=second", "text/csv", CSV).await.expect(201);
    assert_eq!(names(&app).await, ["first", "second"]);
}

#[tokio::test]
async fn turns_go_round_between_tokens() {
    let (app, many, few, first) = two_tokens(8).await;
    let mut waiting = Vec::new();
    for (token, name) in
        [(&many, "many-2"), (&many, "many-3"), (&many, "many-4"), (&few, "few-1"), (&few, "few-2")]
    {
        waiting.push(upload(&app, token, name));
        until(&app, "upload", (1, waiting.len() as u64)).await;
    }
    assert!(finish(first).starts_with("HTTP/1.1 201"));
    for upload in waiting {
        upload.await.expect("no panic").expect(201);
    }
    assert_eq!(names(&app).await, ["first", "few-1", "many-2", "few-2", "many-3", "many-4"]);
}

#[tokio::test]
async fn a_token_that_fills_the_queue_makes_room_for_another_and_is_told_429() {
    let (app, many, few, first) = two_tokens(2).await;
    let second = upload(&app, &many, "many-2");
    until(&app, "upload", (1, 1)).await;
    let third = upload(&app, &many, "many-3");
    until(&app, "upload", (1, 2)).await;
    // For the only token the queue is full; next to another token its share is used up.
    refusal(upload(&app, &many, "many-4").await.expect("no panic"), 503, "busy");
    let other = upload(&app, &few, "few-1");
    refusal(third.await.expect("no panic"), 429, "token.busy");
    refusal(upload(&app, &many, "many-5").await.expect("no panic"), 429, "token.busy");
    assert!(finish(first).starts_with("HTTP/1.1 201"));
    for upload in [second, other] {
        upload.await.expect("no panic").expect(201);
    }
    assert_eq!(names(&app).await, ["first", "few-1", "many-2"]);
}

#[tokio::test]
async fn the_wait_for_a_turn_ends() {
    let app = TestApp::start_as(|mut config| {
        config.admission.upload = QueueSettings::new(1, 8, Duration::from_millis(300));
        config
    });
    app.rig(&bench()).await;
    let first = half_an_upload(&app, "");
    until(&app, "upload", (1, 0)).await;
    let problem = refusal(app.post_file("/v1/rigs/bench/runs", "text/csv", CSV).await, 503, "busy");
    assert!(
        problem["detail"].as_str().is_some_and(|detail| detail.contains("waited too long in the queue")),
        "{problem}"
    );
    assert!(finish(first).starts_with("HTTP/1.1 201"));
}

#[tokio::test]
async fn a_request_whose_body_is_still_to_come_takes_nobodys_turn() {
    let app = TestApp::start_as(|mut config| {
        config.admission.jobs = QueueSettings::new(1, 0, Duration::from_secs(60));
        config.admission.registry = QueueSettings::new(1, 0, Duration::from_secs(60));
        config
    });
    app.rig(&bench()).await;
    let slow: Vec<TcpStream> = ["/v1/rigs", "/v1/rigs/bench/fits", "/v1/rigs/bench/predict"]
        .map(|path| {
            let mut stream = TcpStream::connect(app.address()).expect("a connection");
            let head = format!(
                "POST {path} HTTP/1.1\r\nHost: localhost\r\nContent-Type: application/json\r\nContent-Length: 100\r\n\r\n{{"
            );
            stream.write_all(head.as_bytes()).expect("sent");
            stream
        })
        .into();
    app.get("/v1/rigs/bench").await.expect(200);
    app.post_json("/v1/rigs/bench/fits", &json!({"kind": "frf"})).await.problem(409, "fit.no_runs");
    let mut other = bench();
    other["id"] = json!("other");
    app.rig(&other).await;
    drop(slow);
}

#[tokio::test]
async fn predictions_beyond_the_queue_are_refused_and_their_connections_kept() {
    let app = TestApp::start_as(|mut config| {
        config.compute.predict = QueueSettings::new(1, 0, Duration::from_secs(60));
        config
    });
    app.rig(&bench()).await;
    app.activate("bench", slow_weights()).await;
    let drive = npy("<f8", false, "(4000, 1)", &[0; 32_000]);
    let predict = || predict_npy(&app, &drive);
    predict().await.expect("no panic").expect(200);
    let (mut served, mut refused) = (0, 0);
    for round in [predict(), predict(), predict(), predict(), predict(), predict(), predict(), predict()] {
        match round.await.expect("no panic") {
            reply if reply.status == 200 => served += 1,
            reply => {
                refusal(reply, 503, "busy");
                refused += 1;
            }
        }
    }
    assert!(served > 0 && refused > 0, "{served} served, {refused} refused");
    until(&app, "predict", (0, 0)).await;
    app.activate("bench", gain_weights(&["u"], &["y"], 2.0)).await;
    predict().await.expect("no panic").expect(200);
}
