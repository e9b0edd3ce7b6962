//! Request bodies as other programs write them: a list of one as its element, and values of wrong types,
//! which are refused in a client's words.

use std::collections::HashMap;

use safetensors::tensor::{Dtype, TensorView};
use serde_json::{Value, json};

use crate::support::{Contract, SAFETENSORS, TestApp, bench, gain_weights, noise_csv};

/// Sends JSON that the contract's schemas describe loosely: a single value in place of a list.
async fn send(app: &TestApp, method: &str, path: &str, body: &Value) -> crate::support::Reply {
    let bytes = serde_json::to_vec(body).expect("JSON");
    app.call(method, path).header("if-match", "*").body("application/json", bytes).send().await
}

#[tokio::test]
async fn a_single_value_is_taken_for_a_list_of_one_everywhere() {
    let mut app = TestApp::start();
    let drive = json!({"name": "u", "unit": "kN", "role": "drive"});
    let alone = json!({"id": "alone", "sample_rate_hz": 100.0, "channels": drive});
    let rig = send(&app, "POST", "/v1/rigs", &alone).await.expect(201).json();
    assert_eq!(rig["channels"].as_array().expect("a list").len(), 1);
    app.rig(&bench()).await;
    let policy =
        json!({"fit_policy": {"kinds": "sweep", "fits": {"kind": "frf", "inputs": "u", "outputs": "y"}}});
    let rig = send(&app, "PATCH", "/v1/rigs/bench", &policy).await.expect(200).json();
    assert_eq!(rig["fit_policy"]["kinds"], json!(["sweep"]));
    assert_eq!(rig["fit_policy"]["fits"][0]["inputs"], json!(["u"]));

    let sample = json!({"sample_rate_hz": 100.0, "channels": {"u": 1, "y": -2.5}});
    let run = send(&app, "POST", "/v1/rigs/bench/runs?kind=other", &sample).await.expect(201).json();
    assert_eq!(run["samples"], 1);
    let run = app.run("kind=noise", &noise_csv(4000, 5)).await;
    let path = format!("/v1/rigs/bench/runs/{}", run["id"].as_str().expect("an id"));
    let tagged = send(&app, "PATCH", &path, &json!({"tags": "linear"})).await.expect(200).json();
    assert_eq!(tagged["tags"], json!(["linear"]));

    let lstm = json!({"blocks": 4, "seeds": 1, "window_len": 32, "hop": 16, "epochs": 2});
    let fit = json!({
        "kind": "hybrid2", "inputs": "u", "outputs": "y", "runs": run["id"], "lstm": lstm,
        "frf": {"runs": {"kinds": "noise", "tags": "linear"}, "segment_len": 256},
    });
    let job = send(&app, "POST", "/v1/rigs/bench/fits", &fit).await.expect(202).json();
    let job = app.finished(job["id"].as_str().expect("an id")).await;
    assert_eq!(job["state"], "succeeded", "{job}");
    let model = app.get(job["result"]["href"].as_str().expect("a link")).await.expect(200).json();
    let request = &model["request"];
    assert_eq!((&request["lstm"]["blocks"], &request["lstm"]["seeds"]), (&json!([4]), &json!([1])));
    assert_eq!((&request["runs"], &request["outputs"]), (&json!([run["id"]]), &json!(["y"])));

    let predict = json!({
        "drive": {"sample_rate_hz": 100, "channels": {"u": 0.5}},
        "target": {"sample_rate_hz": 100, "channels": {"y": 1}}, "include": "errors",
    });
    let answer = send(&app, "POST", "/v1/rigs/bench/predict", &predict).await.expect(200).json();
    assert!(answer["errors"]["channels"]["y"]["rms"].is_number(), "{answer}");
    let signals = json!({"sample_rate_hz": 100, "channels": {"a": 3, "b": [4]}});
    let answer = send(&app, "POST", "/v1/damage", &json!({"predicted": signals})).await.expect(200).json();
    assert_eq!(answer["damage"]["channels"]["a"]["predicted"], 0.0);

    let tensor = json!({"name": "drive", "datatype": "FP32", "shape": [1, 1], "data": 0.5});
    let infer = json!({"inputs": tensor, "outputs": {"name": "response"}});
    let answer = send(&app, "POST", "/v2/models/bench/infer", &infer).await.expect(200).json();
    assert_eq!(answer["outputs"][0]["shape"], json!([1, 1]));

    // There is no such run, but its list is read.
    let none = "0197f1a0-0000-7000-8000-000000000000";
    let diagnosis = json!({"runs": none, "baseline_runs": none, "catalogue": "damping"});
    let refused = send(&app, "POST", "/v1/rigs/bench/diagnoses", &diagnosis).await.json();
    let code = refused["code"].as_str().expect("a refusal");
    assert!(!code.starts_with("body."), "{refused}");

    app.close_doors().await;
    let token = send(&app, "POST", "/v1/tokens", &json!({"role": "reader", "rigs": "bench"})).await;
    assert_eq!(token.expect(201).json()["rigs"], json!(["bench"]));
}

/// Words of our code that mean nothing to a client.
const WORDS: &[&str] = &[
    "struct", "enum", "variant", "tuple", "newtype", "u8", "u32", "u64", "i64", "f32", "f64", "usize", "map",
    "Option", "Vec", "sequence", "untagged",
];

/// The texts of a problem that people read.
fn assert_plain(place: &str, problem: &Value) {
    let limits = problem["errors"].as_array().into_iter().flatten().map(|error| &error["limit"]);
    for text in std::iter::once(&problem["detail"]).chain(limits).filter_map(Value::as_str) {
        let mut words = text.split(|c: char| !(c.is_alphanumeric() || c == '_'));
        let ours = words.find(|word| WORDS.contains(word));
        assert!(ours.is_none() && !text.contains("::"), "{place}: {ours:?} in {text:?}");
    }
}

/// Values of every type, of which at most some suit a field.
fn values() -> Vec<Value> {
    vec![
        json!(5),
        json!(-1),
        json!(1.5),
        json!("x"),
        json!(true),
        json!(null),
        json!([]),
        json!([[1]]),
        json!(["x"]),
        json!([{}]),
        json!({}),
        json!({"a": 1}),
    ]
}

/// A schema with its references followed, and the schemas that it is made of.
fn parts(schema: &'static Value) -> Vec<&'static Value> {
    let document = &Contract::get().document;
    let target = schema["$ref"].as_str().and_then(|reference| document.pointer(&reference[1..]));
    let lists = ["oneOf", "anyOf", "allOf"].into_iter().filter_map(|key| schema[key].as_array());
    let within = lists.flatten().chain(target).flat_map(parts);
    std::iter::once(schema).chain(within.collect::<Vec<_>>()).collect()
}

/// Objects of one field, of which the value has another type than most fields take.
fn wrong_bodies(schema: &'static Value, depth: usize) -> Vec<Value> {
    let mut bodies = values();
    if depth == 0 {
        return bodies;
    }
    for part in parts(schema) {
        let fields = part["properties"].as_object().into_iter().flatten();
        for (name, field) in fields {
            bodies.extend(wrong_bodies(field, depth - 1).into_iter().map(|value| json!({ name: value })));
        }
        if part["items"].is_object() {
            bodies.extend(wrong_bodies(&part["items"], depth - 1).into_iter().map(|value| json!([value])));
        }
        if part["additionalProperties"].is_object() {
            let values = wrong_bodies(&part["additionalProperties"], depth - 1);
            bodies.extend(values.into_iter().map(|value| json!({"u": value})));
        }
    }
    bodies
}

#[tokio::test]
async fn values_of_wrong_types_are_refused_without_the_types_of_our_code() {
    let app = TestApp::start();
    app.bench_with_model().await;
    let document = &Contract::get().document;
    let (mut bodies, mut routes) = (0, 0);
    for (method, template, _) in Contract::get().operations() {
        let operation = &document["paths"][&template][method.to_lowercase()];
        let Some(content) = operation["requestBody"]["content"].as_object() else { continue };
        let Some(media_type) = content.keys().find(|key| key.contains("json")) else { continue };
        routes += 1;
        let id = "0197f1a0-0000-7000-8000-000000000000";
        let path = template.replace("{rig}", "bench").replace("{version}", "1");
        let path = path
            .replace("{diagnosis}", id)
            .replace("{iteration}", id)
            .replace("{evaluation}", id)
            .replace("{study}", id)
            .replace("{run}", id);
        let mut wrong = wrong_bodies(&content[media_type]["schema"], 4);
        wrong.sort_by_key(Value::to_string);
        wrong.dedup();
        for body in wrong {
            let bytes = serde_json::to_vec(&body).expect("JSON");
            let reply = app.call(&method, &path).header("if-match", "*").body(media_type, bytes).send().await;
            if reply.status >= 400 {
                assert_plain(&format!("{method} {template} {body}"), &reply.json());
                bodies += 1;
            }
        }
    }
    assert!(routes >= 9 && bodies > 1000, "{routes} routes, {bodies} bodies");
}

#[tokio::test]
async fn metadata_of_wrong_types_are_refused_without_the_types_of_our_code() {
    let app = TestApp::start();
    app.rig(&bench()).await;
    let good = gain_weights(&["u"], &["y"], 2.0);
    let (_, header) = safetensors::SafeTensors::read_metadata(&good).expect("a header");
    let text = &header.metadata().as_ref().expect("metadata")["rigcast"];
    let good: Value = serde_json::from_str(text).expect("JSON");
    for name in good.as_object().expect("an object").keys() {
        for value in values() {
            let mut metadata = good.clone();
            metadata[name] = value;
            let view = TensorView::new(Dtype::F32, vec![1], &[0; 4]).expect("four bytes");
            let metadata = HashMap::from([("rigcast".to_owned(), metadata.to_string())]);
            let file = safetensors::serialize([("frf.freq_hz", view)], Some(metadata)).expect("a file");
            let reply = app.post_file("/v1/rigs/bench/models", SAFETENSORS, file).await;
            assert!(reply.status >= 400, "{name}");
            assert_plain(name, &reply.json());
        }
    }
}

#[tokio::test]
async fn numbers_in_refusals_are_those_that_were_written() {
    let app = TestApp::start();
    app.rig(&bench()).await;
    let rows: String =
        (0..40).filter(|i| *i != 20).map(|i| format!("{},1,2\n", f64::from(i) * 0.005)).collect();
    let csv = format!("time,u,y\ns,kN,mm\n{rows}");
    let problem = app.post_file("/v1/rigs/bench/runs?kind=noise", "text/csv", csv).await;
    let problem = problem.problem(422, "csv.uneven_time");
    let text = problem["detail"].as_str().expect("a detail");
    assert!(text.contains("0.01 s") && text.contains("0.005 s") && !text.contains("99"), "{text}");
    assert_eq!(problem["errors"][0]["limit"], "steps of 0.005 s within 0.1 %");
}
