//! Predictions: JSON and NPY in request and answer, damage, errors, trust, and refusals.

use rigcast::http::Limits;
use serde_json::{Value, json};

use crate::support::{
    SAFETENSORS, TestApp, bench, f4, f8, gain_model, gain_weights, noise_csv, npy, read_f4, triple, wave,
};

const PREDICT: &str = "/v1/rigs/bench/predict";
const NPY: &str = "application/x-npy";

fn numbers(value: &Value) -> Vec<f64> {
    value.as_array().expect("an array").iter().map(|v| v.as_f64().expect("a number")).collect()
}

fn assert_close(found: &[f64], expected: &[f64], tolerance: f64) {
    assert_eq!(found.len(), expected.len());
    for (i, (f, e)) in found.iter().zip(expected).enumerate() {
        assert!((f - e).abs() <= tolerance, "sample {i}: {f}, expected {e}");
    }
}

#[tokio::test]
async fn a_drive_comes_back_as_the_models_response_with_everything_about_it() {
    let app = TestApp::start();
    app.bench_with_model().await;
    let u = wave(500, 0.4);
    let y: Vec<f64> = u.iter().map(|v| 2.0 * v).collect();
    let measured: Vec<f64> = y.iter().map(|v| 1.1 * v).collect();
    let request = json!({
        "drive": {"sample_rate_hz": 100.0, "channels": {"u": u}},
        "target": {"sample_rate_hz": 100.0, "channels": {"y": measured}},
        "damage": {"slope": 3, "residue": "half"},
    });
    let reply = app.post_json(PREDICT, &request).await.expect(200);
    let answer = reply.json();
    assert_eq!((&answer["model"]["version"], &answer["model"]["kind"]), (&json!(1), &json!("frf")));
    assert_eq!(reply.header("rigcast-model-digest"), answer["model"]["sha256"].as_str().expect("a digest"));
    assert_close(&numbers(&answer["response"]["channels"]["y"]), &y, 1e-9);
    let damage = &answer["damage"]["channels"]["y"];
    assert!((damage["ratio"].as_f64().expect("a ratio") - 1.1f64.powi(-3)).abs() < 1e-9, "{damage}");
    assert_eq!(answer["damage"]["settings"]["residue"], "half");
    let errors = &answer["errors"]["channels"]["y"];
    assert!((errors["rms"].as_f64().expect("a figure") - 0.1 / 1.1).abs() < 1e-9, "{errors}");
    assert_eq!((&answer["trust"]["inside"], &answer["trust"]["spans"]), (&json!(1.0), &json!([])));
}

#[tokio::test]
async fn the_answer_holds_what_was_asked_for_and_nothing_else() {
    let app = TestApp::start();
    app.bench_with_model().await;
    let keys = async |extra: Value| {
        let mut request = json!({"drive": {"sample_rate_hz": 100.0, "channels": {"u": [0.0, 1.0]}}});
        request.as_object_mut().expect("an object").extend(extra.as_object().expect("an object").clone());
        let answer = app.post_json(PREDICT, &request).await.expect(200).json();
        answer.as_object().expect("an object").keys().cloned().collect::<Vec<_>>().join(" ")
    };
    assert_eq!(keys(json!({})).await, "model response trust");
    assert_eq!(keys(json!({"include": ["damage"]})).await, "damage model");
    assert_eq!(keys(json!({"include": []})).await, "model");
    assert_eq!(keys(json!({"damage": {}})).await, "damage model response trust");
    let target = json!({"sample_rate_hz": 100.0, "channels": {"y": [0.0, 1.0]}});
    assert_eq!(keys(json!({"target": target})).await, "damage errors model response trust");
    let problem = app
        .post_json(
            PREDICT,
            &json!({"drive": {"sample_rate_hz": 100.0, "channels": {"u": [0.0]}}, "include": ["errors"]}),
        )
        .await
        .problem(422, "predict.target_missing");
    assert_eq!(problem["errors"][0]["pointer"], "/target");
}

#[tokio::test]
async fn a_drive_outside_the_training_range_is_said_so_by_channel_and_span() {
    let app = TestApp::start();
    app.bench_with_model().await;
    let mut u = vec![0.5; 100];
    u[40..60].fill(1.5);
    let answer = app
        .post_json(PREDICT, &json!({"drive": {"sample_rate_hz": 100.0, "channels": {"u": u}}}))
        .await
        .expect(200)
        .json();
    let trust = &answer["trust"];
    let inside = trust["inside"].as_f64().expect("a share");
    assert!((0.78..=0.8).contains(&inside), "{trust}");
    assert_eq!(trust["spans"][0]["channel"], "u");
    assert!((trust["spans"][0]["from_s"].as_f64().expect("seconds") - 0.4).abs() < 0.011, "{trust}");
}

#[tokio::test]
async fn weights_that_do_not_say_what_they_were_fitted_on_give_no_trust() {
    let app = TestApp::start();
    app.rig(&bench()).await;
    let mut model = gain_model(&["u"], &["y"], 2.0);
    model.range.clear();
    app.activate("bench", rigcast::engine::model::to_safetensors(&model)).await;
    let request = json!({"drive": {"sample_rate_hz": 100.0, "channels": {"u": [0.0, 9.0]}}});
    let reply = app.post_json(PREDICT, &request).await.expect(200);
    assert_eq!(reply.json()["trust"], json!({"inside": null, "spans": []}));
    assert!(!reply.headers.contains_key("rigcast-trust-inside"));
}

#[tokio::test]
async fn drive_and_target_may_be_a_stored_run() {
    let app = TestApp::start();
    app.bench_with_model().await;
    let run = app.run("kind=service&split=test", &noise_csv(300, 2)).await;
    let source = json!({"run": run["id"]});
    let answer = app.post_json(PREDICT, &json!({"drive": source, "target": source})).await.expect(200).json();
    let rms = answer["errors"]["channels"]["y"]["rms"].as_f64().expect("a figure");
    assert!(rms < 1e-9, "the run is y = 2 u, and so is the model: {rms}");
    let unknown = json!({"run": "0197f1a0-0000-7000-8000-000000000000"});
    app.post_json(PREDICT, &json!({"drive": unknown})).await.problem(404, "run.not_found");
    let both = json!({"run": run["id"], "sample_rate_hz": 100.0, "channels": {"u": [0.0]}});
    let problem = app.post_json(PREDICT, &json!({"drive": both})).await.problem(422, "body.invalid_value");
    assert_eq!(problem["errors"][0]["pointer"], "/drive");
}

#[tokio::test]
async fn arrays_go_in_and_out_in_either_precision_and_order() {
    let app = TestApp::start();
    app.bench_with_model().await;
    let u = [0.0, 0.25, -0.5, 0.125];
    let expected = [0.0, 0.5, -1.0, 0.25];
    let query = "model=active&sample_rate_hz=100";
    let files = [
        npy("<f8", false, "(4, 1)", &f8(&u)),
        npy("<f8", true, "(4, 1)", &f8(&u)),
        npy("<f4", false, "(4, 1)", &f4(&u.map(|v| v as f32))),
    ];
    for file in files {
        let reply = app.post_file(&format!("{PREDICT}?{query}"), NPY, file).await.expect(200);
        assert_eq!(reply.header("content-type"), NPY);
        assert_eq!((reply.header("rigcast-model-version"), reply.header("rigcast-channels")), ("1", "y"));
        assert_eq!(reply.header("rigcast-trust-inside"), "1");
        let (header, values) = read_f4(&reply.bytes);
        // The shape's blanks and last comma are the writer's choice.
        let header: String = header.split_whitespace().collect();
        assert!(header.contains("'<f4'") && header.contains(":False") && header.contains("(4,1"), "{header}");
        assert_close(&values.iter().map(|v| f64::from(*v)).collect::<Vec<_>>(), &expected, 1e-6);
    }
    let file = npy("<f8", false, "(4, 1)", &f8(&u));
    let json_out = app.call("POST", &format!("{PREDICT}?{query}")).header("accept", "application/json");
    let answer = json_out.body(NPY, file).send().await.expect(200).json();
    assert_close(&numbers(&answer["response"]["channels"]["y"]), &expected, 1e-9);
    let npy_out = app.call("POST", PREDICT).header("accept", NPY);
    let request = json!({"drive": {"sample_rate_hz": 100.0, "channels": {"u": u}}});
    let reply = npy_out.json(&request).send().await.expect(200);
    assert_eq!(read_f4(&reply.bytes).1.len(), 4);
}

#[tokio::test]
async fn a_drive_longer_than_the_service_predicts_at_once_comes_back_whole() {
    let app = TestApp::start();
    app.bench_with_model().await;
    let u = wave(600_000, 0.4);
    let expected: Vec<f64> = u.iter().map(|v| 2.0 * v).collect();
    let file = npy("<f8", false, "(600000, 1)", &f8(&u));
    let reply = app.post_file(&format!("{PREDICT}?sample_rate_hz=100"), NPY, file).await.expect(200);
    let found: Vec<f64> = read_f4(&reply.bytes).1.iter().map(|v| f64::from(*v)).collect();
    assert_close(&found, &expected, 1e-6);
    let request = json!({"drive": {"sample_rate_hz": 100.0, "channels": {"u": u}}, "include": ["response"]});
    let answer = app.post_json(PREDICT, &request).await.expect(200).json();
    assert_close(&numbers(&answer["response"]["channels"]["y"]), &expected, 1e-9);
}

#[tokio::test]
async fn an_array_over_the_limit_of_drives_is_refused() {
    let app = TestApp::start_with(Limits { drive_bytes: 1000, ..Limits::default() });
    app.bench_with_model().await;
    let post = |samples: usize| {
        let file = npy("<f8", false, &format!("({samples}, 1)"), &f8(&vec![0.5; samples]));
        app.call("POST", &format!("{PREDICT}?sample_rate_hz=100")).body(NPY, file).send()
    };
    post(100).await.expect(200);
    let problem = post(126).await.problem(413, "body.too_large");
    assert_eq!(problem["errors"][0]["limit"], "1000 bytes");
}

#[tokio::test]
async fn a_version_answers_by_its_number_and_none_without_an_active_model() {
    let app = TestApp::start();
    app.rig(&triple()).await;
    let path = "/v1/rigs/triple/predict";
    let drive = json!({"sample_rate_hz": 100.0, "channels": {"u": [0.0, 1.0, 0.0]}});
    app.post_json(path, &json!({"drive": drive})).await.problem(409, "model.none_active");
    app.post_json(path, &json!({"model": 1, "drive": drive})).await.problem(404, "model.not_found");
    app.post_json("/v1/rigs/none/predict", &json!({"drive": drive})).await.problem(404, "rig.not_found");
    let sensor = gain_weights(&["fx"], &["fy"], 3.0);
    app.post_file("/v1/rigs/triple/models", SAFETENSORS, sensor).await.expect(201);
    let drive = json!({"sample_rate_hz": 100.0, "channels": {"fx": [0.0, 0.5, 0.0]}});
    let answer = app.post_json(path, &json!({"model": 1, "drive": drive})).await.expect(200).json();
    assert_close(&numbers(&answer["response"]["channels"]["fy"]), &[0.0, 1.5, 0.0], 1e-9);
    let file = npy("<f8", false, "(3, 1)", &f8(&[0.0, 0.5, 0.0]));
    app.post_file(&format!("{path}?model=1&sample_rate_hz=100"), NPY, file).await.expect(200);
}

#[tokio::test]
async fn three_channels_of_a_group_get_their_multi_rain() {
    let app = TestApp::start();
    app.rig(&triple()).await;
    app.activate("triple", gain_weights(&["u"], &["fx", "fy", "fz"], 2.0)).await;
    let u = wave(300, 1.0);
    let wanted: Vec<f64> = u.iter().map(|v| 2.0 * v).collect();
    let request = json!({
        "drive": {"sample_rate_hz": 100.0, "channels": {"u": u}},
        "target": {"sample_rate_hz": 100.0, "channels": {"fx": wanted, "fy": wanted, "fz": wanted}},
        "include": ["damage"],
    });
    let answer = app.post_json("/v1/rigs/triple/predict", &request).await.expect(200).json();
    let group = &answer["damage"]["groups"]["force"];
    assert!((group["ratio"].as_f64().expect("a ratio") - 1.0).abs() < 1e-9, "{group}");
    let direction = numbers(&group["direction_predicted"]);
    // Three equal channels do the largest damage along their diagonal.
    assert!(direction.iter().all(|d| (d - 3.0f64.sqrt().recip()).abs() < 0.1), "{direction:?}");
    let mut partial = request.clone();
    partial["target"]["channels"].as_object_mut().expect("an object").remove("fy");
    let answer = app.post_json("/v1/rigs/triple/predict", &partial).await.expect(200).json();
    assert_eq!(answer["damage"]["groups"]["force"].get("ratio"), None, "one channel has no target");
    assert!(answer["damage"]["channels"]["fx"]["ratio"].is_number());
}

#[tokio::test]
async fn drives_that_do_not_suit_the_model_are_refused_by_name() {
    let app = TestApp::start();
    app.bench_with_model().await;
    let refused = async |drive: Value, code: &str| {
        let reply = app.post_json(PREDICT, &json!({"drive": drive})).await;
        reply.problem(422, code)["errors"][0].clone()
    };
    let signals = |rate: f64, channels: Value| json!({"sample_rate_hz": rate, "channels": channels});
    let place = refused(signals(100.0, json!({})), "predict.missing_channel").await;
    assert_eq!(place["channel"], "u");
    let place = refused(signals(100.0, json!({"u": [0.0], "w": [0.0]})), "predict.unknown_channel").await;
    assert_eq!(place["channel"], "w");
    let place = refused(signals(200.0, json!({"u": [0.0]})), "predict.sample_rate").await;
    assert_eq!((&place["pointer"], &place["limit"]), (&json!("/drive/sample_rate_hz"), &json!("100 Hz")));
    refused(signals(100.0, json!({"u": []})), "signal.empty").await;
    refused(signals(0.0, json!({"u": [0.0]})), "body.invalid_value").await;
    let place = refused(signals(100.0, json!({"u": [0.0, null]})), "body.invalid_value").await;
    assert_eq!(place["pointer"], "/drive/channels/u/1");
    let place = refused(json!({"sample_rate_hz": 100.0}), "body.missing_field").await;
    assert_eq!(place["pointer"], "/drive/channels");
    let place = refused(json!({"sample_rate_hz": 100.0, "chanels": {}}), "body.unknown_field").await;
    assert_eq!(place["pointer"], "/drive/chanels");
    let text = r#"{"drive": {"sample_rate_hz": 100, "channels": {"u": [0, NaN]}}}"#;
    app.post_file(PREDICT, "application/json", text).await.problem(400, "body.syntax");
    let run = app.run("kind=other", "y\n1\n2\n").await;
    let place = refused(json!({"run": run["id"]}), "predict.missing_channel").await;
    assert_eq!(place["channel"], "u");
}

#[tokio::test]
async fn channels_of_unequal_length_are_refused_by_name() {
    let app = TestApp::start();
    app.rig(&triple()).await;
    app.post_file("/v1/rigs/triple/models", SAFETENSORS, gain_weights(&["fx", "fy"], &["fz"], 1.0))
        .await
        .expect(201);
    let drive = json!({"sample_rate_hz": 100.0, "channels": {"fx": [0.0, 1.0], "fy": [0.0]}});
    let reply = app.post_json("/v1/rigs/triple/predict", &json!({"model": 1, "drive": drive})).await;
    let problem = reply.problem(422, "signal.unequal_lengths");
    assert_eq!(
        problem["errors"][0],
        json!({"pointer": "/drive/channels", "channel": "fy", "limit": "2 samples"})
    );
}

#[tokio::test]
async fn targets_that_do_not_suit_are_refused_by_name() {
    let app = TestApp::start();
    app.bench_with_model().await;
    let refused = async |target: Value, code: &str| {
        let drive = json!({"sample_rate_hz": 100.0, "channels": {"u": [0.0, 1.0]}});
        let reply = app.post_json(PREDICT, &json!({"drive": drive, "target": target})).await;
        reply.problem(422, code)["errors"][0].clone()
    };
    let signals = |rate: f64, channels: Value| json!({"sample_rate_hz": rate, "channels": channels});
    let place = refused(signals(100.0, json!({"q": [0.0, 1.0]})), "predict.unknown_channel").await;
    assert_eq!((&place["pointer"], &place["channel"]), (&json!("/target/channels"), &json!("q")));
    refused(signals(100.0, json!({})), "predict.missing_channel").await;
    refused(signals(99.0, json!({"y": [0.0, 1.0]})), "predict.sample_rate").await;
    refused(signals(100.0, json!({"y": [0.0]})), "predict.unequal_lengths").await;
}

#[tokio::test]
async fn damage_settings_outside_their_limits_are_refused_by_name() {
    let app = TestApp::start();
    app.bench_with_model().await;
    for (damage, pointer) in [
        (json!({"slope": 0}), "/damage/slope"),
        (json!({"constant": -1.0}), "/damage/constant"),
        (json!({"directions": 0}), "/damage/directions"),
    ] {
        let drive = json!({"sample_rate_hz": 100.0, "channels": {"u": [0.0, 1.0]}});
        let reply = app.post_json(PREDICT, &json!({"drive": drive, "damage": damage})).await;
        assert_eq!(reply.problem(422, "setting.out_of_range")["errors"][0]["pointer"], pointer);
    }
}

#[tokio::test]
async fn arrays_that_do_not_suit_the_model_are_refused() {
    let app = TestApp::start();
    app.bench_with_model().await;
    let one = npy("<f8", false, "(1, 1)", &f8(&[0.5]));
    let post = |query: &str, file: Vec<u8>| {
        let path = format!("{PREDICT}{query}");
        let call = app.call("POST", &path).body(NPY, file);
        call.send()
    };
    post("", one.clone()).await.problem(422, "query.invalid");
    post("?sample_rate_hz=0", one.clone()).await.expect(422);
    post("?sample_rate_hz=200", one.clone()).await.problem(422, "predict.sample_rate");
    post("?sample_rate_hz=100&model=latest", one.clone()).await.problem(422, "query.invalid");
    post("?sample_rate_hz=100&rig=x", one.clone()).await.problem(422, "query.unknown_parameter");
    let two = npy("<f8", false, "(1, 2)", &f8(&[0.5, 0.5]));
    post("?sample_rate_hz=100", two).await.problem(422, "signal.channel_count");
    let nan = npy("<f8", false, "(2, 1)", &f8(&[0.5, f64::NAN]));
    let problem = post("?sample_rate_hz=100", nan).await.problem(422, "run.non_finite");
    assert_eq!((&problem["errors"][0]["channel"], &problem["errors"][0]["sample"]), (&json!("u"), &json!(1)));
    post("?sample_rate_hz=100", b"nonsense".to_vec()).await.problem(400, "npy.header");
    for media_type in ["application/zip", "application/octet-stream", "text/plain"] {
        let other = app.call("POST", PREDICT).body(media_type, "u\n1\n").send().await;
        other.problem(415, "content_type.unsupported");
    }
    let html = app.call("POST", &format!("{PREDICT}?sample_rate_hz=100")).header("accept", "text/html");
    html.body(NPY, one).send().await.problem(406, "accept.not_acceptable");
    app.post_json(&format!("{PREDICT}?model=1"), &json!({})).await.problem(422, "query.unknown_parameter");
}

#[tokio::test]
async fn a_drive_comes_as_any_file_that_a_run_comes_as() {
    let app = TestApp::start();
    app.bench_with_model().await;
    let u = wave(500, 0.4);
    let request = json!({"drive": {"sample_rate_hz": 100.0, "channels": {"u": u}}});
    let expected = app.post_json(PREDICT, &request).await.expect(200).json();
    let expected = numbers(&expected["response"]["channels"]["y"]);
    let post = |query: &str, media_type: &str, file: Vec<u8>| {
        app.call("POST", &format!("{PREDICT}{query}"))
            .body(media_type, file)
            .header("accept", "application/json")
    };
    let response = |answer: serde_json::Value| numbers(&answer["response"]["channels"]["y"]);
    // A German export in newtons, with a measured response beside the drive and a column that the rig does not have.
    let rows = u.iter().enumerate().map(|(i, v)| {
        format!(
            "{};{};1,5;20\n",
            format!("{:.2}", i as f64 / 100.0).replace('.', ","),
            (1e3 * v).to_string().replace('.', ",")
        )
    });
    let german = format!("Zeit [s];U [N];y [mm];temp\n{}", rows.collect::<String>()).into_bytes();
    let answer = post("?ignore=temp", "text/csv", german.clone()).send().await.expect(200);
    assert_close(&response(answer.json()), &expected, 1e-12);
    post("", "text/csv", german).send().await.problem(422, "run.unknown_channel");
    // A drive that went out as RPC III or MAT comes in again, and the answer is a file of its kind.
    let csv = format!("u\n{}", u.iter().map(|v| format!("{v}\n")).collect::<String>());
    let run = app.post_file("/v1/rigs/bench/runs?name=drive", "text/csv", csv.clone()).await.expect(201);
    for (media_type, off) in [("application/x-rpc3", 1e-4), ("application/x-matlab-data", 1e-12)] {
        let data = app.call("GET", &format!("{}/data", run.header("location"))).header("accept", media_type);
        let file = data.send().await.expect(200).bytes;
        let answer = post("", media_type, file.clone()).send().await.expect(200);
        assert_close(&response(answer.json()), &expected, off);
        let reply = app.call("POST", PREDICT).body(media_type, file).send().await.expect(200);
        assert_eq!(reply.header("content-type"), media_type);
        assert_eq!(reply.header("rigcast-channels"), "y");
    }
    let reply = app.call("POST", PREDICT).body("text/csv", csv.clone()).send().await.expect(200);
    assert!(reply.text().starts_with("time_s,y\ns,mm\n0.0,"), "{}", &reply.text()[..40]);
    // Another rate is refused, or converted.
    let twice: String = u.iter().map(|v| format!("{v}\n{v}\n")).collect();
    let fast = format!("u\n{twice}").into_bytes();
    post("?sample_rate_hz=200", "text/csv", fast.clone()).send().await.problem(422, "run.sample_rate");
    let answer = post("?sample_rate_hz=200&resample=true", "text/csv", fast).send().await.expect(200);
    assert_eq!(response(answer.json()).len(), expected.len());
    let lacks = post("", "text/csv", b"y\n1\n2\n".to_vec()).send().await;
    assert_eq!(lacks.problem(422, "predict.missing_channel")["errors"][0]["channel"], "u");
    let broken = post("", "application/x-matlab-data", csv.into_bytes()).send().await;
    broken.problem(400, "mat.invalid");
    post("?model=7", "text/csv", b"u\n1\n2\n".to_vec()).send().await.problem(404, "model.not_found");
    post("?dry_run=true", "text/csv", b"u\n1\n2\n".to_vec())
        .send()
        .await
        .problem(422, "query.unknown_parameter");
}

#[tokio::test]
async fn a_long_prediction_comes_back_whole() {
    let app = TestApp::start();
    app.rig(&triple()).await;
    app.activate("triple", gain_weights(&["u"], &["fx", "fy", "fz"], 2.0)).await;
    let u = wave(60_000, 0.4);
    let request = json!({"drive": {"sample_rate_hz": 100.0, "channels": {"u": u}}});
    let answer = app.post_json("/v1/rigs/triple/predict", &request).await.expect(200).json();
    let expected: Vec<f64> = u.iter().map(|v| 2.0 * v).collect();
    assert_close(&numbers(&answer["response"]["channels"]["fz"]), &expected, 1e-9);
}
