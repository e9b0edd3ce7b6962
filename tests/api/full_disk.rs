//! A full disk: uploads, imports and jobs are refused with a problem that says so, predictions go on,
//! nothing acknowledged is lost, and everything works again once there is room.
//!
//! Needs a small file system of its own: skipped where the user may not mount one.
//! `RIGCAST_TEST_FILLINGS=20 cargo test --test api full_disk -- --nocapture` fills it more often.

use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::{Duration, Instant};

use rigcast::client::{Client, ClientError};
use serde_json::{Value, json};
use tempfile::TempDir;

use crate::support::{Program, bench, gain_weights, noise_csv, setting};

/// A file system of a few megabytes in memory.
struct SmallDisk(TempDir);

impl SmallDisk {
    fn mount(mebibytes: u32) -> Option<Self> {
        let directory = TempDir::new().expect("a directory");
        let size = format!("size={mebibytes}m");
        let mounted =
            Command::new("mount").args(["-t", "tmpfs", "-o", &size, "tmpfs"]).arg(directory.path()).output();
        mounted.is_ok_and(|done| done.status.success()).then_some(Self(directory))
    }

    fn data_dir(&self) -> PathBuf {
        self.0.path().join("data")
    }

    /// A file that fills the remaining room.
    fn fill(&self) -> PathBuf {
        let path = self.0.path().join("ballast");
        let mut ballast = std::fs::File::create(&path).expect("a file");
        for piece in [1 << 16, 1 << 10, 1] {
            while std::io::Write::write_all(&mut ballast, &vec![0; piece]).is_ok() {}
        }
        path
    }
}

impl Drop for SmallDisk {
    fn drop(&mut self) {
        // Errors are ignored: a mount that stays does no harm to the tests.
        let _ = Command::new("umount").arg("-l").arg(self.0.path()).status();
    }
}

/// Status and code of a refusal.
fn refusal<T: std::fmt::Debug>(answer: Result<T, ClientError>) -> (u16, String) {
    match answer {
        Err(ClientError::Problem { status, problem }) => {
            (status, problem["code"].as_str().unwrap_or_default().into())
        }
        other => panic!("no refusal: {other:?}"),
    }
}

async fn upload(client: &Client, seed: u64, samples: usize) -> Result<Value, ClientError> {
    client.upload("bench", &[("kind", "noise")], "text/csv", noise_csv(samples, seed).into_bytes()).await
}

async fn activate(base: &str, version: Value) {
    let url = format!("{base}/v1/rigs/bench/active-model");
    let request = reqwest::Client::new().put(url).header("if-match", "*").json(&json!({"version": version}));
    let answer = request.send().await.expect("an answer");
    assert_eq!(answer.status(), 200, "{}", answer.text().await.expect("text"));
}

fn size(path: &Path) -> u64 {
    std::fs::metadata(path).map_or(0, |found| found.len())
}

#[tokio::test]
async fn a_full_disk_refuses_writes_predicts_on_and_recovers() {
    let Some(disk) = SmallDisk::mount(16) else {
        println!("skipped: no file system can be mounted here");
        return;
    };
    let program = Program::start_on(&disk.data_dir(), &[]);
    let client = Client::new(program.base(), None).expect("a client");
    client.post("/v1/rigs", &bench()).await.expect("a rig");
    client.import("bench", gain_weights(&["u"], &["y"], 2.0)).await.expect("a model");
    let mut runs = vec![upload(&client, 0, 3000).await.expect("a run")];
    let drive = json!({"model": 1, "drive": {"sample_rate_hz": 100.0, "channels": {"u": [0.5, 1.0]}}});
    let rounds: u64 = setting("RIGCAST_TEST_FILLINGS", 4);
    for round in 1..=rounds {
        let spare = upload(&client, 100 * round + 98, 3000).await.expect("room at first");
        // Filled by uploads, or at once by another file.
        let ballast = (round % 2 == 0).then(|| disk.fill());
        let full = loop {
            match upload(&client, 100 * round + runs.len() as u64, 20_000).await {
                Ok(run) => runs.push(run),
                refused => break refusal(refused),
            }
        };
        assert_eq!(full, (507, "store.full".into()));
        let filler = disk.fill();
        for seed in 0..25 {
            let refused = refusal(upload(&client, seed, 20_000).await);
            assert_eq!(refused, (507, "store.full".into()));
            client.post("/v1/rigs/bench/predict", &drive).await.expect("predictions go on");
        }
        // A job is a row: it may still find room in the database where runs were deleted before.
        let fit = client.fit("bench", &json!({"kind": "frf"})).await;
        if fit.is_err() || round == 1 {
            let refused = refusal(fit);
            assert!([507, 503].contains(&refused.0), "{refused:?}");
        }
        let ready = client.get("/readyz?verbose").await.expect("ready to predict");
        assert_eq!(ready["checks"]["store"], "full");
        assert_eq!(ready["store"], "full");
        // A full disk can be emptied, and the last model that worked can be put back.
        let spare = format!("/v1/rigs/bench/runs/{}", spare["id"].as_str().expect("an id"));
        client.delete(&spare).await.expect("deleted on a full disk");
        activate(program.base(), json!(null)).await;
        activate(program.base(), json!(1)).await;
        std::fs::remove_file(filler).expect("room");
        if let Some(ballast) = ballast.filter(|path| size(path) > 0) {
            std::fs::remove_file(ballast).expect("room");
        }
        let room = Instant::now();
        // One of them may be a small one, whose room an upload needs twice over.
        for run in runs.split_off(runs.len() - 3) {
            let path = format!("/v1/rigs/bench/runs/{}", run["id"].as_str().expect("an id"));
            while let Err(error) = client.delete(&path).await {
                assert!(room.elapsed() < Duration::from_secs(10), "back within ten seconds, not {error}");
                tokio::time::sleep(Duration::from_millis(100)).await;
            }
        }
        loop {
            match upload(&client, 100 * round + 99, 3000).await {
                Ok(run) => break runs.push(run),
                Err(error) => {
                    assert!(room.elapsed() < Duration::from_secs(10), "back within ten seconds, not {error}")
                }
            }
            tokio::time::sleep(Duration::from_millis(100)).await;
        }
    }
    program.kill();
    let program = Program::start_on(&disk.data_dir(), &[]);
    let client = Client::new(program.base(), None).expect("a client");
    for run in &runs {
        let path = format!("/v1/rigs/bench/runs/{}", run["id"].as_str().expect("an id"));
        assert_eq!(client.get(&path).await.expect("it is there")["sha256"], run["sha256"]);
        client.get(&format!("{path}/data?to_s=1")).await.expect("and whole");
    }
    println!(
        "a disk filled {rounds} times: {} runs acknowledged and there, every prediction answered",
        runs.len()
    );
}
