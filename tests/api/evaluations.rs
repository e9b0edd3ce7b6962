//! Evaluations over HTTP.

use serde_json::{Value, json};

use crate::support::{SAFETENSORS, TestApp, bench, gain_weights, noise, noise_csv, triple};

const EVALUATIONS: &str = "/v1/rigs/bench/evaluations";

/// The report of an evaluation, with its path.
async fn evaluated(app: &TestApp, rig: &str, request: &Value) -> (Value, String) {
    let job = app.post_json(&format!("/v1/rigs/{rig}/evaluations"), request).await.expect(202).json();
    assert_eq!(job["kind"], "evaluation");
    let job = app.finished(job["id"].as_str().expect("an id")).await;
    let href = job["result"]["href"].as_str().unwrap_or_else(|| panic!("a report: {job}")).to_owned();
    let report = app.get(&href).await.expect(200).json();
    assert_eq!((&report["job"], &job["result"]["kind"]), (&job["id"], &json!("evaluation")));
    (report, href)
}

#[track_caller]
fn near(value: &Value, expected: f64) {
    let found = value.as_f64().unwrap_or_else(|| panic!("a number: {value}"));
    assert!((found - expected).abs() < 1e-6, "{found} for {expected}");
}

/// The row of a class and version.
#[track_caller]
fn row<'a>(report: &'a Value, class: &str, model: u64) -> &'a Value {
    let rows = report["table"].as_array().expect("a table");
    let found = rows.iter().find(|row| row["class"] == class && row["model"] == model);
    found.unwrap_or_else(|| panic!("a row of {class} and {model}: {report}"))
}

/// `y = 2 u` on every run; a model that knows it, and one whose gain is a tenth too large.
async fn bench_with_two_models(app: &TestApp) {
    app.bench_with_model().await;
    let other = gain_weights(&["u"], &["y"], 2.2);
    app.post_file("/v1/rigs/bench/models", SAFETENSORS, other).await.expect(201);
    app.run("kind=noise&split=test&name=n1", &noise_csv(6000, 1)).await;
    app.run("kind=service&split=test&tag=sl&name=load", &noise_csv(5000, 2)).await;
    let drive_only: String =
        std::iter::once("u\n".to_owned()).chain(noise(500, 3).iter().map(|u| format!("{u}\n"))).collect();
    app.run("kind=service&split=test&tag=sl&name=drive", &drive_only).await;
}

#[tokio::test]
async fn the_table_has_each_model_on_each_class_with_its_difference_to_the_baseline() {
    let app = TestApp::start();
    bench_with_two_models(&app).await;
    let request = json!({"models": [2, "active"], "baseline": 1, "classes": ["noise", "sl", "service"]});
    let (report, href) = evaluated(&app, "bench", &request).await;
    assert_eq!(report["request"]["models"], json!([2, 1]));
    assert_eq!(report["table"].as_array().map(Vec::len), Some(6), "three classes of two models");
    for class in ["noise", "sl", "service"] {
        let (good, high) = (row(&report, class, 1), row(&report, class, 2));
        near(&good["channels"]["y"]["rms"], 0.0);
        near(&good["channels"]["y"]["damage_ratio"], 1.0);
        near(&high["channels"]["y"]["rms"], 0.1);
        near(&high["groups"]["displacement"]["rms"], 0.1);
        near(&high["groups"]["displacement"]["psd_rms"], 0.21);
        near(&high["channels"]["y"]["damage_ratio"], 1.1_f64.powi(5));
        assert_eq!(high["groups"]["displacement"]["reasons"]["multi_rain"], "not_a_vector");
        assert_eq!((&high["runs"], &high["inside"]), (&json!(1), &json!(1.0)));
        assert_eq!(high["worst_channel"]["channel"], "y");

        near(&high["difference"]["channels"]["y"]["rms"], 0.1);
        near(&high["difference"]["groups"]["displacement"]["damage_ratio"], 1.1_f64.powi(5));
        assert!(good.get("difference").is_none(), "{good}");
        let spectra = &high["spectra"]["channels"]["y"];
        let lines = high["spectra"]["freq_hz"].as_array().expect("lines").len();
        assert!((100..300).contains(&lines), "{lines} lines");
        let ratio = spectra["predicted"][20].as_f64().expect("a density")
            / spectra["target"][20].as_f64().expect("a density");
        assert!((ratio - 1.21).abs() < 0.001, "{ratio}");
    }
    // The run without a response is in the list, and not compared.
    assert_eq!(report["runs"].as_array().map(Vec::len), Some(3));
    assert_eq!(report["omitted"].as_array().map(Vec::len), Some(2));
    assert_eq!(
        (&report["omitted"][0]["reason"], &report["omitted"][0]["channels"]),
        (&json!("missing_channels"), &json!(["y"]))
    );
    let warnings = report["warnings"].to_string();
    assert!(warnings.contains("Model 2 was imported"), "{warnings}");

    let table = app.call("GET", &href).header("accept", "text/csv").send().await.expect(200);
    let mut table = csv::Reader::from_reader(table.bytes.as_slice());
    let rows: Vec<std::collections::HashMap<String, String>> =
        table.deserialize().collect::<Result<_, _>>().expect("a table");
    assert_eq!(rows.len(), 12, "a group and a channel for each row");
    let high = rows.iter().find(|r| r["class"] == "sl" && r["model"] == "2" && r["channel"] == "y");
    near(&json!(high.expect("a row")["rms"].parse::<f64>().expect("a number")), 0.1);
    let page = app.call("GET", &href).header("accept", "text/html").send().await.expect(200);
    assert!(page.header("content-security-policy").contains("default-src 'none'"));
    let page = page.text();
    for part in ["Runs: sl", "version 2 (frf)", "<svg", "Damage ratios on noise", "Not compared"] {
        assert!(page.contains(part), "{part} in {page}");
    }
    assert!(!page.contains("<script") && !page.contains("NaN") && !page.contains("figure="));
    // The page of the service has its plots as files.
    let at = href.strip_prefix("/v1").expect("a path of the API");
    let framed = app.get(at).await.expect(200);
    for (figure, head) in
        [("damage-0", "name,ratio,compared with\r\n"), ("spectrum-0-0", "Frequency in Hz,measured,")]
    {
        assert!(framed.text().contains(&format!("figure={figure}&amp;as=csv")), "{figure} can be saved");
        let numbers = app.get(&format!("{at}?figure={figure}&as=csv")).await.expect(200);
        assert!(numbers.text().starts_with(head), "{}", numbers.text());
        let picture = app.get(&format!("{at}?figure={figure}&as=svg")).await.expect(200);
        assert!(picture.text().contains("xmlns=") && !picture.text().contains("var("), "{}", picture.text());
    }
    app.get(&format!("{at}?figure=none")).await.problem(422, "query.invalid");

    let listed = app.get(EVALUATIONS).await.expect(200).json();
    assert_eq!(listed["items"][0]["id"], report["id"]);
    assert_eq!(listed["items"][0]["classes"], json!(["noise", "sl", "service"]));
}

#[tokio::test]
async fn runs_that_a_model_was_fitted_on_are_marked_and_left_out_unless_asked_for() {
    let app = TestApp::start();
    app.rig(&bench()).await;
    app.run("kind=noise", &noise_csv(6000, 1)).await;
    app.run("kind=service&split=test", &noise_csv(6000, 2)).await;
    let fit = json!({"kind": "frf", "frf": {"segment_len": 256}});
    let job = app.post_json("/v1/rigs/bench/fits", &fit).await.expect(202).json();
    app.finished(job["id"].as_str().expect("an id")).await;
    let runs: Vec<Value> = app.get("/v1/rigs/bench/runs").await.expect(200).json()["items"]
        .as_array()
        .expect("runs")
        .iter()
        .map(|run| run["id"].clone())
        .collect();
    let mut request = json!({"models": [1], "runs": runs});
    let (report, _) = evaluated(&app, "bench", &request).await;
    let trained = row(&report, "noise", 1);
    assert_eq!(
        (&trained["runs"], &trained["left_out"], &trained["inside"]),
        (&json!(0), &json!(1), &Value::Null)
    );
    assert_eq!(trained["channels"]["y"]["reasons"]["rms"], "no_run");
    assert_eq!((&trained["spectra"], &trained["worst_span"]), (&Value::Null, &Value::Null));
    assert_eq!(row(&report, "service", 1)["runs"], 1);
    let marked: Vec<&Value> =
        report["results"].as_array().expect("results").iter().filter(|r| r["counted"] == false).collect();
    assert_eq!(marked.len(), 1);
    assert_eq!(marked[0]["seen"], "training");
    assert!(marked[0]["channels"]["y"]["rms"].is_number(), "its figures are there: {report}");
    assert!(report["warnings"].to_string().contains("include_fitted"), "{report}");

    request["include_fitted"] = json!(true);
    let (report, _) = evaluated(&app, "bench", &request).await;
    let counted = row(&report, "noise", 1);
    assert_eq!((&counted["runs"], &counted["left_out"]), (&json!(1), &json!(0)));
    assert!(counted["channels"]["y"]["rms"].is_number(), "{counted}");
}

#[tokio::test]
async fn a_group_of_three_has_multi_rain_and_a_still_channel_has_reasons() {
    let app = TestApp::start();
    app.rig(&triple()).await;
    app.activate("triple", gain_weights(&["u"], &["fx", "fy", "fz"], 1.1)).await;
    let rows = |still: bool| -> String {
        let row = |u: &f64| format!("{u},{u},{u},{}\n", if still { 0.0 } else { *u });
        std::iter::once("u,fx,fy,fz\n".to_owned()).chain(noise(5000, 4).iter().map(row)).collect()
    };
    for (tag, still) in [("whole", false), ("still", true)] {
        let path = format!("/v1/rigs/triple/runs?kind=service&split=test&tag={tag}");
        app.post_file(&path, "text/csv", rows(still)).await.expect(201);
    }
    let request =
        json!({"classes": ["whole", "still"], "damage": {"slope": 3, "directions": 20}, "span_s": 2});
    let (report, _) = evaluated(&app, "triple", &request).await;
    let whole = row(&report, "whole", 1);
    near(&whole["groups"]["force"]["multi_rain"], 1.1_f64.powi(3));
    near(&whole["groups"]["force"]["damage_ratio"], 1.1_f64.powi(3));
    let span = &whole["worst_span"];
    near(&json!(span["to_s"].as_f64().expect("s") - span["from_s"].as_f64().expect("s")), 2.0);
    let still = row(&report, "still", 1);
    assert_eq!(still["channels"]["fz"]["damage_ratio"], Value::Null);
    assert_eq!(still["channels"]["fz"]["reasons"]["damage_ratio"], "target_damage_zero");
    assert_eq!(still["channels"]["fz"]["reasons"]["rms"], "measured_still");
    assert!(still["groups"]["force"]["multi_rain"].is_number(), "{still}");
}

/// A virtual sensor is compared on the runs that have its inputs and outputs, beside a model that needs others.
#[tokio::test]
async fn a_virtual_sensor_is_evaluated_beside_a_forward_model() {
    let app = TestApp::start();
    let channel = |name: &str, role: &str, quantity: &str| json!({"name": name, "unit": "kN", "role": role, "quantity": quantity});
    let channels = json!([
        channel("u", "drive", "force"),
        channel("y", "response", "displacement"),
        channel("z", "response", "force")
    ]);
    app.rig(&json!({"id": "bench", "name": "Bench", "sample_rate_hz": 100, "channels": channels})).await;
    for (inputs, outputs, gain) in [(["u"], &["y", "z"][..], 1.0), (["y"], &["z"][..], 1.3)] {
        let weights = gain_weights(&inputs, outputs, gain);
        app.post_file("/v1/rigs/bench/models", SAFETENSORS, weights).await.expect(201);
    }
    let rows = |head: &str, n: usize| -> String {
        let row = |u: &f64| format!("{}\n", vec![u.to_string(); n].join(","));
        std::iter::once(format!("{head}\n")).chain(noise(3000, n as u64).iter().map(row)).collect()
    };
    app.run("kind=service&split=test", &rows("u,y,z", 3)).await;
    app.run("kind=service&split=test", &rows("y,z", 2)).await;
    let (report, _) = evaluated(&app, "bench", &json!({"models": [1, 2]})).await;
    let (forward, sensor) = (row(&report, "service", 1), row(&report, "service", 2));
    assert_eq!((&forward["runs"], &sensor["runs"]), (&json!(1), &json!(2)));
    near(&forward["channels"]["z"]["rms"], 0.0);
    near(&sensor["channels"]["z"]["rms"], 0.3);
    assert!(sensor["channels"].get("y").is_none(), "{sensor}");
    assert_eq!(report["groups"][1], json!({"name": "force", "channels": ["z"]}));
    assert_eq!(report["omitted"][0]["channels"], json!(["u"]));
}

#[tokio::test]
async fn what_does_not_suit_the_rig_is_refused_with_its_place() {
    let app = TestApp::start();
    bench_with_two_models(&app).await;
    let none = "0197f1a0-0000-7000-8000-000000000000";
    let run = app.get("/v1/rigs/bench/runs").await.expect(200).json()["items"][0]["id"].clone();
    for (request, pointer) in [
        (json!({"models": []}), "/models"),
        (json!({"models": vec![1; 33]}), "/models"),
        (json!({"runs": []}), "/runs"),
        (json!({"runs": [none]}), "/runs/0"),
        (json!({"runs": [run, run]}), "/runs/1"),
        (json!({"runs": {"kinds": ["music"]}}), "/runs/kinds/0"),
        (json!({"runs": {"split": "rest"}}), "/runs/split"),
        (json!({"classes": []}), "/classes"),
        (json!({"classes": ["sl", "sl"]}), "/classes/1"),
        (json!({"span_s": 0}), "/span_s"),
        (json!({"damage": {"slope": 0}}), "/damage/slope"),
    ] {
        let problem = app.post_json(EVALUATIONS, &request).await.problem(422, "evaluation.invalid");
        assert_eq!(problem["errors"][0]["pointer"], pointer, "{request}: {problem}");
    }
    let refused = async |request: Value, status: u16, code: &str, pointer: &str| {
        let problem = app.post_json(EVALUATIONS, &request).await.problem(status, code);
        assert_eq!(problem["errors"][0]["pointer"], pointer, "{request}: {problem}");
    };
    refused(json!({"classes": ["sl", "n2"]}), 422, "evaluation.empty_class", "/classes/1").await;
    refused(json!({"runs": {"tags": ["n2"]}}), 409, "evaluation.no_runs", "/runs").await;
    refused(json!({"models": [1, 9]}), 404, "model.not_found", "/models/1").await;
    refused(json!({"models": [1], "baseline": 9}), 404, "model.not_found", "/baseline").await;
    let drive = app.get("/v1/rigs/bench/runs?limit=100").await.expect(200).json();
    let drive =
        drive["items"].as_array().expect("runs").iter().find(|r| r["name"] == "drive").expect("a run");
    let request = json!({"models": [1], "runs": [drive["id"]]});
    refused(request, 422, "evaluation.no_common_channels", "/models/0").await;
    app.get(&format!("{EVALUATIONS}/{none}")).await.problem(404, "evaluation.not_found");
    app.post_json("/v1/rigs/none/evaluations", &json!({})).await.problem(404, "rig.not_found");
    // Another rig's versions are none of this rig.
    app.rig(&triple()).await;
    app.post_json("/v1/rigs/triple/evaluations", &json!({"models": [1]}))
        .await
        .problem(404, "model.not_found");
    app.post_json("/v1/rigs/triple/evaluations", &json!({})).await.problem(409, "model.none_active");
}
