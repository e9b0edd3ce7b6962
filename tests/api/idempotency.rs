//! `Idempotency-Key` on every creating request.

use serde_json::{Value, json};

use crate::support::{Reply, SAFETENSORS, TestApp, bench, gain_weights, noise, noise_csv};

const KEY: &str = "idempotency-key";
const FRF: &str = "/v1/rigs/bench/fits";

/// An answer without its request id and its date.
fn essence(reply: &Reply) -> (u16, String, Option<String>, Value) {
    let etag = reply.headers.get("etag").map(|tag| tag.to_str().expect("text").to_owned());
    (reply.status, reply.header("location").to_owned(), etag, reply.json())
}

#[tokio::test]
async fn every_creating_request_is_done_once_under_its_key() {
    let app = TestApp::start();
    let weights = gain_weights(&["u"], &["y"], 2.0);
    let diagnosis = json!({"model": 1, "runs": {"kinds": ["noise"]}, "baseline_runs": {"kinds": ["noise"]}});
    let evaluation = br#"{"models": [1], "runs": {"split": "training"}}"#.to_vec();
    let iteration = json!({"target": {"sample_rate_hz": 100, "channels": {"y": noise(500, 4)}}, "model": 1, "iterations": 1});
    let calls: [(&str, &str, Vec<u8>); 7] = [
        ("/v1/rigs", "application/json", serde_json::to_vec(&bench()).expect("JSON")),
        ("/v1/rigs/bench/runs?kind=noise", "text/csv", noise_csv(6000, 3).into_bytes()),
        ("/v1/rigs/bench/models", SAFETENSORS, weights),
        (FRF, "application/json", br#"{"kind": "frf"}"#.to_vec()),
        ("/v1/rigs/bench/diagnoses", "application/json", serde_json::to_vec(&diagnosis).expect("JSON")),
        ("/v1/rigs/bench/evaluations", "application/json", evaluation),
        ("/v1/rigs/bench/iterations", "application/json", serde_json::to_vec(&iteration).expect("JSON")),
    ];
    for (path, media_type, body) in calls {
        let send = async |key: &str, path: &str, body: &[u8]| {
            app.call("POST", path).header(KEY, key).body(media_type, body).send().await
        };
        let first = send(path, path, &body).await;
        assert!([201, 202].contains(&first.status), "{path}: {first:?}");
        assert_eq!(essence(&send(path, path, &body).await), essence(&first), "{path}");
        let mut other = body.clone();
        other.push(b' ');
        send(path, path, &other).await.problem(422, "idempotency_key.reused");
        let key = format!("{path} of another operation");
        app.call("POST", "/v1/rigs").header(KEY, &key).json(&bench()).send().await.problem(409, "rig.exists");
        // A refused request was not done, so that its key is free.
        if path == FRF {
            let job = essence(&send(&key, path, &body).await).3;
            app.finished(job["id"].as_str().expect("an id")).await;
        }
        if first.status == 202 {
            app.finished(first.json()["id"].as_str().expect("an id")).await;
        }
    }
    let count = async |path: &str| app.get(path).await.expect(200).json()["items"].as_array().map(Vec::len);
    // The upload, and the target and the drive of the iteration.
    assert_eq!(count("/v1/rigs/bench/runs").await, Some(3));
    assert_eq!(count("/v1/jobs").await, Some(5));
    // The first job is over, and the answer to its request is what it was.
    let again = app.call("POST", FRF).header(KEY, FRF).json(&json!({"kind": "frf"})).send().await;
    again.problem(422, "idempotency_key.reused");
}

#[tokio::test]
async fn a_repeat_after_what_it_made_was_deleted_says_so() {
    let app = TestApp::start();
    let create = async || app.call("POST", "/v1/rigs").header(KEY, "k").json(&bench()).send().await;
    create().await.expect(201);
    app.call("DELETE", "/v1/rigs/bench").send().await.expect(204);
    let problem = create().await.problem(410, "idempotency_key.gone");
    assert!(problem["detail"].as_str().expect("text").contains("/v1/rigs/bench"), "{problem}");
    assert_eq!(app.get("/v1/rigs").await.expect(200).json()["items"], json!([]));
}

#[tokio::test]
async fn a_repeat_that_would_make_a_token_makes_none_and_shows_no_secret() {
    let mut app = TestApp::start();
    app.close_doors().await;
    let create = async |body: &Value| app.call("POST", "/v1/tokens").header(KEY, "k").json(body).send().await;
    let draft = json!({"role": "reader", "name": "iteration software"});
    let first = create(&draft).await.expect(201).json();
    let (id, secret) = (first["id"].as_str().expect("an id"), first["secret"].as_str().expect("a secret"));
    let again = create(&draft).await;
    assert!(!again.text().contains(secret));
    let problem = again.problem(409, "idempotency_key.secret");
    assert!(problem["detail"].as_str().expect("text").contains(id), "{problem}");
    create(&json!({"role": "reader"})).await.problem(422, "idempotency_key.reused");
    let tokens = app.get("/v1/tokens").await.expect(200).json();
    assert_eq!(tokens["items"].as_array().map(Vec::len), Some(2), "the admin's and one more");
    app.delete(&format!("/v1/tokens/{id}")).await.expect(204);
    create(&draft).await.problem(410, "idempotency_key.gone");
}

#[tokio::test]
async fn fifty_requests_with_one_key_make_one_job_and_a_restart_does_not_forget_it() {
    let app = TestApp::start();
    app.rig(&bench()).await;
    app.run("kind=noise", &noise_csv(6000, 3)).await;
    let post = async |app: &TestApp| {
        app.call("POST", FRF).header(KEY, "race").json(&json!({"kind": "frf"})).send().await
    };
    let replies = futures::future::join_all((0..50).map(|_| post(&app))).await;
    let first = essence(&replies[0]);
    assert_eq!(first.0, 202);
    for reply in &replies {
        assert_eq!(essence(reply), first);
    }
    let id = first.3["id"].as_str().expect("an id").to_owned();
    app.finished(&id).await;
    let app = app.restart();
    assert_eq!(essence(&post(&app).await), first);
    assert_eq!(app.get("/v1/jobs").await.json()["items"].as_array().map(Vec::len), Some(1));
}

#[tokio::test]
async fn a_key_that_is_none_is_refused() {
    let app = TestApp::start();
    for key in ["", "schlüssel", &"k".repeat(256)] {
        let reply = app.call("POST", "/v1/rigs").header(KEY, key).json(&bench()).send().await;
        reply.problem(400, "idempotency_key.malformed");
    }
}

#[tokio::test]
async fn a_key_is_its_tokens_own_and_opens_nothing() {
    let mut app = TestApp::start();
    app.close_doors().await;
    let tokens =
        [app.token(&json!({"role": "operator"})).await.0, app.token(&json!({"role": "operator"})).await.0];
    let mut other = bench();
    other["id"] = json!("other");
    let create = async |token: Option<&str>, rig: &Value| {
        app.call_as(token, "POST", "/v1/rigs").header(KEY, "same").json(rig).send().await
    };
    let first = create(Some(&tokens[0]), &bench()).await.expect(201);
    assert_eq!(essence(&create(Some(&tokens[0]), &bench()).await), essence(&first));
    // Another token's request under the same key is another request,
    let second = create(Some(&tokens[1]), &other).await.expect(201);
    assert_eq!(second.json()["id"], "other");
    // and a caller without a token does not get the stored answer.
    create(None, &bench()).await.problem(401, "token.missing");
}
