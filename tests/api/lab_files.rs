//! Files as laboratories export them: other names, units and types, columns to leave out, dry runs.

use serde_json::{Value, json};

use crate::support::{TestApp, bench, f8, noise_csv, npy};

const RUNS: &str = "/v1/rigs/bench/runs";

async fn runs(app: &TestApp) -> usize {
    app.get(RUNS).await.expect(200).json()["items"].as_array().expect("items").len()
}

#[tokio::test]
async fn a_german_export_is_understood_and_then_stored() {
    let app = TestApp::start();
    app.rig(&bench()).await;
    let rows = ["0,00;1.250,5;-2,25;21,5", "0,01;-500,25;3;21,5", "0,02;0;0,3;21,25"].join("\r\n");
    let head = "Pr\u{fc}fstand 3;;;\r\nZeit [s];U [N];y (mm);\u{d6}ltemperatur [\u{b0}C]";
    // The first 256 characters of Unicode are those of Windows-1252, but for 32 that the text does not have.
    let windows_1252: Vec<u8> = format!("{head}\r\n{rows}\r\n").chars().map(|c| c as u8).collect();
    let excel = "application/vnd.ms-excel";

    let refused = app.post_file(RUNS, excel, windows_1252.clone()).await.problem(422, "run.unknown_channel");
    assert_eq!(refused["errors"][0]["channel"], "\u{d6}ltemperatur [\u{b0}C]");

    for ignore in ["*", "%C3%96ltemperatur"] {
        let path = format!("{RUNS}?ignore={ignore}&dry_run=true");
        let understood = app.post_file(&path, excel, windows_1252.clone()).await.expect(200).json();
        assert_eq!((&understood["format"], &understood["samples"]), (&json!("csv"), &json!(3)));
        let column = |name: &str, unit: &str, channel: Value, factor: f64| json!({"name": name, "unit": unit, "channel": channel, "factor": factor});
        assert_eq!(
            understood["columns"],
            json!([
                column("U [N]", "N", json!("u"), 1e-3),
                column("y (mm)", "mm", json!("y"), 1.0),
                column("\u{d6}ltemperatur [\u{b0}C]", "\u{b0}C", Value::Null, 1.0),
            ])
        );
        assert_eq!(runs(&app).await, 0, "a dry run stores nothing");
    }

    let stored = app.post_file(&format!("{RUNS}?ignore=*"), excel, windows_1252).await.expect(201);
    let run = stored.json();
    assert_eq!(run["units"], json!(["kN", "mm"]));
    let warnings: Vec<&str> =
        run["quality"]["warnings"].as_array().expect("warnings").iter().filter_map(Value::as_str).collect();
    assert_eq!(warnings[0], "u: converted from N to kN, times 0.001.");
    assert!(warnings[1].contains("left out"), "{warnings:?}");
    let data = app.get(&format!("{}/data", stored.header("location"))).await.expect(200).json();
    assert_eq!(data["channels"]["y"], json!([-2.25, 3.0, 0.3]));
    let u: Vec<f64> = serde_json::from_value(data["channels"]["u"].clone()).expect("numbers");
    for (found, expected) in u.iter().zip([1.2505, -0.50025, 0.0]) {
        assert!((found - expected).abs() < 1e-15, "{found}");
    }
}

#[tokio::test]
async fn a_dry_run_says_what_the_upload_would_do_beside_storing_the_run() {
    let app = TestApp::start();
    let mut rig = bench();
    rig["fit_policy"] =
        json!({"kinds": ["noise"], "min_total_s": 60.0, "fits": [{"kind": "frf"}, {"kind": "frf"}]});
    app.rig(&rig).await;
    let path = format!("{RUNS}?kind=noise");
    let dry = async |file: &str| {
        app.post_file(&format!("{path}&dry_run=true"), "text/csv", file).await.expect(200).json()
    };
    let (half, other) = (noise_csv(3000, 1), noise_csv(3000, 2));
    let first = dry(&half).await;
    assert_eq!(
        (&first["duplicate_of"], &first["fits"], &first["policy"]),
        (&Value::Null, &json!([]), &json!("30.0 of 60.0 s of noise"))
    );
    let run = app.post_file(&path, "text/csv", half.as_str()).await.expect(201).json();
    assert_eq!((&run["policy"], &run["jobs"]), (&first["policy"], &json!([])));
    let again = dry(&half).await;
    assert_eq!(
        (&again["duplicate_of"], &again["fits"], &again["jobs"]),
        (&run["id"], &json!([]), &json!([]))
    );
    let second = dry(&other).await;
    assert_eq!((&second["policy"], &second["jobs"]), (&json!("1 fit to be queued"), &json!([])));
    assert_eq!(second["fits"][0]["kind"], "frf");
    assert_eq!(runs(&app).await, 1, "a dry run stores nothing");
    assert_eq!(app.get("/v1/jobs").await.expect(200).json()["items"], json!([]), "and queues nothing");
    let stored = app.post_file(&path, "text/csv", other).await.expect(201).json();
    assert_eq!(
        (&stored["policy"], stored["jobs"].as_array().map(Vec::len)),
        (&json!("1 fit queued"), Some(1))
    );
    app.finished(stored["jobs"][0].as_str().expect("an id")).await;
}

#[tokio::test]
async fn the_first_bytes_tell_what_the_type_does_not() {
    let app = TestApp::start();
    app.rig(&bench()).await;
    let array = npy("<f8", false, "(2, 2)", &f8(&[0.0, 1.0, 2.0, 3.0]));
    let json_file = json!({"sample_rate_hz": 100.0, "channels": {"u": [1.0, 2.0]}}).to_string();
    for (file, format) in
        [(array, "npy"), (json_file.into_bytes(), "json"), (b"u,y\n1,2\n3,4\n".to_vec(), "csv")]
    {
        for media_type in ["application/octet-stream", "text/plain", "application/x-www-form-urlencoded"] {
            let path = format!("{RUNS}?dry_run");
            let understood = app.post_file(&path, media_type, file.clone()).await.expect(200).json();
            assert_eq!(understood["format"], format, "{media_type}");
        }
    }
    for (file, status, code) in [
        (&b"PK\x03\x04"[..], 415, "content_type.unsupported"),
        (b"\xD0\xCF\x11\xE0", 415, "content_type.unsupported"),
        (b"MATLAB 5.0 MAT-file", 400, "mat.invalid"),
        (b"MATLAB 7.3 MAT-file", 400, "hdf5.invalid"),
        (b"\x89HDF\r\n\x1a\n", 400, "hdf5.invalid"),
    ] {
        app.post_file(RUNS, "application/octet-stream", file).await.problem(status, code);
    }
}

#[tokio::test]
async fn units_of_another_quantity_and_columns_that_say_too_much_are_refused() {
    let app = TestApp::start();
    app.rig(&bench()).await;
    for (file, code, channel) in [
        ("u,y\nkN,V\n1,2\n", "run.invalid", "y"),
        ("u,U [N]\n1,2\n", "run.invalid", "U [N]"),
        ("u,y\nMN,mm\n1e306,2\n", "run.non_finite", "u"),
    ] {
        let refused = app.post_file(RUNS, "text/csv", file).await.problem(422, code);
        assert_eq!(refused["errors"][0]["channel"], channel, "{file}");
    }
    let nothing = app.post_file(&format!("{RUNS}?ignore=u,y"), "text/csv", "u,y\n1,2\n").await;
    nothing.problem(422, "run.no_channels");
    assert_eq!(runs(&app).await, 0);
}

#[tokio::test]
async fn times_rounded_by_a_program_are_of_the_rigs_rate() {
    let app = TestApp::start();
    app.rig(&bench()).await;
    let rows = |step: f64| -> String {
        (0..500).map(|i| format!("{:.1},{}\n", f64::from(i) * step, i % 7)).collect()
    };
    let file = format!("time,u\n{}", rows(0.01));
    let run = app.post_file(RUNS, "text/csv", file).await.expect(201).json();
    assert_eq!(run["samples"], 500);
    assert_eq!(
        run["quality"]["warnings"][0],
        "The times in the file are rounded: they give its sample rate within 2 %."
    );
    let slower = format!("time,u\n{}", rows(0.02));
    app.post_file(RUNS, "text/csv", slower).await.problem(422, "run.sample_rate");
}

#[tokio::test]
async fn columns_are_found_by_the_aliases_of_the_rigs_channels() {
    let app = TestApp::start();
    let mut rig = bench();
    rig["channels"][0]["aliases"] = json!(["Kanal 1", "F_x"]);
    app.rig(&rig).await;
    for header in ["Kanal 1,y", "F_x [kN],y", "f_X,Y", "u,y"] {
        let file = format!("{header}\n1,2\n3,4\n");
        let run = app.post_file(RUNS, "text/csv", file).await.expect(201).json();
        assert_eq!(run["channels"], json!(["u", "y"]), "{header}");
    }
    app.post_file(RUNS, "text/csv", "u,F_x\n1,2\n3,4\n").await.problem(422, "run.invalid");
    // They may change when there are runs.
    let path = "/v1/rigs/bench";
    let mut channels = app.get(path).await.expect(200).json()["channels"].clone();
    assert_eq!(channels[0]["aliases"], json!(["Kanal 1", "F_x"]));
    channels[0].as_object_mut().expect("a channel").remove("aliases");
    channels[1]["aliases"] = json!(["F_x"]);
    let patch = |channels: &serde_json::Value| {
        app.call("PATCH", path).header("if-match", "*").json(&json!({"channels": channels}))
    };
    patch(&channels).send().await.expect(200);
    let run = app.post_file(RUNS, "text/csv", "F_x\n1\n3\n").await.expect(201).json();
    assert_eq!(run["channels"], json!(["y"]));
    for (aliases, pointer) in [
        (json!(["u"]), "/channels/1/aliases/0"),
        (json!(["a", "a"]), "/channels/1/aliases/1"),
        (json!(["a", " b"]), "/channels/1/aliases/1"),
        (json!([""]), "/channels/1/aliases/0"),
        (json!(vec!["a"; 33]), "/channels/1/aliases"),
    ] {
        channels[1]["aliases"] = aliases;
        let problem = patch(&channels).send().await.problem(422, "rig.invalid");
        assert_eq!(problem["errors"][0]["pointer"], pointer);
    }
}

/// A matrix without names that has one column more than the rig has channels.
#[tokio::test]
async fn a_first_column_of_even_steps_is_the_time_of_a_matrix_without_header() {
    let app = TestApp::start();
    app.rig(&bench()).await;
    let matrix = |first: &dyn Fn(u32) -> String| -> String {
        (0..40).map(|i| format!("{},{},{}\n", first(i), i % 7, 3 * (i % 5))).collect()
    };
    let seconds = |i: u32| format!("{:.2}", 5.0 + 0.01 * f64::from(i));
    let path = format!("{RUNS}?dry_run=true");
    for (first, unit) in [
        (&seconds as &dyn Fn(u32) -> String, "s"),
        (&|i| (10 * i).to_string(), "ms"),
        (&|i| (i + 1).to_string(), "samples"),
    ] {
        let understood = app.post_file(&path, "text/csv", matrix(first)).await.expect(200).json();
        assert_eq!(understood["sample_rate_hz"], 100.0, "{understood}");
        let column = |name: &str, unit: Value, channel: Value| json!({"name": name, "unit": unit, "channel": channel, "factor": 1.0});
        assert_eq!(
            understood["columns"],
            json!([
                column("time", json!(unit), Value::Null),
                column("u", Value::Null, json!("u")),
                column("y", Value::Null, json!("y")),
            ])
        );
        let warnings = understood["quality"]["warnings"].to_string();
        let words = if unit == "samples" { "the number of the sample" } else { "the time in" };
        assert!(warnings.contains(words) && !warnings.contains("left out"), "{warnings}");
    }
    let stored = app.post_file(RUNS, "text/csv", matrix(&seconds)).await.expect(201);
    let data = app.get(&format!("{}/data", stored.header("location"))).await.expect(200).json();
    assert_eq!((&data["channels"]["u"][8], &data["channels"]["y"][8]), (&json!(1.0), &json!(9.0)));
    // As an array, and with the names of the query.
    let array: Vec<f64> = (0..40).flat_map(|i| [0.01 * f64::from(i), 1.5, f64::from(i * i)]).collect();
    let array = npy("<f8", false, "(40, 3)", &f8(&array));
    let named = format!("{path}&channels=y,u");
    let understood = app.post_file(&named, "application/x-npy", array).await.expect(200).json();
    assert_eq!(
        (&understood["columns"][0]["name"], &understood["columns"][1]["channel"]),
        (&json!("time"), &json!("y"))
    );
    // Times of another rate are told, and a column that does not rise evenly is no time.
    let slow = |i: u32| format!("{:.2}", 0.02 * f64::from(i));
    app.post_file(&path, "text/csv", matrix(&slow)).await.problem(422, "run.sample_rate");
    let resampled = app.post_file(&format!("{path}&resample=true"), "text/csv", matrix(&slow)).await;
    assert_eq!(resampled.expect(200).json()["sample_rate_hz"], 50.0);
    let uneven = |i: u32| format!("{:.2}", 0.01 * f64::from(i + i * i / 20));
    for first in [&uneven as &dyn Fn(u32) -> String, &|_| "1".to_owned(), &|i| (40 - i).to_string()] {
        app.post_file(&path, "text/csv", matrix(first)).await.problem(422, "run.channel_count");
    }
}
