//! Single bytes of stored weights and runs, flipped: each is found, named and never served.
//!
//! `RIGCAST_TEST_FLIPS=200 cargo test --test api flips -- --nocapture` flips more.

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use serde_json::json;

use crate::support::{SAFETENSORS, TestApp, bench, gain_weights, noise_csv, setting};

/// The request that reads an object, and the name of its owner in the readiness report.
struct Stored {
    path: String,
    named: (&'static str, serde_json::Value),
    file: std::path::PathBuf,
}

/// Some runs and models with the files of their objects.
async fn stored(app: &TestApp) -> Vec<Stored> {
    app.rig(&bench()).await;
    let mut found = Vec::new();
    let mut known: Vec<std::path::PathBuf> = Vec::new();
    let mut new = |app: &TestApp| {
        let file = app.files().into_iter().find(|file| !known.contains(file)).expect("one object more");
        known.push(file.clone());
        file
    };
    for seed in 0..3 {
        let run = app.run("kind=noise", &noise_csv(500, seed)).await;
        let path = format!("/v1/rigs/bench/runs/{}/data", run["id"].as_str().expect("an id"));
        found.push(Stored { path, named: ("run", run["id"].clone()), file: new(app) });
        let weights = gain_weights(&["u"], &["y"], 1.0 + seed as f64);
        let model = app.post_file("/v1/rigs/bench/models", SAFETENSORS, weights).await.expect(201).json();
        let path = format!("/v1/rigs/bench/models/{}/weights", model["version"]);
        found.push(Stored { path, named: ("version", model["version"].clone()), file: new(app) });
    }
    found
}

#[tokio::test]
async fn every_flipped_byte_is_found_named_and_never_served() {
    let flips: usize = setting("RIGCAST_TEST_FLIPS", 20);
    let app = TestApp::start();
    let stored = stored(&app).await;
    let mut random = ChaCha8Rng::seed_from_u64(7);
    for flip in 0..flips {
        let one = &stored[flip % stored.len()];
        let whole = std::fs::read(&one.file).expect("readable");
        let mut bytes = whole.clone();
        let at = random.random_range(0..bytes.len());
        bytes[at] ^= 1 << random.random_range(0..8);
        std::fs::write(&one.file, bytes).expect("written");
        app.get(&one.path).await.problem(500, "store.damaged");
        let degraded = app.get("/readyz").await.expect(200).json()["degraded"].clone();
        let (field, value) = &one.named;
        assert_eq!((&degraded[0]["rig"], &degraded[0][*field]), (&json!("bench"), value), "byte {at}");
        std::fs::write(&one.file, whole).expect("written");
        app.get(&one.path).await.expect(200);
        assert_eq!(app.get("/readyz").await.expect(200).json()["degraded"], json!([]), "it is whole again");
    }
    println!("{flips} flipped bytes: each found and named");
}
