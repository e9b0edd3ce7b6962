//! An open-loop load: requests are sent at their own times, whether or not earlier ones were answered. A
//! latency counts from the time at which the request was due, so that a client that falls behind does not
//! hide it.

use std::sync::Arc;
use std::time::{Duration, Instant};

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use tokio::task::JoinSet;

use super::client::Target;

/// The outcome of a request.
#[derive(Debug, Clone, Copy)]
pub struct Outcome {
    /// Time from when it was due to the end of its answer.
    pub took: Duration,
    /// Its status; 0: no answer at all.
    pub status: u16,
}

/// Requests of one kind at a mean rate, at random times as independent clients send them.
pub async fn arrivals(
    target: Arc<Target>,
    request: Arc<Vec<u8>>,
    per_s: f64,
    length: Duration,
    seed: u64,
) -> Vec<Outcome> {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let begin = Instant::now();
    let mut due = Duration::ZERO;
    let mut tasks = JoinSet::new();
    while due < length {
        tokio::time::sleep_until((begin + due).into()).await;
        let (target, request) = (Arc::clone(&target), Arc::clone(&request));
        tasks.spawn(async move {
            let status = target.send(&request).await.unwrap_or_default();
            Outcome { took: begin.elapsed() - due, status }
        });
        due += Duration::from_secs_f64(-(1.0 - rng.random::<f64>()).ln() / per_s);
    }
    tasks.join_all().await
}

/// Latencies of the requests that were answered with success.
pub fn accepted(outcomes: &[Outcome]) -> Vec<Outcome> {
    outcomes.iter().copied().filter(|outcome| (200..300).contains(&outcome.status)).collect()
}

/// Latencies of the requests that were refused for load.
pub fn shed(outcomes: &[Outcome]) -> Vec<Outcome> {
    outcomes.iter().copied().filter(|outcome| [429, 503].contains(&outcome.status)).collect()
}

/// A quantile of latencies, seconds; NaN without any.
pub fn quantile(outcomes: &[Outcome], q: f64) -> f64 {
    let mut took: Vec<Duration> = outcomes.iter().map(|outcome| outcome.took).collect();
    took.sort_unstable();
    let place = (q * took.len() as f64).ceil() as usize;
    took.get(place.saturating_sub(1)).map_or(f64::NAN, Duration::as_secs_f64)
}
