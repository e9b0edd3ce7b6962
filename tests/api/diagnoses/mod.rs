//! Diagnoses: from runs and a model to a named effect, and what is refused before and after.

mod adoption;
mod cores;
mod refusals;
pub mod rig;

use rigcast::engine::model::Preprocess;
use serde_json::json;

use rig::{DIAGNOSES, Lab, RATE, csv, drive, frf_weights, measure, respond, upload_csv};

#[tokio::test]
async fn a_stiffening_spring_is_named_with_where_and_how_far_it_closes() {
    let lab = Lab::with_frf().await;
    let (href, report) = lab.report(&lab.request()).await;
    let verdict = &report["verdict"];
    assert_eq!(
        (&verdict["kind"], &verdict["effect"]),
        (&json!("identified"), &json!("cubic_stiffness")),
        "{verdict}"
    );
    assert_eq!((&verdict["family"], &verdict["axis"]), (&json!("stiffness"), &json!("z")));
    let model = lab.app.get("/v1/rigs/mass/models/1").await.expect(200).json();
    assert_eq!(report["model"], json!({"version": 1, "sha256": model["sha256"]}));
    assert_eq!((&report["mode"], &report["noise_floor_source"]), (&json!("external"), &json!("repeats")));
    assert_eq!((&report["request"]["model"], &report["request"]["material_gap"]), (&json!(1), &json!(0.02)));
    let closure = report["hypotheses"][0]["held_out"]["closure_rms"].as_f64().expect("a closure");
    assert!(closure > 0.9, "{}", report["hypotheses"][0]);
    assert_eq!(report["hypotheses"][0]["held_out"]["runs"][0], lab.high[0], "runs are named by id");

    let items = lab.app.get(DIAGNOSES).await.expect(200).json()["items"].clone();
    let listed = &items[0];
    assert_eq!((items.as_array().map(Vec::len), &listed["id"]), (Some(1), &report["id"]));
    assert_eq!((&listed["verdict"]["effect"], &listed["job"]), (&verdict["effect"], &report["job"]));

    let asked = |accept: &'static str| lab.app.call("GET", &href).header("accept", accept).send();
    asked("text/csv").await.problem(406, "accept.not_acceptable");
    let run = format!("/v1/rigs/mass/runs/{}", lab.high[0]);
    lab.app.call("PATCH", &run).json(&json!({"name": "full level"})).send().await.expect(200);
    let page = asked("text/html").await.expect(200);
    assert!(
        page.text().contains("full level") && !page.text().contains(&lab.high[0]),
        "runs have their names"
    );
    assert!(page.header("content-type").starts_with("text/html"));
    assert!(
        page.text().contains("Mass") && page.text().contains(&format!("{href}/adopt")),
        "{}",
        page.text()
    );
    assert_eq!(
        asked("application/json").await.expect(200).json(),
        report,
        "the same report whenever it is read"
    );
}

#[tokio::test]
async fn a_simulation_outside_is_diagnosed_from_its_simulated_runs() {
    let lab = Lab::without_model().await;
    let mut simulated = serde_json::Map::new();
    for (id, drive) in lab.high.iter().zip([
        drive(16.0, 1.0, 1),
        drive(16.0, 0.7, 2),
        drive(16.0, 0.7, 2),
        drive(16.0, 1.0, 1),
    ]) {
        let run = upload_csv(&lab.app, "kind=other", &csv(&[("disp", &respond(&drive, 0.0))])).await;
        simulated.insert(id.clone(), json!(run));
    }
    let mut request = lab.request();
    request["simulated"] = simulated.into();
    request["baseline_runs"] = json!({"tags": ["low"]});
    let (_, report) = lab.report(&request).await;
    assert_eq!(
        (&report["model"], &report["verdict"]["effect"]),
        (&json!(null), &json!("cubic_stiffness")),
        "{}",
        report["verdict"]
    );
    assert_eq!(report["request"]["baseline_runs"], json!([lab.low]), "the selection is resolved");
}

#[tokio::test]
async fn what_the_models_filter_removes_is_no_gap() {
    let lab = Lab::without_model().await;
    // No stiffening, but hum.
    let mut runs = Vec::new();
    for seed in [1, 2] {
        let u = drive(20.0, 1.0, seed);
        let hum = |k: usize| 0.15 * (std::f64::consts::TAU * 50.0 * k as f64 / RATE).sin();
        let y: Vec<f64> = measure(&u, 0.0, 30 + seed).iter().enumerate().map(|(k, y)| y + hum(k)).collect();
        runs.push(upload_csv(&lab.app, "kind=other", &csv(&[("drive", &u), ("disp", &y)])).await);
    }
    let verdict = async |filter: Preprocess| {
        let version = lab.import(frf_weights(filter)).await;
        let request = json!({
            "model": version, "mode": "external", "runs": runs, "baseline_runs": [lab.low], "material_gap": 0.05,
        });
        let (_, report) = lab.report(&request).await;
        assert_eq!(report["noise_floor_source"], "assumed");
        report["verdict"].clone()
    };
    let bare = verdict(Preprocess::default()).await;
    assert_eq!(bare["effect"], "periodic_disturbance", "{bare}");
    let filtered = verdict(Preprocess { low_pass_hz: Some(40.0), ..Preprocess::default() }).await;
    assert_eq!(filtered["kind"], "no_material_gap", "{filtered}");
}

#[tokio::test]
async fn an_frf_from_before_the_change_that_is_not_the_core_is_said_to_be_stood_for() {
    // The ridge makes the FRF about a tenth smaller than the rig that the baseline runs show.
    let lab = Lab::with_frf_of(json!({"segment_len": 2048, "ridge": 0.1})).await;
    for (material_gap, stood_for) in [(0.02, true), (0.5, false)] {
        let mut request = lab.request();
        request["material_gap"] = json!(material_gap);
        let (_, report) = lab.report(&request).await;
        let warnings = report["warnings"].as_array().expect("a list").clone();
        assert_eq!(
            warnings.contains(&json!("core_stands_for_sim: disp")),
            stood_for,
            "{material_gap}: {warnings:?}"
        );
    }
}

#[tokio::test]
async fn a_diagnosis_is_cancelled_and_deleted_with_its_rig_like_anything_else() {
    let lab = Lab::with_frf().await;
    let mut request = lab.request();
    request["catalogue"] = json!(["all"]);
    let job = lab.app.post_json(DIAGNOSES, &request).await.expect(202).json();
    let job = job["id"].as_str().expect("an id");
    lab.app.post(&format!("/v1/jobs/{job}/cancel")).await.expect(202);
    assert_eq!(lab.app.finished(job).await["state"], "cancelled");
    assert_eq!(lab.app.get(DIAGNOSES).await.expect(200).json()["items"], json!([]));

    let (href, report) = lab.report(&lab.request()).await;
    let app = lab.app.restart();
    assert_eq!(app.get(&href).await.expect(200).json(), report, "it outlives the process");
    app.delete("/v1/rigs/mass").await.expect(204);
    app.get(&href).await.problem(404, "diagnosis.not_found");
    assert_eq!(app.files(), Vec::<std::path::PathBuf>::new(), "nothing is left behind");
}
