//! Health, metrics, documentation.

use std::time::{Duration, Instant};

use rigcast::telemetry::names::{self, Kind};
use serde_json::json;

use crate::support::{Program, TestApp, bench, noise_csv};

#[tokio::test]
async fn the_service_is_alive_and_ready_and_tells_its_checks_when_asked() {
    let app = TestApp::start();
    assert_eq!(app.get("/livez").await.expect(200).json(), json!({"status": "ok"}));
    assert_eq!(
        app.get("/readyz").await.expect(200).json(),
        json!({"status": "ready", "store": "ok", "quarantined": [], "degraded": [], "degraded_models": 0})
    );
    let verbose = app.get("/readyz?verbose").await.expect(200).json();
    assert_eq!((&verbose["checks"]["store"], &verbose["checks"]["draining"]), (&json!("ok"), &json!(false)));
}

#[tokio::test]
async fn one_damaged_model_degrades_its_rig_and_nothing_else() {
    let app = TestApp::start();
    app.bench_with_model().await;
    let [weights] = &app.files()[..] else { panic!("one object: the weights") };
    let mut bytes = std::fs::read(weights).expect("readable");
    let last = bytes.len() - 1;
    bytes[last] ^= 1;
    let mut permissions = std::fs::metadata(weights).expect("there").permissions();
    #[expect(clippy::permissions_set_readonly_false, reason = "a file of the test's own, for its own user")]
    permissions.set_readonly(false);
    std::fs::set_permissions(weights, permissions).expect("allowed");
    std::fs::write(weights, bytes).expect("written");
    let drive = json!({"drive": {"sample_rate_hz": 100.0, "channels": {"u": [0.0]}}});
    let reply = app.post_json("/v1/rigs/bench/predict", &drive).await;
    let problem = reply.problem(500, "store.damaged");
    assert!(!problem.to_string().contains("objects"), "a 5xx tells nothing of our insides: {problem}");
    let ready = app.get("/readyz").await.expect(200).json();
    assert_eq!(
        (&ready["degraded"][0]["rig"], &ready["degraded"][0]["version"]),
        (&json!("bench"), &json!(1))
    );
    app.get("/v1/rigs/bench/models/1").await.expect(200);
    app.get("/v1/rigs/bench/models/1/weights").await.problem(500, "store.damaged");
}

#[tokio::test]
async fn metrics_count_requests_by_route_and_jobs_by_state() {
    let app = TestApp::start();
    app.bench_with_model().await;
    app.get("/v1/rigs/bench").await.expect(200);
    app.get("/v1/rigs/other").await.expect(404);
    app.get("/no/such/route").await.expect(404);
    let drive = json!({"drive": {"sample_rate_hz": 100.0, "channels": {"u": [0.0, 1.0]}}});
    app.post_json("/v1/rigs/bench/predict", &drive).await.expect(200);
    let reply = app.get("/metrics").await.expect(200);
    assert!(reply.header("content-type").starts_with("text/plain; version=0.0.4"));
    let text = reply.text();
    let value = |name: &str, labels: &[&str]| {
        text.lines()
            .find(|l| l.starts_with(name) && labels.iter().all(|label| l.contains(label)))
            .and_then(|l| l.rsplit(' ').next()?.parse::<f64>().ok())
            .unwrap_or_else(|| panic!("no {name} with {labels:?} in {text}"))
    };
    let requests = "rigcast_http_requests_total";
    assert!(value(requests, &["route=\"/v1/rigs/{rig}\"", "method=\"GET\"", "status=\"404\""]) >= 1.0);
    assert!(value(requests, &["route=\"unmatched\"", "status=\"404\""]) >= 1.0);
    assert!(!text.contains("/no/such/route"), "clients make no labels");
    assert!(
        value("rigcast_http_request_duration_seconds_count", &["route=\"/v1/rigs/{rig}/predict\""]) >= 1.0
    );
    assert!(value("rigcast_predictions_total", &["kind=\"frf\""]) >= 1.0);
    assert!(value("rigcast_prediction_duration_seconds_count", &["kind=\"frf\""]) >= 1.0);
    assert!(value("rigcast_model_loads_total", &[]) >= 1.0);
    for state in ["queued", "running", "succeeded", "failed", "cancelled"] {
        assert!(value("rigcast_jobs", &[&format!("state=\"{state}\"")]) >= 0.0);
    }
    assert_eq!(value("rigcast_build_info", &[rigcast::VERSION]), 1.0);
}

/// Lines of the metrics that begin so.
fn series<'a>(text: &'a str, name: &str) -> Vec<&'a str> {
    text.lines()
        .filter(|line| line.strip_prefix(name).is_some_and(|rest| rest.starts_with(['{', ' '])))
        .collect()
}

#[tokio::test]
async fn every_metric_is_there_from_the_start() {
    let directory = tempfile::TempDir::new().expect("a directory");
    let program = Program::start(&directory, &[]);
    let text = reqwest::get(format!("{}/metrics", program.base())).await.expect("an answer");
    let text = text.text().await.expect("text");
    for (kind, name, help) in names::ALL {
        assert!(text.contains(&format!("# HELP {name} {help}")), "{name} is not explained");
        // There is no rig that could have a model.
        let sample = if *kind == Kind::Histogram { format!("{name}_count") } else { (*name).to_owned() };
        let found = series(&text, &sample);
        let of_rigs = [names::VALIDATION_ERROR, names::MODEL_ERROR_RATIO].contains(name);
        assert_eq!(found.is_empty(), of_rigs, "{name}: {found:?}");
        if *kind == Kind::Counter && *name != names::PROCESS_CPU {
            assert!(found.iter().all(|line| line.ends_with(" 0")), "{name} begins at zero: {found:?}");
        }
    }
    for expected in [
        "rigcast_shed_total{class=\"predict\",reason=\"late\"} 0",
        "rigcast_job_attempts_total{kind=\"diagnosis\",outcome=\"lost\"} 0",
        "rigcast_connections_timed_out_total{slow_in=\"idle\"} 0",
        "rigcast_predictions_total{kind=\"hybrid2\"} 0",
        "rigcast_parse_errors_total{format=\"csv\",reason=\"csv.ragged_row\"} 0",
        "rigcast_store_errors_total{kind=\"full\"} 0",
        "rigcast_prediction_stage_seconds_count{stage=\"simulate\"} 0",
    ] {
        assert!(text.lines().any(|line| line == expected), "no {expected} in {text}");
    }
    let number =
        |line: &str| -> f64 { line.rsplit(' ').next().and_then(|n| n.parse().ok()).expect("a number") };
    let bytes = series(&text, names::DATA_BYTES);
    assert_eq!(bytes.len(), 3, "{bytes:?}");
    assert!(bytes.iter().any(|line| line.contains("\"database\"") && number(line) > 4096.0), "{bytes:?}");
    assert!(number(series(&text, names::DATA_FREE_BYTES)[0]) > 0.0);
    // The program's figures, not this test's.
    assert!((5.0..10_000.0).contains(&number(series(&text, names::PROCESS_OPEN_FDS)[0])), "{text}");
}

#[tokio::test]
async fn the_validation_error_is_the_active_models_whatever_made_it_active() {
    let app = TestApp::start();
    app.rig(&bench()).await;
    app.run("kind=noise", &noise_csv(3000, 31)).await;
    let shown = async |app: &TestApp| -> Option<f64> {
        let text = app.get("/metrics").await.expect(200).text().to_owned();
        let line = series(&text, names::VALIDATION_ERROR).into_iter().find(|line| line.contains("\"bench\""));
        line.map(|line| line.rsplit(' ').next().and_then(|n| n.parse().ok()).expect("a number"))
    };
    let fit = async |app: &TestApp, request: serde_json::Value| {
        let job = app.post_json("/v1/rigs/bench/fits", &request).await.expect(202).json();
        let job = app.finished(job["id"].as_str().expect("an id")).await;
        let model = app.get(job["result"]["href"].as_str().expect("a model")).await.expect(200).json();
        let errors: Vec<f64> = model["report"]["validation_rms"]
            .as_array()
            .expect("a list")
            .iter()
            .filter_map(|e| e.as_f64())
            .collect();
        (model["version"].clone(), errors.iter().sum::<f64>() / errors.len() as f64)
    };
    let point = async |app: &TestApp, version: &serde_json::Value| {
        let put = app.call("PUT", "/v1/rigs/bench/active-model").header("if-match", "*");
        put.json(&json!({"version": version})).send().await.expect(200);
    };
    let is = |found: Option<f64>, error: f64| found.is_some_and(|found| (found - error).abs() < 1e-12);
    assert_eq!(shown(&app).await, None, "no model yet");
    let (first, error) = fit(&app, json!({"kind": "frf"})).await;
    assert!(is(shown(&app).await, error), "the fit made it active");
    let stiff = json!({"kind": "frf", "activate": "never", "frf": {"segment_len": 256, "ridge": 0.5}});
    let (second, other) = fit(&app, stiff).await;
    assert!((other - error).abs() > 1e-9, "the fits must differ to be told apart");
    assert!(is(shown(&app).await, error), "a newer model that is not active says nothing");
    point(&app, &second).await;
    assert!(is(shown(&app).await, other));
    let weights = crate::support::gain_weights(&["u"], &["y"], 2.0);
    let import = app.post_file("/v1/rigs/bench/models", crate::support::SAFETENSORS, weights).await;
    point(&app, &import.expect(201).json()["version"]).await;
    assert_eq!(shown(&app).await, None, "an imported model was not validated here");
    point(&app, &first).await;
    assert!(is(shown(&app).await, error), "rolled back");
    app.delete(&format!("/v1/rigs/bench/models/{second}")).await.expect(204);
    let app = app.restart();
    assert!(is(shown(&app).await, error), "from the start on");
    point(&app, &serde_json::Value::Null).await;
    assert_eq!(shown(&app).await, None);
}

#[tokio::test]
async fn a_fit_leaves_its_duration_in_the_metrics() {
    let app = TestApp::start();
    app.rig(&bench()).await;
    app.run("kind=noise", &noise_csv(3000, 31)).await;
    let job = app.post_json("/v1/rigs/bench/fits", &json!({"kind": "frf"})).await.expect(202).json();
    app.finished(job["id"].as_str().expect("an id")).await;
    let reply = app.get("/metrics").await.expect(200);
    assert!(reply.text().contains("rigcast_fit_duration_seconds_count{"), "{}", reply.text());
}

#[tokio::test]
async fn the_documentation_needs_nothing_from_elsewhere() {
    let app = TestApp::start();
    let page = app.get("/docs").await.expect(200).text().to_owned();
    assert!(page.contains("/openapi.yaml"), "{page}");
    let links: Vec<&str> =
        page.split(['"', '\'']).filter(|part| part.starts_with('/') || part.starts_with("http")).collect();
    assert!(links.len() >= 3, "{links:?}");
    for link in links {
        assert!(link.starts_with('/'), "{link} is not ours");
        app.get(link).await.expect(200);
    }
    app.get("/docs/nothing.js").await.problem(404, "route.not_found");
}

#[tokio::test]
async fn the_service_stays_quick_while_a_fit_uses_the_cores() {
    let app = TestApp::start();
    app.rig(&bench()).await;
    app.run("kind=noise", &noise_csv(20_000, 41)).await;
    let long = json!({"kind": "lstm", "lstm": {"blocks": [39], "epochs": 1000000, "seeds": [1, 2]}});
    let job = app.post_json("/v1/rigs/bench/fits", &long).await.expect(202);
    let path = job.header("location").to_owned();
    while app.get(&path).await.json()["state"] != "running" {
        tokio::time::sleep(Duration::from_millis(20)).await;
    }
    let mut times: Vec<Duration> = Vec::new();
    for _ in 0..200 {
        let started = Instant::now();
        app.get("/livez").await.expect(200);
        times.push(started.elapsed());
        tokio::time::sleep(Duration::from_millis(5)).await;
    }
    app.post(&format!("{path}/cancel")).await.expect(202);
    app.finished(job.json()["id"].as_str().expect("an id")).await;
    times.sort_unstable();
    println!("GET /livez during a fit: median {:?}, 99th percentile {:?}", times[100], times[197]);
    // The bound is 100 ms at the 99th percentile on a machine of its own; other tests run here too.
    assert!(times[197] < Duration::from_millis(500), "99th percentile {:?}", times[197]);
}

/// Flips the last bit of an object.
fn damage(app: &TestApp, digest: &str) {
    let path = app.directory().join("objects").join(&digest[..2]).join(digest);
    let mut bytes = std::fs::read(&path).expect("readable");
    *bytes.last_mut().expect("not empty") ^= 1;
    std::fs::remove_file(&path).expect("allowed");
    std::fs::write(path, bytes).expect("written");
}

#[tokio::test]
async fn the_last_good_model_answers_for_a_damaged_one_and_readiness_names_what_is_damaged() {
    let app = TestApp::start();
    app.bench_with_model().await;
    let weights = crate::support::gain_weights(&["u"], &["y"], 5.0);
    let second = app.post_file("/v1/rigs/bench/models", crate::support::SAFETENSORS, weights).await;
    let second = second.expect(201).json();
    let tag = app.get("/v1/rigs/bench/active-model").await.expect(200).header("etag").to_owned();
    let put = app.call("PUT", "/v1/rigs/bench/active-model").header("if-match", &tag);
    put.json(&json!({"version": 2})).send().await.expect(200);
    let model = async || {
        let drive = json!({"drive": {"sample_rate_hz": 100.0, "channels": {"u": [0.0]}}});
        app.post_json("/v1/rigs/bench/predict", &drive).await.expect(200).json()["model"].clone()
    };
    // Before a run comes: the active model is held against each, and a model in memory answers whatever its file says.
    damage(&app, second["sha256"].as_str().expect("a digest"));
    let answered = model().await;
    assert_eq!((&answered["version"], answered["sha256"] != second["sha256"]), (&json!(1), true));
    let run = app.run("kind=noise", &crate::support::noise_csv(3000, 5)).await;
    for file in app.files() {
        // The run's samples: the only other object that is no model.
        let name = file.file_name().and_then(|name| name.to_str()).expect("a digest").to_owned();
        if ![&answered["sha256"], &second["sha256"]].contains(&&json!(name)) {
            damage(&app, &name);
        }
    }
    let path = format!("/v1/rigs/bench/runs/{}", run["id"].as_str().expect("an id"));
    app.get(&format!("{path}/data")).await.problem(500, "store.damaged");
    let ready = app.get("/readyz?verbose").await.expect(200).json();
    let degraded = ready["degraded"].as_array().expect("a list");
    assert!(degraded.iter().all(|one| one["rig"] == "bench"), "{ready}");
    assert!(degraded.iter().any(|one| one["version"] == 2), "{ready}");
    assert!(degraded.iter().any(|one| one["run"] == run["id"]), "{ready}");
    // A job that needs the run fails with a reason.
    let job = app.post_json("/v1/rigs/bench/fits", &json!({"kind": "frf"})).await.expect(202).json();
    let job = app.finished(job["id"].as_str().expect("an id")).await;
    assert_eq!(job["problem"]["code"], "store.damaged", "{job}");
}
