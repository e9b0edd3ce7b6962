//! Predictions beside targets: what is compared, and what is said of the rest.

use serde_json::{Value, json};

use crate::support::{TestApp, bench, gain_weights, noise, triple, wave};

const PREDICT: &str = "/v1/rigs/bench/predict";

/// A run of the bench: `y = 2 u` and a fifth of noise, both white.
fn noisy_csv(n: usize, seed: u64) -> String {
    let rows = noise(n, seed).into_iter().zip(noise(n, seed + 1000));
    rows.fold(String::from("u,y\n"), |text, (u, hiss)| text + &format!("{u},{}\n", 2.0 * u + 0.4 * hiss))
}

fn figure(value: &Value) -> f64 {
    value.as_f64().unwrap_or_else(|| panic!("{value} is no figure"))
}

#[tokio::test]
async fn a_target_passes_the_models_filter_before_it_is_compared() {
    let app = TestApp::start();
    app.rig(&bench()).await;
    app.run("kind=noise", &noisy_csv(20_000, 1)).await;
    let request = json!({"kind": "frf", "preprocess": {"low_pass_hz": 5.0}, "frf": {"segment_len": 512}});
    let job = app.post_json("/v1/rigs/bench/fits", &request).await.expect(202).json();
    let job = app.finished(job["id"].as_str().expect("an id")).await;
    let model = app.get(job["result"]["href"].as_str().expect("a model")).await.expect(200).json();
    let foretold = figure(&model["report"]["validation_rms"][0]);

    let run = app.run("kind=noise&split=test", &noisy_csv(20_000, 2)).await;
    let request =
        json!({"drive": {"run": run["id"]}, "target": {"run": run["id"]}, "include": ["errors", "damage"]});
    let answer = app.post_json(PREDICT, &request).await.expect(200).json();
    let found = &answer["errors"]["channels"]["y"];
    // Unfiltered, nine tenths of the target's power lie above the filter: the error would be 0.95.
    assert!((0.1..0.3).contains(&foretold), "{model}");
    assert!((figure(&found["rms"]) / foretold - 1.0).abs() < 0.2, "{found}, validation {foretold}");
    assert!(figure(&found["psd_rms"]) < 0.3, "{found}");
    assert_eq!(answer["errors"]["settings"]["preprocess"], json!({"low_pass_hz": 5.0}));
    let damage = &answer["damage"];
    assert!((0.6..1.6).contains(&figure(&damage["channels"]["y"]["ratio"])), "{damage}");
    assert_eq!(damage["preprocess"], json!({"low_pass_hz": 5.0}));
    let request = json!({"drive": {"run": run["id"]}, "include": ["damage"]});
    let answer = app.post_json(PREDICT, &request).await.expect(200).json();
    assert_eq!(answer["damage"].get("preprocess"), None, "without a target nothing was filtered");
}

#[tokio::test]
async fn a_preload_is_told_from_what_moves() {
    let app = TestApp::start();
    app.bench_with_model().await;
    let u = wave(1000, 0.4);
    let moves: Vec<f64> = u.iter().map(|v| 2.0 * v).collect();
    let mean = moves.iter().sum::<f64>() / 1000.0;
    let deviation = (moves.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / 1000.0).sqrt();
    let errors = async |target: Vec<f64>| {
        let request = json!({
            "drive": {"sample_rate_hz": 100.0, "channels": {"u": u}},
            "target": {"sample_rate_hz": 100.0, "channels": {"y": target}}, "include": ["errors"],
        });
        app.post_json(PREDICT, &request).await.expect(200).json()["errors"].clone()
    };
    let off = errors(moves.iter().map(|v| v + 30.0 * deviation).collect()).await;
    assert_eq!(off["settings"]["psd"]["detrend"], "constant");
    assert_eq!(off["settings"]["preprocess"], json!({}));
    let found = &off["channels"]["y"];
    assert!((figure(&found["mean"]) + 30.0).abs() < 1e-6, "{found}");
    assert!(figure(&found["rms"]) > 0.9, "{found}");
    assert!(figure(&found["rms_ac"]) < 1e-9 && figure(&found["psd_rms"]) < 1e-9, "{found}");
    let still = errors(vec![3.0; 1000]).await["channels"]["y"].clone();
    assert_eq!(
        (&still["rms_ac"], &still["mean"], &still["psd_rms"]),
        (&json!(null), &json!(null), &json!(null))
    );
    assert_eq!(still["reason"], "measured_constant");
    assert!(still["rms"].is_number());
    let zero = errors(vec![0.0; 1000]).await["channels"]["y"].clone();
    assert_eq!((&zero["rms"], &zero["reason"]), (&json!(null), &json!("measured_zero")));
}

#[tokio::test]
async fn a_group_that_is_predicted_or_wanted_in_part_is_named() {
    let app = TestApp::start();
    app.rig(&triple()).await;
    app.post_file(
        "/v1/rigs/triple/models",
        crate::support::SAFETENSORS,
        gain_weights(&["u"], &["fz", "fx"], 2.0),
    )
    .await
    .expect(201);
    let u = wave(300, 1.0);
    let drive = json!({"sample_rate_hz": 100.0, "channels": {"u": u}});
    let request = json!({"model": 1, "drive": drive, "include": ["damage"]});
    let answer = app.post_json("/v1/rigs/triple/predict", &request).await.expect(200).json();
    assert_eq!(answer["damage"]["groups"], json!({}));
    let omitted = json!([{"group": "force", "channels": ["fy"], "reason": "not_predicted"}]);
    assert_eq!(answer["damage"]["omitted"], omitted);

    app.activate("triple", gain_weights(&["u"], &["fx", "fy", "fz"], 2.0)).await;
    let damage = async |target: Value| {
        let request = json!({"drive": drive, "target": target, "include": ["damage"]});
        app.post_json("/v1/rigs/triple/predict", &request).await.expect(200).json()["damage"].clone()
    };
    let part = damage(json!({"sample_rate_hz": 100.0, "channels": {"fx": u}})).await;
    assert_eq!(part["omitted"], json!([{"group": "force", "channels": ["fy", "fz"], "reason": "no_target"}]));
    assert!(part["groups"]["force"]["predicted"].is_number());
    let whole = damage(json!({"sample_rate_hz": 100.0, "channels": {"fx": u, "fy": u, "fz": u}})).await;
    assert_eq!(whole["omitted"], json!([]));

    let request = json!({
        "predicted": {"sample_rate_hz": 100.0, "channels": {"a": u, "b": u, "c": u}},
        "target": {"sample_rate_hz": 100.0, "channels": {"a": u, "c": u}},
        "groups": {"g": ["c", "b", "a"]},
    });
    let answer = app.post_json("/v1/damage", &request).await.expect(200).json();
    let omitted = json!([{"group": "g", "channels": ["b"], "reason": "no_target"}]);
    assert_eq!(answer["damage"]["omitted"], omitted);
}
