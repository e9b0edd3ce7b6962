//! Tokens as a resource: made, listed, revoked, and the effect on requests under way.

use std::time::{Duration, Instant};

use futures::StreamExt;
use serde_json::{Value, json};

use crate::support::{TestApp, bench, exchange, noise_csv};

#[tokio::test]
async fn a_secret_is_shown_once_and_the_list_shows_the_rest() {
    let mut app = TestApp::start();
    let admin = app.close_doors().await;
    let wanted = json!({"name": "line\n\"one\"", "role": "operator", "rigs": ["b", "a"], "expires_at": "2100-01-01T00:00:00Z"});
    let token = app.post_json("/v1/tokens", &wanted).await.expect(201).json();
    assert_eq!((&token["name"], &token["role"]), (&wanted["name"], &wanted["role"]));
    assert_eq!((&token["rigs"], &token["expires_at"]), (&json!(["a", "b"]), &wanted["expires_at"]));
    let secret = token["secret"].as_str().expect("a secret");
    assert!(secret.starts_with("rigcast_") && secret.len() == 51, "{secret}");
    let list = app.get("/v1/tokens").await.expect(200);
    assert!(!list.text().contains("secret"), "{}", list.text());
    let without = |token: &Value| {
        let mut token = token.clone();
        token.as_object_mut().expect("an object").remove("secret");
        token
    };
    assert_eq!(list.json(), json!({"items": [without(&admin), without(&token)], "next": null}));
    let first = app.get("/v1/tokens?limit=1").await.expect(200).json();
    assert_eq!(first["items"], json!([without(&admin)]));
    let next = first["next"].as_str().expect("a cursor");
    let second = app.get(&format!("/v1/tokens?cursor={next}")).await.expect(200).json();
    assert_eq!(second, json!({"items": [without(&token)], "next": null}));
}

#[tokio::test]
async fn the_first_token_must_be_an_admins_for_all_rigs() {
    let mut app = TestApp::start();
    for draft in
        [json!({"role": "reader"}), json!({"role": "operator"}), json!({"role": "admin", "rigs": ["a"]})]
    {
        app.post_json("/v1/tokens", &draft).await.problem(409, "token.first_admin");
    }
    app.get("/v1/rigs").await.expect(200);
    app.close_doors().await;
    let refused = app.call_as(None, "GET", "/v1/rigs").send().await;
    assert_eq!(refused.header("www-authenticate"), "Bearer realm=\"rigcast\"");
    refused.problem(401, "token.missing");
}

#[tokio::test]
async fn drafts_that_make_no_sense_are_refused_with_the_field() {
    let app = TestApp::start();
    for (draft, code, pointer) in [
        (json!({}), "body.missing_field", "/role"),
        (json!({"role": "root"}), "body.invalid_value", "/role"),
        (json!({"role": "admin", "rigs": []}), "body.invalid_value", "/rigs"),
        (json!({"role": "admin", "rigs": ["../a"]}), "body.invalid_value", "/rigs/0"),
        (json!({"role": "admin", "name": "x".repeat(1001)}), "body.invalid_value", "/name"),
        (json!({"role": "admin", "expires_at": "2001-01-01T00:00:00Z"}), "body.invalid_value", "/expires_at"),
        (json!({"role": "admin", "expires_at": "tomorrow"}), "body.invalid_value", "/expires_at"),
        (json!({"role": "admin", "secret": "mine"}), "body.unknown_field", "/secret"),
    ] {
        let problem = app.post_json("/v1/tokens", &draft).await.problem(422, code);
        assert_eq!(problem["errors"][0]["pointer"], pointer, "{problem}");
    }
    app.get("/v1/rigs").await.expect(200);
}

#[tokio::test]
async fn a_revoked_token_opens_nothing_a_second_later_and_its_stream_ends() {
    let mut app = TestApp::start();
    app.rig(&bench()).await;
    app.run("kind=noise", &noise_csv(6000, 11)).await;
    let endless = json!({"kind": "lstm", "lstm": {"blocks": [39], "epochs": 1000000, "seeds": [1]}});
    let job = app.post_json("/v1/rigs/bench/fits", &endless).await.expect(202).json();
    let job = job["id"].as_str().expect("an id").to_owned();
    let events = format!("http://{}/v1/jobs/{job}/events", app.address());
    let follow = async |secret: &str| {
        let request = reqwest::Client::new().get(&events);
        let request = if secret.is_empty() { request } else { request.bearer_auth(secret) };
        let stream = request.send().await.expect("an answer");
        assert_eq!(stream.status(), 200);
        let mut stream = stream.bytes_stream();
        stream.next().await.expect("the present state").expect("text");
        stream
    };
    let mut open = follow("").await;
    app.close_doors().await;
    let closed = Instant::now();
    let ended = tokio::time::timeout(Duration::from_secs(5), async { while open.next().await.is_some() {} });
    ended.await.expect("a stream from before the first token ends");
    println!("a stream without a token ended {:?} after the first token", closed.elapsed());
    let (secret, id) = app.token(&json!({"role": "reader"})).await;
    let mut stream = follow(&secret).await;

    app.call_as(Some(&secret), "GET", "/v1/rigs").send().await.expect(200);
    app.delete(&format!("/v1/tokens/{id}")).await.expect(204);
    let revoked = Instant::now();
    app.call_as(Some(&secret), "GET", "/v1/rigs").send().await.problem(401, "token.invalid");
    println!("refused {:?} after the revocation", revoked.elapsed());
    let ended =
        tokio::time::timeout(Duration::from_secs(5), async { while stream.next().await.is_some() {} });
    ended.await.expect("the stream ends");
    println!("its stream of events ended after {:?}", revoked.elapsed());

    app.delete(&format!("/v1/tokens/{id}")).await.problem(404, "token.not_found");
    app.post(&format!("/v1/jobs/{job}/cancel")).await.expect(202);
    app.finished(&job).await;
}

#[tokio::test]
async fn a_token_that_has_expired_is_as_good_as_none() {
    let mut app = TestApp::start();
    app.close_doors().await;
    let soon = jiff::Timestamp::now() + Duration::from_millis(700);
    let (secret, _) = app.token(&json!({"role": "reader", "expires_at": soon})).await;
    app.call_as(Some(&secret), "GET", "/v1/rigs").send().await.expect(200);
    tokio::time::sleep(Duration::from_millis(800)).await;
    let refused = app.call_as(Some(&secret), "GET", "/v1/rigs").send().await;
    assert!(refused.header("www-authenticate").contains("invalid_token"));
    refused.problem(401, "token.invalid");
}

#[tokio::test]
async fn the_token_is_asked_for_before_anything_of_the_body() {
    let mut app = TestApp::start();
    app.close_doors().await;
    for head in [
        "POST /v1/rigs HTTP/1.1\r\nhost: x\r\ncontent-type: application/json\r\ncontent-length: 9000000000\r\n\r\n",
        "POST /v1/rigs/b/runs HTTP/1.1\r\nhost: x\r\ncontent-type: text/csv\r\ncontent-encoding: gzip\r\ncontent-length: 9\r\n\r\n",
        "POST /v1/rigs/b/models HTTP/1.1\r\nhost: x\r\ntransfer-encoding: chunked\r\n\r\n",
        "POST /v1/rigs HTTP/1.1\r\nhost: x\r\nauthorization: Bearer x\r\ncontent-length: 9000000000\r\n\r\n",
    ] {
        let started = Instant::now();
        let answer = exchange(app.address(), head.as_bytes());
        assert!(answer.starts_with("HTTP/1.1 401"), "{answer}");
        assert!(started.elapsed() < Duration::from_secs(5), "nobody waited for the body");
    }
    assert_eq!(app.files(), Vec::<std::path::PathBuf>::new());
}
