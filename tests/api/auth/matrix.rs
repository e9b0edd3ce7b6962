//! Every operation of the table with every kind of caller.

use std::time::Duration;

use rigcast::domain::TokenRole::{self, Admin, Operator, Reader};
use rigcast::http::Right;
use rigcast::http::routes::{ROUTES, Route};
use serde_json::{Value, json};

use super::outcome;
use crate::support::{Reply, TestApp, bench, noise_csv};

const UNKNOWN: &str = "0197f1a0-0000-7000-8000-000000000000";

/// A kind of caller.
struct Caller {
    name: String,
    secret: Option<String>,
    /// Role, and whether it is for all rigs, for the bench, or for another; `None`: not in force.
    token: Option<(TokenRole, Scope)>,
}

#[derive(Debug, Clone, Copy, PartialEq)]
enum Scope {
    All,
    Own,
    Other,
}

/// Path of a route, with the bench as its rig; the route that deletes a rig gets a rig of its own.
fn path(route: &Route, job: &str) -> String {
    let rig =
        if (route.method.as_str(), route.path) == ("DELETE", "/v1/rigs/{rig}") { "doomed" } else { "bench" };
    let filled = route.path.replace("{rig}", rig).replace("{job}", job).replace("{version}", "9");
    let filled = ["{run}", "{diagnosis}", "{iteration}", "{evaluation}", "{study}", "{token}"]
        .iter()
        .fold(filled, |path, name| path.replace(name, UNKNOWN));
    filled.replace("{asset}", "swagger-ui.css").replace("{digest}", "0").replace("{file}", "style.css")
}

/// Sends the request of this test to an operation: harmless, and the same for every caller.
async fn send(app: &TestApp, secret: Option<&str>, route: &Route, job: &str) -> Reply {
    let call = app.call_as(secret, route.method.as_str(), &path(route, job));
    match (route.method.as_str(), route.path) {
        ("POST", "/v1/rigs") => call.json(&bench()).send().await,
        ("POST" | "PUT" | "PATCH", path) if !path.ends_with("/cancel") => call.json(&json!({})).send().await,
        _ => call.send().await,
    }
}

/// The answer that the table requires; `None`: that of the handler, as on an open service.
fn expected(right: Right, path: &str, caller: &Caller) -> Option<(u16, &'static str)> {
    let (Right::Role(needed) | Right::AllRigs(needed)) = right else { return None };
    let Some((role, scope)) = caller.token else {
        return Some(if caller.secret.is_none() { (401, "token.missing") } else { (401, "token.invalid") });
    };
    if role < needed {
        return Some((403, "token.role"));
    }
    match scope {
        Scope::All => None,
        Scope::Own | Scope::Other if matches!(right, Right::AllRigs(_)) => Some((403, "token.scope")),
        Scope::Own => None,
        Scope::Other if path.contains("{rig}") => Some((404, "rig.not_found")),
        Scope::Other if path.contains("{job}") => Some((404, "job.not_found")),
        Scope::Other if path == "/v1/rigs" && needed > Reader => Some((403, "token.scope")),
        Scope::Other => None,
    }
}

async fn callers(app: &TestApp) -> Vec<Caller> {
    let soon = jiff::Timestamp::now() + Duration::from_millis(300);
    let (expired, _) = app.token(&json!({"role": "admin", "expires_at": soon})).await;
    let (revoked, id) = app.token(&json!({"role": "admin"})).await;
    app.delete(&format!("/v1/tokens/{id}")).await.expect(204);
    let garbage = format!("rigcast_{}", "A".repeat(43));
    let mut callers = vec![Caller { name: "none".into(), secret: None, token: None }];
    for (name, secret) in [("garbage", garbage), ("revoked", revoked), ("expired", expired)] {
        callers.push(Caller { name: name.into(), secret: Some(secret), token: None });
    }
    for role in [Reader, Operator, Admin] {
        for (scope, rigs) in [
            (Scope::All, Value::Null),
            (Scope::Own, json!(["bench", "doomed"])),
            (Scope::Other, json!(["other"])),
        ] {
            let (secret, _) = app.token(&json!({"role": role.as_str(), "rigs": rigs})).await;
            let name = format!("{} of {scope:?}", role.as_str());
            callers.push(Caller { name, secret: Some(secret), token: Some((role, scope)) });
        }
    }
    tokio::time::sleep(Duration::from_millis(400)).await;
    callers
}

#[tokio::test]
async fn every_operation_answers_every_caller_as_the_table_of_rights_says() {
    let mut app = TestApp::start();
    app.rig(&bench()).await;
    app.run("kind=noise", &noise_csv(3000, 7)).await;
    let job = app.post_json("/v1/rigs/bench/fits", &json!({"kind": "frf"})).await.expect(202).json();
    let job = job["id"].as_str().expect("an id").to_owned();
    app.finished(&job).await;

    let mut doomed = bench();
    doomed["id"] = json!("doomed");
    let mut open = Vec::new();
    app.rig(&doomed).await;
    for route in ROUTES {
        let reply = outcome(&send(&app, None, route, &job).await);
        assert!(
            ![401, 403].contains(&reply.0) && reply.1 != "rig.not_found",
            "{} is open: {reply:?}",
            route.path
        );
        open.push(reply);
    }
    app.close_doors().await;

    let callers = callers(&app).await;
    let (mut cases, mut wrong) = (0, Vec::new());
    for (route, open) in ROUTES.iter().zip(&open) {
        for caller in &callers {
            if path(route, &job).ends_with("/doomed") {
                let made = app.post_json("/v1/rigs", &doomed).await.status;
                assert!([201, 409].contains(&made));
            }
            let wanted =
                expected(route.right, route.path, caller).map_or(open.clone(), |(s, c)| (s, c.into()));
            let reply = send(&app, caller.secret.as_deref(), route, &job).await;
            let found = outcome(&reply);
            cases += 1;
            if found != wanted {
                let at = format!("{} {} by {}", route.method, route.path, caller.name);
                wrong.push(format!("{at}: {found:?}, not {wanted:?}"));
            }
            let challenged = reply.headers.contains_key("www-authenticate");
            assert_eq!(challenged, reply.status == 401, "{} by {}", route.path, caller.name);
        }
    }
    println!("rights matrix: {} of {cases} cases as the table says", cases - wrong.len());
    assert_eq!(cases, ROUTES.len() * callers.len());
    assert!(wrong.is_empty(), "{}", wrong.join("\n"));
}

#[tokio::test]
async fn a_head_request_needs_what_its_get_needs() {
    let mut app = TestApp::start();
    app.rig(&bench()).await;
    app.close_doors().await;
    let url = format!("http://{}/v1/rigs/bench", app.address());
    let refused = reqwest::Client::new().head(url).send().await.expect("an answer");
    assert_eq!(refused.status(), 401);
}

#[tokio::test]
async fn what_is_no_operation_is_not_found_for_anybody() {
    let mut app = TestApp::start();
    app.close_doors().await;
    app.call_as(None, "GET", "/v1/nothing").send().await.problem(404, "route.not_found");
    app.call_as(None, "PUT", "/v1/rigs").send().await.problem(405, "method.not_allowed");
}
