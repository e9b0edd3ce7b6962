//! Drive-file iterations over HTTP.

use std::f64::consts::TAU;

use serde_json::{Value, json};

use crate::foreign_readers::python;
use crate::support::{SAFETENSORS, TestApp, bench, gain_weights, noise};

const ITERATIONS: &str = "/v1/rigs/bench/iterations";

/// The bench, a model `y = 2 u`, and a target of 6,000 samples whose mean is not zero.
async fn bench_with_target(app: &TestApp) -> (Vec<f64>, String) {
    app.bench_with_model().await;
    let target: Vec<f64> = (0..6000)
        .map(|i| i as f64 / 100.0)
        .map(|t| 0.5 + (TAU * 1.3 * t).sin() + 0.4 * (TAU * 7.7 * t).sin())
        .collect();
    let csv: String =
        std::iter::once("y\n".to_owned()).chain(target.iter().map(|y| format!("{y}\n"))).collect();
    let run = app.run("kind=service&split=test&name=track", &csv).await;
    (target, run["id"].as_str().expect("an id").to_owned())
}

async fn iterated(app: &TestApp, request: &Value) -> Value {
    let job = app.post_json(ITERATIONS, request).await.expect(202).json();
    assert_eq!(job["kind"], "iteration");
    let job = app.finished(job["id"].as_str().expect("an id")).await;
    let href = job["result"]["href"].as_str().unwrap_or_else(|| panic!("a drive: {job}")).to_owned();
    let found = app.get(&href).await.expect(200).json();
    assert!(job["stage"].as_str().is_some_and(|stage| stage.contains("error")), "{job}");
    assert_eq!((&found["job"], &job["result"]["kind"]), (&job["id"], &json!("iteration")));
    found
}

#[tokio::test]
async fn a_drive_is_found_stored_as_a_run_and_predicts_the_target() {
    let app = TestApp::start();
    let (target, run) = bench_with_target(&app).await;
    let found =
        iterated(&app, &json!({"target": {"run": run}, "start": "zero", "stop": {"error": 1e-3}})).await;
    assert_eq!(found["stopped"], "error");
    assert_eq!(found["request"]["model"], 1);
    let steps = found["steps"].as_array().expect("steps");
    assert_eq!(steps[0]["errors"]["y"], 1.0, "no drive, no response");
    assert!(found["errors"]["y"]["rms"].as_f64().expect("a number") <= 1e-3, "{found}");
    let ratio = steps.last().and_then(|step| step["damage"]["y"]["ratio"].as_f64()).expect("a ratio");
    assert!((ratio - 1.0).abs() < 0.05, "{ratio}");

    let drive = found["drive"].as_str().expect("a run");
    let stored = app.get(&format!("/v1/rigs/bench/runs/{drive}")).await.expect(200).json();
    assert_eq!(stored["name"], "drive for track");
    assert_eq!(
        (&stored["channels"], &stored["split"], &stored["tags"]),
        (&json!(["u"]), &json!("test"), &json!(["iterated"]))
    );
    let data = app.get(&format!("/v1/rigs/bench/runs/{drive}/data")).await.expect(200).json();
    let u: Vec<f64> =
        data["channels"]["u"].as_array().expect("samples").iter().filter_map(Value::as_f64).collect();
    let error: f64 = u.iter().zip(&target).map(|(u, y)| (2.0 * u - y).powi(2)).sum();
    assert!(error <= 1e-6 * target.iter().map(|y| y * y).sum::<f64>(), "{error}");
    // As a file for a rig's controller.
    let file =
        app.call("GET", &format!("/v1/rigs/bench/runs/{drive}/data")).header("accept", "application/x-rpc3");
    assert!(file.send().await.expect(200).bytes.starts_with(b"FORMAT"));
    // And as the drive of a prediction, whose response comes as a file too.
    let request = json!({"drive": {"run": drive}, "target": {"run": run}, "include": ["errors", "trust"]});
    let predicted = app.post_json("/v1/rigs/bench/predict", &request).await.expect(200).json();
    assert!(predicted["errors"]["channels"]["y"]["rms"].as_f64().expect("a number") <= 1e-3, "{predicted}");

    let predict = |accept: &str| {
        app.call("POST", "/v1/rigs/bench/predict")
            .header("accept", accept)
            .json(&json!({"drive": {"run": drive}}))
    };
    let table = predict("text/csv").send().await.expect(200);
    assert_eq!(table.header("rigcast-channels"), "y");
    let table = String::from_utf8(table.bytes).expect("text");
    let mut rows = table.lines();
    assert_eq!((rows.next(), rows.next()), (Some("time_s,y"), Some("s,mm")));
    let y: Vec<f64> = rows.filter_map(|row| row.split(',').nth(1)?.parse().ok()).collect();
    assert_eq!(y.len(), target.len());
    assert!(y.iter().zip(&target).all(|(y, wanted)| (y - wanted).abs() < 0.01), "the target");
    let file = predict("application/x-rpc3").send().await.expect(200).bytes;
    let read = app.post_file("/v1/rigs/bench/runs?kind=other&split=test", "application/x-rpc3", file).await;
    let read = read.expect(201).json();
    assert_eq!((&read["channels"], &read["samples"]), (&json!(["y"]), &json!(6000)));

    // It goes on from the drive, and is listed newest first.
    let again =
        iterated(&app, &json!({"target": {"run": run}, "start": {"run": drive}, "name": "again"})).await;
    assert!(again["total_error"].as_f64() <= found["total_error"].as_f64(), "{again}");
    let listed = app.get(ITERATIONS).await.expect(200).json();
    assert_eq!((&listed["items"][0]["id"], &listed["items"][1]["id"]), (&again["id"], &found["id"]));
    app.delete(&format!("/v1/rigs/bench/runs/{drive}")).await.expect(204);
    let href = format!("{ITERATIONS}/{}", found["id"].as_str().expect("an id"));
    assert_eq!(app.get(&href).await.expect(200).json()["drive"], Value::Null);
}

#[tokio::test]
async fn a_target_that_comes_with_the_request_becomes_a_run_and_gives_the_same_drive() {
    let app = TestApp::start();
    let (target, run) = bench_with_target(&app).await;
    let stored = iterated(&app, &json!({"target": {"run": run}, "iterations": 3})).await;
    let runs = async || app.get("/v1/rigs/bench/runs?tag=target").await.expect(200).json()["items"].clone();
    assert_eq!(runs().await, json!([]));
    let request = json!({"name": "track again", "iterations": 3,
        "target": {"sample_rate_hz": 100, "channels": {"y": target}}});
    let found = iterated(&app, &request).await;
    assert_eq!((&found["steps"], &found["errors"]), (&stored["steps"], &stored["errors"]));
    let kept = &runs().await[0];
    assert_eq!(found["request"]["target"], json!({"run": kept["id"]}));
    assert_eq!(
        (&kept["name"], &kept["split"], &kept["channels"], &kept["units"]),
        (&json!("target for track again"), &json!("test"), &json!(["y"]), &json!(["mm"]))
    );
    let path = format!("/v1/rigs/bench/runs/{}/data", kept["id"].as_str().expect("an id"));
    assert_eq!(app.get(&path).await.expect(200).json()["channels"]["y"], json!(target));
    // A list of names beside a run is no signals.
    let named = json!({"target": {"run": kept["id"], "channels": "y"}, "start": "zero", "iterations": 1});
    iterated(&app, &named).await;
}

#[tokio::test]
async fn a_refused_iteration_leaves_no_target_behind_and_a_restart_loses_none() {
    let app = TestApp::start();
    app.bench_with_model().await;
    let request =
        json!({"target": {"sample_rate_hz": 100, "channels": {"y": noise(500, 5)}}, "iterations": 2});
    let send = async |app: &TestApp, body: &Value| {
        app.call("POST", ITERATIONS).header("idempotency-key", "k").json(body).send().await
    };
    let mut unknown = request.clone();
    unknown["model"] = json!(9);
    send(&app, &unknown).await.problem(404, "model.not_found");
    assert!(
        app.get("/v1/rigs/bench/runs").await.expect(200).json()["items"]
            .as_array()
            .is_some_and(Vec::is_empty)
    );
    let job = send(&app, &request).await.expect(202).json();
    let app = app.restart();
    assert_eq!(send(&app, &request).await.expect(202).json()["id"], job["id"], "once under its key");
    send(&app, &unknown).await.problem(422, "idempotency_key.reused");
    let job = app.finished(job["id"].as_str().expect("an id")).await;
    assert_eq!(job["state"], "succeeded", "{job}");
    let runs = app.get("/v1/rigs/bench/runs?tag=target").await.expect(200).json();
    assert_eq!(runs["items"].as_array().map(Vec::len), Some(1));
}

#[tokio::test]
async fn limits_hold_and_the_report_says_what_they_cost() {
    let app = TestApp::start();
    let (_, run) = bench_with_target(&app).await;
    let found = iterated(&app, &json!({"target": {"run": run}, "limits": {"u": {"peak": 0.5}}})).await;
    let best = &found["steps"][found["best"].as_u64().expect("a step") as usize];
    assert!(best["drive_peak"]["u"].as_f64().expect("a number") <= 0.5, "{best}");
    assert!(best["limited"]["u"].as_f64().expect("a share") > 0.05, "{best}");
    let warnings = found["warnings"].to_string();
    assert!(warnings.contains("The limits of u changed"), "{warnings}");
}

#[tokio::test]
async fn what_does_not_suit_the_rig_is_refused_with_its_place() {
    let app = TestApp::start();
    let (_, run) = bench_with_target(&app).await;
    let none = "0197f1a0-0000-7000-8000-000000000000";
    let short = app.run("kind=service", "u,y\n1,2\n2,3\n").await["id"].clone();
    let drives: String =
        std::iter::once("u\n".to_owned()).chain(noise(500, 3).iter().map(|u| format!("{u}\n"))).collect();
    let drives = app.run("kind=service", &drives).await["id"].clone();
    for (request, pointer) in [
        (json!({"target": {"run": none}}), "/target/run"),
        (json!({"target": {"run": short}}), "/target/run"),
        (json!({"target": {"run": drives}}), "/target/run"),
        (json!({"target": {"run": run, "channels": ["u"]}}), "/target/channels/0"),
        (json!({"target": {"run": run, "channels": []}}), "/target/channels"),
        (json!({"target": {"run": run, "channels": ["y", "y"]}}), "/target/channels/1"),
        (json!({"target": {"run": run}, "start": {"run": run}}), "/start/run"),
        (json!({"target": {"run": run}, "start": {"run": drives}}), "/start/run"),
        (json!({"target": {"run": run}, "iterations": 0}), "/iterations"),
        (json!({"target": {"run": run}, "gain": 0}), "/gain"),
        (json!({"target": {"run": run}, "gains": {"u": 1}}), "/gains/u"),
        (json!({"target": {"run": run}, "weights": {"y": 0}}), "/weights/y"),
        (json!({"target": {"run": run}, "limits": {"y": {"peak": 1}}}), "/limits/y"),
        (json!({"target": {"run": run}, "limits": {"u": {"rate": -1}}}), "/limits/u/rate"),
        (json!({"target": {"run": run}, "band_hz": [9, 3]}), "/band_hz"),
        (json!({"target": {"run": run}, "stop": {"error": 2}}), "/stop/error"),
        (json!({"target": {"run": run}, "damage": {"slope": 0}}), "/damage/slope"),
        (json!({"target": {"run": run}, "name": "n".repeat(1001)}), "/name"),
    ] {
        let problem = app.post_json(ITERATIONS, &request).await.problem(422, "iteration.invalid");
        assert_eq!(problem["errors"][0]["pointer"], pointer, "{request}: {problem}");
    }
    let sent = |channels: Value| json!({"target": {"sample_rate_hz": 100, "channels": channels}});
    for (request, pointer) in [
        (sent(json!({"u": vec![1.0; 100]})), "/target/channels/u"),
        (sent(json!({"y": vec![1.0; 63]})), "/target/channels"),
        (sent(json!({})), "/target/channels"),
    ] {
        let problem = app.post_json(ITERATIONS, &request).await.json();
        assert_eq!(problem["errors"][0]["pointer"], pointer, "{problem}");
    }
    let mut fast = sent(json!({"y": vec![1.0; 100]}));
    fast["target"]["sample_rate_hz"] = json!(200);
    let problem = app.post_json(ITERATIONS, &fast).await.problem(422, "signal.sample_rate");
    assert_eq!(problem["errors"][0]["pointer"], "/target/sample_rate_hz");
    fast["target"]["sample_rate_hz"] = json!(0);
    app.post_json(ITERATIONS, &fast).await.problem(422, "body.invalid_value");
    for (target, code) in [
        (json!({}), "body.missing_field"),
        (json!({"channels": ["y"]}), "body.missing_field"),
        (json!({"channels": 3}), "body.invalid_value"),
        (json!({"run": run, "sample_rate_hz": 100, "channels": {"y": [1.0]}}), "body.invalid_value"),
        (json!({"run": run, "chanels": ["y"]}), "body.unknown_field"),
    ] {
        app.post_json(ITERATIONS, &json!({"target": target})).await.problem(422, code);
    }
    app.post_json(ITERATIONS, &json!({"target": {"run": run}, "model": 9}))
        .await
        .problem(404, "model.not_found");
    app.get(&format!("{ITERATIONS}/{none}")).await.problem(404, "iteration.not_found");
    app.post_json("/v1/rigs/none/iterations", &json!({"target": {"run": run}}))
        .await
        .problem(404, "rig.not_found");
    // A target of zeros is seen by the job.
    let zeros: String = std::iter::once("y\n".to_owned()).chain((0..500).map(|_| "0\n".to_owned())).collect();
    let zeros = app.run("kind=service", &zeros).await["id"].clone();
    let job = app.post_json(ITERATIONS, &json!({"target": {"run": zeros}})).await.expect(202).json();
    let job = app.finished(job["id"].as_str().expect("an id")).await;
    assert_eq!(
        (&job["state"], &job["problem"]["code"]),
        (&json!("failed"), &json!("iteration.invalid")),
        "{job}"
    );
}

/// The tool of the examples, which knows the service by its contract only.
#[tokio::test]
async fn a_tool_outside_the_service_iterates_with_the_inverse_and_predictions() {
    let Some(mut python) = python() else { return };
    let app = TestApp::start();
    app.rig(&bench()).await;
    // A resonator: the correction must get its phase right.
    let (mut y, mut v) = (0.0, 0.0);
    let rows = |samples: Vec<f64>, y: &mut f64, v: &mut f64| {
        let row = |u: f64| {
            *v += 0.3 * (u - *y) - 0.2 * *v;
            *y += *v;
            format!("{u},{}\n", *y + 3.0)
        };
        std::iter::once("u,y\n".to_owned()).chain(samples.into_iter().map(row)).collect::<String>()
    };
    let training = rows(noise(60_000, 1), &mut y, &mut v);
    app.run("kind=noise", &training).await;
    let job =
        app.post_json("/v1/rigs/bench/fits", &json!({"kind": "frf", "frf": {"segment_len": 256}})).await;
    let job = app.finished(job.expect(202).json()["id"].as_str().expect("an id")).await;
    assert_eq!(job["state"], "succeeded", "{job}");
    let target =
        app.run("kind=service&split=test", &rows(noise(6000, 2), &mut y, &mut v)).await["id"].clone();

    let folder = tempfile::tempdir().expect("a directory");
    let tool = concat!(env!("CARGO_MANIFEST_DIR"), "/examples/iterate.py");
    let run = target.as_str().expect("an id").to_owned();
    let (address, out) = (format!("http://{}", app.address()), folder.path().join("drive.npy"));
    python.arg(tool).args([&address, "bench", &run, "--model", "1", "--out"]).arg(&out);
    let output =
        tokio::task::spawn_blocking(move || python.output()).await.expect("no panic").expect("Python runs");
    let said = String::from_utf8_lossy(&output.stdout).into_owned();
    assert!(output.status.success(), "{said}{}", String::from_utf8_lossy(&output.stderr));
    let best = said.rsplit("best: ").next().and_then(|rest| rest.split(' ').next()?.parse::<f64>().ok());
    let best = best.unwrap_or_else(|| panic!("{said}"));
    let ours =
        iterated(&app, &json!({"target": {"run": run}, "model": 1, "iterations": 10, "start": "zero"})).await;
    let ours = 100.0 * ours["total_error"].as_f64().expect("a number");
    assert!(best < 1.0 && ours < 1.0, "outside {best} %, inside {ours} %\n{said}");
    assert!(std::fs::read(&out).expect("the drive was written").starts_with(b"\x93NUMPY"));
}

/// A virtual sensor has no drives to iterate.
#[tokio::test]
async fn a_model_whose_inputs_are_not_drives_is_refused() {
    let app = TestApp::start();
    let channel = |name: &str, role: &str| json!({"name": name, "unit": "kN", "role": role});
    let channels = json!([channel("u", "drive"), channel("y", "response"), channel("z", "response")]);
    app.rig(&json!({"id": "bench", "name": "Bench", "sample_rate_hz": 100, "channels": channels})).await;
    let csv: String =
        std::iter::once("z\n".to_owned()).chain(noise(500, 4).iter().map(|z| format!("{z}\n"))).collect();
    let run = app.run("kind=service", &csv).await["id"].clone();
    let weights = gain_weights(&["y"], &["z"], 1.0);
    let sensor = app.post_file("/v1/rigs/bench/models", SAFETENSORS, weights).await.expect(201).json();
    let request = json!({"target": {"run": run}, "model": sensor["version"]});
    app.post_json(ITERATIONS, &request).await.problem(422, "model.not_forward");
}
