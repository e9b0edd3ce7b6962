//! Names that could be taken for something else: a path, a line of the log, a query, a page.

use serde_json::{Value, json};

use crate::support::{bench, exchange};

pub const NAMES: [&str; 52] = [
    "../../../etc/passwd",
    "..\\..\\windows",
    "/etc/passwd",
    "C:\\run.csv",
    "file:///etc/passwd",
    "a/../b",
    ".",
    "..",
    "line\n2026-01-01T00:00:00Z ERROR forged",
    "carriage\rreturn",
    "crlf\r\nX-Forged: yes",
    "\u{1b}[2J\u{1b}]0;title\u{7}",
    "nul\u{0}byte",
    "\u{202e}drowssap",
    "line\u{2028}separator",
    "'; DROP TABLE rigs; --",
    "\" OR \"1\"=\"1",
    "%s%n%x",
    "%2e%2e%2f",
    "<script>alert(1)</script>",
    "\"><img src=x onerror=alert(1)>",
    "{{7*7}}",
    "${jndi:ldap://lab/x}",
    "=cmd|' /C calc'!A0",
    "\u{feff}bom",
    "na\u{ef}ve \u{1f600} \u{fffd}",
    "~/.ssh/id_rsa",
    "....//....//etc/shadow",
    "/proc/self/environ",
    "/dev/stdin",
    "\\\\server\\share\\run.csv",
    "CON",
    "aux.csv",
    "run.csv\u{0}.png",
    "rigcast.db",
    "objects/../rigcast.db",
    "scratch",
    "-rf *",
    "--data-dir=/tmp",
    "$(reboot)",
    "`reboot`",
    "; reboot",
    "| cat /etc/passwd",
    "&& reboot",
    "%00",
    "%252e%252e%252f",
    "..%c0%af..%c0%af",
    "?x=1#y",
    "*",
    "\u{202e}\u{2066}gpj.exe",
    "\u{1f468}\u{200d}\u{1f469}\u{200d}\u{1f467}",
    "1; ATTACH DATABASE '/tmp/x' AS x",
];

/// Sends every name in every place to the program at `base`: it is returned unchanged or refused. Returns
/// how often it was kept, and how often refused.
pub async fn send_all(base: &str) -> (usize, usize) {
    let client = reqwest::Client::new();
    let address = base.strip_prefix("http://").and_then(|at| at.parse().ok()).expect("an address");
    let url = |path: &str| format!("{}{path}", base);
    let made = client.post(url("/v1/rigs")).json(&bench()).send().await.expect("an answer");
    assert_eq!(made.status(), 201);
    let (mut kept, mut refused) = (0, 0);
    let mut judge = |name: &str, status: u16, back: &Value| match status {
        200 | 201 => {
            assert_eq!(back, name, "exactly as it was sent");
            kept += 1;
        }
        400 | 404 | 422 => refused += 1,
        other => panic!("{name:?}: {other}"),
    };
    for (i, name) in NAMES.iter().enumerate() {
        // A name of a rig, of a channel, of a run, a tag; a header, an id, a token's name.
        let mut rig = bench();
        (rig["id"], rig["name"]) = (json!(format!("rig-{i}")), json!(name));
        let reply = client.post(url("/v1/rigs")).json(&rig).send().await.expect("an answer");
        let status = reply.status().as_u16();
        judge(name, status, &reply.json::<Value>().await.expect("JSON")["name"]);

        (rig["id"], rig["name"]) = (json!(format!("channel-{i}")), json!("c"));
        rig["channels"][0]["name"] = json!(name);
        let reply = client.post(url("/v1/rigs")).json(&rig).send().await.expect("an answer");
        let status = reply.status().as_u16();
        judge(name, status, &reply.json::<Value>().await.expect("JSON")["channels"][0]["name"]);
        if status == 201 {
            let file = json!({"sample_rate_hz": 100.0, "channels": {(*name): [0.0, 1.0], "y": [0.0, i]}});
            let run = client.post(url(&format!("/v1/rigs/channel-{i}/runs"))).json(&file).send().await;
            let run = run.expect("an answer");
            assert_eq!(run.status(), 201, "{name:?}");
            let location = run.headers()["location"].to_str().expect("text").to_owned();
            for accept in ["application/json", "text/csv", "application/x-npy"] {
                let data = client.get(url(&format!("{location}/data"))).header("accept", accept).send().await;
                let data = data.expect("an answer");
                assert_eq!(data.status(), 200, "{name:?} as {accept}");
                assert!(!data.headers().contains_key("x-forged"));
            }
        }

        let query = [("name", *name), ("tag", name)];
        let run = client.post(url("/v1/rigs/bench/runs")).query(&query).header("content-type", "text/csv");
        let run = run.body(format!("u,y\n0,{i}\n")).send().await.expect("an answer");
        let status = run.status().as_u16();
        judge(name, status, &run.json::<Value>().await.expect("JSON")["name"]);
        let listed =
            client.get(url("/v1/rigs/bench/runs")).query(&[("tag", name)]).send().await.expect("an answer");
        let listed: Value = listed.json().await.expect("JSON");
        if status == 201 {
            assert_eq!(
                listed["items"].as_array().map(Vec::len),
                Some(1),
                "{name:?} finds its run and no other"
            );
            assert_eq!(listed["items"][0]["tags"], json!([name]));
        }

        let collections = [
            "v1/rigs",
            "v1/jobs",
            "v1/rigs/bench/runs",
            "v1/rigs/bench/models",
            "v1/rigs/bench/diagnoses",
            "v1/rigs/bench/iterations",
            "v1/rigs/bench/evaluations",
            "v1/rigs/bench/studies",
            "v2/models",
            "v2/models/bench/versions",
        ];
        for path in collections {
            // As bytes, so that no client library changes it.
            let encoded: String = name.bytes().map(|byte| format!("%{byte:02x}")).collect();
            let plain = if [".", ".."].contains(name) { *name } else { &encoded };
            for name in [&encoded, plain] {
                let request =
                    format!("GET /{path}/{name} HTTP/1.1\r\nhost: localhost\r\nconnection: close\r\n\r\n");
                let answer = exchange(address, request.as_bytes());
                assert!(answer.starts_with("HTTP/1.1 404"), "{path} {name:?}: {answer}");
            }
        }
        if let Ok(value) = reqwest::header::HeaderValue::from_bytes(name.as_bytes()) {
            let reply =
                client.get(url("/livez")).header("x-request-id", value).send().await.expect("an answer");
            let id = reply.headers()["x-request-id"].to_str().expect("text");
            let is_one = name.bytes().all(|byte| byte.is_ascii_alphanumeric() || b"-_.:".contains(&byte));
            assert!(id != *name || is_one, "{name:?}");
        }
        let unknown = json!({(*name): 1});
        let reply = client.post(url("/v1/rigs/bench/fits")).json(&unknown).send().await.expect("an answer");
        judge(name, reply.status().as_u16(), &Value::Null);
        let reply = client.get(url("/v1/rigs")).query(&[(name, name)]).send().await.expect("an answer");
        judge(name, reply.status().as_u16(), &Value::Null);
    }
    (kept, refused)
}
