//! Every invalid request gets a problem that names the field.

use serde_json::{Value, json};

use super::rig::{DIAGNOSES, Lab, csv, drive, upload_csv};

const NOBODY: &str = "0197f1a0-0000-7000-8000-000000000000";

fn pointer(problem: &Value) -> &str {
    problem["errors"][0]["pointer"].as_str().unwrap_or("none")
}

#[tokio::test]
async fn fields_that_do_not_suit_the_rig_or_each_other_are_named_at_once() {
    let lab = Lab::with_frf().await;
    let [a, b, c, d] = lab.high.clone();
    let simulated = json!({a.clone(): b});
    for (changes, place) in [
        (json!({"catalogue": ["stiffness", "stiffnes"]}), "/catalogue/1"),
        (json!({"catalogue": []}), "/catalogue"),
        (json!({"material_gap": 0.0}), "/material_gap"),
        (json!({"envelope": {"drive_peak": {"drive": -1.0}}}), "/envelope/drive_peak/drive"),
        (json!({"envelope": {"drive_peak": {"disp": 1.0}}}), "/envelope/drive_peak"),
        (json!({"model": 1, "simulated": simulated}), "/model"),
        (json!({"simulated": simulated}), "/baseline_runs"),
        (json!({"simulated": simulated, "baseline_runs": [lab.low]}), &format!("/simulated/{b}")),
        (json!({"runs": [a, NOBODY], "repeats": []}), "/runs/1"),
        (json!({"runs": []}), "/runs"),
        (json!({"runs": [a, a], "repeats": []}), "/runs/1"),
        (json!({"runs": {"fit": [a], "select": [b], "test": [a]}, "repeats": []}), "/runs/test/0"),
        (json!({"runs": {"fit": [a], "select": [], "test": [b]}, "repeats": []}), "/runs/select"),
        (json!({"runs": {"fit": [a, b], "select": [c], "test": [d]}, "repeats": [[a, d]]}), "/repeats/0"),
        (json!({"runs": {"kinds": ["nose"]}, "repeats": []}), "/runs/kinds/0"),
        (json!({"repeats": [[a, lab.low]]}), "/repeats/0/1"),
        (json!({"repeats": [[a, d], [a, b]]}), "/repeats/1/0"),
        (json!({"repeats": [[a]]}), "/repeats/0"),
        (json!({"baseline_runs": [NOBODY]}), "/baseline_runs/0"),
    ] {
        let problem = lab.refused(changes.clone(), 422, "diagnosis.invalid").await;
        assert_eq!(pointer(&problem), place, "{changes}: {problem}");
    }
    let problem = lab.refused(json!({"catalogue": ["stiffnes"]}), 422, "diagnosis.invalid").await;
    assert!(problem["detail"].as_str().is_some_and(|d| d.contains("cubic_stiffness")), "{problem}");
    for (changes, code) in [
        (json!({"runs": {"fit": [a]}}), "body.invalid_value"),
        (json!({"mode": "outside"}), "body.invalid_value"),
        (json!({"model": "latest"}), "body.invalid_value"),
        (json!({"material_gap": "0.02"}), "body.invalid_value"),
        (json!({"repeat": []}), "body.unknown_field"),
        (json!({"envelope": {"peak": {}}}), "body.unknown_field"),
    ] {
        lab.refused(changes, 422, code).await;
    }
    lab.app.post_json(DIAGNOSES, &json!({})).await.problem(422, "body.missing_field");
    lab.refused(json!({"runs": {"tags": ["none"]}, "repeats": []}), 409, "diagnosis.no_runs").await;
    lab.refused(json!({"model": 9}), 404, "model.not_found").await;
    lab.app.post_json("/v1/rigs/none/diagnoses", &lab.request()).await.problem(404, "rig.not_found");
    lab.app.get("/v1/rigs/none/diagnoses").await.problem(404, "rig.not_found");
    for id in [NOBODY, "1"] {
        lab.app.get(&format!("{DIAGNOSES}/{id}")).await.problem(404, "diagnosis.not_found");
    }
    let jobs = lab.app.get("/v1/jobs?kind=diagnosis").await.expect(200).json();
    assert_eq!(jobs["items"], json!([]), "nothing was queued");
}

#[tokio::test]
async fn runs_that_cannot_be_diagnosed_are_refused_with_the_channel_and_the_run() {
    let lab = Lab::without_model().await;
    lab.refused(json!({}), 409, "model.none_active").await;
    let version = lab.import(super::frf_weights(Default::default())).await;
    let problem = lab.refused(json!({"model": version}), 422, "diagnosis.invalid").await;
    assert_eq!(pointer(&problem), "/baseline_runs", "imported weights have no fit runs: {problem}");

    let u = drive(8.0, 1.0, 5);
    let zeros = vec![0.0; u.len()];
    let of = async |columns: &[(&str, &[f64])]| upload_csv(&lab.app, "kind=other", &csv(columns)).await;
    let drive_only = of(&[("drive", &u)]).await;
    let still = of(&[("drive", &zeros), ("disp", &u)]).await;
    let flat = of(&[("drive", &u), ("disp", &zeros)]).await;
    let short = of(&[("drive", &u[..40]), ("disp", &u[..40])]).await;
    let brief = of(&[("drive", &u[..100]), ("disp", &u[..100])]).await;
    let with =
        |runs: Value| json!({"model": version, "runs": runs, "repeats": [], "baseline_runs": [lab.low]});

    let problem = lab.refused(with(json!([drive_only])), 422, "diagnosis.missing_channel").await;
    assert_eq!(problem["errors"][0]["channel"], "disp");
    assert!(problem["detail"].as_str().is_some_and(|d| d.contains(&drive_only)), "{problem}");
    let problem = lab.refused(with(json!([still])), 422, "signal.dead_channel").await;
    assert_eq!((pointer(&problem), &problem["errors"][0]["channel"]), ("/runs", &json!("drive")));
    let problem = lab.refused(with(json!([flat])), 422, "signal.dead_channel").await;
    assert_eq!(problem["errors"][0]["channel"], "disp");
    let mut baseline = with(json!([lab.high[0]]));
    baseline["baseline_runs"] = json!([still]);
    let problem = lab.refused(baseline, 422, "signal.dead_channel").await;
    assert_eq!(pointer(&problem), "/baseline_runs");
    lab.refused(with(json!([short])), 422, "diagnosis.too_short").await;

    let mut outside = json!({"simulated": {lab.high[0].clone(): brief}, "baseline_runs": [lab.low]});
    outside["runs"] = json!([lab.high[0]]);
    outside["repeats"] = json!([]);
    lab.refused(outside.clone(), 422, "signal.unequal_lengths").await;
    outside["simulated"] = json!({lab.high[0].clone(): drive_only});
    lab.refused(outside, 422, "diagnosis.invalid").await;

    // Long enough for a look at the row, too short for the core: the job says so.
    let request = json!({"model": version, "mode": "external", "runs": [brief], "baseline_runs": [lab.low]});
    let job = lab.finished(&request).await;
    assert_eq!(
        (&job["state"], &job["problem"]["code"]),
        (&json!("failed"), &json!("diagnosis.too_short")),
        "{job}"
    );
    assert_eq!(pointer(&job["problem"]), "/runs");
}
