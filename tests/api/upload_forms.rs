//! Runs as forms (`multipart/form-data`): one part is the file, the others describe it.

use base64::Engine as _;
use rigcast::http::Limits;
use serde_json::{Value, json};
use sha2::{Digest, Sha256};

use crate::support::{Reply, TestApp, bench, f8, npy};

const RUNS: &str = "/v1/rigs/bench/runs";
const TYPE: &str = "multipart/form-data; boundary=----frontier42";
const CSV: &[u8] = b"u,y\n1,2\n3,4\n";

/// A part: what follows `form-data; ` in its head, and its data.
type Part<'a> = (&'a str, &'a [u8]);

fn form(parts: &[Part]) -> Vec<u8> {
    let part = |(head, data): &Part| {
        [b"------frontier42\r\nContent-Disposition: form-data; ", head.as_bytes(), b"\r\n\r\n", data, b"\r\n"]
            .concat()
    };
    let mut body: Vec<u8> = parts.iter().flat_map(part).collect();
    body.extend_from_slice(b"------frontier42--\r\n");
    body
}

async fn send(app: &TestApp, query: &str, parts: &[Part<'_>]) -> Reply {
    app.post_file(&format!("{RUNS}{query}"), TYPE, form(parts)).await
}

#[tokio::test]
async fn a_form_is_the_upload_of_its_file_with_its_fields_as_parameters() {
    let app = TestApp::start();
    app.rig(&bench()).await;
    let plain = app.post_file(RUNS, "text/csv", CSV).await.expect(201).json();
    let parts: [Part; 9] = [
        ("name=\"kind\"", b"noise"),
        ("name=\"tag\"", b"linear"),
        ("name=\"name\"", "Prüfung 1".as_bytes()),
        ("name=\"file\"; filename=\"a b.csv\"\r\nContent-Type: application/vnd.ms-excel", CSV),
        ("name=\"split\"", b"validation"),
        ("name=\"tag\"", b"second"),
        ("name=\"started_at\"", b"2026-03-01T12:00:00Z"),
        ("name=\"sample_rate_hz\"", b"100"),
        ("name=\"channels\"", b""),
    ];
    let run = send(&app, "?kind=noise", &parts).await.expect(201).json();
    assert_eq!(
        (&run["name"], &run["kind"], &run["split"]),
        (&json!("Prüfung 1"), &json!("noise"), &json!("validation"))
    );
    assert_eq!(
        (&run["tags"], &run["started_at"]),
        (&json!(["linear", "second"]), &json!("2026-03-01T12:00:00Z"))
    );
    assert_eq!(
        (&run["sha256"], &run["duplicate_of"]),
        (&plain["sha256"], &plain["id"]),
        "the file's bytes alone count"
    );
    let data =
        app.get(&format!("{RUNS}/{}/data", run["id"].as_str().expect("an id"))).await.expect(200).json();
    assert_eq!(data["channels"], json!({"u": [1.0, 3.0], "y": [2.0, 4.0]}));

    let dry: [Part; 2] = [("name=dry_run", b"true"), ("name=file", CSV)];
    assert_eq!(send(&app, "", &dry).await.expect(200).json()["samples"], 2);
    let runs = app.get(RUNS).await.expect(200).json()["items"].as_array().expect("items").len();
    assert_eq!(runs, 2, "a dry run stores nothing");
}

#[tokio::test]
async fn the_type_the_name_or_the_bytes_of_the_part_tell_the_format() {
    let app = TestApp::start();
    app.rig(&bench()).await;
    let array = npy("<f8", false, "(2, 2)", &f8(&[0.0, 1.0, 2.0, 3.0]));
    let file = json!({"sample_rate_hz": 100.0, "channels": {"u": [1.0, 2.0]}}).to_string().into_bytes();
    for (head, data, format) in [
        ("name=file\r\nContent-Type: application/x-npy", &array, "npy"),
        ("name=file; filename=a.csv\r\nContent-Type: Application/JSON; charset=utf-8", &file, "json"),
        ("name=data; filename=A.NPY\r\nContent-Type: application/octet-stream", &array, "npy"),
        ("name=data; filename=a.dat\r\nContent-Type: image/x-anything", &array, "npy"),
        ("name=data; filename=\"\"", &file, "json"),
    ] {
        let understood = send(&app, "?dry_run=true", &[(head, data)]).await.expect(200).json();
        assert_eq!(understood["format"], format, "{head}");
    }
    let refused = send(&app, "", &[("name=file; filename=a.rsp", CSV)]).await;
    assert_eq!(refused.json()["code"].as_str().map(|code| code.starts_with("rpc3.")), Some(true));
}

#[tokio::test]
async fn a_form_that_makes_no_sense_is_refused_by_what_is_wrong() {
    let app = TestApp::start();
    app.rig(&bench()).await;
    let file: Part = ("name=file; filename=a.csv", CSV);
    let pointer = |problem: &Value| problem["errors"][0]["pointer"].clone();
    let kind = send(&app, "?kind=noise", &[file, ("name=kind", b"sine")]).await.problem(422, "form.invalid");
    assert_eq!(pointer(&kind), "?kind");
    let two = send(&app, "", &[file, ("name=other; filename=b.csv", CSV)]).await.problem(422, "form.invalid");
    assert_eq!(two["errors"][0]["limit"], "one file");
    send(&app, "", &[("name=kind", b"noise")]).await.problem(422, "form.invalid");
    send(&app, "", &[]).await.problem(422, "form.invalid");
    let unknown =
        send(&app, "", &[file, ("name=knid", b"noise")]).await.problem(422, "query.unknown_parameter");
    assert_eq!(pointer(&unknown), "?knid");
    send(&app, "", &[file, ("name=kind", b"loud")]).await.problem(422, "query.invalid");
    send(&app, "", &[file, ("name=name", b"\xff")]).await.problem(422, "form.invalid");
    let long = format!("name={}", "n".repeat(65));
    send(&app, "", &[file, (&long, b"1")]).await.problem(422, "form.invalid");
    let value = vec![b'x'; (64 << 10) + 1];
    let problem = send(&app, "", &[file, ("name=channels", &value)]).await.problem(422, "form.invalid");
    assert_eq!(
        (pointer(&problem), &problem["errors"][0]["limit"]),
        (json!("?channels"), &json!("at most 65536 bytes"))
    );
    let fields = vec![("name=tag", &b"a"[..]); 101];
    send(&app, "", &fields).await.problem(422, "form.invalid");

    let endless = format!("name=file; {}", "x".repeat(9 << 10));
    send(&app, "", &[(&endless, b"")]).await.problem(400, "form.malformed");
    send(&app, "", &[("filename=a.csv", CSV)]).await.problem(400, "form.malformed");
    let whole = form(&[file]);
    for end in [0, 10, 60, whole.len() - 10, whole.len() - 4] {
        app.post_file(RUNS, TYPE, &whole[..end]).await.problem(400, "form.malformed");
    }
    app.post_file(RUNS, "multipart/form-data", whole.clone()).await.problem(400, "form.malformed");
    app.post_file(RUNS, "multipart/mixed; boundary=----frontier42", whole)
        .await
        .problem(415, "content_type.unsupported");
    assert!(app.files().is_empty(), "{:?}", app.files());
}

#[tokio::test]
async fn limits_digests_and_keys_are_about_the_body_as_it_is_sent() {
    let app = TestApp::start_with(Limits { upload_bytes: 1000, ..Limits::default() });
    app.rig(&bench()).await;
    let body = form(&[("name=file; filename=a.csv", CSV)]);
    let digest = |bytes: &[u8]| {
        let digest = Sha256::digest(bytes);
        format!("sha-256=:{}:", base64::engine::general_purpose::STANDARD.encode(digest))
    };
    let call =
        |digest: &str| app.call("POST", RUNS).header("content-digest", digest).body(TYPE, body.clone());
    call(&digest(CSV)).send().await.problem(400, "digest.mismatch");
    let made = call(&digest(&body)).header("idempotency-key", "once").send().await.expect(201).json();
    let again = call(&digest(&body)).header("idempotency-key", "once").send().await.expect(201).json();
    assert_eq!(made["id"], again["id"]);
    let other = form(&[("name=file; filename=b.csv", CSV)]);
    let reused = app.call("POST", RUNS).header("idempotency-key", "once").body(TYPE, other).send().await;
    reused.problem(422, "idempotency_key.reused");
    let large = vec![b'1'; 1000];
    send(&app, "", &[("name=file; filename=a.csv", &large)]).await.problem(413, "body.too_large");
}
