//! Which data train, stop and compare, and which model becomes active for it.

use std::path::Path;

use rigcast::engine::metrics::rms;
use serde_json::{Value, json};

use crate::support::{TestApp, bench, noise_csv};

#[path = "../../examples/support/dataset.rs"]
#[expect(dead_code, reason = "the examples use more of it")]
mod dataset;

async fn fitted(app: &TestApp, rig: &str, request: &Value) -> (Value, Value) {
    let job = app.post_json(&format!("/v1/rigs/{rig}/fits"), request).await.expect(202).json();
    let job = app.finished(job["id"].as_str().expect("an id")).await;
    assert_eq!(job["state"], "succeeded", "{job}");
    let model = app.get(job["result"]["href"].as_str().expect("a link")).await.expect(200).json();
    (job, model)
}

fn spans(of: &Value) -> Vec<(u64, u64)> {
    let sample = |span: &Value, name: &str| span[name].as_u64().expect("a sample");
    let items = of.as_array().expect("spans");
    items.iter().map(|span| (sample(span, "from_sample"), sample(span, "to_sample"))).collect()
}

#[tokio::test]
async fn of_two_runs_one_is_left_out_to_compare_and_then_fitted_too() {
    let app = TestApp::start();
    app.rig(&bench()).await;
    for seed in [1, 2] {
        app.run("kind=noise", &noise_csv(3000, seed)).await;
    }
    let lstm = json!({"blocks": [4], "window_len": 32, "epochs": 20, "seeds": [1, 2]});
    let (_, model) = fitted(&app, "bench", &json!({"kind": "lstm", "lstm": lstm})).await;
    let (lineage, comparison) = (&model["lineage"], &model["report"]["comparison"]);
    assert_eq!((&comparison["rule"], &comparison["refitted"]), (&json!("left_out_runs"), &json!(true)));
    assert_eq!(spans(&lineage["training"]), [(0, 3000), (0, 3000)]);
    assert_eq!((spans(&lineage["validation"]), spans(&lineage["stopping"])), (vec![(0, 3000)], vec![]));
    let score = &comparison["scores"][0]["outputs"][0];
    let of = |name: &str| score[name].as_f64().expect("a sum");
    let rms = model["report"]["validation_rms"][0].as_f64().expect("an error");
    assert!((rms - (of("error") / of("measured")).sqrt()).abs() < 1e-12);

    // The FRF leaves the same run out and is far better on it: it takes the LSTM's place.
    let (job, frf) = fitted(&app, "bench", &json!({"kind": "frf"})).await;
    assert_eq!(frf["lineage"]["validation"], lineage["validation"]);
    assert_eq!(frf["active"], true, "{job}");
    let (job, _) = fitted(&app, "bench", &json!({"kind": "lstm", "lstm": lstm})).await;
    let words = job["stage"].as_str().expect("last words");
    assert!(words.contains("not active: RMS error") && words.contains("30.0 s that neither"), "{words}");
}

#[tokio::test]
async fn runs_too_short_to_compare_fall_back_to_their_last_tenths_with_a_warning() {
    let app = TestApp::start();
    app.rig(&bench()).await;
    for (samples, seed) in [(3000, 1), (300, 2)] {
        app.run("kind=noise", &noise_csv(samples, seed)).await;
    }
    let (_, model) = fitted(&app, "bench", &json!({"kind": "frf"})).await;
    let comparison = &model["report"]["comparison"];
    assert_eq!((&comparison["rule"], &comparison["refitted"]), (&json!("last_tenths"), &json!(false)));
    assert_eq!(spans(&model["lineage"]["validation"]), [(2700, 3000), (270, 300)]);
    let warnings = model["report"]["warnings"].to_string();
    assert!(warnings.contains("no whole run was left out to compare models"), "{warnings}");
    assert!(comparison["reason"].as_str().is_some_and(|why| why.contains("too little")), "{comparison}");
}

/// What happened on measured data: the last tenths of two runs favoured an LSTM that was half as bad again
/// as the FRF on every run that neither had seen.
#[tokio::test]
async fn on_a_shaker_nothing_takes_the_place_of_an_frf_that_is_better_on_unseen_data() {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared/data/multiaxis_shaker");
    if !folder.is_dir() {
        println!("skipped: no {} here", folder.display());
        return;
    }
    let data = dataset::Dataset::open(&folder, Some("halves")).expect("the data");
    let app = TestApp::start();
    app.post_json("/v1/rigs", &data.rig()).await.expect(201);
    for (name, content_type, bytes) in data.training().expect("two halves") {
        let url = format!("/v1/rigs/{}/runs?kind=noise&name={name}", data.id());
        app.post_file(&url, content_type, bytes).await.expect(201);
    }
    let frf = fitted(&app, data.id(), &json!({"kind": "frf"})).await.1["version"].clone();
    for kind in ["lstm", "hybrid2"] {
        let request = json!({"kind": kind, "lstm": {"seeds": [1], "epochs": 150}});
        fitted(&app, data.id(), &request).await;
    }
    let active = app.get(&format!("/v1/rigs/{}/active-model", data.id())).await.expect(200).json();
    let mut errors = Vec::new();
    for version in [&frf, &active["version"]] {
        let mut of_version = Vec::new();
        for test in data.tests().expect("the other halves") {
            let channels: serde_json::Map<String, Value> =
                (1..).zip(&test.drive).map(|(i, x)| (format!("input_{i}"), json!(x))).collect();
            let request = json!({"model": version, "include": ["response"],
                "drive": {"sample_rate_hz": data.sample_rate_hz(), "channels": channels}});
            let url = format!("/v1/rigs/{}/predict", data.id());
            let answer = app.post_json(&url, &request).await.expect(200).json();
            for (i, measured) in (1..).zip(&test.response) {
                let predicted = &answer["response"]["channels"][format!("output_{i}")];
                let predicted: Vec<f64> = serde_json::from_value(predicted.clone()).expect("samples");
                of_version.push(rms(measured, &predicted).expect("a response"));
            }
        }
        errors.push(of_version);
    }
    for (frf, active) in errors[0].iter().zip(&errors[1]) {
        assert!(*active <= 1.02 * frf, "{errors:?}");
    }
}
