//! Waiting for a fit to come so far.

use std::time::Duration;

use rigcast::client::Client;

/// Waits until a fit that is running, at its first attempt, has come further than `progress`; returns how far.
pub async fn further(client: &Client, job: &str, progress: f64) -> f64 {
    loop {
        let found = client.get(&format!("/v1/jobs/{job}")).await.expect("the job");
        assert_eq!(found["attempt"].as_u64().unwrap_or_default().max(1), 1, "a stop is no failure: {found}");
        assert!(["queued", "running"].contains(&found["state"].as_str().unwrap_or_default()), "{found}");
        let now = found["progress"].as_f64().unwrap_or_default();
        if found["state"] == "running" && now > progress {
            return now;
        }
        tokio::time::sleep(Duration::from_millis(50)).await;
    }
}
