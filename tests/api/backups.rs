//! Backup and restore by the real program, while it serves.

use rigcast::client::Client;
use serde_json::json;
use tempfile::TempDir;

use crate::support::{Program, bench, gain_weights, noise_csv, rigcast};

#[tokio::test]
async fn a_backup_made_while_serving_restores_to_a_service_that_answers_alike() {
    let directory = TempDir::new().expect("a directory");
    let program = Program::start(&directory, &[]);
    let client = Client::new(program.base(), None).expect("a client");
    client.post("/v1/rigs", &bench()).await.expect("a rig");
    client
        .upload("bench", &[("kind", "noise")], "text/csv", noise_csv(3000, 1).into_bytes())
        .await
        .expect("a run");
    let weights = gain_weights(&["u"], &["y"], 2.0);
    client.import("bench", weights).await.expect("a model");
    let copies = TempDir::new().expect("a directory");
    let (backup, again) = (copies.path().join("backup"), copies.path().join("again"));
    let run = |subcommand: &str, data: &std::path::Path| {
        let paths = [backup.as_os_str(), "--data-dir".as_ref(), data.as_os_str()];
        let done = rigcast(&[subcommand]).args(paths).stdout(std::process::Stdio::piped()).output();
        let done = done.expect("it ends");
        (done.status.code(), String::from_utf8_lossy(&[done.stdout, done.stderr].concat()).into_owned())
    };
    let (code, said) = run("backup", directory.path());
    assert_eq!(code, Some(0), "{said}");
    assert!(said.contains("2 objects"), "{said}");
    let (code, said) = run("backup", directory.path());
    assert_eq!(code, Some(1), "nothing is written over a backup: {said}");
    let (code, said) = run("restore", &again);
    assert_eq!(code, Some(0), "{said}");

    let second = Program::start_on(&again, &[]);
    let restored = Client::new(second.base(), None).expect("a client");
    for path in ["/v1/rigs", "/v1/rigs/bench/runs", "/v1/rigs/bench/models", "/v1/jobs"] {
        let (first, second) =
            (client.get(path).await.expect("a list"), restored.get(path).await.expect("a list"));
        assert_eq!(first, second, "{path}");
    }
    let drive = json!({"model": 1, "drive": {"sample_rate_hz": 100.0, "channels": {"u": [0.5, 1.0]}}});
    let answer = restored.post("/v1/rigs/bench/predict", &drive).await.expect("a prediction");
    assert_eq!(answer, client.post("/v1/rigs/bench/predict", &drive).await.expect("a prediction"));
}

#[test]
fn a_damaged_or_lost_database_stops_the_start_with_a_message() {
    let directory = TempDir::new().expect("a directory");
    std::fs::write(directory.path().join("rigcast.db"), vec![b'x'; 8192]).expect("written");
    let path = directory.path().to_str().expect("UTF-8");
    let arguments = ["serve", "--listen", "127.0.0.1:0", "--data-dir", path];
    let refused = rigcast(&arguments).output().expect("it ends");
    let said = String::from_utf8_lossy(&refused.stderr);
    assert_eq!(refused.status.code(), Some(1), "{said}");
    assert!(said.contains("rigcast.db is damaged") && said.contains("rigcast restore"), "{said}");
}
