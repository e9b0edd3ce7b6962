//! Adopting: the version with the effect in it predicts better, here and wherever its weights go.

use serde_json::{Value, json};

use super::rig::{DIAGNOSES, Lab, RATE, csv, drive, measure, respond, upload, upload_csv};
use crate::support::{f8, npy, read_f4};

/// Adopts; gives the version and its model.
async fn adopted(lab: &Lab, href: &str, body: Value) -> (u64, Value) {
    let reply = lab.app.post_json(&format!("{href}/adopt"), &body).await.expect(201);
    let made = reply.json();
    assert_eq!(made["href"], reply.header("location"));
    let model = lab.app.get(made["href"].as_str().expect("a link")).await.expect(200).json();
    (made["version"].as_u64().expect("a version"), model)
}

async fn predicted(lab: &Lab, version: u64, u: &[f64]) -> Vec<f64> {
    let request = json!({
        "model": version, "include": ["response"], "drive": {"sample_rate_hz": RATE, "channels": {"drive": u}},
    });
    let answer = lab.app.post_json("/v1/rigs/mass/predict", &request).await.expect(200).json();
    let samples = answer["response"]["channels"]["disp"].as_array().expect("samples").clone();
    samples.iter().map(|v| v.as_f64().expect("a number")).collect()
}

#[tokio::test]
async fn the_adopted_effect_predicts_an_unseen_run_better_here_and_after_a_round_trip() {
    let lab = Lab::with_frf().await;
    let (href, report) = lab.report(&lab.request()).await;
    let (version, model) = adopted(&lab, &href, json!({})).await;
    assert_eq!((version, &model["origin"], &model["active"]), (2, &json!("diagnosis"), &json!(false)));
    assert_eq!((&model["kind"], &model["job"]), (&json!("frf"), &report["job"]));
    let link = &model["lineage"]["diagnoses"][0];
    assert_eq!((&link["id"], &link["version"], &link["hypothesis"]), (&report["id"], &json!(1), &json!(0)));
    assert_eq!(link["fit"][0]["run"], lab.high[0]);
    let seen =
        lab.app.call("PATCH", &format!("/v1/rigs/mass/runs/{}", lab.high[0])).json(&json!({"split": "test"}));
    seen.send().await.problem(409, "run.fitted_on");

    let u = drive(10.0, 0.9, 99);
    let unseen = upload(&lab.app, "kind=service&split=test", &u, 98).await;
    let (before, after) = (lab.error_of(1, &unseen).await, lab.error_of(version, &unseen).await);
    assert!(before > 0.1 && after < 0.2 * before, "{before} before, {after} after");

    // The same through every door: JSON, NPY, export and import.
    let json = predicted(&lab, version, &u).await;
    let path = format!("/v1/rigs/mass/predict?model={version}&sample_rate_hz={RATE}");
    let file = npy("<f8", false, &format!("({}, 1)", u.len()), &f8(&u));
    let (_, array) = read_f4(&lab.app.post_file(&path, "application/x-npy", file).await.expect(200).bytes);
    assert!(json.iter().zip(&array).all(|(a, b)| *a as f32 == *b), "NPY answers the same");
    let weights = lab.app.get(&format!("/v1/rigs/mass/models/{version}/weights")).await.expect(200).bytes;
    let again = lab.import(weights).await;
    assert_eq!(predicted(&lab, again, &u).await, json, "the same weights, the same prediction");
    assert_eq!(model["sha256"], lab.app.get(&format!("/v1/rigs/mass/models/{again}")).await.json()["sha256"]);
}

#[tokio::test]
async fn a_network_takes_an_effect_too_and_activation_is_as_asked() {
    let lab = Lab::without_model().await;
    // Of low runs only, the hybrid knows nothing of the stiffening either.
    let request = json!({
        "kind": "hybrid2", "frf": {"segment_len": 2048}, "preprocess": {"low_pass_hz": 40.0},
        "lstm": {"blocks": [4], "window_len": 64, "hop": 32, "epochs": 2, "seeds": [1]},
    });
    let job = lab.app.post_json("/v1/rigs/mass/fits", &request).await.expect(202).json();
    let job = lab.app.finished(job["id"].as_str().expect("an id")).await;
    assert_eq!(job["state"], "succeeded", "{job}");
    let (href, report) = lab.report(&lab.request()).await;
    // So short a training errs a little of its own, which may leave more than one effect standing.
    let verdict = report["verdict"]["kind"].as_str().expect("a kind");
    assert!(["identified", "partial", "not_distinguishable"].contains(&verdict), "{}", report["verdict"]);
    assert_eq!(report["hypotheses"][0]["effect"], "cubic_stiffness", "{}", report["verdict"]);
    let unseen = upload(&lab.app, "kind=service&split=test", &drive(10.0, 0.9, 99), 98).await;
    let before = lab.error_of(1, &unseen).await;
    let (version, model) = adopted(&lab, &href, json!({"activate": "if_better"})).await;
    assert_eq!(
        (&model["kind"], &model["active"]),
        (&json!("hybrid2"), &json!(true)),
        "{}",
        report["hypotheses"][0]
    );
    let after = lab.error_of(version, &unseen).await;
    assert!(after < 0.5 * before, "{before} before, {after} after");
    // The diagnosed model is no longer the active one: nobody has compared.
    let (_, model) = adopted(&lab, &href, json!({"activate": "if_better"})).await;
    assert_eq!(model["active"], false);
    let (_, model) = adopted(&lab, &href, json!({"activate": "always"})).await;
    assert_eq!(model["active"], true);
}

#[tokio::test]
async fn what_cannot_be_adopted_is_refused_with_a_code_of_its_own() {
    let lab = Lab::with_frf().await;
    let refused = async |href: &str, body: Value, status, code| {
        lab.app.post_json(&format!("{href}/adopt"), &body).await.problem(status, code)
    };
    let (href, report) = lab.report(&lab.request()).await;
    let n = report["hypotheses"].as_array().expect("a list").len();
    let problem = refused(&href, json!({"hypothesis": n}), 422, "diagnosis.no_hypothesis").await;
    assert_eq!(problem["errors"][0]["pointer"], "/hypothesis");
    refused(&href, json!({"hypothesis": -1}), 422, "body.invalid_value").await;
    refused(&href, json!({"hypotheses": 0}), 422, "body.unknown_field").await;
    refused(&href, json!({"activate": "now"}), 422, "body.invalid_value").await;
    let nobody = format!("{DIAGNOSES}/0197f1a0-0000-7000-8000-000000000000");
    refused(&nobody, json!({}), 404, "diagnosis.not_found").await;

    // Nothing to blame: the rig as the model knows it.
    let mut calm = Vec::new();
    for seed in [41, 42] {
        let u = drive(20.0, 0.15, seed);
        calm.push(
            upload_csv(&lab.app, "kind=other", &csv(&[("drive", &u), ("disp", &measure(&u, 0.0, seed))]))
                .await,
        );
    }
    let (none, report) = lab.report(&json!({"mode": "external", "runs": calm, "material_gap": 0.1})).await;
    assert_eq!(report["verdict"]["kind"], "no_material_gap");
    refused(&none, json!({}), 409, "diagnosis.no_effect").await;

    // A simulation outside has no model that an effect could be added to.
    let mut request = lab.request();
    let drives = [drive(16.0, 1.0, 1), drive(16.0, 0.7, 2), drive(16.0, 0.7, 2), drive(16.0, 1.0, 1)];
    let mut simulated = serde_json::Map::new();
    for (id, u) in lab.high.iter().zip(&drives) {
        let run = upload_csv(&lab.app, "kind=other", &csv(&[("disp", &respond(u, 0.0))])).await;
        simulated.insert(id.clone(), json!(run));
    }
    request["simulated"] = simulated.into();
    request["baseline_runs"] = json!([lab.low]);
    request["catalogue"] = json!(["cubic_stiffness"]);
    let (outside, _) = lab.report(&request).await;
    refused(&outside, json!({}), 409, "diagnosis.no_model").await;

    // A spring that softens, tried far beyond the runs: it lets go.
    let mut soft = Vec::new();
    let u = drive(16.0, 0.5, 51);
    for seed in [61, 62] {
        soft.push(
            upload_csv(&lab.app, "kind=other", &csv(&[("drive", &u), ("disp", &measure(&u, -45.0, seed))]))
                .await,
        );
    }
    let request = json!({
        "mode": "external", "runs": soft, "repeats": [soft], "catalogue": ["cubic_stiffness"],
        "envelope": {"drive_peak": {"drive": 50.0}},
    });
    let (unstable, report) = lab.report(&request).await;
    assert_eq!(report["hypotheses"][0]["stable_over_envelope"], false, "{}", report["verdict"]);
    refused(&unstable, json!({}), 409, "diagnosis.unstable").await;

    lab.app.get("/v1/rigs/mass/models/2").await.problem(404, "model.not_found");
    let put = lab.app.call("PUT", "/v1/rigs/mass/active-model").header("if-match", "*");
    put.json(&json!({"version": null})).send().await.expect(200);
    lab.app.delete("/v1/rigs/mass/models/1").await.expect(204);
    refused(&href, json!({}), 404, "model.not_found").await;
}
