//! Objects in S3-compatible storage: the real program with a server of that protocol, which the Python package `moto`
//! has. `scripts/python_env.sh storage` installs it.

use std::net::TcpListener;
use std::path::Path;

use rigcast::client::Client;
use serde_json::json;
use tempfile::TempDir;

use crate::support::{Program, Storage, bench, noise_csv, refused_start, rigcast};

#[tokio::test(flavor = "multi_thread")]
async fn runs_and_models_live_in_the_bucket_and_outlive_the_local_copies() {
    let Some(storage) = Storage::start() else { return };
    let directory = TempDir::new().expect("a directory");
    let program = Program::start(&directory, &storage.environment());
    let client = Client::new(program.base(), None).expect("a client");
    client.post("/v1/rigs", &bench()).await.expect("a rig");
    let csv = noise_csv(6000, 1);
    let run =
        client.upload("bench", &[("kind", "noise")], "text/csv", csv.into_bytes()).await.expect("a run");
    // Its worker process opens the bucket by itself.
    let fit = client.fit("bench", &json!({"kind": "frf", "runs": [run["id"]]})).await.expect("a job");
    client.wait(&fit, |_| {}).await.expect("a model");
    let drive = json!({"model": 1, "drive": {"sample_rate_hz": 100.0, "channels": {"u": [0.5, 1.0]}}});
    let predicted = client.post("/v1/rigs/bench/predict", &drive).await.expect("a prediction");
    let samples = format!("/v1/rigs/bench/runs/{}/data?from_s=0&to_s=1", run["id"].as_str().expect("an id"));
    let read = client.get(&samples).await.expect("samples");

    // Everything but the database is lost.
    program.kill();
    std::fs::remove_dir_all(directory.path().join("objects")).expect("removed");
    let program = Program::start(&directory, &storage.environment());
    let client = Client::new(program.base(), None).expect("a client");
    assert_eq!(client.get(&samples).await.expect("samples"), read);
    assert_eq!(client.post("/v1/rigs/bench/predict", &drive).await.expect("a prediction"), predicted);
    let ready = client.get("/readyz").await.expect("ready");
    assert_eq!((&ready["bucket"], &ready["store"]), (&json!("ok"), &json!("ok")));

    // A backup has all objects, and needs the bucket no more.
    let copies = TempDir::new().expect("a directory");
    std::fs::remove_dir_all(directory.path().join("objects")).expect("removed");
    std::fs::create_dir(directory.path().join("objects")).expect("made");
    let backup = copies.path().join("backup");
    let done = rigcast(&["backup", backup.to_str().expect("UTF-8"), "--data-dir"])
        .arg(directory.path())
        .envs(storage.environment())
        .output()
        .expect("it ends");
    assert!(done.status.success(), "{}", String::from_utf8_lossy(&done.stderr));

    // While the storage says nothing, what is loaded predicts, and an upload is refused and not lost.
    storage.signal("-STOP");
    let again = client.post("/v1/rigs/bench/predict", &drive).await.expect("a prediction");
    assert_eq!(again, predicted);
    let csv = noise_csv(3000, 2);
    let refused = client.upload("bench", &[("kind", "noise")], "text/csv", csv.clone().into_bytes()).await;
    let refused = refused.expect_err("the storage is away").to_string();
    assert!(refused.contains("503"), "{refused}");
    let ready = client.get("/readyz").await.expect("ready");
    assert!(ready["bucket"].as_str().is_some_and(|said| said.contains("s3://lab/one")), "{ready}");
    assert!(!ready.to_string().contains("hunter2"), "{ready}");
    storage.signal("-CONT");
    client.upload("bench", &[("kind", "noise")], "text/csv", csv.into_bytes()).await.expect("a run");
}

#[test]
fn a_bucket_that_cannot_be_used_stops_the_start_with_its_reason() {
    let Some(storage) = Storage::start() else { return };
    let first = TempDir::new().expect("a directory");
    Program::start(&first, &storage.environment()).kill();
    let start =
        |directory: &Path, change: &[(&str, &str)]| refused_start(directory, &storage.environment(), change);
    // A token is a row: it is made without the bucket.
    let made = rigcast(&["token", "create", "--name", "lab", "--role", "admin", "--data-dir"])
        .arg(first.path())
        .output();
    let made = made.expect("it ends");
    assert!(made.status.success(), "{}", String::from_utf8_lossy(&made.stderr));
    let other = TempDir::new().expect("a directory");
    let said = start(other.path(), &[]);
    assert!(said.contains("it belongs to another Rigcast"), "{said}");
    let said = start(first.path(), &[("RIGCAST_OBJECTS", "")]);
    assert!(said.contains("name it with --objects"), "{said}");
    let said = start(first.path(), &[("RIGCAST_OBJECTS", "s3://lab/two")]);
    assert!(said.contains("are in s3://lab/one"), "{said}");
    let said = start(other.path(), &[("RIGCAST_OBJECTS", "s3://nowhere/one")]);
    assert!(said.contains("s3://nowhere/one") && said.contains("no such bucket"), "{said}");
    let free = TcpListener::bind("127.0.0.1:0").and_then(|free| free.local_addr()).expect("a port");
    let said = start(other.path(), &[("RIGCAST_S3_ENDPOINT", &format!("http://{free}"))]);
    assert!(said.contains("s3://lab/one cannot be used"), "{said}");
    let said = start(other.path(), &[("RIGCAST_OBJECTS", "s3://key:hunter2@lab/one")]);
    assert!(said.contains("keys belong into AWS_ACCESS_KEY_ID"), "{said}");
}
