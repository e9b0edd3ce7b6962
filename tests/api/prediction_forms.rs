//! Forms of predictions beyond one signal: batches of drives, figures beside a file, other sample rates.

use serde_json::{Value, json};

use crate::support::{Reply, TestApp, bench, f4, f8, gain_weights, noise_csv, npy, read_f4, triple, wave};

const PREDICT: &str = "/v1/rigs/bench/predict";
const NPY: &str = "application/x-npy";
const PARTS: &str = "multipart/mixed";

/// The parts of an answer, each with its headers.
fn parts(reply: &Reply) -> Vec<(String, Vec<u8>)> {
    let media_type = reply.header("content-type");
    let boundary = media_type.strip_prefix("multipart/mixed; boundary=").expect("a boundary");
    let find = |bytes: &[u8], text: &str| bytes.windows(text.len()).position(|w| w == text.as_bytes());
    let (first, next) = (format!("--{boundary}\r\n"), format!("\r\n--{boundary}"));
    let mut rest = reply.bytes.strip_prefix(first.as_bytes()).expect("the first part");
    let mut found = Vec::new();
    loop {
        let end = find(rest, &next).expect("the end of a part");
        let head = find(rest, "\r\n\r\n").expect("headers");
        let headers = String::from_utf8(rest[..head].to_vec()).expect("text");
        let content = rest[head + 4..end].to_vec();
        for line in headers.lines().filter_map(|line| line.strip_prefix("Content-Length: ")) {
            assert_eq!(line.parse(), Ok(content.len()));
        }
        found.push((headers, content));
        rest = &rest[end + next.len()..];
        if rest == b"--\r\n" {
            return found;
        }
        rest = rest.strip_prefix(b"\r\n").expect("another part");
    }
}

/// Figures, and the media type and bytes of the file beside them.
fn figures_and_file(reply: &Reply) -> (Value, String, Vec<u8>) {
    let parts = parts(reply);
    let [(first, figures), (second, file)] = &parts[..] else { panic!("two parts: {}", parts.len()) };
    assert!(first.contains("Content-Type: application/json"), "{first}");
    let figures = serde_json::from_slice(figures).expect("JSON");
    crate::support::Contract::get().validate("figures", "/components/schemas/PredictAnswer", &figures);
    let media_type = second.lines().find_map(|line| line.strip_prefix("Content-Type: ")).expect("a type");
    (figures, media_type.to_owned(), file.clone())
}

fn close(found: &[f32], expected: impl IntoIterator<Item = f64>) {
    let expected: Vec<f64> = expected.into_iter().collect();
    assert_eq!(found.len(), expected.len());
    for (i, (f, e)) in found.iter().zip(&expected).enumerate() {
        assert!((f64::from(*f) - e).abs() < 1e-5, "number {i}: {f}, expected {e}");
    }
}

#[tokio::test]
async fn a_batch_of_drives_gets_a_batch_of_responses() {
    let app = TestApp::start();
    app.rig(&triple()).await;
    app.activate("triple", gain_weights(&["u"], &["fx", "fy", "fz"], 2.0)).await;
    let drives: Vec<f64> = wave(3 * 50, 0.4);
    let path = "/v1/rigs/triple/predict?sample_rate_hz=100";
    // In Fortran order the drive's index runs fastest.
    let turned: Vec<f64> = (0..50).flat_map(|t| (0..3).map(move |b| b * 50 + t)).map(|i| drives[i]).collect();
    for file in [npy("<f8", false, "(3, 50, 1)", &f8(&drives)), npy("<f8", true, "(3, 50, 1)", &f8(&turned))]
    {
        let reply = app.post_file(path, NPY, file).await.expect(200);
        assert_eq!(reply.header("content-type"), NPY);
        let (header, values) = read_f4(&reply.bytes);
        assert!(header.contains("(3, 50, 3)"), "{header}");
        close(&values, drives.iter().flat_map(|u| [2.0 * u; 3]));
    }
    let one = npy("<f4", false, "(1, 2, 1)", &f4(&[0.5, -0.5]));
    let reply = app.post_file(path, NPY, one).await.expect(200);
    let (header, values) = read_f4(&reply.bytes);
    assert!(header.contains("(1, 2, 3)"), "{header}");
    close(&values, [1.0, 1.0, 1.0, -1.0, -1.0, -1.0]);
}

#[tokio::test]
async fn each_drive_of_a_batch_is_predicted_by_itself() {
    let app = TestApp::start();
    app.bench_with_model().await;
    // The second drive leaves the range of the training; the first does not.
    let drives: Vec<f64> = wave(100, 0.4).into_iter().chain(vec![1.5; 100]).collect();
    let file = npy("<f8", false, "(2, 100, 1)", &f8(&drives));
    let run = app.run("kind=service&split=test", &csv(&drives[..100], 1.1)).await;
    let path = format!(
        "{PREDICT}?sample_rate_hz=100&target={}&slope=3&residue=half",
        run["id"].as_str().expect("an id")
    );
    let reply =
        app.call("POST", &path).header("accept", PARTS).body(NPY, file.clone()).send().await.expect(200);
    assert_eq!(reply.header("rigcast-trust-inside"), "0");
    let (figures, media_type, array) = figures_and_file(&reply);
    assert_eq!(media_type, NPY);
    close(&read_f4(&array).1, drives.iter().map(|u| 2.0 * u));
    let [first, second] = &figures["drives"].as_array().expect("a list")[..] else { panic!("{figures}") };
    let number = |value: &Value| value.as_f64().expect("a number");
    assert!((number(&first["errors"]["channels"]["y"]["rms"]) - 0.1 / 1.1).abs() < 1e-6, "{first}");
    assert!((number(&first["damage"]["channels"]["y"]["ratio"]) - 1.1f64.powi(-3)).abs() < 1e-6, "{first}");
    assert_eq!(first["damage"]["settings"]["residue"], "half");
    assert_eq!((&first["trust"]["inside"], &second["trust"]["inside"]), (&json!(1.0), &json!(0.0)));
    assert!(number(&second["errors"]["channels"]["y"]["rms"]) > 1.0, "{second}");
    // A drive of the batch is what it is alone.
    let alone = npy("<f8", false, "(100, 1)", &f8(&drives[..100]));
    let reply = app.call("POST", &path).header("accept", PARTS).body(NPY, alone).send().await.expect(200);
    let (figures, ..) = figures_and_file(&reply);
    for field in ["damage", "errors", "trust"] {
        assert_eq!(figures[field], first[field]);
    }
    let json_only = app.call("POST", &path).header("accept", "application/json").body(NPY, file);
    json_only.send().await.problem(406, "accept.not_acceptable");
}

/// A run of a drive and a response of twice the drive times `factor`.
fn csv(drive: &[f64], factor: f64) -> String {
    let rows = drive.iter().map(|u| format!("{u},{}\n", 2.0 * factor * u));
    format!("u,y\n{}", rows.collect::<String>())
}

#[tokio::test]
async fn batches_that_do_not_suit_are_refused_by_drive() {
    let app = TestApp::start();
    app.bench_with_model().await;
    let post = async |shape: &str, values: &[f64]| {
        app.post_file(&format!("{PREDICT}?sample_rate_hz=100"), NPY, npy("<f8", false, shape, &f8(values)))
            .await
    };
    let problem = post("(2, 2, 1)", &[0.0, 0.0, 0.0, f64::NAN]).await.problem(422, "run.non_finite");
    let expected = json!({"pointer": "/1", "channel": "u", "sample": 1});
    assert_eq!(problem["errors"][0], expected);
    let problem = post("(1025, 1, 1)", &[0.0; 1025]).await.problem(422, "predict.batch_size");
    assert_eq!(problem["errors"][0]["limit"], "at most 1024 drives");
    post("(1024, 1, 1)", &[0.0; 1024]).await.expect(200);
    post("(2, 2, 2)", &[0.0; 8]).await.problem(422, "signal.channel_count");
    post("(2, 0, 1)", &[]).await.problem(422, "run.empty");
    post("(0, 2, 1)", &[]).await.problem(422, "run.empty");
    post("(2, 2, 1)", &[0.0; 3]).await.problem(400, "npy.truncated");
    post("(1, 1, 1, 1)", &[0.0]).await.problem(422, "npy.shape");
    // A result beyond 32 bits is found in its drive.
    let problem = post("(2, 2, 1)", &[0.0, 0.0, 1e308, 1e308]).await;
    problem.problem(422, "result.non_finite");
}

#[tokio::test]
async fn figures_come_beside_a_file_of_each_form() {
    let app = TestApp::start();
    app.bench_with_model().await;
    let u = wave(500, 0.4);
    let y: Vec<f64> = u.iter().map(|v| 2.2 * v).collect();
    let mut request = json!({
        "drive": {"sample_rate_hz": 100.0, "channels": {"u": u}},
        "target": {"sample_rate_hz": 100.0, "channels": {"y": y}},
        "damage": {"slope": 3},
    });
    let mut whole = app.post_json(PREDICT, &request).await.expect(200).json();
    whole.as_object_mut().expect("an object").remove("response");
    let ask = |request: &Value, accept: &str| {
        app.call("POST", PREDICT).header("accept", accept).json(request).send()
    };
    let reply = ask(&request, PARTS).await.expect(200);
    assert_eq!(reply.header("content-length"), reply.bytes.len().to_string());
    let (figures, media_type, file) = figures_and_file(&reply);
    assert_eq!((figures, media_type.as_str()), (whole.clone(), NPY));
    close(&read_f4(&file).1, u.iter().map(|v| 2.0 * v));
    for media_type in ["text/csv", "application/x-rpc3", "application/x-matlab-data"] {
        let reply = ask(&request, &format!("multipart/mixed; file=\"{media_type}\"")).await.expect(200);
        let (figures, found, file) = figures_and_file(&reply);
        assert_eq!((figures, found.as_str()), (whole.clone(), media_type));
        let alone = ask(&request, media_type).await.expect(200).bytes;
        // A MAT file says when it was made.
        assert!(file == alone || media_type == "application/x-matlab-data" && file.len() == alone.len());
    }
    ask(&request, "multipart/mixed; file=text/html").await.problem(406, "accept.not_acceptable");
    request["include"] = json!(["trust"]);
    let (figures, ..) = figures_and_file(&ask(&request, PARTS).await.expect(200));
    assert_eq!(figures.as_object().expect("an object").keys().collect::<Vec<_>>(), ["model", "trust"]);
}

#[tokio::test]
async fn a_drive_in_a_file_is_compared_with_a_run() {
    let app = TestApp::start();
    app.bench_with_model().await;
    let text = noise_csv(400, 3);
    let run = app.run("kind=service&split=test", &text).await;
    let run = run["id"].as_str().expect("an id");
    let ask = |query: &str| {
        let call = app.call("POST", &format!("{PREDICT}?{query}")).header("accept", "application/json");
        call.body("text/csv", text.clone()).send()
    };
    let answer = ask(&format!("target={run}")).await.expect(200).json();
    assert!(answer["errors"]["channels"]["y"]["rms"].as_f64().is_some_and(|rms| rms < 1e-9), "{answer}");
    assert!(answer["damage"]["channels"]["y"]["ratio"].is_number(), "{answer}");
    let answer = ask(&format!("target={run}&include=errors,trust&include=response")).await.expect(200).json();
    assert_eq!(
        answer.as_object().expect("an object").keys().collect::<Vec<_>>(),
        ["errors", "model", "response", "trust"]
    );
    let answer = ask("slope=7&include=damage").await.expect(200).json();
    assert_eq!(answer["damage"]["settings"]["slope"], 7.0);
    for (query, code, pointer) in [
        ("include=errors", "predict.target_missing", "?target"),
        ("include=eror", "query.invalid", "?include"),
        ("target=1", "query.invalid", "?target"),
        ("slope=51", "query.invalid", "?slope"),
        ("constant=0", "query.invalid", "?constant"),
        ("directions=0", "query.invalid", "?directions"),
        ("residue=none", "query.invalid", "?residue"),
    ] {
        assert_eq!(ask(query).await.problem(422, code)["errors"][0]["pointer"], pointer, "{query}");
    }
    ask("target=0197f1a0-0000-7000-8000-000000000000").await.problem(404, "run.not_found");
}

#[tokio::test]
async fn drive_and_target_of_another_rate_are_converted_when_that_is_asked_for() {
    let app = TestApp::start();
    app.rig(&bench()).await;
    app.activate("bench", gain_weights(&["u"], &["y"], 2.0)).await;
    // 3 Hz in 20 s, at 250 Hz and at the model's 100 Hz.
    let sine = |rate: f64, scale: f64| -> Vec<f64> {
        (0..(20.0 * rate) as usize)
            .map(|i| scale * (std::f64::consts::TAU * 3.0 * i as f64 / rate).sin())
            .collect()
    };
    let signals = |rate: f64, name: &str, scale: f64| json!({"sample_rate_hz": rate, "channels": {name: sine(rate, scale)}});
    let request = json!({"drive": signals(250.0, "u", 0.5), "target": signals(100.0, "y", 1.0)});
    let resampled = format!("{PREDICT}?resample=true");
    app.post_json(PREDICT, &request).await.problem(422, "predict.sample_rate");
    let answer = app.post_json(&resampled, &request).await.expect(200).json();
    assert_eq!(answer["resampled_from_hz"], json!({"drive": 250.0}));
    assert_eq!(answer["response"]["sample_rate_hz"], 100.0);
    assert_eq!(answer["response"]["channels"]["y"].as_array().map(Vec::len), Some(2000));
    // The ends ring, since the sine stops there.
    let rms = answer["errors"]["channels"]["y"]["rms"].as_f64().expect("a figure");
    assert!(rms < 0.02, "{rms}");
    let both = json!({"drive": signals(100.0, "u", 0.5), "target": signals(400.0, "y", 1.0)});
    let answer = app.post_json(&resampled, &both).await.expect(200).json();
    assert_eq!(answer["resampled_from_hz"], json!({"target": 400.0}));
    let same = json!({"drive": signals(100.0, "u", 0.5)});
    assert_eq!(app.post_json(&resampled, &same).await.expect(200).json().get("resampled_from_hz"), None);

    let file = npy("<f8", false, "(2, 5000, 1)", &f8(&[sine(250.0, 0.5), sine(250.0, -0.5)].concat()));
    let query = |more: &str| format!("{PREDICT}?sample_rate_hz=250{more}");
    app.post_file(&query(""), NPY, file.clone()).await.problem(422, "predict.sample_rate");
    let reply = app.post_file(&query("&resample=true"), NPY, file).await.expect(200);
    assert_eq!(reply.header("rigcast-sample-rate-hz"), "100");
    let (header, values) = read_f4(&reply.bytes);
    assert!(header.contains("(2, 2000, 1)"), "{header}");
    let inside = |values: &[f32], scale: f64| {
        let expected = sine(100.0, scale)[200..1800].to_vec();
        let off = values[200..1800].iter().zip(&expected).map(|(a, b)| (f64::from(*a) - b).abs());
        assert!(off.fold(0.0, f64::max) < 1e-3);
    };
    inside(&values[..2000], 1.0);
    inside(&values[2000..], -1.0);
}

#[tokio::test]
async fn rates_that_cannot_be_converted_are_refused() {
    let app = TestApp::start();
    app.bench_with_model().await;
    let resampled = format!("{PREDICT}?resample=true");
    let drive = |rate: f64, n: usize| json!({"sample_rate_hz": rate, "channels": {"u": vec![0.0; n]}});
    for rate in [1.0, 1e-300, 1e9] {
        let problem = app.post_json(&resampled, &json!({"drive": drive(rate, 10)})).await;
        let problem = problem.problem(422, "predict.sample_rate");
        assert_eq!(problem["errors"][0]["pointer"], "/drive/sample_rate_hz", "{rate} Hz");
    }
    let target = json!({"sample_rate_hz": 50.0, "channels": {"y": vec![0.0; 100]}});
    let problem = app.post_json(&resampled, &json!({"drive": drive(100.0, 100), "target": target})).await;
    problem.problem(422, "predict.unequal_lengths");
    // Two million samples become more than any request may hold.
    let file = npy("<f4", false, "(2000000, 1)", &f4(&vec![0.0; 2_000_000]));
    let reply = app.post_file(&format!("{PREDICT}?sample_rate_hz=4&resample=true"), NPY, file).await;
    reply.problem(413, "body.too_large");
}
