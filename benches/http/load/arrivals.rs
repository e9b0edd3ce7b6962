//! Open loop: requests come when they come, whatever became of those before. Times count from when a
//! request should have been sent, so that a client that falls behind does not hide it.

use std::sync::Arc;
use std::time::{Duration, Instant};

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use tokio::task::JoinSet;

use super::client::Target;

/// What became of a request.
#[derive(Debug, Clone, Copy)]
pub struct Outcome {
    /// From when it was due to the end of its answer.
    pub took: Duration,
    /// Its status; 0: no answer at all.
    pub status: u16,
}

/// Requests of one kind at a mean rate, at random moments as independent clients send them.
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

/// Those that were answered as asked.
pub fn accepted(outcomes: &[Outcome]) -> Vec<Outcome> {
    outcomes.iter().copied().filter(|outcome| (200..300).contains(&outcome.status)).collect()
}

/// Those that were sent away.
pub fn shed(outcomes: &[Outcome]) -> Vec<Outcome> {
    outcomes.iter().copied().filter(|outcome| [429, 503].contains(&outcome.status)).collect()
}

/// A quantile of their times, seconds; of none it is not a number.
pub fn quantile(outcomes: &[Outcome], q: f64) -> f64 {
    let mut took: Vec<Duration> = outcomes.iter().map(|outcome| outcome.took).collect();
    took.sort_unstable();
    let place = (q * took.len() as f64).ceil() as usize;
    took.get(place.saturating_sub(1)).map_or(f64::NAN, Duration::as_secs_f64)
}
