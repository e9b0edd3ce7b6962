//! A session through all operations, each of which must answer as in the contract.

use std::collections::BTreeSet;

use serde_json::json;

use crate::support::{Contract, SAFETENSORS, TestApp, bench, gain_weights, noise, noise_csv};

#[tokio::test]
async fn every_operation_succeeds_once_and_answers_as_the_contract_says() {
    let mut app = TestApp::start();
    app.rig(&bench()).await;
    app.get("/v1/rigs").await.expect(200);
    let rig = app.get("/v1/rigs/bench").await.expect(200);
    let patch = app.call("PATCH", "/v1/rigs/bench").header("if-match", rig.header("etag"));
    patch.json(&json!({"name": "Renamed"})).send().await.expect(200);

    let run = app.run("kind=noise&name=n1&tag=a&tag=b", &noise_csv(3000, 1)).await;
    let run = format!("/v1/rigs/bench/runs/{}", run["id"].as_str().expect("an id"));
    app.get("/v1/rigs/bench/runs").await.expect(200);
    app.get(&run).await.expect(200);
    app.call("PATCH", &run).json(&json!({"tags": ["c"]})).send().await.expect(200);
    for accept in ["application/json", "text/csv", "application/x-npy"] {
        app.call("GET", &format!("{run}/data")).header("accept", accept).send().await.expect(200);
    }

    let job = app.post_json("/v1/rigs/bench/fits", &json!({"kind": "frf"})).await.expect(202).json();
    let id = job["id"].as_str().expect("an id").to_owned();
    let job = format!("/v1/jobs/{id}");
    app.get("/v1/jobs").await.expect(200);
    app.get(&job).await.expect(200);
    app.get(&format!("{job}/losses")).await.expect(200);
    app.get(&format!("{job}/events")).await.expect(200);
    app.finished(&id).await;
    app.post(&format!("{job}/cancel")).await.expect(202);

    let weights = gain_weights(&["u"], &["y"], 2.0);
    let model = app.post_file("/v1/rigs/bench/models", SAFETENSORS, weights).await.expect(201);
    let model = model.header("location").to_owned();
    app.get("/v1/rigs/bench/models").await.expect(200);
    app.get(&model).await.expect(200);
    app.get(&format!("{model}/weights")).await.expect(200);
    app.get(&format!("{model}/frf")).await.expect(200);
    app.get(&format!("{model}/report")).await.expect(200);
    let active = app.get("/v1/rigs/bench/active-model").await.expect(200);
    let version: u64 = model.rsplit('/').next().and_then(|v| v.parse().ok()).expect("a version");
    let put = app.call("PUT", "/v1/rigs/bench/active-model").header("if-match", active.header("etag"));
    put.json(&json!({"version": version})).send().await.expect(200);

    app.get("/v1/rigs/bench/drift").await.expect(200);

    let drive = json!({"sample_rate_hz": 100.0, "channels": {"u": [0.0, 0.5, -0.5, 0.0]}});
    let target = json!({"sample_rate_hz": 100.0, "channels": {"y": [0.0, 1.0, -1.0, 0.0]}});
    let request = json!({"drive": drive, "target": target, "damage": {"slope": 3}});
    app.post_json("/v1/rigs/bench/predict", &request).await.expect(200);
    app.post_json("/v1/damage", &json!({"predicted": target, "target": target})).await.expect(200);

    inference(&app, version).await;
    diagnose(&app).await;
    iterate(&app).await;
    evaluate(&app).await;
    study(&app).await;

    let put = app.call("PUT", "/v1/rigs/bench/active-model").header("if-match", "*");
    put.json(&json!({"version": null})).send().await.expect(200);
    app.delete(&model).await.expect(204);
    app.delete(&run).await.expect(204);
    app.delete("/v1/rigs/bench").await.expect(204);

    for path in ["/", "/livez", "/readyz", "/readyz?verbose", "/metrics", "/openapi.yaml", "/docs"] {
        app.get(path).await.expect(200);
    }
    app.get("/docs/swagger-ui.css").await.expect(200);

    app.close_doors().await;
    let (_, token) = app.token(&json!({"role": "reader", "rigs": ["bench"]})).await;
    app.get("/v1/tokens").await.expect(200);
    app.delete(&format!("/v1/tokens/{token}")).await.expect(204);

    let all: BTreeSet<String> = Contract::get().operations().into_iter().map(|(_, _, id)| id).collect();
    assert_eq!(app.succeeded(), all);
}

/// Everything that clients of the Open Inference Protocol ask, of the active version and of one by its number.
async fn inference(app: &TestApp, version: u64) {
    for path in ["/v2", "/v2/health/live", "/v2/health/ready"] {
        app.get(path).await.expect(200);
    }
    app.post("/v2/repository/index").await.expect(200);
    for model in ["/v2/models/bench".to_owned(), format!("/v2/models/bench/versions/{version}")] {
        for rest in ["", "/config", "/ready"] {
            app.get(&format!("{model}{rest}")).await.expect(200);
        }
        let tensor = json!({"name": "drive", "datatype": "FP32", "shape": [2, 1], "data": [0.0, 0.5]});
        app.post_json(&format!("{model}/infer"), &json!({"inputs": [tensor]})).await.expect(200);
    }
}

/// The gain of the bench rises by a third and its model stays: a diagnosis, its report, and its adoption.
async fn diagnose(app: &TestApp) {
    let mut runs = Vec::new();
    for seed in [5, 6] {
        let mut csv = String::from("u,y\n");
        for (u, e) in noise(3000, 4).iter().zip(noise(3000, seed)) {
            csv.push_str(&format!("{u},{}\n", 2.7 * u + 0.01 * e));
        }
        runs.push(app.run("kind=service", &csv).await["id"].clone());
    }
    let request = json!({
        "mode": "external", "model": 1, "runs": runs, "repeats": [runs], "catalogue": ["gain", "sensor_gain", "cubic_stiffness"],
    });
    let diagnoses = "/v1/rigs/bench/diagnoses";
    let job = app.post_json(diagnoses, &request).await.expect(202).json();
    let job = app.finished(job["id"].as_str().expect("an id")).await;
    app.get(diagnoses).await.expect(200);
    let report = job["result"]["href"].as_str().unwrap_or_else(|| panic!("a report: {job}"));
    for accept in ["application/json", "text/html"] {
        app.call("GET", report).header("accept", accept).send().await.expect(200);
    }
    app.post_json(&format!("{report}/adopt"), &json!({})).await.expect(201);
}

/// The models on the runs, as JSON, as a table and as a page.
async fn evaluate(app: &TestApp) {
    let evaluations = "/v1/rigs/bench/evaluations";
    let request = json!({"models": [1], "runs": {"split": "training"}, "include_fitted": true});
    let job = app.post_json(evaluations, &request).await.expect(202).json();
    let job = app.finished(job["id"].as_str().expect("an id")).await;
    app.get(evaluations).await.expect(200);
    let report = job["result"]["href"].as_str().unwrap_or_else(|| panic!("a report: {job}"));
    for accept in ["application/json", "text/csv", "text/html"] {
        app.call("GET", report).header("accept", accept).send().await.expect(200);
    }
}

/// Two trials of a small network.
async fn study(app: &TestApp) {
    let studies = "/v1/rigs/bench/studies";
    let lstm = json!({"window_len": 32, "hop": 16, "epochs": 1, "seeds": [1]});
    let request = json!({
        "kind": "search", "trials": 2, "fit": {"kind": "lstm", "lstm": lstm}, "space": {"cells": {"min": 2, "max": 4}},
    });
    let job = app.post_json(studies, &request).await.expect(202).json();
    let job = app.finished(job["id"].as_str().expect("an id")).await;
    app.get(studies).await.expect(200);
    app.get(job["result"]["href"].as_str().unwrap_or_else(|| panic!("a table: {job}"))).await.expect(200);
}

/// The drive of a run, found from its response.
async fn iterate(app: &TestApp) {
    let target = app.run("kind=service", &noise_csv(3000, 9)).await["id"].clone();
    let iterations = "/v1/rigs/bench/iterations";
    let job =
        app.post_json(iterations, &json!({"model": 1, "target": {"run": target}})).await.expect(202).json();
    let job = app.finished(job["id"].as_str().expect("an id")).await;
    app.get(iterations).await.expect(200);
    app.get(job["result"]["href"].as_str().unwrap_or_else(|| panic!("a drive: {job}"))).await.expect(200);
}
