//! The Open Inference Protocol: metadata, predictions in JSON and binary tensors, refusals, and Triton's client.

use axum::http::HeaderName;
use rigcast::engine::model::to_safetensors;
use rigcast::http::Limits;
use serde_json::{Value, json};

use crate::foreign_readers::python;
use crate::support::{
    Reply, SAFETENSORS, TestApp, bench, f4, f8, gain_model, gain_weights, npy, read_f4, triple, wave,
};

/// Asks everything that Triton's client can ask of a model, and prints the answers as JSON.
const TRITON: &str = "
import json, sys
import numpy as np
import tritonclient.http as triton
from tritonclient.utils import InferenceServerException
client = triton.InferenceServerClient(sys.argv[1])
u = np.array(json.loads(sys.argv[2]), dtype=np.float32).reshape(-1, 1)

def infer(binary_in, outputs, datatype=np.float32, version=''):
    drive = triton.InferInput('drive', list(u.shape), {np.float32: 'FP32', np.float64: 'FP64'}[datatype])
    drive.set_data_from_numpy(u.astype(datatype), binary_data=binary_in)
    answer = client.infer('triple', [drive], model_version=version, outputs=outputs, request_id='17', priority=2)
    told = answer.get_response()
    assert told['id'] == '17' and told['model_version'] == '1', told
    return answer.as_numpy('force').astype(float).tolist()

def refused(call):
    try:
        call()
    except InferenceServerException as error:
        return [error.status(), error.message()]

def wanted(binary):
    return [triton.InferRequestedOutput('force', binary_data=binary)]

wrong = triton.InferInput('drive', list(u.shape), 'INT32')
wrong.set_data_from_numpy(u.astype(np.int32))
json.dump({
    'live': client.is_server_live(), 'ready': client.is_server_ready(),
    'model_ready': [client.is_model_ready('triple'), client.is_model_ready('triple', '1'), client.is_model_ready('bench')],
    'server': client.get_server_metadata(), 'index': client.get_model_repository_index(),
    'metadata': client.get_model_metadata('triple'), 'config': client.get_model_config('triple', '1'),
    'responses': [
        infer(True, None), infer(True, wanted(True)), infer(False, wanted(True)), infer(True, wanted(False)),
        infer(False, wanted(False)), infer(True, None, np.float64), infer(True, None, version='1'),
    ],
    'refused': [refused(lambda: client.infer('triple', [wrong])), refused(lambda: client.get_model_metadata('none'))],
}, sys.stdout)
";

const INFER: &str = "/v2/models/triple/infer";
const JSON_LENGTH: HeaderName = HeaderName::from_static("inference-header-content-length");

/// A rig of one drive and a group of three responses, whose model doubles the drive.
async fn triple_with_model(app: &TestApp) {
    app.rig(&triple()).await;
    app.activate("triple", gain_weights(&["u"], &["fx", "fy", "fz"], 2.0)).await;
}

/// A model of which every output is another mixture of the inputs.
fn mixing_weights(inputs: &[&str], outputs: &[&str]) -> Vec<u8> {
    let mut model = gain_model(inputs, outputs, 1.0);
    let pairs = inputs.len() * outputs.len();
    let lines = model.frf.iter_mut().flat_map(|frf| frf.h.chunks_mut(pairs));
    lines.flatten().enumerate().for_each(|(i, h)| *h *= (1 + i % pairs) as f64);
    to_safetensors(&model)
}

/// A request of JSON with binary data behind it.
async fn post_binary(app: &TestApp, request: &Value, binary: &[u8]) -> Reply {
    let text = request.to_string();
    let call = app.call("POST", INFER).header(JSON_LENGTH.as_str(), &text.len().to_string());
    call.body("application/octet-stream", [text.as_bytes(), binary].concat()).send().await
}

/// A drive of `n` singles whose binary data stand behind the JSON.
fn binary_drive(n: usize) -> Value {
    json!({
        "name": "drive", "datatype": "FP32", "shape": [n, 1], "parameters": {"binary_data_size": 4 * n},
    })
}

/// The JSON of an answer and the singles behind it.
fn split(reply: &Reply) -> (Value, Vec<f32>) {
    let length: usize = reply.header(JSON_LENGTH.as_str()).parse().expect("a length");
    let document = serde_json::from_slice(&reply.bytes[..length]).expect("JSON");
    let singles = reply.bytes[length..].as_chunks::<4>().0.iter().map(|b| f32::from_le_bytes(*b)).collect();
    (document, singles)
}

fn singles(value: &Value) -> Vec<f32> {
    value.as_array().expect("an array").iter().map(|v| v.as_f64().expect("a number") as f32).collect()
}

/// The response of the prediction route, `[sample, channel]`, to the same singles.
async fn predicted(app: &TestApp, u: &[f32]) -> Vec<f32> {
    let file = npy("<f4", false, &format!("({}, 1)", u.len()), &f4(u));
    let path = "/v1/rigs/triple/predict?sample_rate_hz=100";
    read_f4(&app.post_file(path, "application/x-npy", file).await.expect(200).bytes).1
}

#[tokio::test]
async fn query_parameters_that_the_service_does_not_know_are_ignored() {
    let app = TestApp::start();
    triple_with_model(&app).await;
    for path in [
        "/v2",
        "/v2/health/live",
        "/v2/health/ready",
        "/v2/models/triple",
        "/v2/models/triple/ready",
        "/v2/models/triple/config",
        "/v2/models/triple/versions/1",
    ] {
        app.get(&format!("{path}?timeout=3&trace=%ff")).await.expect(200);
    }
    app.post_json("/v2/repository/index?ready=true", &json!({})).await.expect(200);
    let request =
        json!({"inputs": [{"name": "drive", "datatype": "FP32", "shape": [2, 1], "data": [0, 0.1]}]});
    app.post_json(&format!("{INFER}?timeout=3"), &request).await.expect(200);
}

#[tokio::test]
async fn metadata_name_tensors_channels_and_units_and_a_rig_without_a_model_is_not_ready() {
    let app = TestApp::start();
    app.rig(&bench()).await;
    triple_with_model(&app).await;
    let sensor = gain_weights(&["fx", "u"], &["fy"], 3.0);
    app.post_file("/v1/rigs/triple/models", SAFETENSORS, sensor).await.expect(201);
    let metadata = app.get("/v2/models/triple").await.expect(200).json();
    assert_eq!((&metadata["name"], &metadata["versions"]), (&json!("triple"), &json!(["1", "2"])));
    assert_eq!(metadata["platform"], "rigcast_frf");
    let drive = json!({
        "name": "drive", "datatype": "FP32", "shape": [-1, 1], "parameters": {"channels": ["u"], "units": ["kN"]},
    });
    let force = json!({
        "name": "force", "datatype": "FP32", "shape": [-1, 3],
        "parameters": {"channels": ["fx", "fy", "fz"], "units": ["kN", "kN", "kN"]},
    });
    assert_eq!((&metadata["inputs"], &metadata["outputs"]), (&json!([drive]), &json!([force])));
    assert_eq!(metadata["parameters"]["sample_rate_hz"], 100.0);
    let sensor = app.get("/v2/models/triple/versions/2").await.expect(200).json();
    let names = |list: &Value| -> Vec<String> {
        list.as_array()
            .expect("tensors")
            .iter()
            .map(|t| t["name"].as_str().expect("a name").to_owned())
            .collect()
    };
    assert_eq!(
        (names(&sensor["inputs"]), names(&sensor["outputs"])),
        (vec!["force".into(), "drive".into()], vec!["force_2".into()])
    );
    let config = app.get("/v2/models/triple/config").await.expect(200).json();
    assert_eq!((&config["max_batch_size"], &config["output"][0]["dims"]), (&json!(0), &json!([-1, 3])));

    let index = app.post("/v2/repository/index").await.expect(200).json();
    assert_eq!(index[0]["state"], "UNAVAILABLE");
    assert_eq!(index[1], json!({"name": "triple", "version": "1", "state": "READY", "reason": ""}));
    let ready =
        app.post_json("/v2/repository/index", &json!({"ready": true, "later": 1})).await.expect(200).json();
    assert_eq!(ready.as_array().map(Vec::len), Some(1));
    app.get("/v2/models/triple/ready").await.expect(200);
    let refused = app.get("/v2/models/bench/ready").await.problem(503, "model.not_ready");
    assert_eq!(refused["error"], refused["detail"], "clients of the protocol read `error`");
    app.get("/v2/models/bench").await.problem(409, "model.none_active");
    app.get("/v2/models/none/ready").await.problem(404, "rig.not_found");
    app.get("/v2/models/triple/versions/9/ready").await.problem(404, "model.not_found");
    let nowhere = app.get("/v2/nowhere").await.problem(404, "route.not_found");
    assert_eq!(nowhere["error"], nowhere["detail"]);
    let elsewhere = app.get("/v1/nowhere").await.problem(404, "route.not_found");
    assert!(elsewhere.get("error").is_none());
}

#[tokio::test]
async fn tensors_in_json_and_binary_hold_what_the_prediction_route_answers() {
    let app = TestApp::start();
    triple_with_model(&app).await;
    // Long enough to be written in pieces, in either form.
    let u: Vec<f32> = wave(60_000, 0.4).into_iter().map(|v| v as f32).collect();
    let expected = predicted(&app, &u).await;
    assert_eq!(expected.len(), 180_000);
    let in_json = json!({"name": "drive", "datatype": "FP32", "shape": [u.len(), 1], "data": u});
    let all_binary = json!({"binary_data_output": true, "priority": 3});

    let request = json!({"id": "17", "inputs": [in_json], "later": {"a": [1]}});
    let answer = app.post_json(INFER, &request).await.expect(200).json();
    assert_eq!(
        (&answer["id"], &answer["model_name"], &answer["model_version"]),
        (&json!("17"), &json!("triple"), &json!("1"))
    );
    assert_eq!(answer["outputs"][0]["shape"], json!([u.len(), 3]));
    assert_eq!(singles(&answer["outputs"][0]["data"]), expected);
    assert_eq!(answer["parameters"]["sample_rate_hz"], 100.0);

    let request = json!({"inputs": [binary_drive(u.len())], "parameters": all_binary});
    let (document, found) = split(&post_binary(&app, &request, &f4(&u)).await.expect(200));
    assert_eq!(document["outputs"][0]["parameters"]["binary_data_size"], 4 * expected.len());
    assert!(document.get("id").is_none());
    assert_eq!(found, expected);

    // One in each direction, and rows of numbers.
    let request = json!({"inputs": [binary_drive(u.len())]});
    let answer = post_binary(&app, &request, &f4(&u)).await.expect(200).json();
    assert_eq!(singles(&answer["outputs"][0]["data"]), expected);
    let rows: Vec<[f32; 1]> = u.iter().map(|v| [*v]).collect();
    let in_rows = json!({"name": "drive", "datatype": "FP32", "shape": [u.len(), 1], "data": rows});
    let request = json!({"inputs": [in_rows], "parameters": all_binary});
    let reply =
        app.call("POST", "/v2/models/triple/versions/1/infer").json(&request).send().await.expect(200);
    assert_eq!(split(&reply).1, expected);
    let wide: Vec<f64> = u.iter().map(|v| f64::from(*v)).collect();
    let drive = json!({
        "name": "drive", "datatype": "FP64", "shape": [u.len(), 1], "parameters": {"binary_data_size": 8 * u.len()},
    });
    let request = json!({"inputs": [drive], "parameters": all_binary});
    assert_eq!(split(&post_binary(&app, &request, &f8(&wide)).await.expect(200)).1, expected);
}

#[tokio::test]
async fn several_tensors_keep_their_channels_apart_and_outputs_are_chosen_by_name() {
    let app = TestApp::start();
    let channel = |name: &str, role: &str, group: Option<&str>| {
        let mut channel = json!({"name": name, "unit": "kN", "role": role});
        if let Some(group) = group {
            channel["group"] = group.into();
        }
        channel
    };
    let (hub, force) = (Some("hub"), Some("force"));
    let rig = json!({"id": "triple", "sample_rate_hz": 100.0, "channels": [
        channel("a", "drive", hub), channel("b", "drive", None), channel("c", "drive", hub), channel("d", "drive", hub),
        channel("w", "response", force), channel("x", "response", force), channel("y", "response", None),
        channel("z", "response", force),
    ]});
    app.rig(&rig).await;
    app.activate("triple", mixing_weights(&["a", "b", "c", "d"], &["w", "x", "y", "z"])).await;
    let signals: Vec<Vec<f32>> =
        [0.2, 0.3, 0.7, 1.1].iter().map(|k| (0..50).map(|i| (k * i as f32).sin()).collect()).collect();
    let rows = |channels: &[&Vec<f32>]| -> Vec<f32> {
        (0..50).flat_map(|i| channels.iter().map(move |channel| channel[i])).collect()
    };
    let channels = json!({"a": signals[0], "b": signals[1], "c": signals[2], "d": signals[3]});
    let drive = json!({"sample_rate_hz": 100.0, "channels": channels});
    let expected =
        app.post_json("/v1/rigs/triple/predict", &json!({"drive": drive})).await.expect(200).json();
    let expected = ["w", "x", "y", "z"].map(|name| singles(&expected["response"]["channels"][name]));
    assert!(expected[0] != expected[1] && expected[1] != expected[3], "the channels differ");

    let tensor = |name: &str, columns: usize, data: Vec<f32>| json!({"name": name, "datatype": "FP64", "shape": [50, columns], "data": data});
    let hub = rows(&[&signals[0], &signals[2], &signals[3]]);
    let inputs = json!([tensor("hub", 3, hub), tensor("drive", 1, signals[1].clone())]);
    let outputs = json!([
        {"name": "response", "parameters": {"binary_data": true}}, {"name": "force"},
    ]);
    let reply = app.post_json(INFER, &json!({"inputs": inputs, "outputs": outputs})).await.expect(200);
    let (document, response) = split(&reply);
    assert_eq!(response, expected[2]);
    let force = rows(&[&expected[0], &expected[1], &expected[3]]);
    assert_eq!(singles(&document["outputs"][1]["data"]), force);
    assert_eq!(
        (&document["outputs"][0]["name"], document["outputs"][0].get("data")),
        (&json!("response"), None)
    );
    let one = json!({"inputs": inputs, "outputs": [{"name": "force"}]});
    let answer = app.post_json(INFER, &one).await.expect(200).json();
    assert_eq!(answer["outputs"].as_array().map(Vec::len), Some(1));
}

#[tokio::test]
async fn a_request_that_does_not_fit_is_refused_with_its_place() {
    let app = TestApp::start();
    triple_with_model(&app).await;
    let drive = json!({"name": "drive", "datatype": "FP32", "shape": [2, 1], "data": [0.0, 0.5]});
    let change = |field: &str, value: Value| {
        let mut drive = drive.clone();
        drive[field] = value;
        json!({"inputs": [drive]})
    };
    let cases = [
        (change("name", json!("force")), 422, "inference.unknown_tensor", "/inputs/0/name"),
        (change("datatype", json!("INT32")), 422, "inference.datatype", "/inputs/0/datatype"),
        (change("shape", json!([2])), 422, "inference.shape", "/inputs/0/shape"),
        (change("shape", json!([3, 1])), 422, "inference.shape", "/inputs/0/shape"),
        (change("shape", json!([u64::MAX, 1])), 422, "inference.shape", "/inputs/0/shape"),
        (change("shape", json!([-1, 1])), 422, "body.invalid_value", "/inputs/0/shape/0"),
        (change("data", json!([0.0, 1e39])), 422, "signal.non_finite", "/inputs/0/data"),
        (change("data", json!([0.0, "x"])), 422, "body.invalid_value", "/inputs/0/data/1"),
        (json!({"inputs": [drive, drive]}), 422, "inference.duplicate_tensor", "/inputs/1/name"),
        (json!({"inputs": []}), 422, "inference.missing_tensor", "/inputs"),
        (json!({}), 422, "body.missing_field", "/inputs"),
        (
            json!({"inputs": [{"name": "drive", "datatype": "FP32", "shape": [0, 1], "data": []}]}),
            422,
            "signal.empty",
            "/inputs/0/shape",
        ),
        (
            json!({"inputs": [drive], "outputs": [{"name": "y"}]}),
            422,
            "inference.unknown_tensor",
            "/outputs/0/name",
        ),
        (
            json!({"inputs": [drive], "outputs": [{"name": "force"}, {"name": "force"}]}),
            422,
            "inference.duplicate_tensor",
            "/outputs/1/name",
        ),
        (
            json!({"inputs": [drive], "parameters": {"sample_rate_hz": 200.0}}),
            422,
            "predict.sample_rate",
            "/parameters/sample_rate_hz",
        ),
        (
            json!({"inputs": [binary_drive(2)]}),
            400,
            "inference.binary_size",
            "/inputs/0/parameters/binary_data_size",
        ),
    ];
    for (request, status, code, pointer) in cases {
        let problem = app.post_json(INFER, &request).await.problem(status, code);
        assert_eq!(problem["errors"][0]["pointer"], pointer, "{request}: {problem}");
        assert_eq!(problem["error"], problem["detail"]);
    }
    let problem = post_binary(&app, &json!({"inputs": [binary_drive(3)]}), &f4(&[0.0, 1.0, f32::NAN])).await;
    let problem = problem.problem(422, "signal.non_finite");
    assert_eq!((&problem["errors"][0]["channel"], &problem["errors"][0]["sample"]), (&json!("u"), &json!(2)));
    for (bytes, code) in [(4, "inference.binary_size"), (12, "inference.binary_size")] {
        post_binary(&app, &json!({"inputs": [binary_drive(2)]}), &vec![0; bytes]).await.problem(400, code);
    }
    for length in ["999", "-1", "x"] {
        let call = app.call("POST", INFER).header(JSON_LENGTH.as_str(), length);
        call.json(&json!({"inputs": [drive]})).send().await.problem(400, "inference.header_length");
    }
    let text = app.call("POST", INFER).body("text/csv", "u\n1\n").send().await;
    text.problem(415, "content_type.unsupported");
    app.call("POST", INFER).body("application/json", "{").send().await.problem(400, "body.syntax");
}

#[tokio::test]
async fn bodies_over_their_limits_are_refused_in_either_form() {
    let app = TestApp::start_with(Limits { drive_bytes: 1000, json_bytes: 600, ..Limits::default() });
    triple_with_model(&app).await;
    let in_json = |n: usize| json!({"inputs": [{"name": "drive", "datatype": "FP32", "shape": [n, 1], "data": vec![0; n]}]});
    app.post_json(INFER, &in_json(100)).await.expect(200);
    let problem = app.post_json(INFER, &in_json(300)).await.problem(413, "body.too_large");
    assert_eq!(problem["errors"][0]["limit"], "600 bytes");
    let binary = |n: usize| json!({"inputs": [binary_drive(n)]});
    post_binary(&app, &binary(150), &vec![0; 600]).await.expect(200);
    post_binary(&app, &binary(300), &vec![0; 1200]).await.problem(413, "body.too_large");
    // The JSON before binary data has the limit of JSON.
    let problem = post_binary(&app, &in_json(300), &[]).await.problem(413, "body.too_large");
    assert_eq!(problem["errors"][0]["limit"], "600 bytes");
}

#[tokio::test]
async fn a_drive_outside_the_training_is_said_so_in_the_parameters() {
    let app = TestApp::start();
    triple_with_model(&app).await;
    let u: Vec<f64> = (0..100).map(|i| if i < 50 { 0.5 } else { 1.5 }).collect();
    let tensor = json!({"name": "drive", "datatype": "FP32", "shape": [100, 1], "data": u});
    let answer = app.post_json(INFER, &json!({"inputs": [tensor]})).await.expect(200).json();
    let parameters = &answer["parameters"];
    assert!(parameters["trust_inside"].as_f64().is_some_and(|inside| inside <= 0.5), "{parameters}");
    assert!(
        parameters["trust_outside"].as_str().is_some_and(|text| text.starts_with("u from 0.5 s")),
        "{parameters}"
    );
}

#[tokio::test]
async fn tritons_client_lists_checks_and_asks_a_model() {
    let Some(mut python) = python() else { return };
    let app = TestApp::start();
    app.rig(&bench()).await;
    triple_with_model(&app).await;
    let u: Vec<f32> = wave(300, 0.4).into_iter().map(|v| v as f32).collect();
    let expected = predicted(&app, &u).await;
    let numbers = serde_json::to_string(&u).expect("JSON");
    let output =
        python.args(["-c", TRITON, &app.address().to_string(), &numbers]).output().expect("Python runs");
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let told: Value = serde_json::from_slice(&output.stdout).expect("JSON");
    assert_eq!((&told["live"], &told["ready"]), (&json!(true), &json!(true)));
    assert_eq!(told["model_ready"], json!([true, true, false]));
    assert_eq!((&told["server"]["name"], &told["index"][1]["name"]), (&json!("rigcast"), &json!("triple")));
    assert_eq!(
        (&told["metadata"]["inputs"][0]["name"], &told["config"]["max_batch_size"]),
        (&json!("drive"), &json!(0))
    );
    for response in told["responses"].as_array().expect("responses") {
        let found: Vec<f32> = response.as_array().expect("rows").iter().flat_map(singles).collect();
        assert_eq!(found, expected);
    }
    let refused = &told["refused"];
    assert_eq!((&refused[0][0], &refused[1][0]), (&json!("422"), &json!("404")));
    assert!(refused[0][1].as_str().is_some_and(|text| text.contains("FP32 or FP64")), "{refused}");
}
