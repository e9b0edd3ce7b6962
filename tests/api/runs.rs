//! Runs that are accepted: formats in and out, metadata, duplicates, the fit policy.

use base64::Engine as _;
use serde_json::json;
use sha2::{Digest, Sha256};

use crate::support::{TestApp, bench, f4, f8, noise_csv, npy};

#[tokio::test]
async fn the_same_samples_come_back_from_every_format_in_every_format() {
    let app = TestApp::start();
    app.rig(&bench()).await;
    let u = [0.0, 0.1, -0.2, 1e-7];
    let y = [1.5, -2.25, 3.0, 0.3];
    let rows: Vec<f64> = u.iter().zip(&y).flat_map(|(u, y)| [*u, *y]).collect();
    let csv = "u,y\nkN,mm\n0,1.5\n0.1,-2.25\n-0.2,3\n1e-7,0.3\n";
    let json_file = json!({"sample_rate_hz": 100.0, "channels": {"u": u, "y": y}});
    let files: [(&str, Vec<u8>); 4] = [
        ("text/csv; charset=utf-8", csv.into()),
        ("application/json", serde_json::to_vec(&json_file).expect("JSON")),
        ("application/x-npy", npy("<f8", false, "(4, 2)", &f8(&rows))),
        ("application/x-npy", npy("<f8", true, "(4, 2)", &f8(&[u, y].concat()))),
    ];
    for (media_type, file) in files {
        let created =
            app.post_file("/v1/rigs/bench/runs?kind=service", media_type, file.clone()).await.expect(201);
        let run = created.json();
        assert_eq!(run["sha256"], format!("{:x}", HexDigest(&file)));
        assert_eq!((&run["samples"], &run["duration_s"]), (&json!(4), &json!(0.04)));
        assert_eq!((&run["units"], &run["channels"]), (&json!(["kN", "mm"]), &json!(["u", "y"])));
        let data = format!("{}/data", created.header("location"));
        assert_eq!(app.get(&data).await.expect(200).json(), json_file);
        let npy_out = app.call("GET", &data).header("accept", "application/x-npy").send().await.expect(200);
        assert_eq!(npy_out.header("rigcast-channels"), "u,y");
        assert!(npy_out.bytes.ends_with(&f8(&rows)), "C order, doubles");
        let csv_out = app.call("GET", &data).header("accept", "text/csv").send().await.expect(200);
        let again =
            app.post_file("/v1/rigs/bench/runs?kind=service", "text/csv", csv_out.bytes.clone()).await;
        let again = format!("{}/data", again.expect(201).header("location"));
        assert_eq!(app.get(&again).await.expect(200).json(), json_file, "{}", csv_out.text());
    }
}

#[tokio::test]
async fn a_run_goes_out_as_rpc3_and_comes_in_again() {
    const RPC3: &str = "application/x-rpc3";
    let app = TestApp::start();
    app.rig(&bench()).await;
    // A step of 10 ms; four samples are less than a frame.
    let csv = "u,y\nkN,mm\n0,1.5\n0.1,-2.25\n-0.2,3\n1e-7,0.3\n";
    let created = app.post_file("/v1/rigs/bench/runs?kind=service", "text/csv", csv).await.expect(201);
    let data = format!("{}/data", created.header("location"));
    let out = app.call("GET", &data).header("accept", RPC3).send().await.expect(200);
    assert_eq!(out.header("content-type"), RPC3);
    assert_eq!(out.header("content-length"), out.bytes.len().to_string());
    let has = |file: &[u8], text: &[u8]| file.windows(text.len()).any(|w| w == text);
    assert!(has(&out.bytes, b"\0RESPONSE\0"), "a response is among the channels");
    let drive =
        app.call("GET", &format!("{data}?channels=u")).header("accept", RPC3).send().await.expect(200);
    assert!(has(&drive.bytes, b"\0DRIVE\0"));

    let again = app.post_file("/v1/rigs/bench/runs", RPC3, out.bytes.clone()).await.expect(201);
    let found = app.get(&format!("{}/data", again.header("location"))).await.expect(200).json();
    for (channel, expected) in [("u", [0.0, 0.1, -0.2, 1e-7]), ("y", [1.5, -2.25, 3.0, 0.3])] {
        let found = found["channels"][channel].as_array().expect("samples");
        assert_eq!(found.len(), 4, "the padding of the frame is left out");
        for (found, expected) in found.iter().zip(expected) {
            assert!(
                (found.as_f64().expect("a number") - expected).abs() < 3.0 / 32752.0,
                "{channel}: {found}"
            );
        }
    }
    let floats = format!("{RPC3}; numbers=floats");
    let exact = app.call("GET", &data).header("accept", &floats).send().await.expect(200);
    assert_eq!(exact.header("content-type"), floats);
    assert_eq!(exact.header("content-length"), exact.bytes.len().to_string());
    let again = app.post_file("/v1/rigs/bench/runs", &floats, exact.bytes).await.expect(201);
    let found = app.get(&format!("{}/data", again.header("location"))).await.expect(200).json();
    let single: Vec<f64> = [0.0_f32, 0.1, -0.2, 1e-7].map(f64::from).to_vec();
    assert_eq!(found["channels"]["u"], json!(single));
    let other = app.call("GET", &data).header("accept", "application/x-rpc3; numbers=doubles").send().await;
    other.problem(406, "accept.not_acceptable");
    // Descriptions are text for people: the query may name the channels by their place.
    let path = "/v1/rigs/bench/runs?channels=u";
    app.post_file(path, RPC3, out.bytes.clone()).await.problem(422, "run.channel_count");
    let mut described = drive.bytes.clone();
    let at = described.windows(11).position(|w| w == b"DESC.CHAN_1").expect("a description") + 32;
    described[at..at + 7].copy_from_slice(b"Kanal 1");
    app.post_file("/v1/rigs/bench/runs", RPC3, described.clone()).await.problem(422, "run.unknown_channel");
    let named = app.post_file(path, RPC3, described.clone()).await.expect(201).json();
    assert_eq!((&named["channels"], &named["samples"]), (&json!(["u"]), &json!(4)));
    let kept = app.post_file(&format!("{path}&padding=keep&scale=count"), RPC3, described).await;
    assert_eq!(kept.expect(201).json()["samples"], 4, "SAMPLES says how many there are");
    app.post_file(&format!("{path}&padding=cut"), RPC3, vec![0_u8; 512]).await.problem(422, "query.invalid");
    app.post_file(path, RPC3, vec![0_u8; 512]).await.problem(400, "rpc3.header");
    app.post_file(path, RPC3, &drive.bytes[..drive.bytes.len() - 1]).await.problem(400, "rpc3.size");
}

/// A data set 58 of four samples in steps of 10 ms.
fn uff58(id: &str, unit: &str, samples: [f64; 4]) -> String {
    let numbers: String = samples.iter().map(|v| format!("{v:13.5e}")).collect();
    let head = format!("    -1\n    58\n{id}\nNONE\nNONE\nNONE\nNONE\n    1\n");
    let axes = "         2         4         1  0.00000E+00  1.00000E-02\n        17    0    0    0 Time                 s";
    format!("{head}{axes}\n         1    0    0    0 NONE                 {unit}\n\n\n{numbers}\n    -1\n")
}

#[tokio::test]
async fn a_run_comes_in_as_uff58() {
    const UFF58: &str = "application/x-uff58";
    let app = TestApp::start();
    app.rig(&bench()).await;
    let path = "/v1/rigs/bench/runs";
    let (u, y) = ([0.0, 0.1, -0.2, 1e-7], [1.5, -2.25, 3.0, 0.3]);
    // The order of the file is not the rig's.
    let file = uff58("y", "mm", y) + &uff58("u", "kN", u);
    let created = app.post_file(path, UFF58, file.clone()).await.expect(201);
    assert_eq!(created.json()["channels"], json!(["y", "u"]));
    let data = app.get(&format!("{}/data", created.header("location"))).await.expect(200).json();
    assert_eq!(data, json!({"sample_rate_hz": 100.0, "channels": {"y": y, "u": u}}));

    // ID lines are text for people: the query may name the channels by their place.
    let described = uff58("Kanal 1", "mm", y) + &uff58("Kanal 2", "kN", u);
    app.post_file(path, UFF58, described.clone()).await.problem(422, "run.unknown_channel");
    let named = app.post_file(&format!("{path}?channels=y,u"), UFF58, described.clone()).await.expect(201);
    assert_eq!(named.json()["channels"], json!(["y", "u"]));
    app.post_file(&format!("{path}?channels=y"), UFF58, described.clone())
        .await
        .problem(422, "run.channel_count");
    // Without names the channels are the rig's in order, and their units must be too.
    let unnamed = uff58("NONE", "kN", u) + &uff58("NONE", "mm", y);
    let in_order = app.post_file(path, UFF58, unnamed).await.expect(201);
    assert_eq!(in_order.json()["channels"], json!(["u", "y"]));
    app.post_file(path, UFF58, uff58("u", "V", u)).await.problem(422, "run.invalid");

    app.post_file(path, UFF58, &file.as_bytes()[..file.len() - 7]).await.problem(400, "uff58.size");
    app.post_file(path, UFF58, file.replace("    1\n", "    4\n")).await.problem(422, "uff58.unsupported");
    app.post_file(path, UFF58, file.replace("-2.25", "-2,25")).await.problem(422, "uff58.not_a_number");
    let refused =
        app.post_file(path, UFF58, file.replace("    58\n", " 5.8\n")).await.problem(400, "uff58.header");
    assert_eq!(refused["errors"][0]["row"], 2);
}

/// SHA-256 in hex.
struct HexDigest<'a>(&'a [u8]);

impl std::fmt::LowerHex for HexDigest<'_> {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        Sha256::digest(self.0).iter().try_for_each(|b| write!(f, "{b:02x}"))
    }
}

#[tokio::test]
async fn a_stretch_of_some_channels_is_cut_by_time() {
    let app = TestApp::start();
    app.rig(&bench()).await;
    let samples: Vec<f64> = (0..100).map(f64::from).collect();
    let file = npy("<f8", false, "(100,)", &f8(&samples));
    let created =
        app.post_file("/v1/rigs/bench/runs?channels=y", "application/x-npy", file).await.expect(201);
    let data = format!("{}/data", created.header("location"));
    let cut = app.get(&format!("{data}?from_s=0.07&to_s=0.1&channels=y")).await.expect(200).json();
    assert_eq!(cut, json!({"sample_rate_hz": 100.0, "channels": {"y": [7.0, 8.0, 9.0]}}));
    let csv = app.call("GET", &format!("{data}?from_s=0.98")).header("accept", "text/csv").send().await;
    let text = csv.expect(200).text().to_owned();
    let times: Vec<&str> = text.lines().skip(2).map(|l| l.split(',').next().unwrap_or_default()).collect();
    assert_eq!(times, ["0.98", "0.99"], "time goes on from the start of the run: {text}");
    app.get(&format!("{data}?channels=u")).await.problem(422, "run.unknown_channel");
    for query in ["from_s=1", "from_s=0.5&to_s=0.5", "from_s=-1", "to_s=x"] {
        app.get(&format!("{data}?{query}")).await.problem(422, "query.invalid");
    }
    let html = app.call("GET", &data).header("accept", "text/html").send().await;
    html.problem(406, "accept.not_acceptable");
}

#[tokio::test]
async fn singles_and_a_subset_of_the_channels_in_any_order_are_a_run() {
    let app = TestApp::start();
    app.rig(&bench()).await;
    let file = npy("<f4", false, "(2, 2)", &f4(&[1.0, 2.0, 3.0, 4.0]));
    let created =
        app.post_file("/v1/rigs/bench/runs?channels=y,u", "application/x-npy", file).await.expect(201);
    assert_eq!(created.json()["channels"], json!(["y", "u"]));
    let data = app.get(&format!("{}/data", created.header("location"))).await.expect(200).json();
    assert_eq!(data["channels"], json!({"y": [1.0, 3.0], "u": [2.0, 4.0]}));
}

#[tokio::test]
async fn a_run_keeps_what_was_said_about_it_and_lets_it_be_changed() {
    let app = TestApp::start();
    app.rig(&bench()).await;
    let query = "name=N%201&kind=noise&split=validation&tag=linear&tag=cold&started_at=2026-03-01T12:00:00Z";
    let run = app.run(query, &noise_csv(50, 3)).await;
    assert_eq!(
        (&run["name"], &run["split"], &run["kind"]),
        (&json!("N 1"), &json!("validation"), &json!("noise"))
    );
    assert_eq!(
        (&run["tags"], &run["started_at"]),
        (&json!(["linear", "cold"]), &json!("2026-03-01T12:00:00Z"))
    );
    assert_eq!(run["quality"]["channels"][1]["channel"], "y");
    assert_eq!(run["quality"]["warnings"], json!([]));
    let path = format!("/v1/rigs/bench/runs/{}", run["id"].as_str().expect("an id"));
    let patch = |body: serde_json::Value| app.call("PATCH", &path).json(&body).send();
    let changed = patch(json!({"split": "test", "tags": null})).await.expect(200).json();
    assert_eq!(
        (&changed["split"], &changed["tags"], &changed["name"]),
        (&json!("test"), &json!([]), &json!("N 1"))
    );
    assert_eq!(app.get(&path).await.json(), changed);
    patch(json!({"samples": 3})).await.problem(422, "body.unknown_field");
    patch(json!({"tags": [""]})).await.problem(422, "run.invalid");
    app.run("kind=sine", &noise_csv(50, 4)).await;
    for (query, count) in
        [("kind=noise", 1), ("split=test", 1), ("split=training", 1), ("kind=sweep", 0), ("", 2)]
    {
        let found = app.get(&format!("/v1/rigs/bench/runs?{query}")).await.expect(200).json();
        assert_eq!(found["items"].as_array().map(Vec::len), Some(count), "{query}");
    }
    app.delete(&path).await.expect(204);
    app.get(&path).await.problem(404, "run.not_found");
    app.delete(&path).await.problem(404, "run.not_found");
}

#[tokio::test]
async fn the_same_bytes_again_are_a_run_that_names_the_first() {
    let app = TestApp::start();
    app.rig(&bench()).await;
    let file = noise_csv(50, 5);
    let first = app.run("kind=noise", &file).await;
    let second = app.run("kind=noise", &file).await;
    assert_eq!((&first["duplicate_of"], &second["duplicate_of"]), (&json!(null), &first["id"]));
    assert_ne!(first["id"], second["id"]);
    assert_eq!(app.files().len(), 1, "one object for both");
    let path = format!("/v1/rigs/bench/runs/{}", first["id"].as_str().expect("an id"));
    app.delete(&path).await.expect(204);
    assert_eq!(app.files().len(), 1, "the other run still needs it");
}

#[tokio::test]
async fn a_digest_that_is_right_is_taken_and_a_wrong_one_stores_nothing() {
    let app = TestApp::start();
    app.rig(&bench()).await;
    let file = noise_csv(50, 6);
    let digest = |bytes: &[u8]| {
        format!("sha-256=:{}:", base64::engine::general_purpose::STANDARD.encode(Sha256::digest(bytes)))
    };
    let upload = |digest: String| {
        let call = app.call("POST", "/v1/rigs/bench/runs").header("content-digest", &digest);
        call.body("text/csv", file.clone()).send()
    };
    upload(digest(b"something else")).await.problem(400, "digest.mismatch");
    upload("sha-256=nonsense".into()).await.problem(400, "digest.malformed");
    assert_eq!((app.runs().await, app.files().len()), (0, 0));
    upload(digest(file.as_bytes())).await.expect(201);
}

#[tokio::test]
async fn another_sample_rate_is_converted_when_asked_for() {
    let app = TestApp::start();
    app.rig(&bench()).await;
    let slow: Vec<f64> = (0..400).map(|i| (0.05 * f64::from(i)).sin()).collect();
    let file = json!({"sample_rate_hz": 200.0, "channels": {"u": slow}});
    let created = app.post_json("/v1/rigs/bench/runs?resample=true", &file).await.expect(201);
    let run = created.json();
    assert_eq!((&run["samples"], &run["sample_rate_hz"]), (&json!(200), &json!(100.0)));
    let data = app.get(&format!("{}/data", created.header("location"))).await.expect(200).json();
    for i in 50..150 {
        let found = data["channels"]["u"][i].as_f64().expect("a number");
        assert!((found - slow[2 * i]).abs() < 1e-3, "sample {i}: {found}");
    }
}

#[tokio::test]
async fn a_run_that_is_noise_for_training_sets_off_the_policys_fits() {
    let app = TestApp::start();
    let mut draft = bench();
    draft["fit_policy"] = json!({"min_total_s": 60.0, "fits": [{"kind": "frf"}]});
    app.rig(&draft).await;
    let short = app.run("kind=noise", &noise_csv(3000, 7)).await;
    assert_eq!(short["jobs"], json!([]), "half a minute is not enough");
    assert_eq!(short["policy"], "30.0 of 60.0 s of noise");
    let other = app.run("kind=service", &noise_csv(9000, 8)).await;
    assert_eq!(other["jobs"], json!([]), "service loads do not count");
    assert_eq!(other["policy"], "kind service is not among noise");
    let enough = app.run("kind=noise", &noise_csv(3000, 9)).await;
    let jobs = enough["jobs"].as_array().expect("jobs");
    assert_eq!(jobs.len(), 1);
    let job = app.finished(jobs[0].as_str().expect("an id")).await;
    assert_eq!((&job["kind"], &job["state"]), (&json!("fit"), &json!("succeeded")), "{job}");
    let model = app.get(job["result"]["href"].as_str().expect("a link")).await.expect(200).json();
    assert_eq!(model["lineage"]["training"].as_array().map(Vec::len), Some(2));
    let active = app.get("/v1/rigs/bench/active-model").await.expect(200).json();
    assert_eq!(active["version"], model["version"], "the first model becomes active");
}

#[tokio::test]
async fn an_upload_says_what_looks_wrong_with_its_channels_and_why_it_starts_no_fit() {
    let app = TestApp::start();
    app.rig(&bench()).await;
    // u rests at 4.998 for three samples; y is u, sample by sample.
    let run = app.run("kind=noise", "u,y\n0.5,0.5\n4.998,4.998\n4.998,4.998\n4.998,4.998\n-1,-1\n").await;
    let clipped = |name: &str| format!("{name}: 3 samples at its largest value 4.998: probably clipped");
    let expected = json!([clipped("u"), clipped("y"), "y repeats u"]);
    assert_eq!(run["quality"]["warnings"], expected);
    assert_eq!((&run["jobs"], &run["policy"]), (&json!([]), &json!("the rig has no fit_policy")));
    let path = format!("/v1/rigs/bench/runs/{}", run["id"].as_str().expect("an id"));
    let shown = app.get(&path).await.expect(200).json();
    assert_eq!(shown["quality"]["warnings"], expected, "the run keeps them");
    assert_eq!(shown.get("policy"), None, "which is of the upload, not of the run");
}
