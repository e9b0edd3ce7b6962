//! Fits: from runs to an active model that predicts, and what is refused before and after.

use serde_json::{Value, json};

use crate::support::{TestApp, bench, noise, noise_csv};

const FITS: &str = "/v1/rigs/bench/fits";

async fn with_noise(samples: usize) -> TestApp {
    let app = TestApp::start();
    app.rig(&bench()).await;
    app.run("kind=noise", &noise_csv(samples, 21)).await;
    app
}

async fn fitted(app: &TestApp, request: Value) -> Value {
    let job = app.post_json(FITS, &request).await.expect(202).json();
    app.finished(job["id"].as_str().expect("an id")).await
}

#[tokio::test]
async fn a_fit_ends_in_an_active_model_that_predicts_the_rig() {
    let app = with_noise(6000).await;
    let job = fitted(&app, json!({"kind": "frf", "frf": {"segment_len": 256}})).await;
    assert_eq!(job["state"], "succeeded", "{job}");
    assert_eq!((&job["progress"], &job["result"]["kind"]), (&json!(1.0), &json!("model")));
    let model = app.get(job["result"]["href"].as_str().expect("a link")).await.expect(200).json();
    assert_eq!(
        (&model["origin"], &model["job"], &model["active"]),
        (&json!("fit"), &job["id"], &json!(true))
    );
    assert_eq!(model["report"]["frf"]["segment_len"], 256);
    assert_eq!(model["request"]["inputs"], json!(["u"]));
    let u = noise(500, 99);
    let request = json!({"drive": {"sample_rate_hz": 100.0, "channels": {"u": u}}});
    let answer = app.post_json("/v1/rigs/bench/predict", &request).await.expect(200).json();
    let y = answer["response"]["channels"]["y"].as_array().expect("samples");
    for (i, (y, u)) in y.iter().zip(&u).enumerate() {
        let found = y.as_f64().expect("a number");
        assert!((found - 2.0 * u).abs() < 0.05, "sample {i}: {found}, expected {}", 2.0 * u);
    }
}

#[tokio::test]
async fn a_model_repeats_the_faults_of_the_runs_that_it_was_fitted_on() {
    let app = with_noise(6000).await;
    let clipped: String = std::iter::once("u,y\n".to_owned())
        .chain(noise(6000, 22).iter().map(|u| format!("{u},{}\n", (2.0 * u).clamp(-1.0, 1.0))))
        .collect();
    app.run("kind=noise&name=n2", &clipped).await;
    let job = fitted(&app, json!({"kind": "frf", "frf": {"segment_len": 256}})).await;
    let model = app.get(job["result"]["href"].as_str().expect("a link")).await.expect(200).json();
    let warnings = model["report"]["warnings"].as_array().expect("warnings");
    let told: Vec<&str> =
        warnings.iter().filter_map(Value::as_str).filter(|w| w.contains("is clipped")).collect();
    assert_eq!(told.len(), 1, "{warnings:?}");
    assert!(told[0].starts_with("y is clipped in 1 of 2 runs (n2), up to "), "{warnings:?}");
}

#[tokio::test]
async fn a_small_lstm_is_fitted_too_and_its_weights_go_round() {
    let app = with_noise(4000).await;
    let lstm = json!({"blocks": [4], "window_len": 32, "hop": 16, "epochs": 2, "seeds": [1]});
    let job = fitted(&app, json!({"kind": "hybrid2", "lstm": lstm, "activate": "never"})).await;
    assert_eq!(job["state"], "succeeded", "{job}");
    let href = job["result"]["href"].as_str().expect("a link").to_owned();
    let model = app.get(&href).await.expect(200).json();
    assert_eq!((&model["report"]["best_seed"], &model["active"]), (&json!(1), &json!(false)));
    let weights = app.get(&format!("{href}/weights")).await.expect(200).bytes;
    let again =
        app.post_file("/v1/rigs/bench/models", "application/x-safetensors", weights).await.expect(201).json();
    assert_eq!(again["sha256"], model["sha256"]);
}

#[tokio::test]
async fn a_fit_starts_at_a_version_and_says_so_and_what_does_not_suit_is_refused() {
    let app = with_noise(4000).await;
    let lstm = json!({"blocks": [4], "window_len": 32, "hop": 16, "epochs": 3, "seeds": [1]});
    let first = fitted(&app, json!({"kind": "lstm", "lstm": lstm})).await;
    assert_eq!(first["result"]["id"], "1", "{first}");
    // A new measurement, and blocks that are left open.
    let new = app.run("kind=noise", &noise_csv(4000, 22)).await["id"].clone();
    let lstm = json!({"window_len": 32, "hop": 16, "epochs": 2, "seeds": [1]});
    let request = json!({"kind": "lstm", "lstm": lstm, "runs": [new], "start": {"version": 1}});
    let job = fitted(&app, request.clone()).await;
    assert_eq!(job["state"], "succeeded", "{job}");
    let model = app.get(job["result"]["href"].as_str().expect("a link")).await.expect(200).json();
    assert_eq!(model["request"]["start"], json!({"version": 1}));
    assert_eq!(model["report"]["lstm"]["blocks"], json!([4]));
    let start = &model["lineage"]["start"];
    let one = app.get("/v1/rigs/bench/models/1").await.expect(200).json();
    assert_eq!((&start["version"], &start["sha256"]), (&json!(1), &one["sha256"]));
    assert_eq!(start["seen"][0], one["lineage"]["training"][0]);
    assert_eq!(model["report"]["warnings"], json!([]), "the version has not seen the new run");

    // On the data that the version has seen no error is a measure, and nothing becomes active.
    let mut again = request.clone();
    again["runs"] = model["lineage"]["start"]["seen"][0]["run"].clone();
    let job = fitted(&app, again).await;
    let seen = app.get(job["result"]["href"].as_str().expect("a link")).await.expect(200).json();
    let warnings = seen["report"]["warnings"].to_string();
    assert!(!warnings.contains("has seen data"), "the last tenth compared version 1 too: {warnings}");
    let mut whole = request.clone();
    whole["validation_runs"] = json!([one["lineage"]["training"][0]["run"]]);
    let job = fitted(&app, whole).await;
    let seen = app.get(job["result"]["href"].as_str().expect("a link")).await.expect(200).json();
    assert!(seen["report"]["warnings"].to_string().contains("has seen data"), "{seen}");
    assert_eq!(seen["active"], false, "{job}");

    // Bad input.
    for (change, pointer) in [
        (json!({"kind": "hybrid2"}), "/start/version"),
        (json!({"kind": "frf"}), "/start"),
        (json!({"inputs": ["y"], "outputs": ["u"]}), "/start/version"),
        (json!({"lstm": {"blocks": [5], "window_len": 32, "hop": 16}}), "/lstm/blocks"),
    ] {
        let mut bad = request.clone();
        bad.as_object_mut().expect("an object").extend(change.as_object().expect("an object").clone());
        let problem = app.post_json(FITS, &bad).await.problem(422, "fit.invalid");
        assert_eq!(problem["errors"][0]["pointer"], pointer, "{problem}");
    }
    let mut bad = request.clone();
    bad["start"] = json!({"version": 99});
    let problem = app.post_json(FITS, &bad).await.problem(404, "model.not_found");
    assert_eq!(problem["errors"][0]["pointer"], "/start/version");
    // Versions are a rig's own: another rig has none of this number.
    let mut other = bench();
    other["id"] = json!("other");
    app.rig(&other).await;
    app.post_file("/v1/rigs/other/runs?kind=noise", "text/csv", noise_csv(4000, 23)).await.expect(201);
    let lstm = json!({"kind": "lstm", "start": {"version": 1}});
    app.post_json("/v1/rigs/other/fits", &lstm).await.problem(404, "model.not_found");
    bad["start"] = json!({"version": 1, "weights": "all"});
    app.post_json(FITS, &bad).await.problem(422, "body.unknown_field");
    // An imported version tells its blocks only when it is read.
    let weights = app.get("/v1/rigs/bench/models/1/weights").await.expect(200).bytes;
    let imported = app.post_file("/v1/rigs/bench/models", "application/x-safetensors", weights).await;
    let mut from = request.clone();
    from["start"] = json!({"version": imported.expect(201).json()["version"]});
    let job = fitted(&app, from.clone()).await;
    assert_eq!(job["state"], "succeeded", "{job}");
    from["lstm"]["blocks"] = json!([5]);
    let job = fitted(&app, from).await;
    assert_eq!((&job["state"], &job["problem"]["code"]), (&json!("failed"), &json!("fit.invalid")));
    assert_eq!(job["problem"]["errors"][0]["pointer"], "/lstm/blocks");
}

#[tokio::test]
async fn the_preset_of_the_paper_follows_the_task_and_is_echoed() {
    let app = with_noise(3000).await;
    // From the drive to the response, and back: no forward model, so virtual sensing.
    for (inputs, outputs, task, blocks) in
        [(["u"], ["y"], "forward", [39]), (["y"], ["u"], "virtual_sensing", [29])]
    {
        let request = json!({"kind": "lstm", "inputs": inputs, "outputs": outputs, "preset": "paper",
                             "lstm": {"epochs": 1, "seeds": [1]}});
        let job = fitted(&app, request).await;
        assert_eq!(job["state"], "succeeded", "{job}");
        let model = app.get(job["result"]["href"].as_str().expect("a link")).await.expect(200).json();
        let report = &model["report"];
        assert_eq!((&report["task"], &report["lstm"]["blocks"]), (&json!(task), &json!(blocks)));
        assert_eq!(report["lstm"]["epochs"], 1, "asked for in place of the hundreds of the paper");
        for (setting, value) in [
            ("optimizer", json!("rmsprop")),
            ("schedule", json!("constant")),
            ("warmup_steps", json!(0)),
            ("learning_rate", json!(2e-4)),
            ("window_len", json!(256)),
            ("hop", json!(128)),
            ("window_offset", json!("fixed")),
            ("burn_in", json!(0.0)),
            ("clip_norm", json!(null)),
            ("validate_every", json!(1)),
            ("hybrid_start", json!("random")),
            ("recombine", json!("welch")),
        ] {
            assert_eq!(report["lstm"][setting], value, "{setting}");
        }
        assert_eq!((&report["recombine"], &model["request"]["preset"]), (&json!("welch"), &json!("paper")));
    }
    let job = fitted(&app, json!({"kind": "frf", "preset": "paper", "frf": {"segment_len": 256}})).await;
    let model = app.get(job["result"]["href"].as_str().expect("a link")).await.expect(200).json();
    assert_eq!(model["report"]["frf"]["estimator"], "ratio", "one drive correlates with no other");
    assert_eq!(model["report"]["frf"]["ridge"], 0.0);
}

#[tokio::test]
async fn a_fit_of_a_rig_without_runs_is_refused() {
    let app = TestApp::start();
    app.rig(&bench()).await;
    app.post_json(FITS, &json!({"kind": "frf"})).await.problem(409, "fit.no_runs");
    app.run("kind=noise&split=test", &noise_csv(3000, 1)).await;
    app.post_json(FITS, &json!({"kind": "frf"})).await.problem(409, "fit.no_runs");
    app.post_json("/v1/rigs/none/fits", &json!({"kind": "frf"})).await.problem(404, "rig.not_found");
    assert_eq!(app.get("/v1/jobs").await.json()["items"], json!([]));
}

#[tokio::test]
async fn channels_and_selections_that_the_rig_does_not_have_are_named() {
    let app = with_noise(3000).await;
    let refused = async |request: Value| {
        app.post_json(FITS, &request).await.problem(422, "fit.invalid")["errors"][0].clone()
    };
    let place = refused(json!({"kind": "frf", "inputs": ["u", "w"]})).await;
    assert_eq!((&place["pointer"], &place["channel"]), (&json!("/inputs/1"), &json!("w")));
    let place = refused(json!({"kind": "frf", "runs": {"split": "test"}})).await;
    assert_eq!(place["pointer"], "/runs/split");
    let place = refused(json!({"kind": "frf", "runs": ["0197f1a0-0000-7000-8000-000000000000"]})).await;
    assert_eq!(place["pointer"], "/runs/0");
    for (request, code) in [
        (json!({"kind": "narx"}), "body.invalid_value"),
        (json!({"kind": "frf", "epochs": 3}), "body.unknown_field"),
        (json!({"kind": "frf", "lstm": {"epoch": 3}}), "body.unknown_field"),
        (json!({}), "body.missing_field"),
    ] {
        app.post_json(FITS, &request).await.problem(422, code);
    }
    assert_eq!(app.get("/v1/jobs").await.json()["items"], json!([]));
}

#[tokio::test]
async fn a_run_that_lacks_a_channel_of_the_fit_is_named_with_the_channel() {
    let app = TestApp::start();
    app.rig(&bench()).await;
    let run = app.run("kind=noise", "u\n1\n2\n3\n").await;
    let problem = app.post_json(FITS, &json!({"kind": "frf"})).await.problem(422, "fit.missing_channel");
    assert_eq!(problem["errors"][0]["channel"], "y", "{problem}");
    assert!(problem.to_string().contains(run["id"].as_str().expect("an id")), "{problem}");
}

#[tokio::test]
async fn a_channel_without_power_and_runs_too_short_for_the_settings_are_refused() {
    let app = TestApp::start();
    app.rig(&bench()).await;
    let mut dead = String::from("u,y\n");
    for y in noise(3000, 5) {
        dead.push_str(&format!("1.5,{y}\n"));
    }
    app.run("kind=noise", &dead).await;
    let problem = refusal(&app, json!({"kind": "frf"}), "signal.dead_channel").await;
    assert_eq!(problem["errors"][0]["channel"], "u", "{problem}");

    let app = with_noise(100).await;
    refusal(&app, json!({"kind": "frf", "frf": {"segment_len": 4096}}), "signal.too_short").await;
    refusal(&app, json!({"kind": "lstm", "lstm": {"window_len": 4096, "hop": 1}}), "signal.too_short").await;
    refusal(&app, json!({"kind": "frf", "frf": {"segment_len": 64, "overlap": 0.0}}), "frf.too_few_averages")
        .await;
    for (request, pointer) in [
        (json!({"kind": "frf", "frf": {"overlap": 1.5}}), "/frf/overlap"),
        (json!({"kind": "frf", "frf": {"segment_len": 3}}), "/frf/segment_len"),
        (json!({"kind": "lstm", "lstm": {"learning_rate": -1.0}}), "/lstm/learning_rate"),
        (json!({"kind": "lstm", "lstm": {"window_len": 64, "hop": 64}}), "/lstm/hop"),
        (json!({"kind": "frf", "preprocess": {"low_pass_hz": 50.0}}), "/preprocess/low_pass_hz"),
    ] {
        let problem = refusal(&app, request, "fit.invalid").await;
        assert_eq!(problem["errors"][0]["pointer"], pointer, "{problem}");
    }
}

/// The problem of a fit, in the answer or from its job; nothing of the fit is stored.
async fn refusal(app: &TestApp, request: Value, code: &str) -> Value {
    let reply = app.post_json(FITS, &request).await;
    let problem = if reply.status == 202 {
        let job = app.finished(reply.json()["id"].as_str().expect("an id")).await;
        assert_eq!(job["state"], "failed", "{job}");
        job["problem"].clone()
    } else {
        reply.expect(422).json()
    };
    assert_eq!(problem["code"], code, "{request}: {problem}");
    assert_eq!(app.get("/v1/rigs/bench/models").await.json()["items"], json!([]), "nothing half-stored");
    problem
}
