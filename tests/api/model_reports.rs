//! Reports of model versions over HTTP.

use serde_json::{Value, json};

use crate::support::{TestApp, bench, noise, noise_csv};

/// `y = 2 u + 0.5 sin t`, with a tone that no model of `u` knows.
fn with_a_tone(n: usize, seed: u64) -> String {
    let rows = noise(n, seed).into_iter().enumerate();
    let rows = rows.map(|(t, u)| format!("{u},{}\n", 2.0 * u + 0.5 * (t as f64 * 0.5).sin()));
    std::iter::once("u,y\n".to_owned()).chain(rows).collect()
}

/// Fits the bench, and returns the path of the version.
async fn fitted(app: &TestApp, request: &Value) -> String {
    let job = app.post_json("/v1/rigs/bench/fits", request).await.expect(202).json();
    let job = app.finished(job["id"].as_str().expect("an id")).await;
    job["result"]["href"].as_str().unwrap_or_else(|| panic!("a model: {job}")).to_owned()
}

#[tokio::test]
async fn a_report_shows_what_the_model_leaves_and_which_data_served_for_what() {
    let app = TestApp::start();
    app.rig(&bench()).await;
    app.run("kind=noise&name=one", &with_a_tone(6000, 1)).await;
    let left_out = app.run("kind=noise&name=two", &with_a_tone(3000, 2)).await;
    let lstm = json!({"blocks": [4], "window_len": 32, "hop": 16, "epochs": 3, "seeds": [5, 6]});
    let request = json!({"kind": "hybrid2", "frf": {"segment_len": 256}, "lstm": lstm});
    let href = fitted(&app, &request).await;
    let report = app.get(&format!("{href}/report")).await.expect(200).json();
    assert_eq!((&report["reasons"], &report["rule"]), (&json!({}), &json!("left_out_runs")));

    let training = &report["training"];
    assert_eq!(
        (&training["chosen_by"], &training["refitted"]),
        (&json!("lowest_stopping_mse"), &json!(true))
    );
    let seeds = training["seeds"].as_array().expect("seeds");
    let kept: Vec<&Value> = seeds.iter().filter(|seed| seed["chosen"] == true).collect();
    assert_eq!((seeds.len(), kept.len(), &kept[0]["seed"]), (2, 1, &training["best_seed"]));
    assert_eq!(seeds[0]["epochs"].as_array().map(Vec::len), seeds[0]["stopping"].as_array().map(Vec::len));

    let error = report["errors"][0]["rms"].as_f64().expect("an error");
    assert!((0.05..0.5).contains(&error), "the tone is left: {error}");
    let residual = &report["residual"];
    assert_eq!((&residual["of"], &residual["duration_s"]), (&json!("comparison"), &json!(30.0)));
    let spectrum = &residual["spectra"]["channels"]["y"]["residual"];
    let spectrum: Vec<f64> = spectrum.as_array().expect("lines").iter().filter_map(Value::as_f64).collect();
    let largest = (0..spectrum.len()).max_by(|a, b| spectrum[*a].total_cmp(&spectrum[*b])).expect("a line");
    let hz = residual["spectra"]["freq_hz"][largest].as_f64().expect("a frequency");
    assert!((hz - 50.0 / std::f64::consts::TAU).abs() < 0.2, "the tone is at {hz} Hz");
    let lags = &residual["autocorrelation"];
    let (first, bound) = (lags["channels"]["y"][0].as_f64(), lags["bound"].as_f64());
    assert!(first > bound.map(|bound| 10.0 * bound), "{first:?} beyond {bound:?}");

    let coverage = &report["coverage"][0];
    assert_eq!((&coverage["channel"], coverage["shares"].as_array().map(Vec::len)), (&json!("u"), Some(10)));
    let rms = coverage["rms"].as_f64().expect("an RMS");
    assert!((rms - 1.0 / 3.0_f64.sqrt()).abs() < 0.01, "{rms}");
    let data = report["data"].as_array().expect("data");
    let compared: Vec<&Value> = data.iter().filter(|used| used["use"] == "comparison").collect();
    assert_eq!((&compared[0]["run"], &compared[0]["name"]), (&left_out["id"], &json!("two")));
    assert_eq!(compared[0]["rms"]["y"].as_f64(), Some(error));
    assert!(report["frf"]["href"].as_str().is_some_and(|path| path == format!("{href}/frf")));

    let page =
        app.call("GET", &format!("{href}/report")).header("accept", "text/html").send().await.expect(200);
    assert!(page.header("content-security-policy").contains("default-src 'none'"));
    for part in ["Loss curves", "Autocorrelation of the residual of y", "<svg", "comparison"] {
        assert!(page.text().contains(part), "{part} in {}", page.text());
    }
    assert!(!page.text().contains("<script") && !page.text().contains("NaN"));
    the_report_is_a_table(&app, &href, &report).await;
    every_plot_is_a_file(&app, href.strip_prefix("/v1").expect("a page")).await;
    app.call("GET", &format!("{href}/report"))
        .header("accept", "image/png")
        .send()
        .await
        .problem(406, "accept.not_acceptable");
}

/// The same figures as in JSON, one a row.
async fn the_report_is_a_table(app: &TestApp, href: &str, report: &Value) {
    let table =
        app.call("GET", &format!("{href}/report")).header("accept", "text/csv").send().await.expect(200);
    let rows: Vec<Vec<&str>> = table.text().lines().map(|row| row.split(',').collect()).collect();
    assert_eq!(rows[0], ["part", "name", "quantity", "at", "value"]);
    let count = |part: &str| rows.iter().filter(|row| row[0] == part).count();
    let len = |value: &Value| value.as_array().map_or(0, Vec::len);
    let epochs: usize =
        report["training"]["seeds"].as_array().expect("seeds").iter().map(|s| len(&s["epochs"])).sum();
    assert_eq!((count("errors"), count("training")), (1, 2 * epochs));
    assert_eq!(count("spectra"), 2 * len(&report["residual"]["spectra"]["freq_hz"]));
    assert_eq!(count("autocorrelation"), len(&report["residual"]["autocorrelation"]["channels"]["y"]));
    let error = rows.iter().find(|row| row[0] == "errors").expect("a row");
    assert_eq!(error[..4], ["errors", "y", "rms", ""]);
    assert_eq!(error[4].parse::<f64>().ok(), report["errors"][0]["rms"].as_f64());
    assert!(rows.iter().any(|row| row[..4] == ["coverage", "u", "share", "10"]), "{rows:?}");
}

/// Each plot of the page as a picture and as numbers.
async fn every_plot_is_a_file(app: &TestApp, path: &str) {
    let page =
        app.call("GET", &format!("{path}/report")).header("accept", "text/html").send().await.expect(200);
    for figure in ["loss", "residual-0", "autocorrelation-0"] {
        let at = format!("{path}/report?figure={figure}");
        let linked = at.replace('&', "&amp;");
        assert!(page.text().contains(&linked), "{figure} is saved from the page");
        let svg = app.get(&format!("{at}&as=svg")).await.expect(200);
        assert!(svg.text().ends_with("</svg>\n") && !svg.text().contains("var("), "{figure}");
        let csv = app.get(&format!("{at}&as=csv")).await.expect(200);
        let columns = csv.text().lines().next().map_or(0, |head| head.split(',').count());
        assert!(columns >= 2 && csv.text().lines().count() > 3, "{figure}: {}", csv.text());
    }
    app.get(&format!("{path}/report?figure=residual-9")).await.expect(422);
}

#[tokio::test]
async fn a_report_says_why_parts_of_it_are_not_there() {
    let app = TestApp::start();
    app.bench_with_model().await;
    let report = app.get("/v1/rigs/bench/models/1/report").await.expect(200).json();
    for part in ["training", "errors", "residual", "coverage", "rule"] {
        assert!(report[part].is_null() && report["reasons"][part] == "imported", "{part}: {report}");
    }
    assert_eq!((&report["data"], &report["origin"]), (&json!([]), &json!("import")));
    assert!(report["frf"]["reason"].is_string(), "weights made elsewhere carry no coherence: {report}");

    app.run("kind=noise", &noise_csv(3000, 1)).await;
    let href = fitted(&app, &json!({"kind": "frf", "frf": {"segment_len": 256}})).await;
    let report = app.get(&format!("{href}/report")).await.expect(200).json();
    assert_eq!(report["reasons"], json!({"training": "no_network"}));
    app.get("/v1/rigs/bench/models/7/report").await.problem(404, "model.not_found");
    app.get("/v1/rigs/nobody/models/1/report").await.problem(404, "rig.not_found");
}
