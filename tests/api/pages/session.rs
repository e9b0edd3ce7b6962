//! Signing in, the session, and its end.

use std::time::Duration;

use serde_json::json;

use super::{BROWSER, browse, page, strict};
use crate::support::{Reply, TestApp, bench};

/// The value of a cookie that an answer sets.
fn cookie(reply: &Reply, name: &str) -> Option<String> {
    let mut set = reply.headers.get_all("set-cookie").iter().map(|value| value.to_str().expect("text"));
    let found = set.find(|value| value.starts_with(&format!("{name}=")))?;
    assert!(found.contains("HttpOnly") && found.contains("SameSite=Strict"), "{found}");
    Some(found.split(';').next().expect("a pair").to_owned())
}

/// The value of the hidden field of a form.
fn csrf(html: &str) -> String {
    let rest = html.split("name=\"csrf\" value=\"").nth(1).expect("a form");
    rest.split('"').next().expect("a value").to_owned()
}

async fn send(app: &TestApp, cookies: &str, path: &str, fields: &[(&str, &str)]) -> Reply {
    let body = fields.iter().fold(String::new(), |body, (name, value)| format!("{body}&{name}={value}"));
    browse(app, "POST", path)
        .header("cookie", cookies)
        .body("application/x-www-form-urlencoded", body.trim_start_matches('&').to_owned())
        .send()
        .await
}

/// Signs in with a token; returns the session's cookie.
async fn sign_in(app: &TestApp, token: &str) -> String {
    let form = page(app, "/sign-in?to=/rigs/bench").await.expect(200);
    strict(&form);
    let cookies = cookie(&form, "rigcast_sign_in").expect("a cookie of the form");
    let fields = [("token", token), ("csrf", &csrf(form.text())), ("to", "/rigs/bench")];
    let reply = send(app, &cookies, "/sign-in", &fields).await.expect(303);
    assert_eq!(reply.header("location"), "/rigs/bench");
    cookie(&reply, "rigcast_session").expect("a session")
}

async fn closed() -> (TestApp, String) {
    let mut app = TestApp::start();
    app.rig(&bench()).await;
    let token = app.close_doors().await["secret"].as_str().expect("a secret").to_owned();
    (app, token)
}

#[tokio::test]
async fn a_browser_without_a_session_is_led_to_the_form_and_back() {
    let (app, token) = closed().await;
    let sent = page(&app, "/rigs/bench?x=%20").await.expect(303);
    assert_eq!(sent.header("location"), "/sign-in?to=%2Frigs%2Fbench%3Fx%3D%2520");
    assert_eq!(app.call_as(None, "GET", "/rigs/bench").send().await.status, 401, "a program is told so");
    let session = sign_in(&app, &token).await;
    let shown = browse(&app, "GET", "/rigs/bench").header("cookie", &session).send().await.expect(200);
    assert!(shown.text().contains("Bench") && shown.text().contains("Sign out"));
    assert!(
        !session.contains(&token) && !shown.text().contains(&token),
        "the secret stays where it was typed"
    );
}

#[tokio::test]
async fn a_refusal_shows_a_person_who_is_signed_in_the_way_on() {
    let (app, _) = closed().await;
    let (secret, _) = app.token(&json!({"role": "reader", "rigs": ["bench"], "name": "Marta"})).await;
    let session = sign_in(&app, &secret).await;
    // Deleted, beyond the token's scope, and beyond its role.
    for (path, status) in [("/rigs/bench/runs/none", 404), ("/rigs/other", 404), ("/tokens", 403)] {
        let reply = browse(&app, "GET", path).header("cookie", &session).send().await.expect(status);
        strict(&reply);
        let text = reply.text();
        assert!(
            text.contains("Marta") && text.contains("Sign out") && text.contains("href=\"/jobs\""),
            "{text}"
        );
    }
}

#[tokio::test]
async fn a_wrong_token_and_a_foreign_form_begin_no_session() {
    let (app, token) = closed().await;
    let form = page(&app, "/sign-in").await.expect(200);
    let cookies = cookie(&form, "rigcast_sign_in").expect("a cookie");
    let good = csrf(form.text());
    for (cookies, fields) in [
        (cookies.as_str(), [("token", "rigcast_wrong"), ("csrf", good.as_str()), ("to", "/")]),
        (cookies.as_str(), [("token", token.as_str()), ("csrf", "x"), ("to", "/")]),
        ("", [("token", token.as_str()), ("csrf", good.as_str()), ("to", "/")]),
    ] {
        let reply = send(&app, cookies, "/sign-in", &fields).await.expect(200);
        assert!(cookie(&reply, "rigcast_session").is_none() && reply.text().contains("role=\"alert\""));
    }
    let away = [("token", token.as_str()), ("csrf", good.as_str()), ("to", "//evil.lab")];
    let reply = send(&app, &cookies, "/sign-in", &away).await.expect(303);
    assert_eq!(reply.header("location"), "/", "nobody is led elsewhere");
}

#[tokio::test]
async fn a_change_under_a_session_needs_its_csrf_token() {
    let (app, token) = closed().await;
    let session = sign_in(&app, &token).await;
    let html = browse(&app, "GET", "/").header("cookie", &session).send().await.expect(200);
    let csrf = csrf(html.text());
    let mut rig = bench();
    rig["id"] = json!("second");
    let make = || app.call_as(None, "POST", "/v1/rigs").header("cookie", &session).json(&rig);
    make().send().await.problem(403, "csrf.invalid");
    make().header("x-csrf-token", "rigcast_x").send().await.problem(403, "csrf.invalid");
    make().header("x-csrf-token", &csrf).send().await.expect(201);
    let read = app.call_as(None, "GET", "/v1/rigs").header("cookie", &session).send().await.expect(200);
    assert_eq!(read.json()["items"].as_array().expect("items").len(), 2, "reading needs none");
    let told = app.call_as(None, "GET", "/session").header("cookie", &session).send().await.expect(200);
    assert_eq!(told.json()["csrf"], csrf);
}

#[tokio::test]
async fn a_session_ends_with_its_token_and_when_it_is_signed_out() {
    let (app, _) = closed().await;
    let (secret, id) = app.token(&json!({"role": "operator", "rigs": ["bench"]})).await;
    let session = sign_in(&app, &secret).await;
    let look = |session: String| {
        let call = browse(&app, "GET", "/rigs/bench").header("cookie", &session);
        async move { call.send().await }
    };
    let html = look(session.clone()).await.expect(200);
    let refused = send(&app, &session, "/sign-out", &[("csrf", "x")]).await.expect(403);
    assert!(refused.text().contains("csrf.invalid"));
    let out = send(&app, &session, "/sign-out", &[("csrf", &csrf(html.text()))]).await.expect(303);
    assert_eq!(cookie(&out, "rigcast_session").as_deref(), Some("rigcast_session="));
    look(session).await.expect(303);

    let session = sign_in(&app, &secret).await;
    look(session.clone()).await.expect(200);
    app.delete(&format!("/v1/tokens/{id}")).await.expect(204);
    look(session).await.expect(303);

    let soon = jiff::Timestamp::now() + Duration::from_secs(2);
    let (short, _) = app.token(&json!({"role": "reader", "expires_at": soon})).await;
    let session = sign_in(&app, &short).await;
    look(session.clone()).await.expect(200);
    tokio::time::sleep(Duration::from_millis(2100)).await;
    look(session).await.expect(303);
}

#[tokio::test]
async fn a_session_sees_and_does_what_its_token_may() {
    let (app, _) = closed().await;
    let mut other = bench();
    other["id"] = json!("other");
    app.rig(&other).await;
    let (reader, _) = app.token(&json!({"role": "reader", "rigs": ["bench"]})).await;
    let session = sign_in(&app, &reader).await;
    let html = browse(&app, "GET", "/").header("cookie", &session).send().await.expect(200);
    assert!(html.text().contains("/rigs/bench") && !html.text().contains("/rigs/other"));
    for (path, status) in
        [("/rigs/other", 404), ("/rigs/bench/upload", 403), ("/tokens", 403), ("/operations", 200)]
    {
        let reply =
            app.call_as(None, "GET", path).header("cookie", &session).header("accept", BROWSER).send().await;
        assert_eq!(reply.status, status, "{path}");
    }
}
