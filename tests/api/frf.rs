//! A model's FRF: all that was measured of it, its inverse, and what is refused.

use realfft::num_complex::Complex64;
use rigcast::engine::model::to_safetensors;
use serde_json::{Value, json};

use crate::support::{SAFETENSORS, TestApp, bench, gain_model, gain_weights, noise, triple, wave};

const MODELS: &str = "/v1/rigs/bench/models";
const NPY: &str = "application/x-npy";

/// 60 s of `y = 2 u + e`, the noise `e` half as strong as `2 u`: coherence 1 / (1 + 1/4).
fn noisy_csv() -> String {
    let (u, e) = (noise(6000, 5), noise(6000, 6));
    let rows = u.iter().zip(&e).map(|(u, e)| format!("{u},{}\n", 2.0 * u + e));
    std::iter::once("u,y\n".to_owned()).chain(rows).collect()
}

/// A service with an FRF fitted to that, and the model.
async fn fitted() -> (TestApp, Value) {
    let app = TestApp::start();
    app.rig(&bench()).await;
    app.run("kind=noise", &noisy_csv()).await;
    let request = json!({"kind": "frf", "frf": {"segment_len": 128, "overlap": 0.5, "ridge": 0.0}});
    let job = app.post_json("/v1/rigs/bench/fits", &request).await.expect(202).json();
    let job = app.finished(job["id"].as_str().expect("an id")).await;
    let model = app.get(job["result"]["href"].as_str().expect("a model")).await.expect(200).json();
    (app, model)
}

fn number(value: &Value) -> f64 {
    value.as_f64().unwrap_or_else(|| panic!("{value} is a number"))
}

fn numbers(values: &Value) -> Vec<f64> {
    values.as_array().unwrap_or_else(|| panic!("{values} is a list")).iter().map(number).collect()
}

/// `[line, 0, 0]` of an array.
fn of_path(lines: &Value) -> Vec<f64> {
    lines.as_array().expect("lines").iter().map(|line| number(&line[0][0])).collect()
}

/// Header text and numbers of an NPY file of `<f8` or `<c16`.
fn read_npy(file: &[u8]) -> (String, Vec<f64>) {
    assert_eq!(&file[..8], b"\x93NUMPY\x01\x00", "an NPY file");
    let len = usize::from(u16::from_le_bytes([file[8], file[9]]));
    let header = String::from_utf8(file[10..10 + len].to_vec()).expect("text");
    (header, file[10 + len..].as_chunks::<8>().0.iter().map(|b| f64::from_le_bytes(*b)).collect())
}

#[tokio::test]
async fn a_fitted_model_shows_its_frf_with_all_that_was_measured() {
    let (app, model) = fitted().await;
    let href = model["frf"]["href"].as_str().expect("a link");
    assert_eq!(href, format!("{MODELS}/{}/frf", model["version"]));
    let frf = app.get(href).await.expect(200);
    assert_eq!(frf.header("rigcast-model-digest"), model["sha256"]);
    let frf = frf.json();
    assert_eq!((&frf["inputs"], &frf["outputs"]), (&json!(["u"]), &json!(["y"])));
    assert_eq!(frf["units"], json!({"inputs": ["kN"], "outputs": ["mm"]}));
    assert_eq!((&frf["estimate"]["window"], &frf["estimate"]["estimator"]), (&json!("hann"), &json!("h1")));
    let averages = &frf["estimate"]["averages"];
    assert_eq!(averages, &model["report"]["frf_averages"]);
    assert!(number(averages) > 70.0, "segments of 128 every 64 of at most 6,000 samples: {averages}");
    assert_eq!((frf["freq_hz"].as_array().map(Vec::len), &frf["freq_hz"][64]), (Some(65), &json!(50.0)));

    let (re, im, radius) =
        (of_path(&frf["h"]["re"]), of_path(&frf["h"]["im"]), of_path(&frf["confidence"]["radius"]));
    let inside = (1..64).filter(|&line| (re[line] - 2.0).hypot(im[line]) <= radius[line]).count();
    assert!((54..=63).contains(&inside), "{inside} of 63 lines hold the true gain within their radius");
    let coherence = of_path(&frf["coherence"]);
    let mean = coherence[2..].iter().sum::<f64>() / 63.0;
    assert!((mean - 0.8).abs() < 0.03, "{mean}");
    let multiple: Vec<f64> =
        frf["multiple_coherence"].as_array().expect("lines").iter().map(|l| number(&l[0])).collect();
    assert!(multiple.iter().zip(&coherence).all(|(m, c)| (m - c).abs() < 1e-12), "one drive: both are one");
    assert!(numbers(&frf["condition"]).iter().all(|&c| c == 1.0));
    assert_eq!(frf["reason"], Value::Null);

    let summary = &model["frf"];
    assert_eq!((&summary["averages"], &summary["usable_hz"]), (averages, &frf["usable_hz"]));
    let output = &summary["outputs"][0];
    assert_eq!(output["channel"], "y");
    assert!((number(&output["coherence_median"]) - 0.8).abs() < 0.04, "{output}");
    // sqrt(1 - 0.8) / (sqrt 0.8 sqrt(2 * 80))
    assert!((number(&output["random_error"]) - 0.04).abs() < 0.01, "{output}");
}

#[tokio::test]
async fn table_and_array_hold_the_same_numbers_as_the_document() {
    let (app, model) = fitted().await;
    let href = model["frf"]["href"].as_str().expect("a link");
    let document = app.get(href).await.expect(200).json();
    let accept = |query: &str, media_type: &'static str| {
        app.call("GET", &format!("{href}{query}")).header("accept", media_type).send()
    };
    let text = accept("", "text/csv").await.expect(200).text().to_owned();
    let lines: Vec<&str> = text.lines().collect();
    assert_eq!(
        lines[0],
        "freq_hz,re(y/u),im(y/u),coherence(y/u),multiple_coherence(y),condition,confidence(y/u)"
    );
    assert_eq!(lines[1], "Hz,mm/kN,mm/kN,,,,mm/kN");
    assert_eq!(lines.len(), 2 + 65);
    let row: Vec<f64> = lines[2 + 30].split(',').map(|cell| cell.parse().expect("a number")).collect();
    let at = |array: &Value| number(&array[30][0][0]);
    let confidence = at(&document["confidence"]["radius"]);
    let expected = [
        number(&document["freq_hz"][30]),
        at(&document["h"]["re"]),
        at(&document["h"]["im"]),
        at(&document["coherence"]),
        number(&document["multiple_coherence"][30][0]),
        1.0,
        confidence,
    ];
    assert_eq!(row, expected);

    let file = accept("", NPY).await.expect(200);
    assert_eq!((file.header("rigcast-inputs"), file.header("rigcast-outputs")), ("u", "y"));
    assert_eq!(file.header("rigcast-step-hz"), "0.78125");
    let (header, h) = read_npy(&file.bytes);
    assert!(header.contains("'<c16'") && header.contains("(65, 1, 1)"), "{header}");
    assert_eq!(h.iter().step_by(2).copied().collect::<Vec<_>>(), of_path(&document["h"]["re"]));
    assert_eq!(h.iter().skip(1).step_by(2).copied().collect::<Vec<_>>(), of_path(&document["h"]["im"]));
    for (part, shape, expected) in [
        ("coherence", "(65, 1, 1)", of_path(&document["coherence"])),
        ("confidence", "(65, 1, 1)", of_path(&document["confidence"]["radius"])),
        ("condition", "(65,", numbers(&document["condition"])),
        ("freq_hz", "(65,", numbers(&document["freq_hz"])),
    ] {
        let (header, values) = read_npy(&accept(&format!("?part={part}"), NPY).await.expect(200).bytes);
        assert!(header.contains("'<f8'") && header.contains(shape), "{part}: {header}");
        assert_eq!(values, expected, "{part}");
    }
    let (header, _) = read_npy(&accept("?part=multiple_coherence", NPY).await.expect(200).bytes);
    assert!(header.contains("(65, 1)"), "{header}");
    let part = app.get(&format!("{href}?part=condition&from_hz=10&to_hz=12.5")).await.expect(200).json();
    assert_eq!(numbers(&part["freq_hz"]), [10.15625, 10.9375, 11.71875, 12.5]);
    assert_eq!((part["condition"].as_array().map(Vec::len), part.get("h")), (Some(4), None));
    let table = accept("?part=h", "text/csv").await.expect(200).text().to_owned();
    assert!(table.starts_with("freq_hz,re(y/u),im(y/u)\n"), "{table}");
}

#[tokio::test]
async fn the_inverse_asks_for_the_drive_of_a_response() {
    let (app, model) = fitted().await;
    let href = model["frf"]["href"].as_str().expect("a link");
    let frf = app.get(href).await.expect(200).json();
    let answer = app.get(&format!("{href}?inverse=true&ridge=0")).await.expect(200).json();
    assert_eq!((answer.get("h"), answer.get("coherence")), (None, None));
    assert_eq!(answer["inverse"]["ridge"], 0.0);
    let parts = |of: &Value| (of_path(&of["re"]), of_path(&of["im"]));
    let ((h_re, h_im), (re, im)) = (parts(&frf["h"]), parts(&answer["inverse"]));
    let product = |line: usize| {
        let (h, inverse) = ((h_re[line], h_im[line]), (re[line], im[line]));
        (h.0 * inverse.0 - h.1 * inverse.1, h.0 * inverse.1 + h.1 * inverse.0)
    };
    for (line, product) in (0..65).map(product).enumerate() {
        assert!((product.0 - 1.0).hypot(product.1) < 1e-9, "line {line}: {product:?}");
    }
    let plain = app.get(&format!("{href}?inverse")).await.expect(200).json();
    assert_eq!(plain["inverse"]["ridge"], 1e-3, "the default");
    assert!(of_path(&plain["inverse"]["re"])[30] < re[30], "a ridge makes it smaller");
    let table = app.call("GET", &format!("{href}?inverse&to_hz=5")).header("accept", "text/csv").send().await;
    let table = table.expect(200).text().to_owned();
    assert!(table.starts_with("freq_hz,re(u/y),im(u/y)\nHz,kN/mm,kN/mm\n"), "{table}");
    for (query, place) in [
        ("inverse=true&ridge=-1", "?ridge"),
        ("inverse=true&ridge=nan", "?ridge"),
        ("inverse=true&ridge=inf", "?ridge"),
        ("inverse=true&ridge=much", "?ridge"),
        ("inverse=true&ridge=1&ridge=2", "?ridge"),
        ("ridge=0.1", "?ridge"),
        ("inverse=perhaps", "?inverse"),
        ("inverse=true&part=coherence", "?part"),
        ("part=phase", "?part"),
        ("from_hz=-1", "?from_hz"),
        ("from_hz=20&to_hz=10", "?from_hz"),
        ("from_hz=50.1", "?from_hz"),
        ("to_hz=x", "?to_hz"),
    ] {
        let problem = app.get(&format!("{href}?{query}")).await.problem(422, "query.invalid");
        assert_eq!(problem["errors"][0]["pointer"], place, "{query}");
    }
    app.get(&format!("{href}?invers=true")).await.problem(422, "query.unknown_parameter");
    let refused = app.call("GET", href).header("accept", "image/png").send().await;
    refused.problem(406, "accept.not_acceptable");
    app.get(&format!("{MODELS}/9/frf")).await.problem(404, "model.not_found");
    app.get("/v1/rigs/nobody/models/1/frf").await.problem(404, "rig.not_found");
}

#[tokio::test]
async fn weights_made_elsewhere_have_an_frf_and_say_why_it_has_no_coherence() {
    let app = TestApp::start();
    app.rig(&bench()).await;
    let weights = gain_weights(&["u"], &["y"], 2.0);
    let model = app.post_file(MODELS, SAFETENSORS, weights).await.expect(201).json();
    assert_eq!((&model["frf"]["lines"], model["frf"].get("averages")), (&json!(5), None));
    assert!(model["frf"]["reason"].as_str().is_some_and(|r| r.contains("made elsewhere")), "{model}");
    let frf = app.get(&format!("{MODELS}/1/frf")).await.expect(200).json();
    assert_eq!(of_path(&frf["h"]["re"]), [2.0; 5]);
    assert!(frf["reason"].as_str().is_some_and(|r| r.contains("made elsewhere")), "{frf}");
    for part in ["estimate", "coherence", "multiple_coherence", "condition", "confidence"] {
        assert_eq!(frf.get(part), Some(&Value::Null), "{part}");
        if part != "estimate" {
            app.get(&format!("{MODELS}/1/frf?part={part}")).await.problem(409, "model.no_coherence");
        }
    }
    let inverse = app.get(&format!("{MODELS}/1/frf?inverse=true&ridge=0")).await.expect(200).json();
    assert_eq!(of_path(&inverse["inverse"]["re"]), [0.5; 5]);
    let table = app.call("GET", &format!("{MODELS}/1/frf")).header("accept", "text/csv").send().await;
    assert!(table.expect(200).text().starts_with("freq_hz,re(y/u),im(y/u)\n"));
}

#[tokio::test]
async fn a_model_without_frf_says_so() {
    let app = TestApp::start();
    app.rig(&bench()).await;
    let (u, y) = (wave(400, 1.0), wave(400, 2.0));
    let rows: String = u.iter().zip(&y).map(|(u, y)| format!("{u},{y}\n")).collect();
    app.run("kind=noise", &format!("u,y\n{rows}")).await;
    let lstm = json!({"blocks": [2], "window_len": 16, "hop": 8, "epochs": 1, "seeds": [1]});
    let request = json!({"kind": "lstm", "lstm": lstm});
    let job = app.post_json("/v1/rigs/bench/fits", &request).await.expect(202).json();
    let job = app.finished(job["id"].as_str().expect("an id")).await;
    let href = job["result"]["href"].as_str().expect("a model").to_owned();
    assert_eq!(app.get(&href).await.expect(200).json().get("frf"), None);
    for query in ["", "?inverse=true", "?part=h"] {
        let problem = app.get(&format!("{href}/frf{query}")).await.problem(409, "model.no_frf");
        assert!(problem["detail"].as_str().is_some_and(|d| d.contains("lstm")), "{problem}");
    }
}

#[tokio::test]
async fn an_frf_that_is_written_in_pieces_is_whole_and_the_same_in_every_format() {
    let app = TestApp::start();
    app.rig(&triple()).await;
    let outputs = ["fx", "fy", "fz"];
    let lines = 20_001;
    let mut model = gain_model(&["u"], &outputs, 2.0);
    let frf = model.frf.as_mut().expect("an FRF");
    frf.segment_len = 2 * (lines - 1);
    let parts = noise(2 * 3 * lines, 9);
    frf.h = parts.chunks(2).map(|z| Complex64::new(1.5 + z[0], z[1])).collect();
    let sent = frf.h.clone();
    app.post_file("/v1/rigs/triple/models", SAFETENSORS, to_safetensors(&model)).await.expect(201);
    let href = "/v1/rigs/triple/models/1/frf";
    let accept = |query: &str, media_type: &'static str| {
        app.call("GET", &format!("{href}{query}")).header("accept", media_type).send()
    };
    let flat = |array: &Value| -> Vec<f64> {
        let paths =
            array.as_array().expect("lines").iter().flat_map(|line| line.as_array().expect("outputs"));
        paths.flat_map(numbers).collect()
    };
    let (re, im): (Vec<f64>, Vec<f64>) = sent.iter().map(|z| (z.re, z.im)).unzip();
    let document = app.get(href).await.expect(200).json();
    assert!(flat(&document["h"]["re"]) == re && flat(&document["h"]["im"]) == im);
    assert_eq!(document["h"]["re"].as_array().map(Vec::len), Some(lines));
    let freq = numbers(&document["freq_hz"]);
    assert_eq!((freq.len(), freq[lines - 1]), (lines, 50.0));

    let file = accept("", NPY).await.expect(200);
    assert_eq!(file.header("content-length"), file.bytes.len().to_string());
    let (header, h) = read_npy(&file.bytes);
    assert!(header.contains("(20001, 3, 1)"), "{header}");
    assert!(h == sent.iter().flat_map(|z| [z.re, z.im]).collect::<Vec<f64>>());

    let table = accept("?part=h", "text/csv").await.expect(200).text().to_owned();
    let mut rows = table.lines();
    assert_eq!(rows.next(), Some("freq_hz,re(fx/u),im(fx/u),re(fy/u),im(fy/u),re(fz/u),im(fz/u)"));
    assert_eq!(rows.next(), Some("Hz,kN/kN,kN/kN,kN/kN,kN/kN,kN/kN,kN/kN"));
    let cells: Vec<f64> = rows.flat_map(|row| row.split(',')).map(|c| c.parse().expect("a number")).collect();
    let expected = freq.iter().zip(sent.chunks(3));
    let expected = expected.flat_map(|(hz, h)| [*hz].into_iter().chain(h.iter().flat_map(|z| [z.re, z.im])));
    assert!(cells == expected.collect::<Vec<f64>>());

    let inverse = app.get(&format!("{href}?inverse")).await.expect(200).json();
    let (_, of_file) = read_npy(&accept("?inverse", NPY).await.expect(200).bytes);
    let inverse = &inverse["inverse"];
    assert!(flat(&inverse["re"]) == of_file.iter().step_by(2).copied().collect::<Vec<f64>>());
    assert!(flat(&inverse["im"]) == of_file.iter().skip(1).step_by(2).copied().collect::<Vec<f64>>());
    // H^+ H is one, but for the ridge.
    let product: Complex64 = of_file[6 * 9_000..6 * 9_001]
        .chunks(2)
        .zip(&sent[3 * 9_000..])
        .map(|(z, h)| Complex64::new(z[0], z[1]) * h)
        .sum();
    assert!((product - 1.0).norm() < 0.01, "{product}");
}
