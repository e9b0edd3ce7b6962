//! The README's session, line by line.

use std::process::Command;

use crate::support::TestApp;

const README: &str = include_str!("../../README.md");

/// The `sh` blocks in their order, against the service at `address`; a refusal ends the session.
fn session(address: std::net::SocketAddr) -> String {
    let mut script = String::from("set -euo pipefail\n");
    for block in README.split("```sh\n").skip(1) {
        script.push_str(block.split("```").next().expect("a block ends"));
    }
    script
        .replace("http://127.0.0.1:8080", &format!("http://{address}"))
        .replace("curl -sS", "curl --fail-with-body -sS")
}

#[tokio::test]
async fn the_readmes_session_works_as_it_stands() {
    let have = |tool: &str| Command::new(tool).arg("--version").output().is_ok();
    if let Some(tool) = ["bash", "curl", "awk"].into_iter().find(|tool| !have(tool)) {
        println!("skipped: no {tool} on this machine");
        return;
    }
    let app = TestApp::start();
    let script = session(app.address());
    assert!(script.matches("curl").count() >= 8, "the session has its calls:\n{script}");
    let folder = tempfile::tempdir().expect("a directory");
    let at = folder.path().to_owned();
    let run = move || Command::new("bash").arg("-c").arg(script).current_dir(at).output();
    let done = tokio::task::spawn_blocking(run).await.expect("no panic").expect("bash runs");
    let (out, err) = (String::from_utf8_lossy(&done.stdout), String::from_utf8_lossy(&done.stderr));
    assert!(done.status.success(), "{out}\n{err}");

    for part in
        [r#""state":"succeeded""#, r#""ratio":"#, r#""inside":"#, r#""response":{"sample_rate_hz":200"#]
    {
        assert!(out.contains(part), "{part} is missing in\n{out}");
    }
    app.get("/v1/rigs/bench-1/active-model").await.expect(200);
    let weights = std::fs::read(folder.path().join("model.safetensors")).expect("weights were written");
    assert_eq!(
        rigcast::engine::model::from_safetensors(&weights).expect("weights of ours").inputs,
        ["drive"]
    );
}
