//! Names that would like to be something else: a path, a line of the log, a query, a page.

use serde_json::{Value, json};
use tempfile::TempDir;

use crate::support::{Program, bench, exchange};

const NAMES: [&str; 26] = [
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
];

/// Everything below a directory, as paths relative to it.
fn below(root: &std::path::Path) -> Vec<String> {
    let (mut found, mut open) = (Vec::new(), vec![root.to_owned()]);
    while let Some(directory) = open.pop() {
        for entry in std::fs::read_dir(directory).expect("a directory") {
            let path = entry.expect("an entry").path();
            found.push(path.strip_prefix(root).expect("below").to_str().expect("UTF-8").to_owned());
            if path.is_dir() {
                open.push(path);
            }
        }
    }
    found
}

/// Whether a file of the data directory has a name of ours.
fn is_ours(path: &str) -> bool {
    let hex = |text: &str| !text.is_empty() && text.bytes().all(|b| b.is_ascii_hexdigit());
    match path.split('/').collect::<Vec<_>>()[..] {
        [file] => {
            ["rigcast.db", "rigcast.db-wal", "rigcast.db-shm", "lock", "scratch", "objects"].contains(&file)
        }
        ["objects", folder] => hex(folder) && folder.len() == 2,
        ["objects", folder, digest] => digest.starts_with(folder) && hex(digest) && digest.len() == 64,
        _ => false,
    }
}

#[tokio::test]
async fn hostile_names_come_back_as_they_are_and_become_nothing_else() {
    let outside = TempDir::new().expect("a directory");
    let directory = TempDir::new_in(&outside).expect("a directory");
    let program = Program::start(&directory, &[("RIGCAST_LOG", "trace"), ("RIGCAST_LOG_FORMAT", "text")]);
    let client = reqwest::Client::new();
    let address = program.base().strip_prefix("http://").and_then(|at| at.parse().ok()).expect("an address");
    let url = |path: &str| format!("{}{path}", program.base());
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

        for path in ["rigs", "jobs", "rigs/bench/runs", "rigs/bench/models", "rigs/bench/diagnoses"] {
            // As no client library would send it, so that none tidies it up.
            let encoded: String = name.bytes().map(|byte| format!("%{byte:02x}")).collect();
            let plain = if [".", ".."].contains(name) { *name } else { &encoded };
            for name in [&encoded, plain] {
                let request =
                    format!("GET /v1/{path}/{name} HTTP/1.1\r\nhost: localhost\r\nconnection: close\r\n\r\n");
                let answer = exchange(address, request.as_bytes());
                assert!(answer.starts_with("HTTP/1.1 404"), "{path} {name:?}: {answer}");
            }
        }
        if let Ok(value) = reqwest::header::HeaderValue::from_bytes(name.as_bytes()) {
            let reply =
                client.get(url("/livez")).header("x-request-id", value).send().await.expect("an answer");
            let id = reply.headers()["x-request-id"].to_str().expect("text");
            assert!(id != *name || name.bytes().all(|byte| byte == b'.'), "{name:?}");
        }
        let unknown = json!({(*name): 1});
        let reply = client.post(url("/v1/rigs/bench/fits")).json(&unknown).send().await.expect("an answer");
        judge(name, reply.status().as_u16(), &Value::Null);
        let reply = client.get(url("/v1/rigs")).query(&[(name, name)]).send().await.expect("an answer");
        judge(name, reply.status().as_u16(), &Value::Null);
    }
    println!("{} names: {kept} kept exactly, {refused} refused", NAMES.len());
    assert!(kept >= 2 * NAMES.len(), "people may call things as they like: {kept}");

    let entries: Vec<String> = below(outside.path());
    let inside = directory.path().file_name().and_then(|name| name.to_str()).expect("UTF-8");
    for path in &entries {
        let own = path == inside || path.strip_prefix(&format!("{inside}/")).is_some_and(is_ours);
        assert!(own, "{path} is none of our names");
    }
    assert!(entries.len() > 50, "runs were stored: {}", entries.len());
    program.signal("-TERM");
    let (code, log) = program.ended();
    assert_eq!(code, Some(0));
    assert!(log.len() > 200, "{} lines", log.len());
    for line in &log {
        let begins =
            line.get(..20).is_some_and(|start| start.starts_with("20") && start.as_bytes()[10] == b'T');
        assert!(begins && !line.contains(|c: char| c.is_control()), "{line:?}");
        assert!(!line.starts_with("2026-01-01T00:00:00Z"), "{line:?}");
    }
}
