//! Model versions: weights in and out, the active one.

use serde_json::json;

use crate::support::{SAFETENSORS, TestApp, bench, gain_model, gain_weights, triple};

const MODELS: &str = "/v1/rigs/bench/models";
const ACTIVE: &str = "/v1/rigs/bench/active-model";

#[tokio::test]
async fn weights_come_out_as_they_went_in() {
    let app = TestApp::start();
    app.rig(&bench()).await;
    let weights = gain_weights(&["u"], &["y"], 2.0);
    let created = app.post_file(MODELS, SAFETENSORS, weights.clone()).await.expect(201);
    assert_eq!(created.header("location"), "/v1/rigs/bench/models/1");
    let model = created.json();
    assert_eq!(
        (&model["version"], &model["origin"], &model["active"]),
        (&json!(1), &json!("import"), &json!(false))
    );
    assert_eq!(
        (&model["kind"], &model["inputs"], &model["outputs"]),
        (&json!("frf"), &json!(["u"]), &json!(["y"]))
    );
    let out = app.get(&format!("{MODELS}/1/weights")).await.expect(200);
    assert_eq!(out.bytes, weights);
    assert_eq!(out.header("etag"), format!("{}", model["sha256"]));
    let second = app.post_file(MODELS, "application/octet-stream", out.bytes).await.expect(201).json();
    assert_eq!((&second["version"], &second["sha256"]), (&json!(2), &model["sha256"]));
    let all = app.get(MODELS).await.expect(200).json();
    assert_eq!(all["items"].as_array().map(Vec::len), Some(2));
}

#[tokio::test]
async fn weights_that_do_not_fit_store_nothing() {
    let app = TestApp::start();
    app.rig(&bench()).await;
    let import = |bytes: Vec<u8>| app.post_file(MODELS, SAFETENSORS, bytes);
    import(Vec::new()).await.problem(422, "weights.malformed");
    import(b"\x80\x04pickle".to_vec()).await.problem(422, "weights.malformed");
    let whole = gain_weights(&["u"], &["y"], 2.0);
    import(whole[..whole.len() - 1].to_vec()).await.problem(422, "weights.malformed");
    let problem = import(gain_weights(&["u"], &["u"], 2.0)).await.problem(422, "weights.malformed");
    assert!(problem["detail"].as_str().expect("text").contains("is an input too"), "{problem}");
    let problem = import(gain_weights(&["u"], &["q"], 2.0)).await.problem(422, "model.unknown_channel");
    assert_eq!(problem["errors"][0]["channel"], "q");
    let mut fast = gain_model(&["u"], &["y"], 2.0);
    fast.sample_rate_hz = 200.0;
    if let Some(frf) = &mut fast.frf {
        frf.sample_rate_hz = 200.0;
    }
    import(rigcast::engine::model::to_safetensors(&fast)).await.problem(422, "model.sample_rate");
    let bend = |change: fn(&mut rigcast::engine::model::RigModel)| {
        let mut model = gain_model(&["u"], &["y"], 2.0);
        change(&mut model);
        import(rigcast::engine::model::to_safetensors(&model))
    };
    let senseless = [
        ("range[0]", bend(|model| (model.range[0].min, model.range[0].max) = (1.0, -1.0)).await),
        ("max_rate", bend(|model| model.range[0].max_rate = -1.0).await),
        ("range[0].band_hz", bend(|model| model.range[0].band_hz = Some([40.0, 2.0])).await),
        ("usable_hz", bend(|model| model.frf.iter_mut().for_each(|frf| frf.usable_hz = [50.0, 0.0])).await),
        ("usable_hz", bend(|model| model.frf.iter_mut().for_each(|frf| frf.usable_hz = [0.0, 80.0])).await),
        ("sample_rate_hz", bend(|model| model.sample_rate_hz = -100.0).await),
    ];
    for (named, answer) in senseless {
        let problem = answer.problem(422, "weights.malformed");
        assert!(problem["detail"].as_str().expect("text").contains(named), "{problem}");
    }
    app.post_file(MODELS, "application/json", "{}").await.problem(415, "content_type.unsupported");
    let all = app.get(MODELS).await.expect(200).json();
    assert_eq!((&all["items"], app.files().len()), (&json!([]), 0));
}

#[tokio::test]
async fn a_tensor_of_the_wrong_shape_is_named() {
    let app = TestApp::start();
    app.rig(&bench()).await;
    // The same bytes under another shape: one line fewer, one input more.
    let weights = gain_weights(&["u"], &["y"], 2.0);
    let header =
        usize::try_from(u64::from_le_bytes(weights[..8].try_into().expect("8 bytes"))).expect("a length");
    let text = String::from_utf8(weights[8..8 + header].to_vec()).expect("text");
    assert!(text.contains("[5,1,1]"), "lines, outputs, inputs: {text}");
    let bent = text.replacen("[5,1,1]", "[1,5,1]", 1);
    let file = [&weights[..8], bent.as_bytes(), &weights[8 + header..]].concat();
    let problem = app.post_file(MODELS, SAFETENSORS, file).await.problem(422, "weights.shape");
    assert!(problem["detail"].as_str().is_some_and(|d| d.contains("frf.")), "{problem}");
    assert_eq!(app.get(MODELS).await.json()["items"], json!([]));
}

#[tokio::test]
async fn the_active_model_changes_only_for_who_knows_the_present_one() {
    let app = TestApp::start();
    app.rig(&bench()).await;
    for gain in [2.0, 3.0] {
        app.post_file(MODELS, SAFETENSORS, gain_weights(&["u"], &["y"], gain)).await.expect(201);
    }
    let none = app.get(ACTIVE).await.expect(200);
    assert_eq!(none.json(), json!({"version": null}));
    let put = |tag: &str, version: serde_json::Value| {
        app.call("PUT", ACTIVE).header("if-match", tag).json(&json!({"version": version})).send()
    };
    let missing = app.call("PUT", ACTIVE).json(&json!({"version": 1})).send().await;
    missing.problem(428, "if_match.missing");
    let first = put(none.header("etag"), json!(1)).await.expect(200);
    assert_eq!(first.json(), json!({"version": 1}));
    put(none.header("etag"), json!(2)).await.problem(412, "if_match.stale");
    assert_eq!(app.get(ACTIVE).await.json(), json!({"version": 1}));
    put(first.header("etag"), json!(9)).await.problem(404, "model.not_found");
    let second = put(first.header("etag"), json!(2)).await.expect(200);
    assert_eq!(app.get(&format!("{MODELS}/2")).await.json()["active"], true);
    app.delete(&format!("{MODELS}/2")).await.problem(409, "model.active");
    app.delete(&format!("{MODELS}/1")).await.expect(204);
    app.get(&format!("{MODELS}/1")).await.problem(404, "model.not_found");
    put(second.header("etag"), json!(null)).await.expect(200);
    app.delete(&format!("{MODELS}/2")).await.expect(204);
    let third = app.post_file(MODELS, SAFETENSORS, gain_weights(&["u"], &["y"], 4.0)).await.expect(201);
    assert_eq!(third.json()["version"], 3, "numbers are not given again");
    for body in [json!({}), json!({"version": "1"}), json!({"version": 1.5}), json!({"version": 1, "x": 1})] {
        let reply = app.call("PUT", ACTIVE).header("if-match", "*").json(&body).send().await;
        assert_eq!(reply.status, 422, "{body}: {}", reply.text());
    }
}

#[tokio::test]
async fn a_virtual_sensor_cannot_be_the_active_model() {
    let app = TestApp::start();
    app.rig(&triple()).await;
    let sensor = gain_weights(&["fx"], &["fy"], 2.0);
    app.post_file("/v1/rigs/triple/models", SAFETENSORS, sensor).await.expect(201);
    let put = app.call("PUT", "/v1/rigs/triple/active-model").header("if-match", "*");
    let problem = put.json(&json!({"version": 1})).send().await.problem(422, "model.not_forward");
    assert_eq!(problem["errors"][0]["pointer"], "/version");
}
