//! Adoption: the version with the effect predicts better, here and wherever its weights are imported.

use serde_json::{Value, json};

use super::rig::{CUBIC, DIAGNOSES, Lab, RATE, csv, drive, measure, respond, upload, upload_csv};
use crate::support::{f8, npy, read_f4};

/// Adopts an effect; returns the version and its model.
pub async fn adopted(lab: &Lab, href: &str, body: Value) -> (u64, Value) {
    let reply = lab.app.post_json(&format!("{href}/adopt"), &body).await.expect(201);
    let made = reply.json();
    assert_eq!(made["href"], reply.header("location"));
    let model = lab.app.get(made["href"].as_str().expect("a link")).await.expect(200).json();
    (made["version"].as_u64().expect("a version"), model)
}

pub async fn predicted(lab: &Lab, version: u64, u: &[f64]) -> Vec<f64> {
    let request = json!({
        "model": version, "include": ["response"], "drive": {"sample_rate_hz": RATE, "channels": {"drive": u}},
    });
    let answer = lab.app.post_json("/v1/rigs/mass/predict", &request).await.expect(200).json();
    let samples = answer["response"]["channels"]["disp"].as_array().expect("samples").clone();
    samples.iter().map(|v| v.as_f64().expect("a number")).collect()
}

/// A run of the rig whose sensor reads 0.4 mm more than it did.
async fn shifted(lab: &Lab, query: &str, drive: &[f64], seed: u64) -> String {
    let read: Vec<f64> = measure(drive, CUBIC, seed).iter().map(|y| y + 0.4).collect();
    upload_csv(&lab.app, query, &csv(&[("drive", drive), ("disp", &read)])).await
}

#[tokio::test]
async fn two_effects_are_adopted_together() {
    let lab = Lab::with_frf().await;
    let (a, b) = (drive(16.0, 1.0, 1), drive(16.0, 0.7, 2));
    let mut runs = Vec::new();
    for (k, drive) in [&a, &b, &b, &a].into_iter().enumerate() {
        runs.push(shifted(&lab, "kind=service&tag=shifted", drive, 51 + k as u64).await);
    }
    let mut request = lab.request();
    request["repeats"] = json!([[runs[0], runs[3]], [runs[1], runs[2]]]);
    request["runs"] = json!(runs);
    request["catalogue"] = json!(["linear_change", "cubic_stiffness", "coulomb_friction", "offset"]);
    let (href, report) = lab.report(&request).await;
    let named = |effects: &Value| -> Vec<String> {
        let list = effects.as_array().expect("effects");
        let mut names: Vec<String> =
            list.iter().map(|e| e["effect"].as_str().expect("a name").to_owned()).collect();
        names.sort();
        names
    };
    let both = ["cubic_stiffness", "offset"];
    assert_eq!(named(&report["verdict"]["effects"]), both, "{}", report["verdict"]);
    let hypothesis = &report["hypotheses"][0];
    assert_eq!(
        (named(&hypothesis["effects"]), &hypothesis["effect"]),
        (both.map(String::from).to_vec(), &report["verdict"]["effect"])
    );
    let page = lab.app.call("GET", &href).header("accept", "text/html").send().await.expect(200);
    assert!(String::from_utf8_lossy(&page.bytes).contains("together they close"));

    let (version, model) = adopted(&lab, &href, json!({})).await;
    assert_eq!(named(&model["effects"]), both);
    let u = drive(10.0, 0.9, 99);
    let unseen = shifted(&lab, "kind=service&split=test", &u, 98).await;
    let (before, after) = (lab.error_of(1, &unseen).await, lab.error_of(version, &unseen).await);
    assert!(before > 0.2 && after < 0.15 * before, "{before} before, {after} after");
    let weights = lab.app.get(&format!("/v1/rigs/mass/models/{version}/weights")).await.expect(200).bytes;
    let again = lab.import(weights).await;
    assert_eq!(predicted(&lab, again, &u).await, predicted(&lab, version, &u).await);
}

#[tokio::test]
async fn the_adopted_effect_predicts_an_unseen_run_better_here_and_after_a_round_trip() {
    let lab = Lab::with_frf().await;
    let (href, report) = lab.report(&lab.request()).await;
    let (version, model) = adopted(&lab, &href, json!({})).await;
    assert_eq!((version, &model["origin"], &model["active"]), (2, &json!("diagnosis"), &json!(false)));
    assert_eq!((&model["kind"], &model["job"]), (&json!("adopted"), &report["job"]));
    let fitted = lab.app.get("/v1/rigs/mass/models/1").await.expect(200).json();
    assert_eq!((&fitted["kind"], fitted.get("base"), fitted.get("effects")), (&json!("frf"), None, None));
    let base = json!({"version": 1, "kind": "frf", "sha256": fitted["sha256"]});
    let effects = json!([{"effect": "cubic_stiffness", "family": "stiffness", "channel": "disp"}]);
    assert_eq!((&model["base"], &model["effects"]), (&base, &effects));
    let listed = lab.app.get("/v1/rigs/mass/models").await.expect(200).json();
    assert_eq!(listed["items"][1], model);
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

    // The same result by JSON, NPY, export and import.
    let json = predicted(&lab, version, &u).await;
    let path = format!("/v1/rigs/mass/predict?model={version}&sample_rate_hz={RATE}");
    let file = npy("<f8", false, &format!("({}, 1)", u.len()), &f8(&u));
    let (_, array) = read_f4(&lab.app.post_file(&path, "application/x-npy", file).await.expect(200).bytes);
    assert!(json.iter().zip(&array).all(|(a, b)| *a as f32 == *b), "NPY answers the same");
    let weights = lab.app.get(&format!("/v1/rigs/mass/models/{version}/weights")).await.expect(200).bytes;
    let again = lab.import(weights).await;
    assert_eq!(predicted(&lab, again, &u).await, json, "the same weights, the same prediction");
    let imported = lab.app.get(&format!("/v1/rigs/mass/models/{again}")).await.expect(200).json();
    assert_eq!((&imported["sha256"], &imported["kind"]), (&model["sha256"], &json!("adopted")));
    assert_eq!(imported["base"], json!({"version": null, "kind": "frf", "sha256": null}));
    assert_eq!(imported["effects"], effects);

    // It holds its base: that version may go. Answers and metrics name what predicts.
    lab.activate(version).await;
    lab.app.delete("/v1/rigs/mass/models/1").await.expect(204);
    assert_eq!(predicted(&lab, version, &u).await, json);
    let request = json!({"drive": {"sample_rate_hz": RATE, "channels": {"drive": u}}, "include": ["trust"]});
    let answer = lab.app.post_json("/v1/rigs/mass/predict", &request).await.expect(200).json();
    assert_eq!(
        answer["model"],
        json!({"version": version, "kind": "adopted", "base": base, "sha256": model["sha256"]})
    );
    let metrics = lab.app.get("/metrics").await.expect(200);
    let counted = metrics
        .text()
        .lines()
        .find_map(|line| line.strip_prefix(r#"rigcast_predictions_total{kind="adopted"} "#));
    assert!(counted.is_some_and(|n| n.parse::<f64>().is_ok_and(|n| n > 0.0)), "{}", metrics.text());
}

#[tokio::test]
async fn an_adopted_effect_is_part_of_the_sim_when_its_version_is_diagnosed() {
    let lab = Lab::with_frf().await;
    let (href, _) = lab.report(&lab.request()).await;
    let (version, _) = adopted(&lab, &href, json!({})).await;
    for mode in ["external", "in_situ"] {
        let mut request = lab.request();
        (request["model"], request["mode"]) = (json!(version), json!(mode));
        let (again, report) = lab.report(&request).await;
        assert_eq!(report["verdict"]["kind"], "no_material_gap", "{mode}: {}", report["verdict"]);
        let gap = report["gap"]["systematic_rms_rel"].as_f64().expect("a number");
        assert!(gap < 0.02, "{mode}: {}", report["gap"]);
        lab.app.post_json(&format!("{again}/adopt"), &json!({})).await.problem(409, "diagnosis.no_effect");
        let page = lab.app.call("GET", &again).header("accept", "text/html").send().await.expect(200);
        assert!(page.text().contains("(adopted on frf)"));
    }
}

#[tokio::test]
async fn no_fit_makes_an_adopted_model() {
    let lab = Lab::without_model().await;
    let request = json!({"kind": "adopted"});
    let problem = lab.app.post_json("/v1/rigs/mass/fits", &request).await.problem(422, "body.invalid_value");
    assert_eq!(problem["errors"][0]["pointer"], "/kind", "{problem}");
    assert!(problem["errors"][0]["limit"].as_str().is_some_and(|l| l.contains("hybrid2")), "{problem}");
}

#[tokio::test]
async fn a_network_takes_an_effect_too_and_activation_is_as_asked() {
    let lab = Lab::without_model().await;
    // The hybrid, fitted to low runs only, does not have the stiffening either.
    let request = json!({
        "kind": "hybrid2", "frf": {"segment_len": 2048}, "preprocess": {"low_pass_hz": 40.0},
        "lstm": {"blocks": [4], "window_len": 64, "hop": 32, "epochs": 2, "seeds": [1]},
    });
    let job = lab.app.post_json("/v1/rigs/mass/fits", &request).await.expect(202).json();
    let job = lab.app.finished(job["id"].as_str().expect("an id")).await;
    assert_eq!(job["state"], "succeeded", "{job}");
    let (href, report) = lab.report(&lab.request()).await;
    // So short a training has errors of its own, which may leave more than one effect possible.
    let verdict = report["verdict"]["kind"].as_str().expect("a kind");
    assert!(["identified", "partial", "not_distinguishable"].contains(&verdict), "{}", report["verdict"]);
    assert_eq!(report["hypotheses"][0]["effect"], "cubic_stiffness", "{}", report["verdict"]);
    let unseen = upload(&lab.app, "kind=service&split=test", &drive(10.0, 0.9, 99), 98).await;
    let before = lab.error_of(1, &unseen).await;
    let (version, model) = adopted(&lab, &href, json!({"activate": "if_better"})).await;
    assert_eq!(
        (&model["kind"], &model["base"]["kind"], &model["active"]),
        (&json!("adopted"), &json!("hybrid2"), &json!(true)),
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
    // In situ too the network's effect is in the free run of the core.
    for mode in ["external", "in_situ"] {
        let mut request = lab.request();
        (request["model"], request["mode"]) = (json!(version), json!(mode));
        let (_, report) = lab.report(&request).await;
        assert_ne!(report["verdict"]["effect"], "cubic_stiffness", "{mode}: {}", report["verdict"]);
    }
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

    // No effect: the rig as the model has it.
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

    // An external simulation has no model that an effect could be added to.
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

    // A softening spring far beyond the runs: it becomes unstable.
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
