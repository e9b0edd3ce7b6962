//! Refusals that any operation may give: routes, methods, bodies, queries, ids.

use rigcast::http::Limits;
use serde_json::json;

use crate::support::{Contract, TestApp, bench, exchange};

#[tokio::test]
async fn the_frameworks_own_refusals_are_problem_documents_too() {
    let app = TestApp::start();
    app.get("/v1/nothing").await.problem(404, "route.not_found");
    app.get("/v1/rigs/").await.problem(404, "route.not_found");
    let reply = app.call("PUT", "/v1/rigs").send().await;
    assert!(reply.header("allow").contains("POST"), "{:?}", reply.headers);
    reply.problem(405, "method.not_allowed");
    app.call("POST", "/v1/rigs").send().await.problem(415, "content_type.unsupported");
    app.call("POST", "/v1/rigs")
        .body("text/plain", "{}")
        .send()
        .await
        .problem(415, "content_type.unsupported");
    let gzip = app.call("POST", "/v1/rigs").header("content-encoding", "gzip").json(&json!({}));
    gzip.send().await.problem(415, "content_encoding.unsupported");
}

#[tokio::test]
async fn a_request_whose_head_cannot_be_read_gets_a_problem_document_too() {
    let app = TestApp::start();
    let long = |n: usize| "x".repeat(n);
    let many: String = (0..200).map(|i| format!("x-{i}: 1\r\n")).collect();
    for (request, status, code) in [
        ("nonsense\r\n\r\n".to_owned(), 400, "request.malformed"),
        ("GET / HTTP/1.1\r\nno colon\r\n\r\n".into(), 400, "request.malformed"),
        ("GET / HTTP/1.1\r\nhost: x\r\nbad\u{0}name: x\r\n\r\n".into(), 400, "request.malformed"),
        ("GET /\u{7f} HTTP/1.1\r\nhost: x\r\n\r\n".into(), 400, "request.malformed"),
        ("GET / HTTP/9.9\r\nhost: x\r\n\r\n".into(), 400, "request.malformed"),
        (format!("GET /{} HTTP/1.1\r\nhost: x\r\n\r\n", long(100_000)), 414, "request.uri_too_long"),
        (format!("GET / HTTP/1.1\r\nhost: x\r\n{many}\r\n"), 431, "request.head_too_large"),
        (format!("GET / HTTP/1.1\r\nhost: x\r\nx: {}", long(418_000)), 431, "request.head_too_large"),
        (
            "POST /v1/rigs HTTP/1.1\r\nhost: x\r\ncontent-length: 1\r\ncontent-length: 2\r\n\r\n".into(),
            400,
            "request.malformed",
        ),
        (
            "POST /v1/rigs HTTP/1.1\r\nhost: x\r\ntransfer-encoding: gzip\r\n\r\n".into(),
            400,
            "request.malformed",
        ),
    ] {
        let answer = exchange(app.address(), request.as_bytes());
        let start = &request[..request.len().min(80)];
        let (head, body) = answer.split_once("\r\n\r\n").unwrap_or_else(|| panic!("{start:?}: {answer:?}"));
        assert!(head.starts_with(&format!("HTTP/1.1 {status} ")), "{start:?}: {head}");
        for field in
            ["content-type: application/problem+json", "cache-control: no-store", "connection: close"]
        {
            assert!(head.contains(field), "{start:?}: {head}");
        }
        let problem: serde_json::Value =
            serde_json::from_str(body).unwrap_or_else(|e| panic!("{start:?}: {e}: {body}"));
        assert_eq!((&problem["code"], &problem["status"]), (&json!(code), &json!(status)), "{start:?}");
        assert!(head.contains(&format!("x-request-id: {}", problem["request_id"].as_str().expect("an id"))));
        Contract::get().validate(start, "/components/schemas/Problem", &problem);
    }
}

#[tokio::test]
async fn a_client_may_choose_the_request_id_and_gets_a_new_one_otherwise() {
    let app = TestApp::start();
    let own = app.call("GET", "/v1/rigs/none").header("x-request-id", "batch-7.3").send().await;
    assert_eq!(own.problem(404, "rig.not_found")["request_id"], "batch-7.3");
    let odd = app.call("GET", "/livez").header("x-request-id", "a b<c>").send().await.expect(200);
    let id: uuid::Uuid = odd.header("x-request-id").parse().expect("a UUID");
    assert_eq!(id.get_version_num(), 7);
    let next = app.get("/livez").await;
    assert_ne!(next.header("x-request-id"), odd.header("x-request-id"));
}

#[tokio::test]
async fn unknown_and_senseless_query_parameters_are_named() {
    let app = TestApp::start();
    let problem = app.get("/v1/rigs?limt=3").await.problem(422, "query.unknown_parameter");
    assert_eq!(problem["errors"][0]["pointer"], "?limt");
    for query in ["limit=0", "limit=1001", "limit=ten", "limit=1&limit=2", "cursor=a'b"] {
        app.get(&format!("/v1/rigs?{query}")).await.problem(422, "query.invalid");
    }
    for path in ["/livez?x", "/metrics?x=1", "/docs?x", "/openapi.yaml?x", "/v1/jobs?rigs=bench"] {
        app.get(path).await.problem(422, "query.unknown_parameter");
    }
    for path in ["/v1/jobs?state=done", "/v1/jobs?kind=fits", "/v1/jobs?rig=No", "/readyz?verbose=perhaps"] {
        app.get(path).await.problem(422, "query.invalid");
    }
}

#[tokio::test]
async fn json_that_is_none_is_told_from_json_that_says_something_else() {
    let app = TestApp::start();
    let post = |text: &str| app.call("POST", "/v1/rigs").body("application/json", text.to_owned()).send();
    let problem = post("{\"id\": \"a\",\n x").await.problem(400, "body.syntax");
    assert_eq!(problem["errors"][0]["row"], 2);
    post("{\"sample_rate_hz\": NaN}").await.problem(400, "body.syntax");
    post("{\"sample_rate_hz\": 1e400}").await.problem(400, "body.syntax");
    post(&"[".repeat(1000)).await.problem(400, "body.too_deep");
    post("[]").await.problem(422, "body.invalid_value");
    let mut rig = bench();
    rig["color"] = json!("red");
    let problem = app.post_json("/v1/rigs", &rig).await.problem(422, "body.unknown_field");
    assert_eq!(problem["errors"][0]["pointer"], "/color");
    let mut rig = bench();
    rig["channels"][1]["units"] = json!("mm");
    let problem = app.post_json("/v1/rigs", &rig).await.problem(422, "body.unknown_field");
    assert_eq!(problem["errors"][0]["pointer"], "/channels/1/units");
    let mut rig = bench();
    rig["channels"][1]["role"] = json!("sensor");
    let problem = app.post_json("/v1/rigs", &rig).await.problem(422, "body.invalid_value");
    assert_eq!(problem["errors"][0]["pointer"], "/channels/1/role");
    let problem = app.post_json("/v1/rigs", &json!({"id": "a"})).await.problem(422, "body.missing_field");
    assert_eq!(problem["errors"][0]["pointer"], "/sample_rate_hz");
    let rigs = app.get("/v1/rigs").await.expect(200).json();
    assert_eq!(rigs["items"], json!([]), "nothing was stored");
}

#[tokio::test]
async fn a_json_body_over_the_limit_is_refused_by_its_length_and_while_it_comes() {
    let app = TestApp::start_with(Limits { json_bytes: 1000, ..Limits::default() });
    let head = "POST /v1/rigs HTTP/1.1\r\nhost: localhost\r\ncontent-type: application/json\r\n";
    let declared = format!("{head}content-length: 1001\r\n\r\n");
    let answer = exchange(app.address(), declared.as_bytes());
    assert!(answer.starts_with("HTTP/1.1 413"), "refused before a byte of it came: {answer}");
    assert!(answer.contains("body.too_large") && answer.contains("1000 bytes"), "{answer}");
    // Where nothing can be a signal a megabyte is the most, whatever signals may have.
    let plain = TestApp::start();
    let answer = exchange(plain.address(), format!("{head}content-length: 1048577\r\n\r\n").as_bytes());
    assert!(answer.contains("body.too_large") && answer.contains("1048576 bytes"), "{answer}");
    let chunk = format!("3e9\r\n{}\r\n0\r\n\r\n", " ".repeat(1001));
    let answer =
        exchange(app.address(), format!("{head}transfer-encoding: chunked\r\n\r\n{chunk}").as_bytes());
    assert!(answer.starts_with("HTTP/1.1 413") && answer.contains("body.too_large"), "{answer}");
}

#[tokio::test]
async fn ids_that_cannot_be_ids_are_not_found_like_any_other() {
    let app = TestApp::start();
    app.rig(&bench()).await;
    for rig in ["none", "NONE", "a%20b", "%FF", "..%2f..%2fetc"] {
        app.get(&format!("/v1/rigs/{rig}")).await.expect(404);
    }
    app.get("/v1/rigs/bench/runs/7").await.problem(404, "run.not_found");
    app.get("/v1/rigs/bench/runs/0197f1a0-0000-7000-8000-000000000000").await.problem(404, "run.not_found");
    for version in ["1", "0", "-1", "x", "4294967296"] {
        app.get(&format!("/v1/rigs/bench/models/{version}")).await.problem(404, "model.not_found");
    }
    app.get("/v1/jobs/x").await.problem(404, "job.not_found");
    app.get("/v1/jobs/0197f1a0-0000-7000-8000-000000000000/events").await.problem(404, "job.not_found");
    for path in ["runs", "models", "active-model"] {
        app.get(&format!("/v1/rigs/none/{path}")).await.problem(404, "rig.not_found");
    }
}
