//! Hybrids on an adopted version in place of an FRF.

use serde_json::{Value, json};

use super::adoption::{adopted, predicted};
use super::rig::{Lab, RATE, draft, drive, upload};

const FITS: &str = "/v1/rigs/mass/fits";

/// A small hybrid 2 on a version, fitted to these runs.
fn request(version: u64, runs: &[&String]) -> Value {
    let lstm = json!({"blocks": [4], "window_len": 64, "epochs": 3, "seeds": [1]});
    json!({"kind": "hybrid2", "core": {"version": version}, "lstm": lstm, "runs": runs})
}

/// The finished job of a fit, and its model.
async fn fitted(lab: &Lab, request: &Value) -> (Value, Value) {
    let job = lab.app.post_json(FITS, request).await.expect(202).json();
    let job = lab.app.finished(job["id"].as_str().expect("an id")).await;
    assert_eq!(job["state"], "succeeded", "{job}");
    let model = lab.app.get(job["result"]["href"].as_str().expect("a link")).await.expect(200).json();
    (job, model)
}

/// A lab whose version 2 has an adopted spring.
async fn lab() -> Lab {
    let lab = Lab::with_frf().await;
    let (href, _) = lab.report(&lab.request()).await;
    assert_eq!(adopted(&lab, &href, json!({})).await.0, 2);
    lab
}

#[tokio::test]
async fn a_hybrid_on_an_adopted_core_is_a_model_like_any_other_and_outlives_the_core() {
    let lab = lab().await;
    let new = [
        upload(&lab.app, "kind=noise", &drive(30.0, 0.9, 31), 31).await,
        upload(&lab.app, "kind=noise", &drive(30.0, 0.9, 32), 32).await,
    ];
    let (job, model) = fitted(&lab, &request(2, &[&new[0], &new[1]])).await;
    assert_eq!((&model["kind"], &model["version"]), (&json!("hybrid2"), &json!(3)));
    assert_eq!(model["request"]["core"], json!({"version": 2}));
    let two = lab.app.get("/v1/rigs/mass/models/2").await.expect(200).json();
    let core = &model["lineage"]["core"];
    assert_eq!(
        (&core["version"], &core["sha256"], &core["effects"]),
        (&json!(2), &two["sha256"], &two["effects"])
    );
    let seen: Vec<&Value> = core["seen"].as_array().expect("spans").iter().map(|span| &span["run"]).collect();
    assert!(seen.contains(&&json!(lab.low)) && seen.contains(&&json!(lab.high[0])), "{core}");
    assert_eq!((&model["report"]["frf"], &model["report"]["warnings"]), (&Value::Null, &json!([])));
    // The FRF of version 1 was active, and the hybrid is better on the new runs, which neither has seen.
    assert_eq!(model["active"], true, "{job}");
    assert_eq!(model["frf"]["lines"], two["frf"]["lines"], "its FRF is the core's");

    let u = drive(10.0, 0.9, 99);
    let unseen = upload(&lab.app, "kind=service&split=test", &u, 98).await;
    let (frf, hybrid) = (lab.error_of(1, &unseen).await, lab.error_of(3, &unseen).await);
    assert!(hybrid < 0.3 * frf, "{frf} of the FRF, {hybrid} of the hybrid on the core");

    // The effect came after the band of its base; the hybrid was compared with the core in it.
    let band = async |version: u64| {
        let drive = json!({"sample_rate_hz": RATE, "channels": {"drive": u}});
        let request =
            json!({"model": version, "drive": drive, "include": ["band", "trust"], "fallback": "frf"});
        lab.app.post_json("/v1/rigs/mass/predict", &request).await.expect(200).json()
    };
    let (of_core, of_hybrid) = (band(2).await, band(3).await);
    assert!(of_core["band"].is_null() && of_core["band_reason"].to_string().contains("adopted"), "{of_core}");
    assert_eq!(of_core["trust"]["fallback_fade_s"], 0.1015625, "13 samples");
    let half = &of_hybrid["band"]["channels"]["disp"]["half_width"];
    assert_eq!(half.as_array().map(Vec::len), Some(u.len()));

    // It holds its core: that version may go, and another rig of these channels takes the file.
    let before = predicted(&lab, 3, &u).await;
    lab.app.delete("/v1/rigs/mass/models/2").await.expect(204);
    assert_eq!(predicted(&lab, 3, &u).await, before);
    let weights = lab.app.get("/v1/rigs/mass/models/3/weights").await.expect(200).bytes;
    let again = lab.import(weights).await;
    assert_eq!(predicted(&lab, again, &u).await, before, "the same weights, the same prediction");
    let imported = lab.app.get(&format!("/v1/rigs/mass/models/{again}")).await.expect(200).json();
    assert_eq!((&imported["sha256"], &imported["kind"]), (&model["sha256"], &json!("hybrid2")));
    let core = json!({"version": null, "sha256": null, "effects": two["effects"], "seen": []});
    assert_eq!(imported["lineage"]["core"], core);
    let page =
        lab.app.call("GET", "/rigs/mass/models/3").header("accept", "text/html").send().await.expect(200);
    assert!(page.text().contains("(version 2)"), "the page names the core");
}

#[tokio::test]
async fn what_the_core_has_seen_compares_nothing() {
    let lab = lab().await;
    let new = upload(&lab.app, "kind=noise", &drive(16.0, 0.9, 31), 31).await;
    let (_, model) = fitted(&lab, &request(2, &[&lab.high[0], &new, &lab.high[1]])).await;
    let compared = model["lineage"]["validation"].as_array().expect("spans");
    assert!(compared.iter().all(|span| span["run"] == json!(new)), "{compared:?}");
    assert_eq!(model["report"]["warnings"], json!([]));

    let (job, model) = fitted(&lab, &request(2, &[&lab.high[0], &lab.high[1]])).await;
    let warnings = model["report"]["warnings"].to_string();
    assert!(
        warnings.contains("model version 2, the core, has seen data that compare this model"),
        "{warnings}"
    );
    assert_eq!(model["active"], false, "{job}");
    let evaluation = json!({"models": [model["version"]], "runs": [lab.low]});
    let evaluated = lab.app.post_json("/v1/rigs/mass/evaluations", &evaluation).await.expect(202).json();
    let evaluated = lab.app.finished(evaluated["id"].as_str().expect("an id")).await;
    let report = lab
        .app
        .get(evaluated["result"]["href"].as_str().expect("a link"))
        .await
        .expect(200)
        .text()
        .to_owned();
    assert!(report.contains(r#""seen":"training""#), "the FRF of the core was fitted to it: {report}");
}

#[tokio::test]
async fn a_core_that_does_not_suit_is_refused_by_its_field() {
    let lab = lab().await;
    let good = request(2, &[&lab.high[0], &lab.high[1]]);
    let refused = async |change: Value, status: u16, code: &str| {
        let mut request = good.clone();
        request.as_object_mut().expect("fields").extend(change.as_object().expect("fields").clone());
        lab.app.post_json(FITS, &request).await.problem(status, code)["errors"][0]["pointer"].clone()
    };
    for (change, pointer) in [
        (json!({"kind": "frf"}), "/core"),
        (json!({"kind": "lstm"}), "/core"),
        (json!({"frf": {"segment_len": 256}}), "/frf"),
        (json!({"core": {"version": 1}}), "/core/version"),
        (json!({"inputs": ["disp"], "outputs": ["drive"]}), "/core/version"),
        (json!({"preprocess": {"low_pass_hz": 30.0}}), "/preprocess"),
    ] {
        assert_eq!(refused(change.clone(), 422, "fit.invalid").await, pointer, "{change}");
    }
    assert_eq!(refused(json!({"core": {"version": 99}}), 404, "model.not_found").await, "/core/version");
    refused(json!({"core": {"version": 2, "kind": "frf"}}), 422, "body.unknown_field").await;
    refused(json!({"core": {}}), 422, "body.missing_field").await;
    // Versions are a rig's own.
    let mut other = draft();
    other["id"] = json!("other");
    lab.app.rig(&other).await;
    let u = drive(20.0, 0.9, 41);
    let run = super::rig::csv(&[("drive", &u), ("disp", &super::rig::measure(&u, 0.0, 42))]);
    lab.app.post_file("/v1/rigs/other/runs?kind=noise", "text/csv", run).await.expect(201);
    let on_other = json!({"kind": "hybrid1", "core": {"version": 2}});
    lab.app.post_json("/v1/rigs/other/fits", &on_other).await.problem(404, "model.not_found");
}
