//! The sessions: which test runs the blocks of which sections, and what must have come of it.

use std::io::{BufRead, BufReader, Lines};
use std::path::Path;
use std::process::{Child, ChildStdout, Stdio};

use serde_json::Value;

use super::shell::{blocks, missing, run};
use crate::support::{Program, TestApp, rigcast};

/// Makes a test of each session and the list of all sections that are run. A test is given its sections.
macro_rules! sessions {
    ($($test:ident runs $body:ident on [$(($page:literal, $section:literal)),+ $(,)?];)+) => {
        /// Page and section of every block that is run.
        pub const SESSIONS: &[(&str, &str)] = &[$($(($page, $section)),+),+];

        $(#[test]
        fn $test() {
            if let Some(tool) = missing() {
                println!("skipped: no {tool} on this machine");
                return;
            }
            let folder = tempfile::tempdir().expect("a directory");
            $body(&[$(($page, $section)),+], folder.path());
        })+
    };
}

sessions! {
    the_session_with_curl_works_as_it_stands runs with_curl on [
        ("README.md", "A session with curl"),
        ("docs/fits.md", "A fit by hand"),
        ("docs/fits.md", "The report of a fit"),
        ("docs/fits.md", "The FRF: coherence, confidence, inverse"),
        ("docs/weights.md", "Weights made elsewhere"),
        ("docs/iterations.md", "A drive for a service load"),
        ("docs/evaluations.md", "A report"),
        ("docs/predictions.md", "Open Inference Protocol"),
        ("docs/clients.md", "curl"),
        ("docs/studies.md", "A search for settings"),
    ];
    the_demos_rig_is_diagnosed_and_its_model_mended runs on_the_demo on [
        ("docs/diagnosis.md", "Where model and rig differ"),
    ];
    tokens_are_made_used_and_revoked_and_a_backup_is_restored runs with_tokens on [
        ("docs/operations.md", "Tokens"),
        ("docs/operations.md", "Backups"),
        ("docs/operations.md", "Metrics and alarms"),
    ];
}

/// All blocks of some sections as one script.
fn script(sections: &[(&str, &str)], base: &str) -> String {
    sections.iter().flat_map(|(page, section)| blocks(page, section, base)).collect()
}

/// On the rig of the README, with the service in this process.
fn with_curl(sections: &[(&str, &str)], folder: &Path) {
    let app = TestApp::start();
    let base = format!("http://{}", app.address());
    let script = script(sections, &base);
    assert!(script.matches("curl").count() >= 8, "the session has its calls:\n{script}");
    let out = run(&script, folder);

    for part in
        [r#""state":"succeeded""#, r#""ratio":"#, r#""inside":"#, r#""response":{"sample_rate_hz":200"#]
    {
        assert!(out.contains(part), "{part} is missing in\n{out}");
    }
    assert!(
        out.contains(r#""model_name":"bench-1""#) && out.contains(r#""id":"candidate 4""#),
        "the tensors: {out}"
    );
    let active = run(&format!("curl -sS --fail-with-body {base}/v1/rigs/bench-1/active-model"), folder);
    assert!(active.contains(r#""version":2"#), "the version put by hand stays active: {active}");
    let models = run(&format!("curl -sS --fail-with-body {base}/v1/rigs/bench-1/models"), folder);
    let models: Value = serde_json::from_str(&models).expect("JSON");
    let versions = models["items"].as_array().expect("a list").len();
    assert_eq!(versions, 5, "two of the policy, one fitted by hand, one imported, one of a study: {models}");
    let study = std::fs::read_to_string(folder.join("study-table.json")).expect("a study was shown");
    let study: Value = serde_json::from_str(&study).expect("JSON");
    assert_eq!(study["search"]["trials"].as_array().map(Vec::len), Some(4), "{study}");
    assert!(study["search"]["best"]["error"].as_f64().is_some_and(|error| error < 1.0), "{study}");
    assert!(out.contains("freq_hz,re(disp/drive),im(disp/drive),coherence(disp/drive)"), "the table: {out}");
    let frf: Value =
        serde_json::from_slice(&std::fs::read(folder.join("frf.json")).expect("the FRF was written"))
            .expect("JSON");
    let lines = frf["freq_hz"].as_array().expect("lines").len();
    for (file, dtype) in [("h.npy", "'<c16'"), ("coherence.npy", "'<f8'"), ("inverse.npy", "'<c16'")] {
        let array = std::fs::read(folder.join(file)).expect(file);
        let header = String::from_utf8_lossy(&array[10..128]).into_owned();
        assert!(header.contains(dtype) && header.contains(&format!("({lines}, 1, 1)")), "{file}: {header}");
    }
    let found: Value =
        serde_json::from_slice(&std::fs::read(folder.join("found.json")).expect("an iteration was found"))
            .expect("JSON");
    assert!(found["total_error"].as_f64().is_some_and(|error| error < 0.1), "{found}");
    assert!(std::fs::read(folder.join("drive.drv")).expect("the drive was written").starts_with(b"FORMAT"));
    let report: Value =
        serde_json::from_slice(&std::fs::read(folder.join("report.json")).expect("a report")).expect("JSON");
    let table = report["table"].as_array().expect("a table");
    assert_eq!(table.len(), 2, "two models on service loads: {report}");
    assert!(table.iter().all(|row| row["channels"]["disp"]["damage_ratio"].is_number()), "{report}");
    let fit = std::fs::read(folder.join("fit-report.json")).expect("a report");
    let fit: Value = serde_json::from_slice(&fit).expect("JSON");
    assert!(fit["residual"]["autocorrelation"]["channels"]["disp"][0].is_number(), "{fit}");
    assert_eq!(fit["training"]["seeds"].as_array().map(Vec::len), Some(1), "{fit}");
    let page = std::fs::read_to_string(folder.join("fit-report.html")).expect("a page");
    assert!(page.contains("Loss curves"), "{page}");
    let page = std::fs::read_to_string(folder.join("evaluation.html")).expect("a page");
    assert!(page.contains("Runs: service") && page.contains("version 2 (hybrid2)"), "{page}");
    let figures: Value =
        serde_json::from_slice(&std::fs::read(folder.join("figures.json")).expect("figures were written"))
            .expect("JSON");
    assert!(figures["errors"]["channels"]["disp"]["rms"].is_number(), "{figures}");
    assert!(out.contains(r#""format":"csv""#), "what is understood of a file: {out}");
    let weights = std::fs::read(folder.join("model.safetensors")).expect("weights were written");
    assert_eq!(
        rigcast::engine::model::from_safetensors(&weights).expect("weights of ours").inputs,
        ["drive"]
    );
}

/// With the program itself: the first token is made before the service runs.
fn with_tokens(sections: &[(&str, &str)], folder: &Path) {
    let [tokens, others @ ..] = sections else { panic!("no sections") };
    run(&blocks(tokens.0, tokens.1, "")[0], folder);
    let service = Program::start_on(&folder.join("rigcast-data"), &[]);
    let base = service.base();
    let status = |token: &str, request: &str| {
        let header = format!("-H \"Authorization: Bearer $(cat {token})\"");
        run(&format!("curl -s -o last.txt -w '%{{http_code}}' {header} {base}{request}"), folder)
    };
    let blocks = blocks(tokens.0, tokens.1, base);
    let [_, make, show, revoke] = blocks.as_slice() else { panic!("four blocks of tokens: {blocks:?}") };
    run(make, folder);
    let rig = r#"{"id": "bench-1", "name": "Bench", "sample_rate_hz": 200,
        "channels": [{"name": "drive", "unit": "kN", "role": "drive"}, {"name": "disp", "unit": "mm", "role": "response"}]}"#;
    let json = "-H 'Content-Type: application/json'";
    assert_eq!(status("admin.token", &format!("/v1/rigs {json} -d '{rig}'")), "201");
    assert!(run(show, folder).contains("bench-1"), "the token shows its rig");
    // Software that iterates drives uploads what the rig has answered, asks for fits, and predicts.
    let samples = (0..400).map(|i| format!("{}.5,{}.25\n", i % 7, i % 5)).collect::<String>();
    std::fs::write(folder.join("run.csv"), format!("drive,disp\n{samples}")).expect("a file");
    let upload = "/v1/rigs/bench-1/runs -H 'Content-Type: text/csv' --data-binary @run.csv";
    assert_eq!(status("iteration.token", upload), "201");
    let predict = format!("/v1/rigs/bench-1/predict {json} -d '{{\"drive\": {{\"run\": \"none\"}}}}'");
    assert!(!["401", "403"].contains(&status("iteration.token", &predict).as_str()));
    let other = rig.replace("bench-1", "bench-2");
    assert_eq!(status("iteration.token", &format!("/v1/rigs {json} -d '{other}'")), "403");
    run(revoke, folder);
    assert_eq!(status("iteration.token", "/v1/rigs"), "401");

    let out = run(&script(others, base), folder);
    assert!(folder.join("rigcast-restored/rigcast.db").is_file(), "the backup was restored");
    assert!(out.contains("rigcast_build_info") && out.contains(r#""status":"#), "{out}");
}

/// The demo while it lasts.
struct Demo {
    child: Child,
    base: String,
    /// Held open: the demo ends where nobody can read what it says.
    lines: Lines<BufReader<ChildStdout>>,
}

impl Demo {
    /// Starts it and waits until its rig has all its models and runs.
    fn start(data: &Path) -> Self {
        let mut command = rigcast(&["demo", "--listen", "127.0.0.1:0", "--minutes", "3", "--epochs", "8"]);
        command.arg("--data-dir").arg(data).stdout(Stdio::piped()).stderr(Stdio::null());
        let mut child = command.spawn().expect("the program starts");
        let lines = BufReader::new(child.stdout.take().expect("piped")).lines();
        let mut demo = Self { child, base: String::new(), lines };
        while let Some(Ok(line)) = demo.lines.next() {
            if let Some((_, rest)) = line.split_once("Service on ") {
                rest.split(';').next().expect("the first part").clone_into(&mut demo.base);
            }
            if line.starts_with("The service stays up") {
                return demo;
            }
        }
        panic!("the demo did not get to its end");
    }
}

impl Drop for Demo {
    fn drop(&mut self) {
        // An error means that it has ended already.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

fn on_the_demo(sections: &[(&str, &str)], folder: &Path) {
    let demo = Demo::start(&folder.join("data"));
    let out = run(&script(sections, &demo.base), folder);

    assert!(out.contains(r#""effect":"backlash","family":"deadband_backlash","axis":"z""#), "{out}");
    let page = std::fs::read_to_string(folder.join("diagnosis.html")).expect("the page was written");
    assert!(page.contains("backlash in the drive on axis z"), "{page}");
    // Errors on the service load: first of the model before, then of the one with the effect.
    let force_z: Vec<f64> = out
        .match_indices(r#"{"model":{"version""#)
        .filter_map(|(at, _)| {
            let mut answers = serde_json::Deserializer::from_str(&out[at..]).into_iter::<Value>();
            answers.next()?.ok()?["errors"]["channels"]["force_z"]["rms"].as_f64()
        })
        .collect();
    assert!(force_z.len() == 2 && force_z[1] < 0.2 * force_z[0], "{force_z:?}");
}
