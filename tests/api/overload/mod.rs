//! Overload and slow clients: which requests are refused, and how.

mod connections;
mod deadline;
mod departed;
mod faults;
mod queues;

use std::time::Duration;

use rand::SeedableRng;
use rigcast::engine::lstm::{LstmNet, Recombine};
use rigcast::engine::model::{LstmPart, ModelKind, RigModel, Scaler, to_safetensors};
use serde_json::Value;
use tokio::task::JoinHandle;

use crate::support::{Reply, TestApp, gain_model};

/// Permits in use and tasks that wait, of a class.
async fn depth(app: &TestApp, class: &str) -> (u64, u64) {
    let ready = app.get("/readyz?verbose").await.expect(200).json();
    let of = |key: &str| ready["checks"]["queues"][class][key].as_u64().expect("a number");
    (of("in_use"), of("waiting"))
}

/// Waits until a class has so many permits in use and so many tasks waiting.
async fn until(app: &TestApp, class: &str, expected: (u64, u64)) {
    let mut found = (0, 0);
    for _ in 0..3000 {
        found = depth(app, class).await;
        if found == expected {
            return;
        }
        tokio::time::sleep(Duration::from_millis(20)).await;
    }
    panic!("{class} stays at {found:?}, {expected:?} was expected");
}

/// Checks a refusal for load: its code, and its `Retry-After`.
fn refusal(reply: Reply, status: u16, code: &str) -> Value {
    assert_eq!(reply.header("retry-after"), "1");
    reply.problem(status, code)
}

/// A prediction for the bench from an NPY drive, on a task of its own.
fn predict_npy(app: &TestApp, drive: &[u8]) -> JoinHandle<Reply> {
    let call = app.call("POST", "/v1/rigs/bench/predict?sample_rate_hz=100");
    tokio::spawn(call.header("accept", "application/x-npy").body("application/x-npy", drive).send())
}

/// Weights of a network with a window at every sample: some two million operations each.
fn slow_weights() -> Vec<u8> {
    let scaler = || Scaler { mean: vec![0.0], std: vec![1.0] };
    let mut rng = rand_chacha::ChaCha8Rng::seed_from_u64(1);
    let part = LstmPart {
        net: LstmNet::init(1, &[60], 1, 1.0, &mut rng),
        x: scaler(),
        y: scaler(),
        window_len: 64,
        hop: 1,
        recombine: Recombine::Welch,
    };
    let model = gain_model(&["u"], &["y"], 1.0);
    to_safetensors(&RigModel { kind: ModelKind::Lstm, frf: None, lstm: Some(part), ..model })
}
