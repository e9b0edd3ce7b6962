//! The deadline of answers.

use std::time::Duration;

use rigcast::compute::fair_queue::QueueSettings;
use serde_json::json;

use super::{predict_npy, refusal, slow_weights, until};
use crate::support::{TestApp, bench, npy};

/// So long that the whole would take many times the deadline on any machine, and short enough that the
/// body is read to its end and the client can read the refusal.
const SAMPLES: usize = 250_000;

#[tokio::test]
async fn work_that_is_not_done_at_the_deadline_is_given_up_and_its_turn_comes_back() {
    let app = TestApp::start_as(|mut config| {
        config.compute.long = QueueSettings::new(1, 0, Duration::from_secs(60));
        config.limits.deadline = Duration::from_millis(500);
        config
    });
    app.rig(&bench()).await;
    app.activate("bench", slow_weights()).await;
    let drive = npy("<f4", false, &format!("({SAMPLES}, 1)"), &vec![0; 4 * SAMPLES]);
    let predict = || predict_npy(&app, &drive);
    let first = predict();
    until(&app, "long", (1, 0)).await;
    refusal(predict().await.expect("no panic"), 503, "busy");
    first.await.expect("no panic").problem(504, "predict.deadline");
    until(&app, "long", (0, 0)).await;

    let zeros = vec![0; 400_000];
    let request =
        json!({"drive": {"sample_rate_hz": 100.0, "channels": {"u": zeros}}, "include": ["response"]});
    app.post_json("/v1/rigs/bench/predict", &request).await.problem(504, "predict.deadline");
    until(&app, "long", (0, 0)).await;
}
