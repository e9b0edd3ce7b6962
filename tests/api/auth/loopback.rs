//! The service before its first token: open to this machine only.

use serde_json::json;

use crate::support::{TestApp, bench, exchange};

#[tokio::test]
async fn without_tokens_only_a_loopback_host_comes_in() {
    let app = TestApp::start();
    let port = app.address().port();
    for host in ["127.0.0.1", "localhost", "LOCALHOST", "[::1]", &format!("localhost:{port}"), "[::1]:1"] {
        app.call("GET", "/v1/rigs").header("host", host).send().await.expect(200);
    }
    for host in ["rigcast.lab", "localhost.lab", "127.0.0.1.lab", "192.168.0.7", "0.0.0.0", "[::]"] {
        for (method, path) in [("GET", "/v1/rigs"), ("GET", "/metrics"), ("POST", "/v1/tokens")] {
            let reply = app.call(method, path).header("host", host).send().await;
            assert!(!String::from_utf8_lossy(&reply.bytes).contains(host), "Host is not repeated");
            reply.problem(403, "host.foreign");
        }
        app.call("GET", "/livez").header("host", host).send().await.expect(200);
    }
    for request in
        ["GET /v1/rigs HTTP/1.0\r\n\r\n", "GET http://lab/v1/rigs HTTP/1.1\r\nhost: localhost\r\n\r\n"]
    {
        let answer = exchange(app.address(), request.as_bytes());
        assert!(answer.contains(" 403 Forbidden"), "{answer}");
        assert!(answer.contains("host.foreign"), "{answer}");
    }
}

#[tokio::test]
async fn without_tokens_pages_of_other_origins_change_nothing() {
    let app = TestApp::start();
    let own = format!("http://{}", app.address());
    for origin in ["http://evil.lab", "null", "http://localhost:3000", "http://127.0.0.1"] {
        let call = app.call("POST", "/v1/rigs").header("origin", origin).json(&bench());
        call.send().await.problem(403, "origin.foreign");
        let call = app.call("DELETE", "/v1/rigs/bench").header("origin", origin);
        call.send().await.problem(403, "origin.foreign");
        let read = app.call("GET", "/v1/rigs").header("origin", origin).send().await.expect(200);
        assert_eq!(read.json()["items"], json!([]), "nothing was made");
        assert!(!read.headers.contains_key("access-control-allow-origin"));
    }
    app.call("POST", "/v1/rigs").header("origin", &own).json(&bench()).send().await.expect(201);
}

#[tokio::test]
async fn with_tokens_hosts_and_origins_are_as_good_as_the_token() {
    let mut app = TestApp::start();
    app.close_doors().await;
    let call =
        app.call("POST", "/v1/rigs").header("host", "rigcast.lab").header("origin", "https://elsewhere.lab");
    call.json(&bench()).send().await.expect(201);
    app.call_as(None, "GET", "/v1/rigs").send().await.problem(401, "token.missing");
}

#[tokio::test]
async fn without_tokens_one_that_is_shown_is_refused_all_the_same() {
    let app = TestApp::start();
    app.call_as(Some("rigcast_none"), "GET", "/v1/rigs").send().await.problem(401, "token.invalid");
    app.call_as(Some("rigcast_none"), "GET", "/livez").send().await.expect(200);
}
