//! The log of the real program: who asked for what about which rig, and what came of it.

use serde_json::{Value, json};
use tempfile::TempDir;

use crate::support::{Program, bench};

/// The lines of a program's log that tell of requests.
fn answers(log: &[String]) -> Vec<Value> {
    let lines = log.iter().filter_map(|line| serde_json::from_str::<Value>(line).ok());
    lines.filter(|line| line["message"] == "answered").collect()
}

async fn send(
    method: reqwest::Method,
    url: String,
    token: Option<&str>,
    body: Option<&Value>,
) -> (u16, Value) {
    let request = reqwest::Client::new().request(method, url);
    let request = token.into_iter().fold(request, |request, token| request.bearer_auth(token));
    let request = body.into_iter().fold(request, |request, body| request.json(body));
    let answer = request.send().await.expect("an answer");
    (answer.status().as_u16(), answer.json().await.unwrap_or_default())
}

#[tokio::test]
async fn a_request_is_logged_with_its_rig_its_client_and_its_problem() {
    let directory = TempDir::new().expect("a directory");
    let program = Program::start(&directory, &[("RIGCAST_LOG_FORMAT", "json")]);
    let (get, post) = (reqwest::Method::GET, reqwest::Method::POST);
    let url = |path: &str| format!("{}{path}", program.base());
    assert_eq!(send(post.clone(), url("/v1/rigs"), None, Some(&bench())).await.0, 201);
    let hostile = "/v1/rigs/No%0Arig/predict";
    assert_eq!(send(post.clone(), url(hostile), None, Some(&json!({}))).await.0, 404);
    let drive = json!({"drive": {"sample_rate_hz": 100.0, "channels": {"u": [0.0]}}});
    assert_eq!(send(post.clone(), url("/v1/rigs/bench/predict"), None, Some(&drive)).await.0, 409);
    for probe in ["/livez", "/readyz", "/metrics"] {
        assert_eq!(send(get.clone(), url(probe), None, None).await.0, 200);
    }
    let admin = json!({"role": "admin", "name": "first\nline"});
    let admin = send(post.clone(), url("/v1/tokens"), None, Some(&admin)).await.1;
    let secret = admin["secret"].as_str();
    let reader = json!({"role": "reader", "name": "iteration software"});
    let reader = send(post.clone(), url("/v1/tokens"), secret, Some(&reader)).await.1;
    let own = url(&format!("/v1/tokens/{}", reader["id"].as_str().expect("an id")));
    let rigs = url("/v1/rigs");
    assert_eq!(send(get.clone(), rigs.clone(), reader["secret"].as_str(), None).await.0, 200);
    assert_eq!(send(reqwest::Method::DELETE, own, secret, None).await.0, 204);
    assert_eq!(send(get.clone(), rigs.clone(), reader["secret"].as_str(), None).await.0, 401);
    assert_eq!(send(get, rigs, Some("rigcast_of_nobody"), None).await.0, 401);
    program.signal("-TERM");
    let (_, log) = program.ended();

    let answers = answers(&log);
    let found = |route: &str, status: u16| -> Vec<&Value> {
        let of_route = |line: &&&Value| line["http.route"] == route && line["http.status"] == status;
        answers.iter().map(|line| &line["span"]).filter(|span| of_route(&span)).collect()
    };
    for probe in ["/livez", "/readyz", "/metrics"] {
        assert!(found(probe, 200).is_empty(), "{probe} is at debug only");
    }
    let created = found("/v1/rigs", 201)[0];
    assert_eq!((&created["rig.id"], &created["client.address"]), (&json!("bench"), &json!("127.0.0.1")));
    let predict = "/v1/rigs/{rig}/predict";
    let refused = found(predict, 409)[0];
    assert_eq!(
        (&refused["rig.id"], &refused["problem.code"]),
        (&json!("bench"), &json!("model.none_active"))
    );
    let hostile = found(predict, 404)[0];
    assert_eq!((&hostile["rig.id"], &hostile["problem.code"]), (&Value::Null, &json!("rig.not_found")));
    let listed = found("/v1/rigs", 200)[0];
    assert_eq!((&listed["token.id"], &listed["token.name"]), (&reader["id"], &json!("iteration software")));
    let revoked = found("/v1/rigs", 401);
    assert_eq!(
        (&revoked[0]["token.id"], &revoked[0]["token.name"]),
        (&reader["id"], &json!("iteration software"))
    );
    assert_eq!(revoked[0]["problem.code"], "token.invalid");
    assert_eq!(
        (revoked.len(), &revoked[1]["token.id"]),
        (2, &Value::Null),
        "a secret that never was a token's"
    );
    assert!(log.iter().all(|line| !line.contains(secret.expect("a secret"))), "no secret is logged");
}

#[tokio::test]
async fn probes_are_logged_at_debug_and_always_when_they_fail() {
    let directory = TempDir::new().expect("a directory");
    let program =
        Program::start(&directory, &[("RIGCAST_LOG_FORMAT", "json"), ("RIGCAST_LOG", "rigcast=debug")]);
    let get = reqwest::Method::GET;
    assert_eq!(send(get.clone(), format!("{}/livez", program.base()), None, None).await.0, 200);
    assert_eq!(send(get, format!("{}/livez?x=1", program.base()), None, None).await.0, 422);
    program.signal("-TERM");
    let (_, log) = program.ended();
    let levels: Vec<Value> = answers(&log).iter().map(|line| line["level"].clone()).collect();
    assert_eq!(levels, [json!("DEBUG"), json!("INFO")]);
}
