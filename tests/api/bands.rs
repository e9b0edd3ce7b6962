//! Predictions beside what the model is known for: the FRF in its place outside, and a band about the response.

use serde_json::{Value, json};

use crate::support::{Reply, SAFETENSORS, TestApp, bench, f8, gain_weights, noise, npy, read_f4};

const PREDICT: &str = "/v1/rigs/bench/predict";
const NPY: &str = "application/x-npy";

/// `y = 2 u` and an error of up to 0.1.
fn noisy_csv(n: usize, seed: u64) -> String {
    let rows = noise(n, seed).into_iter().zip(noise(n, seed + 100));
    let rows = rows.map(|(u, e)| format!("{u},{}\n", 2.0 * u + 0.1 * e));
    std::iter::once("u,y\n".to_owned()).chain(rows).collect()
}

/// A bench with a small model of a kind as version 1.
async fn with(kind: &str) -> TestApp {
    let app = TestApp::start();
    app.rig(&bench()).await;
    for seed in [21, 22] {
        app.run("kind=noise", &noisy_csv(4000, seed)).await;
    }
    let lstm = json!({"blocks": [4], "window_len": 32, "epochs": 3, "seeds": [1]});
    let mut request = json!({"kind": kind, "lstm": lstm});
    if kind != "lstm" {
        request["frf"] = json!({"segment_len": 256});
    }
    let job = app.post_json("/v1/rigs/bench/fits", &request).await.expect(202).json();
    let job = app.finished(job["id"].as_str().expect("an id")).await;
    assert_eq!(job["state"], "succeeded", "{job}");
    app
}

/// A drive that leaves the range of the training from 3 s to 4 s of 10 s.
fn leaving() -> Vec<f64> {
    noise(1000, 9)
        .into_iter()
        .enumerate()
        .map(|(t, u)| if (300..400).contains(&t) { 4.0 + u } else { 0.9 * u })
        .collect()
}

fn drive(u: &[f64]) -> Value {
    json!({"sample_rate_hz": 100.0, "channels": {"u": u}})
}

async fn predicted(app: &TestApp, request: Value) -> Value {
    app.post_json(PREDICT, &request).await.expect(200).json()
}

fn numbers(value: &Value) -> Vec<f64> {
    value.as_array().expect("an array").iter().map(|v| v.as_f64().expect("a number")).collect()
}

#[tokio::test]
async fn outside_the_frf_answers_and_elsewhere_the_model() {
    let app = with("hybrid2").await;
    let u = leaving();
    let own = predicted(&app, json!({"drive": drive(&u)})).await;
    let none = predicted(&app, json!({"drive": drive(&u), "fallback": "none"})).await;
    assert_eq!(own, none, "none is the default");
    assert_eq!(own["trust"].get("fallback_share"), None);
    let frf = predicted(&app, json!({"drive": drive(&u), "fallback": "frf"})).await;
    let trust = &frf["trust"];
    assert_eq!((&trust["inside"], &trust["spans"]), (&own["trust"]["inside"], &own["trust"]["spans"]));
    // Half of a window of 32 samples.
    assert_eq!(trust["fallback_fade_s"], 0.16);
    let spans = trust["fallback_spans"].as_array().expect("spans");
    let [span] = &spans[..] else { panic!("one span: {trust}") };
    let (from, to) = (span["from_s"].as_f64().expect("a time"), span["to_s"].as_f64().expect("a time"));
    assert!(from < 3.0 && to >= 4.32 && to - from < 4.0, "{span}");
    let share = trust["fallback_share"].as_f64().expect("a share");
    assert!(share < (to - from) / 10.0 && share > (to - from - 0.33) / 10.0, "{trust}");
    let of = |answer: &Value| numbers(&answer["response"]["channels"]["y"]);
    let (own, blended) = (of(&own), of(&frf));
    for (t, (a, b)) in own.iter().zip(&blended).enumerate() {
        let time = t as f64 / 100.0;
        if time < from || time >= to {
            assert_eq!(a, b, "sample {t}");
        } else if (300..400).contains(&t) {
            assert!((b - 2.0 * u[t]).abs() < 0.3, "sample {t}: {b} for {}", u[t]);
        }
    }
    assert!((own[350] - blended[350]).abs() > 0.5, "a small network bends: {} {}", own[350], blended[350]);

    // Damage and errors are those of the blended response.
    let target = json!({"sample_rate_hz": 100.0, "channels": {"y": blended}});
    let compared = json!({"drive": drive(&u), "target": target, "fallback": "frf"});
    let compared = predicted(&app, compared).await;
    assert_eq!(compared["errors"]["channels"]["y"]["rms"], 0.0);
    assert_eq!(compared["damage"]["channels"]["y"]["ratio"], 1.0);

    // As NPY, the same with a header, and in a batch the greatest share.
    let path = format!("{PREDICT}?sample_rate_hz=100&fallback=frf");
    let reply = app.post_file(&path, NPY, npy("<f8", false, "(1000, 1)", &f8(&u))).await.expect(200);
    assert_eq!(reply.header("rigcast-fallback-share").parse(), Ok(share));
    assert!(
        read_f4(&reply.bytes).1.iter().zip(&blended).all(|(a, b)| *a == *b as f32),
        "NPY answers the same"
    );
    let batch: Vec<f64> = u.iter().copied().chain(vec![0.1; 1000]).collect();
    let reply = app.post_file(&path, NPY, npy("<f8", false, "(2, 1000, 1)", &f8(&batch))).await.expect(200);
    assert_eq!(reply.header("rigcast-fallback-share").parse(), Ok(share));
    let inside = predicted(&app, json!({"drive": drive(&vec![0.1; 500]), "fallback": "frf"})).await;
    assert_eq!(inside["trust"]["fallback_share"], 0.0);
}

#[tokio::test]
async fn a_model_without_an_frf_has_no_fallback_and_an_unknown_one_is_refused() {
    let app = with("lstm").await;
    let request = |fallback: &str| json!({"drive": drive(&[0.1, 0.2]), "fallback": fallback});
    let problem = app.post_json(PREDICT, &request("frf")).await.problem(422, "predict.no_fallback");
    assert_eq!(problem["errors"][0]["pointer"], "/fallback", "{problem}");
    app.post_json(PREDICT, &request("none")).await.expect(200);
    let file = || npy("<f8", false, "(2, 1)", &f8(&[0.1, 0.2]));
    let path = format!("{PREDICT}?sample_rate_hz=100&fallback=");
    let problem = app.post_file(&format!("{path}frf"), NPY, file()).await.problem(422, "predict.no_fallback");
    assert_eq!(problem["errors"][0]["pointer"], "?fallback", "{problem}");
    let reply: Reply = app.post_file(&format!("{path}none"), NPY, file()).await.expect(200);
    assert_eq!(reply.headers.get("rigcast-fallback-share"), None);
    let problem = app.post_json(PREDICT, &request("lstm")).await.problem(422, "body.invalid_value");
    assert_eq!(problem["errors"][0]["pointer"], "/fallback", "{problem}");
    app.post_file(&format!("{path}lstm"), NPY, file()).await.problem(422, "query.invalid");
}

#[tokio::test]
async fn a_band_holds_nine_tenths_of_an_unseen_run_and_goes_where_the_weights_go() {
    let app = with("hybrid1").await;
    let unseen = app.run("kind=noise&split=test", &noisy_csv(4000, 33)).await["id"].clone();
    let request = json!({"drive": {"run": unseen}, "target": {"run": unseen}, "include": ["response", "damage", "band"]});
    let answer = predicted(&app, request.clone()).await;
    let band = &answer["band"];
    assert_eq!(band["coverage"], 0.9);
    let (half, y) =
        (numbers(&band["channels"]["y"]["half_width"]), numbers(&answer["response"]["channels"]["y"]));
    assert_eq!(half.len(), y.len());
    let (u, e) = (noise(4000, 33), noise(4000, 133));
    let inside = (0..4000).filter(|&t| (2.0 * u[t] + 0.1 * e[t] - y[t]).abs() <= half[t]).count();
    assert!((3500..3700).contains(&inside), "{inside} of 4000");
    let [low, high] = numbers(&band["damage"]["y"])[..] else { panic!("{band}") };
    let damage = &answer["damage"]["channels"]["y"];
    for figure in ["predicted", "target"] {
        let d = damage[figure].as_f64().expect("damage");
        assert!(low < d && d < high, "{figure}: {d} within {low} to {high}");
    }
    // By default there is none.
    let plain = predicted(&app, json!({"drive": drive(&[0.1])})).await;
    assert_eq!((plain.get("band"), plain.get("band_reason")), (None, None));

    let weights = app.get("/v1/rigs/bench/models/1/weights").await.expect(200).bytes;
    let again = app.post_file("/v1/rigs/bench/models", SAFETENSORS, weights).await.expect(201).json();
    let mut of_import = request.clone();
    of_import["model"] = again["version"].clone();
    assert_eq!(&predicted(&app, of_import).await["band"], band);

    // Weights made elsewhere have none, and the answer says so.
    let gain = gain_weights(&["u"], &["y"], 2.0);
    let gain = app.post_file("/v1/rigs/bench/models", SAFETENSORS, gain).await.expect(201).json();
    let answer =
        predicted(&app, json!({"model": gain["version"], "drive": drive(&[0.1]), "include": ["band"]})).await;
    assert_eq!(answer["band"], Value::Null);
    assert!(answer["band_reason"].as_str().is_some_and(|why| why.contains("carry no band")), "{answer}");

    // A band is text as a whole: it has a limit.
    let n = 1_000_001;
    let path = format!("{PREDICT}?sample_rate_hz=100&include=band");
    let file = npy("<f8", false, &format!("({n}, 1)"), &f8(&vec![0.1; n]));
    let call = app.call("POST", &path).header("accept", "application/json").body(NPY, file);
    let problem = call.send().await.problem(422, "predict.band_too_long");
    assert_eq!(problem["errors"][0]["pointer"], "/include", "{problem}");
}
