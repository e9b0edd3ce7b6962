//! JSON with repeated keys, unknown fields or too much nesting.

use std::time::{Duration, Instant};

use serde_json::{Value, json};

use super::outcome;
use crate::support::{Reply, TestApp, bench};

async fn post(app: &TestApp, path: &str, text: impl Into<Vec<u8>>) -> Reply {
    app.call("POST", path).body("application/json", text).send().await
}

/// An id of no run.
const ID: &str = "01a20850-0000-7000-8000-000000000000";

#[tokio::test]
async fn a_key_that_comes_twice_is_refused_wherever_it_is() {
    let app = TestApp::start();
    app.bench_with_model().await;
    let drive = r#"{"sample_rate_hz": 100, "channels": {"u": [0, 1]}}"#;
    for (path, text, pointer) in [
        ("/v1/rigs", r#"{"id": "a", "id": "b", "sample_rate_hz": 1, "channels": []}"#.to_owned(), "/id"),
        (
            "/v1/rigs",
            bench().to_string().replacen("\"unit\":\"kN\"", "\"unit\":\"kN\",\"unit\":\"N\"", 1),
            "/channels/0/unit",
        ),
        ("/v1/rigs/bench/predict", format!(r#"{{"drive": {drive}, "drive": {drive}}}"#), "/drive"),
        (
            "/v1/rigs/bench/predict",
            r#"{"drive": {"sample_rate_hz": 100, "channels": {"u": [0], "\u0075": [1]}}}"#.into(),
            "/drive/channels/u",
        ),
        ("/v2/models/bench/infer", r#"{"inputs": [], "later": 1, "inputs": []}"#.into(), "/inputs"),
        (
            "/v1/damage",
            format!(r#"{{"predicted": {drive}, "groups": {{"g": ["u","u","u"], "g": ["u","u","u"]}}}}"#),
            "/groups/g",
        ),
        (
            "/v1/rigs/bench/fits",
            r#"{"kind": "lstm", "lstm": {"epochs": 1, "epochs": 2}}"#.into(),
            "/lstm/epochs",
        ),
        (
            "/v1/rigs/bench/diagnoses",
            format!(r#"{{"runs": [], "simulated": {{"{ID}": "{ID}", "{ID}": "{ID}"}}}}"#),
            "/simulated/01a20850-0000-7000-8000-000000000000",
        ),
    ] {
        let problem = post(&app, path, text.clone()).await.problem(422, "body.invalid_value");
        assert_eq!(problem["errors"][0]["pointer"], pointer, "{text}: {problem}");
    }
    for text in
        [r#"{"name": "a", "name": "b"}"#, r#"{"fit_policy": {"fits": [{"kind": "frf", "kind": "lstm"}]}}"#]
    {
        let patch = app.call("PATCH", "/v1/rigs/bench").header("if-match", "*");
        patch.body("application/merge-patch+json", text).send().await.problem(422, "body.invalid_value");
    }
    let file = r#"{"sample_rate_hz": 100, "channels": {"u": [0], "y": [0], "u": [1]}}"#;
    post(&app, "/v1/rigs/bench/runs", file).await.expect(422);
    assert_eq!(
        (app.runs().await, app.get("/v1/rigs/bench").await.json()["name"].clone()),
        (0, json!("Bench"))
    );
}

#[tokio::test]
async fn an_array_is_no_object_wherever_one_is_asked_for() {
    let app = TestApp::start();
    app.bench_with_model().await;
    let drive = json!({"sample_rate_hz": 100.0, "channels": {"u": [0.0, 1.0]}});
    for body in [
        json!({"drive": [null, 100.0, {"u": [0.0]}]}),
        json!({"drive": drive, "damage": []}),
        json!({"drive": drive, "damage": [3.0]}),
    ] {
        app.call("POST", "/v1/rigs/bench/predict")
            .body("application/json", body.to_string())
            .send()
            .await
            .problem(422, "body.invalid_value");
    }
    let mut rig = bench();
    rig["channels"][0] = json!(["u", "kN", "drive", "force", null, null]);
    post(&app, "/v1/rigs", rig.to_string()).await.problem(422, "body.invalid_value");
    for lstm in [json!([]), json!([1, 2])] {
        let fit = json!({"kind": "lstm", "lstm": lstm}).to_string();
        post(&app, "/v1/rigs/bench/fits", fit).await.problem(422, "body.invalid_value");
    }
    let patch = app.call("PATCH", "/v1/rigs/bench").header("if-match", "*").body("application/json", "[]");
    patch.send().await.problem(422, "body.invalid_value");
}

#[tokio::test]
async fn numbers_that_are_none_and_text_that_is_none_are_refused() {
    let app = TestApp::start();
    app.bench_with_model().await;
    let with = |number: &str| {
        format!(r#"{{"drive": {{"sample_rate_hz": 100, "channels": {{"u": [0, {number}]}}}}}}"#)
    };
    post(&app, "/v1/rigs/bench/predict", with("1e300")).await.expect(200);
    for number in
        ["1e400", "-1e400", "NaN", "Infinity", "-Infinity", "01", "+1", ".5", "1.", "0x1", "1e", "1_0"]
    {
        post(&app, "/v1/rigs/bench/predict", with(number)).await.problem(400, "body.syntax");
        post(&app, "/v1/damage", with(number).replacen("drive", "predicted", 1))
            .await
            .problem(400, "body.syntax");
        let file = format!(r#"{{"sample_rate_hz": 100, "channels": {{"u": [{number}], "y": [0]}}}}"#);
        let run = outcome(&post(&app, "/v1/rigs/bench/runs", file).await);
        assert!([(400, "json.invalid".into()), (422, "run.non_finite".into())].contains(&run), "{run:?}");
        let patch = app.call("PATCH", "/v1/rigs/bench").header("if-match", "*");
        let patch =
            patch.body("application/json", format!(r#"{{"fit_policy": {{"min_total_s": {number}}}}}"#));
        patch.send().await.problem(400, "body.syntax");
    }
    for bytes in [
        &b"{\"role\": \"a\xff\"}"[..],
        b"\xef\xbb\xbf{}",
        b"{\"role\": \"\\ud800\"}",
        b"{\"role\": \"\x01\"}",
        b"\xff\xfe{\0}\0",
    ] {
        post(&app, "/v1/tokens", bytes).await.problem(400, "body.syntax");
        let patch = app.call("PATCH", "/v1/rigs/bench").header("if-match", "*");
        patch.body("application/json", bytes).send().await.problem(400, "body.syntax");
    }
}

#[tokio::test]
async fn deep_json_is_refused_within_a_tenth_of_a_second() {
    let app = TestApp::start();
    app.bench_with_model().await;
    app.get("/v1/rigs/bench").await.expect(200);
    let n = 250_000;
    let deep = [
        "[".repeat(n),
        "[".repeat(n) + &"]".repeat(n),
        "{\"\":".repeat(n),
        format!("{{\"id\": {}", "[{\"a\":".repeat(n / 2)),
        format!("{{\"drive\": {{\"channels\": {{\"u\": {}", "[".repeat(n)),
    ];
    for text in &deep {
        for (method, path) in [
            ("POST", "/v1/rigs"),
            ("POST", "/v1/rigs/bench/predict"),
            ("POST", "/v1/damage"),
            ("POST", "/v1/tokens"),
            ("PATCH", "/v1/rigs/bench"),
            ("POST", "/v1/rigs/bench/fits"),
            ("POST", "/v1/rigs/bench/runs"),
        ] {
            let mut quickest = Duration::MAX;
            for _ in 0..3 {
                let call =
                    app.call(method, path).header("if-match", "*").body("application/json", text.clone());
                let started = Instant::now();
                let reply = call.send().await;
                quickest = quickest.min(started.elapsed());
                if path.ends_with("/runs") {
                    // Its reader never nests deeper than the file of a run.
                    assert!([400, 422].contains(&reply.status), "{:?}", outcome(&reply));
                } else {
                    reply.problem(400, "body.too_deep");
                }
            }
            assert!(quickest < Duration::from_millis(100), "{method} {path}: {quickest:?}");
        }
    }
    let level = |n: usize| format!(r#"{{"fit_policy": {}1{}}}"#, "[".repeat(n), "]".repeat(n));
    let patch = |text: String| {
        app.call("PATCH", "/v1/rigs/bench").header("if-match", "*").body("application/json", text)
    };
    assert_eq!(app.runs().await, 0);
    patch(level(63)).send().await.problem(422, "rig.invalid");
    patch(level(64)).send().await.problem(400, "body.too_deep");
    let unchanged: Value = app.get("/v1/rigs/bench").await.expect(200).json();
    assert_eq!(unchanged["fit_policy"], Value::Null);
}
