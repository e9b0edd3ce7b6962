//! Secrets as canaries: sent to a program with full logging, then searched for in all of its output.

use serde_json::{Value, json};
use tempfile::TempDir;

use crate::support::{Program, bench};

/// Parts of a secret that occur nowhere else.
fn canary(secret: &str) -> &str {
    secret.strip_prefix("rigcast_").unwrap_or(secret)
}

#[tokio::test]
async fn no_secret_is_in_any_log_error_or_metric() {
    for format in ["text", "json"] {
        let directory = TempDir::new().expect("a directory");
        let environment = [("RIGCAST_LOG", "trace"), ("RIGCAST_LOG_FORMAT", format)];
        let program = Program::start(&directory, &environment);
        let base = program.base().to_owned();
        let client = reqwest::Client::new();
        let first = client.post(format!("{base}/v1/tokens")).json(&json!({"role": "admin"})).send().await;
        let first: Value = first.expect("an answer").json().await.expect("JSON");
        let admin = first["secret"].as_str().expect("a secret").to_owned();
        let more =
            client.post(format!("{base}/v1/tokens")).bearer_auth(&admin).json(&json!({"role": "reader"}));
        let more: Value = more.send().await.expect("an answer").json().await.expect("JSON");
        let reader = more["secret"].as_str().expect("a secret").to_owned();
        let garbage = format!("rigcast_{}", "GarbageCanary".repeat(3));
        let password = "PasswordCanaryOfSomebody";

        let mut said = Vec::new();
        let mut ask = async |method: &str, path: &str, authorization: &str, body: Value| {
            let method: reqwest::Method = method.parse().expect("a method");
            let request =
                client.request(method, format!("{base}{path}")).header("authorization", authorization);
            let answer = request.json(&body).send().await.expect("an answer");
            let (status, headers) = (answer.status().as_u16(), format!("{:?}", answer.headers()));
            said.push(headers + &answer.text().await.expect("text"));
            status
        };
        let bearer = |secret: &str| format!("Bearer {secret}");
        // In the right place.
        assert_eq!(ask("POST", "/v1/rigs", &bearer(&admin), bench()).await, 201);
        assert_eq!(ask("POST", "/v1/rigs", &bearer(&admin), bench()).await, 409);
        assert_eq!(ask("POST", "/v1/rigs", &bearer(&reader), bench()).await, 403);
        assert_eq!(ask("GET", "/v1/tokens", &bearer(&admin), json!({})).await, 200);
        assert_eq!(ask("GET", "/v1/nothing", &bearer(&admin), json!({})).await, 404);
        // In wrong places: unknown, of another scheme, twice as long, as a password, as an id, in a body.
        assert_eq!(ask("GET", "/v1/rigs", &bearer(&garbage), json!({})).await, 401);
        assert_eq!(ask("GET", "/v1/rigs", &admin, json!({})).await, 401);
        assert_eq!(ask("GET", "/v1/rigs", &format!("Basic {password}"), json!({})).await, 401);
        assert_eq!(ask("GET", "/v1/rigs", &bearer(&format!("{admin}{password}")), json!({})).await, 401);
        assert_eq!(ask("DELETE", &format!("/v1/tokens/{reader}"), &bearer(&admin), json!({})).await, 404);
        let body = json!({"role": "reader", "secret": garbage});
        assert_eq!(ask("POST", "/v1/tokens", &bearer(&admin), body).await, 422);
        assert_eq!(ask("GET", &format!("/v1/rigs?token={password}"), &bearer(&admin), json!({})).await, 422);
        assert_eq!(ask("GET", "/metrics", &bearer(&reader), json!({})).await, 200);
        assert!(said.last().is_some_and(|metrics| metrics.contains("rigcast_http_requests_total")));

        let limits = std::fs::read_to_string(format!("/proc/{}/limits", program.id()));
        let core =
            limits.ok().and_then(|text| Some(text.lines().find(|l| l.contains("core file"))?.to_owned()));
        // Not on a system without /proc. Soft and hard limit follow the four words.
        let none = core.as_ref().is_none_or(|line| line.split_whitespace().skip(4).take(2).eq(["0", "0"]));
        assert!(none, "{core:?}");
        program.signal("-TERM");
        let (code, log) = program.ended();
        assert_eq!(code, Some(0));
        let id = first["id"].as_str().expect("an id");
        let told = log.iter().filter(|line| line.contains(id)).count();
        assert!(told >= 6, "the log says which token asked: {told} of {} lines", log.len());
        assert!(
            log.iter().any(|line| line.contains("DEBUG") && line.contains("request refused")),
            "all is logged"
        );
        for secret in [&admin, &reader, &garbage, password] {
            for line in log.iter().chain(&said) {
                assert!(!line.contains(canary(secret)), "{line}");
            }
        }
        println!("{format}: {} log lines and {} answers without a secret", log.len(), said.len());
    }
}
