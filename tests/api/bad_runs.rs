//! Refused files: each gets its code and the place of the error, and nothing of it is stored.

use rigcast::http::Limits;
use serde_json::{Value, json};

use crate::support::{Reply, TestApp, bench, exchange, f8, noise_csv, npy};

/// The bench, and the check that nothing came of a refused upload.
struct Bench(TestApp);

impl Bench {
    async fn new() -> Self {
        let app = TestApp::start();
        app.rig(&bench()).await;
        Self(app)
    }

    async fn refused(
        &self,
        query: &str,
        media_type: &str,
        file: impl Into<Vec<u8>>,
        status: u16,
        code: &str,
    ) -> Value {
        let path = format!("/v1/rigs/bench/runs?{query}");
        let reply: Reply = self.0.post_file(&path, media_type, file).await;
        let problem = reply.problem(status, code);
        assert_eq!((self.0.runs().await, self.0.files().len()), (0, 0), "{code}: something was stored");
        problem["errors"][0].clone()
    }

    async fn csv(&self, text: &str, status: u16, code: &str) -> Value {
        self.refused("kind=noise", "text/csv", text, status, code).await
    }

    async fn npy(&self, file: Vec<u8>, status: u16, code: &str) -> Value {
        self.refused("kind=noise", "application/x-npy", file, status, code).await
    }
}

#[tokio::test]
async fn an_unknown_channel_is_named() {
    let bench = Bench::new().await;
    assert_eq!(bench.csv("u,force\n1,2\n", 422, "run.unknown_channel").await["channel"], "force");
    let file = json!({"sample_rate_hz": 100.0, "channels": {"q": [1.0]}}).to_string();
    let place = bench.refused("", "application/json", file, 422, "run.unknown_channel").await;
    assert_eq!(place["channel"], "q");
    let one = npy("<f8", false, "(1, 1)", &f8(&[1.0]));
    let place = bench.refused("channels=w", "application/x-npy", one, 422, "run.unknown_channel").await;
    assert_eq!(place["channel"], "w");
}

#[tokio::test]
async fn unequal_lengths_and_ragged_rows_are_named() {
    let bench = Bench::new().await;
    let file = json!({"sample_rate_hz": 100.0, "channels": {"u": [1.0, 2.0], "y": [1.0]}}).to_string();
    let place = bench.refused("", "application/json", file, 422, "run.unequal_lengths").await;
    assert_eq!((&place["channel"], &place["limit"]), (&json!("y"), &json!("2 samples")));
    assert_eq!(bench.csv("u,y\n1,2\n3\n", 422, "csv.ragged_row").await["row"], 3);
}

#[tokio::test]
async fn an_empty_file_is_refused() {
    let bench = Bench::new().await;
    bench.csv("", 422, "run.empty").await;
    bench.csv("u,y\n", 422, "run.empty").await;
    bench.npy(npy("<f8", false, "(0, 2)", &[]), 422, "run.empty").await;
    bench.npy(Vec::new(), 400, "npy.header").await;
}

#[tokio::test]
async fn a_cell_that_is_no_number_is_named_by_row_and_column() {
    let bench = Bench::new().await;
    let place = bench.csv("u,y\n1,2\n3,four\n", 422, "csv.not_a_number").await;
    assert_eq!((&place["row"], &place["column"], &place["channel"]), (&json!(3), &json!(2), &json!("y")));
}

#[tokio::test]
async fn nan_and_infinity_are_named_by_channel_and_sample() {
    let bench = Bench::new().await;
    for text in ["nan", "inf", "-Infinity", "1e999"] {
        let place = bench.csv(&format!("u,y\n1,2\n3,{text}\n"), 422, "run.non_finite").await;
        assert_eq!((&place["channel"], &place["sample"]), (&json!("y"), &json!(1)), "{text}");
    }
    let file = npy("<f8", false, "(2, 2)", &f8(&[1.0, 2.0, f64::NAN, 4.0]));
    let place = bench.npy(file, 422, "run.non_finite").await;
    assert_eq!((&place["channel"], &place["sample"]), (&json!("u"), &json!(1)));
}

#[tokio::test]
async fn another_sample_rate_and_an_uneven_time_column_are_refused() {
    let bench = Bench::new().await;
    let place = bench.csv("time_s,u\n0,1\n0.02,2\n0.04,3\n", 422, "run.sample_rate").await;
    assert_eq!(place["limit"], "100 Hz");
    assert_eq!(bench.csv("time_s,u\n0,1\n0.01,2\n0.03,3\n0.04,4\n", 422, "csv.uneven_time").await["row"], 4);
    let file = json!({"sample_rate_hz": 101.0, "channels": {"u": [1.0]}}).to_string();
    bench.refused("", "application/json", file, 422, "run.sample_rate").await;
    bench.refused("sample_rate_hz=200", "text/csv", "u\n1\n", 422, "run.sample_rate").await;
    for rate in ["0", "-1", "nan"] {
        bench.refused(&format!("sample_rate_hz={rate}"), "text/csv", "u\n1\n", 422, "query.invalid").await;
    }
}

#[tokio::test]
async fn a_unit_of_another_quantity_is_refused() {
    let bench = Bench::new().await;
    let place = bench.csv("u,y\nV,mm\n1,2\n", 422, "run.invalid").await;
    assert_eq!((&place["channel"], &place["pointer"]), (&json!("u"), &json!("/units/0")));
}

#[tokio::test]
async fn npy_headers_are_held_against_dtype_shape_and_bytes() {
    let bench = Bench::new().await;
    bench.npy(npy("|O", false, "(1, 2)", &[0; 16]), 422, "npy.dtype").await;
    bench.npy(npy("<c16", false, "(1, 2)", &[0; 32]), 422, "npy.dtype").await;
    bench.npy(npy("<f8", false, "(1, 2, 1)", &f8(&[1.0, 2.0])), 422, "npy.shape").await;
    let place =
        bench.npy(npy("<f8", false, "(1000000000000, 2)", &f8(&[1.0, 2.0])), 400, "npy.truncated").await;
    assert_eq!(place["limit"], "16000000000000 bytes of data");
    bench.npy(npy("<f8", false, "(1, 2)", &f8(&[1.0, 2.0, 3.0])), 400, "npy.trailing_bytes").await;
    bench.npy(b"PK\x03\x04 not an array".to_vec(), 400, "npy.header").await;
    let place = bench.npy(npy("<f8", false, "(1, 3)", &f8(&[1.0, 2.0, 3.0])), 422, "run.channel_count").await;
    assert_eq!(place["limit"], "2 columns: u, y");
}

#[tokio::test]
async fn a_body_that_is_shorter_than_declared_stores_nothing() {
    let bench = Bench::new().await;
    let head = "POST /v1/rigs/bench/runs HTTP/1.1\r\nhost: localhost\r\ncontent-type: text/csv\r\n";
    let answer =
        exchange(bench.0.address(), format!("{head}content-length: 1000\r\n\r\nu,y\n1,2\n").as_bytes());
    assert!(answer.starts_with("HTTP/1.1 400"), "{answer}");
    assert!(answer.contains("body.incomplete") && answer.contains("application/problem+json"), "{answer}");
    let answer =
        exchange(bench.0.address(), format!("{head}transfer-encoding: chunked\r\n\r\n4\r\nu,y\n").as_bytes());
    assert!(answer.starts_with("HTTP/1.1 400") && answer.contains("body.incomplete"), "{answer}");
    assert_eq!((bench.0.runs().await, bench.0.files().len()), (0, 0));
}

#[tokio::test]
async fn an_upload_over_the_limit_is_refused_by_its_length_and_while_it_comes() {
    let app = TestApp::start_with(Limits { upload_bytes: 500, ..Limits::default() });
    app.rig(&bench()).await;
    let head = "POST /v1/rigs/bench/runs HTTP/1.1\r\nhost: localhost\r\ncontent-type: text/csv\r\n";
    let answer = exchange(app.address(), format!("{head}content-length: 501\r\n\r\n").as_bytes());
    assert!(answer.starts_with("HTTP/1.1 413") && answer.contains("500 bytes"), "{answer}");
    let chunk = format!("1f5\r\n{}\r\n0\r\n\r\n", "1".repeat(501));
    let answer =
        exchange(app.address(), format!("{head}transfer-encoding: chunked\r\n\r\n{chunk}").as_bytes());
    assert!(answer.starts_with("HTTP/1.1 413") && answer.contains("body.too_large"), "{answer}");
    assert_eq!((app.runs().await, app.files().len()), (0, 0));
    app.run("kind=noise", &noise_csv(5, 1)).await;
}

#[tokio::test]
async fn json_files_refuse_unknown_and_repeated_fields() {
    let bench = Bench::new().await;
    let json =
        async |text: &str, status, code| bench.refused("", "application/json", text, status, code).await;
    json(r#"{"sample_rate_hz": 100, "channels": {"u": [1]}, "unit": "kN"}"#, 422, "json.unknown_field").await;
    json(r#"{"sample_rate_hz": 100, "channels": {"u": [1], "u": [2]}}"#, 422, "run.duplicate_channel").await;
    json(r#"{"channels": {"u": [1]}}"#, 422, "json.missing_field").await;
    let place =
        json(r#"{"sample_rate_hz": 100, "channels": {"u": [1, null]}}"#, 422, "json.not_a_number").await;
    assert_eq!((&place["channel"], &place["sample"]), (&json!("u"), &json!(1)));
    json(r#"{"sample_rate_hz": 100"#, 400, "json.invalid").await;
}

#[tokio::test]
async fn senseless_queries_and_types_are_refused_before_the_body_is_read() {
    let bench = Bench::new().await;
    for query in
        ["kind=nose", "split=train", "started_at=yesterday", "resample=maybe", "tag=", "kind=noise&kind=sine"]
    {
        bench.refused(query, "text/csv", "u\n1\n", 422, "query.invalid").await;
    }
    bench.refused("colour=red", "text/csv", "u\n1\n", 422, "query.unknown_parameter").await;
    bench.refused("channels=u", "text/csv", "u\n1\n", 422, "query.invalid").await;
    bench.refused("", "application/zip", "PK", 415, "content_type.unsupported").await;
    let lost = bench.0.post_file("/v1/rigs/none/runs", "text/csv", "u\n1\n").await;
    lost.problem(404, "rig.not_found");
}
