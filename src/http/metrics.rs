//! Metrics for Prometheus.

use std::fmt::Write;

use axum::extract::State;
use axum::http::header::CONTENT_TYPE;
use axum::response::IntoResponse;

use super::Shared;
use super::params::NoParams;
use super::problem::Answer;
use crate::domain::JobState;
use crate::telemetry::names;

/// Most rigs that have a series of their own.
const MAX_RIGS: u32 = 1000;

/// `GET /metrics`. What the store knows is asked for when the metrics are, whoever changed it.
pub async fn show(State(http): State<Shared>, _: NoParams) -> Answer {
    let counts = http.store.count_jobs().await?;
    for state in JobState::ALL {
        let n = counts.iter().find(|(s, _)| *s == state).map_or(0, |(_, n)| *n);
        metrics::gauge!(names::JOBS, "state" => state.as_str()).set(n as f64);
    }
    metrics::gauge!(names::LOADED_MODELS).set(http.models.loaded() as f64);
    metrics::gauge!(names::DEGRADED).set(http.models.degraded().await?.len() as f64);
    let mut text = http.metrics.render();
    text.push_str(&validation_errors(&http.store.validation_errors(MAX_RIGS).await?));
    Ok(([(CONTENT_TYPE, "text/plain; version=0.0.4; charset=utf-8")], text).into_response())
}

/// Written by hand: a rig that is gone must be gone here too. Rig ids are slugs, nothing is escaped.
fn validation_errors(rigs: &[(String, Vec<Option<f64>>)]) -> String {
    let name = names::VALIDATION_ERROR;
    let help = names::ALL.iter().find(|metric| metric.1 == name).map_or("", |metric| metric.2);
    let mut text = format!("# HELP {name} {help}\n# TYPE {name} gauge\n");
    for (rig, errors) in rigs {
        let known: Vec<f64> = errors.iter().copied().flatten().collect();
        if !known.is_empty() {
            let mean = known.iter().sum::<f64>() / known.len() as f64;
            // Writing to a string cannot fail.
            let _ = writeln!(text, "{name}{{rig=\"{rig}\"}} {mean}");
        }
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_rigs_error_is_the_mean_of_what_is_known() {
        let rigs = [("a".to_owned(), vec![Some(0.1), None, Some(0.3)]), ("b".to_owned(), vec![None])];
        let text = validation_errors(&rigs);
        let lines: Vec<&str> = text.lines().filter(|line| !line.starts_with('#')).collect();
        assert_eq!(lines, ["rigcast_validation_error{rig=\"a\"} 0.2"]);
    }
}
