//! The README's sessions, line by line.

use std::io::{BufRead, BufReader};
use std::process::{Command, Stdio};

use serde_json::Value;

use crate::support::{TestApp, rigcast};

const README: &str = include_str!("../../README.md");

/// The `sh` blocks of a section in their order, against the service at `base`; a refusal ends the session.
fn session(section: &str, base: &str) -> String {
    let text = README.split("\n## ").find(|text| text.starts_with(section)).expect("the README has it");
    let mut script = String::from("set -euo pipefail\n");
    for block in text.split("```sh\n").skip(1) {
        script.push_str(block.split("```").next().expect("a block ends"));
    }
    script.replace("http://127.0.0.1:8080", base).replace("curl -sS", "curl --fail-with-body -sS")
}

/// A tool that the sessions need and that is missing here.
fn missing() -> Option<&'static str> {
    let have = |tool: &str| Command::new(tool).arg("--version").output().is_ok();
    ["bash", "curl", "awk", "grep", "sed"].into_iter().find(|tool| !have(tool))
}

/// Runs a session in a folder; gives what it printed.
fn run(script: &str, folder: &std::path::Path) -> String {
    let done = Command::new("bash").arg("-c").arg(script).current_dir(folder).output().expect("bash runs");
    let (out, err) = (String::from_utf8_lossy(&done.stdout), String::from_utf8_lossy(&done.stderr));
    assert!(done.status.success(), "{out}\n{err}");
    out.into_owned()
}

#[tokio::test]
async fn the_readmes_session_works_as_it_stands() {
    if let Some(tool) = missing() {
        println!("skipped: no {tool} on this machine");
        return;
    }
    let app = TestApp::start();
    let script = session("A session with curl", &format!("http://{}", app.address()));
    assert!(script.matches("curl").count() >= 8, "the session has its calls:\n{script}");
    let folder = tempfile::tempdir().expect("a directory");
    let at = folder.path().to_owned();
    let out = tokio::task::spawn_blocking(move || run(&script, &at)).await.expect("the session works");

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

/// The demo while it lasts.
struct Demo(std::process::Child);

impl Drop for Demo {
    fn drop(&mut self) {
        // An error means that it has ended already.
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

#[test]
fn the_demos_rig_is_diagnosed_and_its_model_mended_as_the_readme_does() {
    if let Some(tool) = missing() {
        println!("skipped: no {tool} on this machine");
        return;
    }
    let folder = tempfile::tempdir().expect("a directory");
    let data = folder.path().join("data");
    let mut command = rigcast(&["demo", "--listen", "127.0.0.1:0", "--minutes", "3", "--epochs", "8"]);
    command.arg("--data-dir").arg(&data).stdout(Stdio::piped()).stderr(Stdio::null());
    let mut demo = Demo(command.spawn().expect("the program starts"));
    let lines = BufReader::new(demo.0.stdout.take().expect("piped")).lines();
    let mut base = String::new();
    let mut stays = false;
    for line in lines.map_while(Result::ok) {
        if let Some((_, rest)) = line.split_once("Service on ") {
            base = rest.split(';').next().expect("the first part").to_owned();
        }
        stays = line.starts_with("The service stays up");
        if stays {
            break;
        }
    }
    assert!(stays, "the demo did not get to its end");
    let out = run(&session("Where model and rig differ", &base), folder.path());

    assert!(out.contains(r#""effect":"backlash","family":"deadband_backlash","axis":"z""#), "{out}");
    let page = std::fs::read_to_string(folder.path().join("diagnosis.html")).expect("the page was written");
    assert!(page.contains("backlash in the drive on axis z"), "{page}");
    // What the models of before and after are off on the service load.
    let force_z: Vec<f64> = out
        .match_indices(r#"{"model":{"version""#)
        .filter_map(|(at, _)| {
            let mut answers = serde_json::Deserializer::from_str(&out[at..]).into_iter::<Value>();
            answers.next()?.ok()?["errors"]["channels"]["force_z"]["rms"].as_f64()
        })
        .collect();
    assert!(force_z.len() == 2 && force_z[1] < 0.2 * force_z[0], "{force_z:?}");
}
