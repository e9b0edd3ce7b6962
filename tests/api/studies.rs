//! Studies over HTTP: a search ends in a table and a model, and what cannot be done is refused.

use serde_json::{Value, json};

use crate::support::{TestApp, bench, lag_csv};

const STUDIES: &str = "/v1/rigs/bench/studies";

async fn lagging(app: &TestApp, runs: u64) {
    app.rig(&bench()).await;
    for seed in 0..runs {
        app.run("kind=noise", &lag_csv(2000, 30 + seed)).await;
    }
}

fn small() -> Value {
    json!({"kind": "lstm", "lstm": {"blocks": [3], "window_len": 32, "hop": 16, "epochs": 6, "seeds": [1]}})
}

async fn studied(app: &TestApp, request: &Value) -> (Value, Value) {
    let job = app.post_json(STUDIES, request).await.expect(202).json();
    assert_eq!((&job["kind"], &job["state"]), (&json!("study"), &json!("queued")));
    let job = app.finished(job["id"].as_str().expect("an id")).await;
    let href = job["result"]["href"].as_str().unwrap_or_else(|| panic!("a study: {job}")).to_owned();
    let study = app.get(&href).await.expect(200).json();
    assert_eq!((&study["id"], &study["state"]), (&job["id"], &json!("succeeded")));
    (job, study)
}

/// That the study's page has a figure of its errors.
async fn shows_errors(app: &TestApp, study: &Value) {
    let page = format!("/rigs/bench/studies/{}", study["id"].as_str().expect("an id"));
    app.get(&page).await.expect(200);
    let svg = app.get(&format!("{page}?figure=errors&as=svg")).await.expect(200);
    assert!(svg.text().contains("RMS error in %"), "{}", svg.text());
}

#[tokio::test]
async fn a_search_ends_in_its_table_and_the_model_of_the_best_trial() {
    let app = TestApp::start();
    lagging(&app, 4).await;
    let request = json!({
        "kind": "search", "method": "successive_halving", "reduction": 2, "trials": 5, "fit": small(),
        "space": {"cells": {"min": 2, "max": 6}, "learning_rate": {"min": 1e-4, "max": 3e-2}, "kinds": ["lstm", "hybrid2"]},
    });
    let (job, study) = studied(&app, &request).await;
    let search = &study["search"];
    let rows = search["trials"].as_array().expect("rows");
    assert_eq!((rows.len(), &search["planned"]), (10, &json!(10)), "5, then 3, then 2");
    let page = format!("/rigs/bench/studies/{}", study["id"].as_str().expect("an id"));
    let html = app.get(&page).await.expect(200);
    assert!(
        html.text().contains("10 of 10 trials are done") && html.text().contains("learning rate"),
        "{}",
        html.text()
    );
    assert!(app.get("/rigs/bench").await.expect(200).text().contains(&page), "the rig's page lists it");
    let numbers = app.get(&format!("{page}?figure=errors&as=csv")).await.expect(200);
    assert!(numbers.text().contains("rung 2"), "{}", numbers.text());
    shows_errors(&app, &study).await;
    app.get(&format!("{page}?figure=loss")).await.problem(422, "query.invalid");
    let epochs: Vec<u64> = rows.iter().map(|row| row["epochs"].as_u64().expect("epochs")).collect();
    assert_eq!(epochs, [2, 2, 2, 2, 2, 3, 3, 3, 6, 6], "a quarter of 6, rounded, a half, all");
    let error = |row: &Value| row["error"].as_f64().expect("an error");
    let best = &search["best"];
    assert!(rows[8..].iter().all(|row| error(row) >= error(best)), "{search}");
    // The trials that went on were the best of their round.
    let least = |rows: &[Value], n: usize| {
        let mut all: Vec<(f64, u64)> =
            rows.iter().map(|row| (error(row), row["trial"].as_u64().expect("a number"))).collect();
        all.sort_by(|a, b| a.partial_cmp(b).expect("finite"));
        let mut kept: Vec<u64> = all[..n].iter().map(|(_, trial)| *trial).collect();
        kept.sort_unstable();
        kept
    };
    let numbers =
        |rows: &[Value]| rows.iter().map(|row| row["trial"].as_u64().expect("a number")).collect::<Vec<_>>();
    assert_eq!(numbers(&rows[5..8]), least(&rows[..5], 3));
    assert_eq!(numbers(&rows[8..]), least(&rows[5..8], 2));

    let version = study["model"].as_u64().expect("a version");
    let model = app.get(&format!("/v1/rigs/bench/models/{version}")).await.expect(200).json();
    assert_eq!((&model["job"], &model["origin"]), (&job["id"], &json!("fit")));
    assert_eq!(model["request"]["kind"], best["settings"]["kind"]);
    assert_eq!(model["report"]["lstm"]["blocks"], best["settings"]["lstm"]["blocks"]);
    assert_eq!(model["report"]["lstm"]["learning_rate"], best["settings"]["lstm"]["learning_rate"]);
    assert_eq!(model["report"]["lstm"]["epochs"], 6);
    // The best was chosen without the data that compare the model.
    assert_eq!(model["report"]["comparison"]["rule"], "left_out_runs");
    assert_eq!(study["request"]["fit"]["runs"].as_array().map(Vec::len), Some(4));
    let listed = app.get(STUDIES).await.expect(200).json();
    assert_eq!((&listed["items"][0]["id"], &listed["items"][0]["model"]), (&job["id"], &json!(version)));
    let said = job["stage"].as_str().expect("last words");
    assert!(
        said.contains("is the best, with an error of") && said.contains(&format!("model {version}")),
        "{said}"
    );

    // The same study has the same table.
    let (_, again) = studied(&app, &request).await;
    assert_eq!(again["search"], study["search"]);
}

#[tokio::test]
async fn no_trial_sees_the_runs_that_compare_or_test() {
    let app = TestApp::start();
    lagging(&app, 2).await;
    let request =
        json!({"kind": "search", "trials": 2, "fit": small(), "space": {"cells": {"min": 2, "max": 4}}});
    let (_, study) = studied(&app, &request).await;
    // The run that compares models (the newer one) and a test run change nothing in the table.
    let other = TestApp::start();
    other.rig(&bench()).await;
    other.run("kind=noise", &lag_csv(2000, 30)).await;
    other.run("kind=noise", &lag_csv(2000, 77)).await;
    other.run("kind=noise&split=test", &lag_csv(2000, 31)).await;
    let (_, second) = studied(&other, &request).await;
    assert_eq!(study["search"], second["search"]);
}

#[tokio::test]
async fn a_cancelled_study_keeps_the_trials_that_it_has_done() {
    let app = TestApp::start();
    lagging(&app, 1).await;
    let mut fit = small();
    fit["lstm"]["epochs"] = json!(200);
    let request =
        json!({"kind": "search", "trials": 200, "fit": fit, "space": {"cells": {"min": 2, "max": 4}}});
    let job = app.post_json(STUDIES, &request).await.expect(202).json();
    let href = format!("{STUDIES}/{}", job["id"].as_str().expect("an id"));
    let seen = loop {
        let study = app.get(&href).await.expect(200).json();
        if study["search"]["trials"].as_array().is_some_and(|rows| rows.len() > 1) {
            break study;
        }
        tokio::time::sleep(std::time::Duration::from_millis(20)).await;
    };
    assert_eq!((&seen["state"], &seen["model"]), (&json!("running"), &Value::Null));
    assert!(seen["search"]["best"]["error"].is_number(), "the best so far: {seen}");
    app.post(&format!("/v1/jobs/{}/cancel", job["id"].as_str().expect("an id"))).await.expect(202);
    let job = app.finished(job["id"].as_str().expect("an id")).await;
    assert_eq!(job["state"], "cancelled");
    let kept = app.get(&href).await.expect(200).json();
    assert_eq!((&kept["state"], &kept["model"]), (&json!("cancelled"), &Value::Null));
    let rows = |study: &Value| study["search"]["trials"].as_array().expect("rows").clone();
    assert!(rows(&kept).starts_with(&rows(&seen)), "{kept}");
}

#[tokio::test]
async fn a_study_that_cannot_be_done_is_refused_with_its_place() {
    let app = TestApp::start();
    lagging(&app, 1).await;
    let with = |change: Value| {
        let mut request = json!({"kind": "search", "fit": small()});
        request.as_object_mut().expect("an object").extend(change.as_object().expect("an object").clone());
        request
    };
    for (change, pointer) in [
        (json!({"trials": 201}), "/trials"),
        (json!({"trials": 0}), "/trials"),
        (json!({"space": {}}), "/space"),
        (json!({"space": {"cells": {"min": 9, "max": 8}}}), "/space/cells"),
        (json!({"space": {"learning_rate": {"min": 0.0, "max": 1e-3}}}), "/space/learning_rate"),
        (json!({"space": {"window_len": []}}), "/space/window_len"),
        (json!({"space": {"hop": {"min": 0.2, "max": 0.9}}}), "/space/hop"),
        (json!({"space": {"kinds": ["frf"]}}), "/space/kinds"),
        (json!({"fit": {"kind": "frf"}}), "/fit/kind"),
        (json!({"reduction": 2}), "/reduction"),
    ] {
        let problem = app.post_json(STUDIES, &with(change.clone())).await.problem(422, "study.invalid");
        assert_eq!(problem["errors"][0]["pointer"], pointer, "{change}: {problem}");
    }
    // What a fit refuses, a study refuses, with the place within its fit.
    let problem = app.post_json(STUDIES, &with(json!({"fit": {"kind": "lstm", "inputs": ["w"]}}))).await;
    assert_eq!(problem.problem(422, "fit.invalid")["errors"][0]["pointer"], "/fit/inputs/0");
    let problem = app.post_json(STUDIES, &with(json!({"space": {"window_len": [32, 4096]}}))).await;
    assert_eq!(problem.problem(422, "signal.too_short")["errors"][0]["pointer"], "/fit/lstm/window_len");
    app.post_json(
        STUDIES,
        &with(json!({"fit": {"kind": "lstm", "start": {"version": 7}}, "space": {"batch_size": [8]}})),
    )
    .await
    .problem(404, "model.not_found");
    let problem = app.post_json(STUDIES, &with(json!({"space": {"cell": 3}}))).await;
    assert_eq!(problem.problem(422, "body.unknown_field")["errors"][0]["pointer"], "/space/cell");
    app.post_json(STUDIES, &json!({"kind": "guess", "fit": small()}))
        .await
        .problem(422, "body.invalid_value");
    app.post_json(STUDIES, &json!({"fit": small()})).await.problem(422, "body.missing_field");
    app.get(&format!("{STUDIES}/0197f1a0-0000-7000-8000-000000000000")).await.problem(404, "study.not_found");
    app.post_json("/v1/rigs/none/studies", &with(json!({}))).await.problem(404, "rig.not_found");
    assert_eq!(app.get("/v1/jobs").await.json()["items"], json!([]), "nothing was queued");
}

#[tokio::test]
async fn a_learning_curve_says_what_more_noise_would_bring() {
    let app = TestApp::start();
    app.rig(&bench()).await;
    app.run("kind=noise", &lag_csv(12_000, 40)).await;
    app.run("kind=noise", &lag_csv(4000, 41)).await;
    let request = json!({
        "kind": "learning_curve", "sizes": 3, "repeats": 2, "more_min": 2.5,
        "fit": {"kind": "frf", "frf": {"segment_len": 64}},
    });
    let (job, study) = studied(&app, &request).await;
    shows_errors(&app, &study).await;
    let curve = &study["learning_curve"];
    let fits = curve["fits"].as_array().expect("fits");
    assert_eq!((fits.len(), &curve["planned"], &study["model"]), (6, &json!(6), &Value::Null));
    let minutes: Vec<f64> = fits.iter().map(|fit| fit["minutes"].as_f64().expect("minutes")).collect();
    assert!(minutes[0] < minutes[2] && minutes[2] < minutes[4] && fits[4]["share"] == 1.0, "{curve}");
    // The shorter run is left out to score, so the longer one is the pool.
    assert!((minutes[4] - 2.0).abs() < 1e-9, "{minutes:?}");
    let output = &curve["outputs"][0];
    let number = |at: &str, field: &str| output[at][field].as_f64().expect("a number");
    assert_eq!(output["channel"], "y");
    assert!((number("then", "minutes") - 4.5).abs() < 1e-9, "{output}");
    assert!(
        number("then", "low") <= number("then", "error") && number("then", "error") <= number("then", "high")
    );
    let said = output["sentence"].as_str().expect("a sentence");
    assert!(
        said.starts_with("another 2.5 minutes of noise would l") && said.contains("the error of y"),
        "{said}"
    );
    assert_eq!(job["stage"], said, "of the worst output");
    assert_eq!(app.get("/v1/rigs/bench/models").await.expect(200).json()["items"], json!([]));

    for (change, pointer, code) in [
        (json!({"sizes": 2}), "/sizes", "study.invalid"),
        (json!({"more_min": -1}), "/more_min", "study.invalid"),
        (json!({"trials": 3}), "/trials", "study.invalid"),
        (
            json!({"fit": {"kind": "frf", "frf": {"runs": {"tags": ["linear"]}}}}),
            "/fit/frf/runs",
            "study.invalid",
        ),
        (json!({"fit": {"kind": "frf", "outputs": []}}), "/fit/outputs", "fit.invalid"),
    ] {
        let mut bad = request.clone();
        bad.as_object_mut().expect("an object").extend(change.as_object().expect("an object").clone());
        let problem = app.post_json(STUDIES, &bad).await.problem(422, code);
        assert_eq!(problem["errors"][0]["pointer"], pointer, "{problem}");
    }
    // Too little for eight blocks: seen when the runs are loaded.
    let app = TestApp::start();
    lagging(&app, 1).await;
    let job = app.post_json(STUDIES, &request).await.expect(202).json();
    let job = app.finished(job["id"].as_str().expect("an id")).await;
    assert_eq!(
        (&job["state"], &job["problem"]["code"]),
        (&json!("failed"), &json!("signal.too_short")),
        "{job}"
    );
}

#[tokio::test]
async fn a_linear_study_trains_networks_on_files_of_an_frf() {
    let app = TestApp::start();
    app.bench_with_model().await;
    let request = json!({
        "kind": "linear_study", "files": [1, 2], "scored_files": 1, "duration_s": 12, "nets": [[2], [3, 2]],
        "epochs": 2, "learning_rate": 0.01, "mean": 1, "amplitude": {"min": 0.5, "max": 1}, "white_to_hz": 10, "end_hz": 30,
    });
    let (job, study) = studied(&app, &request).await;
    shows_errors(&app, &study).await;
    let fits = study["linear_study"]["fits"].as_array().expect("fits");
    let of = |fit: &Value| (fit["files"].as_u64(), fit["net"].clone(), fit["parameters"].as_u64());
    let found: Vec<_> = fits.iter().map(of).collect();
    // {2}: 4 * 2 * (1 + 1 + 2) + 2 + 1; {3, 2}: 4 * 3 * (1 + 1 + 3) + 4 * 2 * (3 + 1 + 2) + 2 + 1.
    let expected =
        |files: u64| [(Some(files), json!([2]), Some(35)), (Some(files), json!([3, 2]), Some(111))];
    assert_eq!(found, [expected(1), expected(2)].concat());
    assert!(fits.iter().all(|fit| fit["error"].as_f64().is_some_and(|error| error > 0.0)), "{study}");
    assert_eq!(study["request"]["model"], 1, "the active one, resolved");
    assert!(job["stage"].as_str().is_some_and(|stage| stage.starts_with("least error")), "{job}");
    let (_, again) = studied(&app, &request).await;
    assert_eq!(again["linear_study"], study["linear_study"]);

    for (change, pointer) in [
        (json!({"files": [2, 1]}), "/files"),
        (json!({"end_hz": 50}), "/end_hz"),
        (json!({"nets": [[0]]}), "/nets/0"),
        (json!({"duration_s": 1}), "/duration_s"),
        (json!({"fit": {"kind": "lstm"}}), "/fit"),
    ] {
        let mut bad = request.clone();
        bad.as_object_mut().expect("an object").extend(change.as_object().expect("an object").clone());
        let problem = app.post_json(STUDIES, &bad).await.problem(422, "study.invalid");
        assert_eq!(problem["errors"][0]["pointer"], pointer, "{problem}");
    }
    let mut bad = request.clone();
    bad["model"] = json!(9);
    app.post_json(STUDIES, &bad).await.problem(404, "model.not_found");
    let empty = TestApp::start();
    empty.rig(&bench()).await;
    empty.post_json(STUDIES, &request).await.problem(409, "model.none_active");
}
