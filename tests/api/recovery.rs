//! A service that was killed, and whose write-ahead log or database was lost or damaged before the next start: it
//! starts with everything that was acknowledged or not at all, and `rigcast recover` brings everything back.
//!
//! `RIGCAST_TEST_DAMAGES=200 cargo test --test api recovery -- --nocapture` damages more places.

use std::collections::BTreeMap;
use std::io::{BufRead, BufReader};
use std::path::Path;
use std::process::{Command, Stdio};

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rigcast::client::Client;
use serde_json::Value;
use tempfile::TempDir;

use crate::support::{Program, bench, gain_weights, noise_csv, setting};

const RUNS: u64 = 20;

/// All files of a directory.
fn files(directory: &Path) -> BTreeMap<std::path::PathBuf, Vec<u8>> {
    let mut found = BTreeMap::new();
    for entry in std::fs::read_dir(directory).expect("a directory") {
        let path = entry.expect("an entry").path();
        if path.is_dir() {
            found.extend(files(&path));
        } else {
            found.insert(path.clone(), std::fs::read(&path).expect("a file"));
        }
    }
    found
}

fn copy(from: &Path) -> TempDir {
    let to = TempDir::new().expect("a directory");
    for (path, bytes) in files(from) {
        let place = to.path().join(path.strip_prefix(from).expect("below"));
        std::fs::create_dir_all(place.parent().expect("a directory")).expect("a directory");
        std::fs::write(place, bytes).expect("a file");
    }
    to
}

/// Objects by name, in the quarantine or not.
fn objects(data_dir: &Path) -> BTreeMap<String, Vec<u8>> {
    let named = files(data_dir).into_iter().filter_map(|(path, bytes)| {
        let name = path.file_name()?.to_str()?.to_owned();
        (name.len() == 64).then_some((name, bytes))
    });
    named.collect()
}

/// Every acknowledged rig, run and model as the service tells of them, and whether they can be read.
async fn told(client: &Client) -> Value {
    let mut told = serde_json::Map::new();
    for path in ["/v1/rigs", "/v1/rigs/bench/runs", "/v1/rigs/bench/models", "/v1/rigs/bench/active-model"] {
        told.insert(path.to_owned(), client.get(path).await.expect("a list"));
    }
    for run in told["/v1/rigs/bench/runs"]["items"].as_array().expect("runs") {
        let id = run["id"].as_str().expect("an id");
        client.get(&format!("/v1/rigs/bench/runs/{id}/data?to_s=1")).await.expect("its samples");
    }
    told.into()
}

/// Files of a service with runs and a model, as a kill leaves them, and what it told of them.
async fn killed_service() -> (TempDir, Value) {
    let directory = TempDir::new().expect("a directory");
    let program = Program::start(&directory, &[]);
    let client = Client::new(program.base(), None).expect("a client");
    client.post("/v1/rigs", &bench()).await.expect("a rig");
    for seed in 0..RUNS {
        let noise = noise_csv(200, seed).into_bytes();
        client.upload("bench", &[("kind", "noise")], "text/csv", noise).await.expect("a run");
    }
    client.import("bench", gain_weights(&["u"], &["y"], 2.0)).await.expect("a model");
    let told = told(&client).await;
    program.kill();
    (directory, told)
}

/// Starts the service; the message if that is refused.
fn refused(data_dir: &Path) -> Option<String> {
    let mut child = Command::new(env!("CARGO_BIN_EXE_rigcast"))
        .args(["serve", "--listen", "127.0.0.1:0", "--data-dir"])
        .arg(data_dir)
        .stderr(Stdio::piped())
        .spawn()
        .expect("the program runs");
    let mut log = String::new();
    for line in BufReader::new(child.stderr.take().expect("piped")).lines() {
        let line = line.expect("text");
        if line.contains("rigcast listens on ") {
            child.kill().expect("it runs");
            child.wait().expect("it ends");
            return None;
        }
        log.push_str(&line);
    }
    assert!(!child.wait().expect("it ends").success(), "{log}");
    Some(log)
}

/// Starts on damaged files, recovers where that is refused, and compares. Returns whether it was refused.
async fn nothing_is_lost(data_dir: &Path, wanted: &Value, what: &str) -> bool {
    let kept = objects(data_dir);
    let refused = refused(data_dir);
    if let Some(message) = &refused {
        assert!(message.contains("rigcast recover"), "{what}: {message}");
        let done = Command::new(env!("CARGO_BIN_EXE_rigcast"))
            .args(["recover", "--data-dir"])
            .arg(data_dir)
            .output()
            .expect("the program runs");
        let said = String::from_utf8_lossy(&done.stdout);
        assert!(done.status.success(), "{what}: {}", String::from_utf8_lossy(&done.stderr));
        assert!(said.contains("was made anew") && said.contains("the files from before are in"), "{said}");
    }
    let now = objects(data_dir);
    assert!(kept.iter().all(|(name, bytes)| now.get(name) == Some(bytes)), "{what}: an object was deleted");
    let program = Program::start_on(data_dir, &[]);
    let client = Client::new(program.base(), None).expect("a client");
    assert_eq!(told(&client).await, *wanted, "{what}, refused: {refused:?}");
    program.kill();
    refused.is_some()
}

#[tokio::test]
async fn a_lost_or_damaged_log_or_database_loses_nothing_that_was_acknowledged() {
    let places: usize = setting("RIGCAST_TEST_DAMAGES", 4);
    let (service, wanted) = killed_service().await;
    let lost = copy(service.path());
    std::fs::remove_file(lost.path().join("rigcast.db-wal")).expect("a log");
    assert!(nothing_is_lost(lost.path(), &wanted, "the log removed").await, "an empty start");
    let mut random = ChaCha8Rng::seed_from_u64(1);
    // An orderly stop brings the log into the database.
    let stopped = copy(service.path());
    let program = Program::start_on(stopped.path(), &[]);
    program.signal("-TERM");
    assert_eq!(program.ended().0, Some(0));
    for (name, service) in [("rigcast.db-wal", &service), ("rigcast.db", &stopped)] {
        let whole = std::fs::read(service.path().join(name)).expect("a file");
        let mut refusals = 0;
        for k in 0..places {
            let mut bytes = whole.clone();
            let at = random.random_range(0..bytes.len());
            let what = match k {
                0 => {
                    bytes.fill(0);
                    format!("{name} zeroed")
                }
                k if k % 5 == 1 => {
                    bytes.truncate(at);
                    format!("{name} cut at {at}")
                }
                _ => {
                    bytes[at] ^= 1 << random.random_range(0..8);
                    format!("{name} flipped at {at}")
                }
            };
            let damaged = copy(service.path());
            std::fs::write(damaged.path().join(name), bytes).expect("a file");
            refusals += usize::from(nothing_is_lost(damaged.path(), &wanted, &what).await);
        }
        println!(
            "{name} damaged at {places} places: {refusals} starts refused, 0 rows lost, 0 objects deleted"
        );
    }
}
