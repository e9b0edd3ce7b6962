//! Metrics for Prometheus.

use axum::extract::State;
use axum::http::header::CONTENT_TYPE;
use axum::response::IntoResponse;

use super::Shared;
use super::params::NoParams;
use super::problem::Answer;
use crate::domain::JobState;
use crate::telemetry::names;

/// `GET /metrics`. Jobs are counted when asked: the store knows them, whoever changed them.
pub async fn show(State(http): State<Shared>, _: NoParams) -> Answer {
    let counts = http.store.count_jobs().await?;
    for state in JobState::ALL {
        let n = counts.iter().find(|(s, _)| *s == state).map_or(0, |(_, n)| *n);
        metrics::gauge!(names::JOBS, "state" => state.as_str()).set(n as f64);
    }
    Ok(([(CONTENT_TYPE, "text/plain; version=0.0.4; charset=utf-8")], http.metrics.render()).into_response())
}
