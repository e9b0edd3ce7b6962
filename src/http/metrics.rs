//! Metrics for Prometheus.

use axum::extract::State;
use axum::http::header::CONTENT_TYPE;
use axum::response::IntoResponse;

use super::observe::method_label;
use super::params::NoParams;
use super::problem::Answer;
use super::routes::ROUTES;
use super::{Http, Shared, codes};
use crate::compute::Class;
use crate::domain::{JobKind, JobState};
use crate::engine::model::VersionKind;
use crate::telemetry::{self, names, process};

/// Most rigs that have a series of their own.
const MAX_RIGS: u32 = 1000;

/// Formats of uploads: the label in the metrics, and the prefix of their own problem codes.
const FORMATS: [(&str, &str); 9] = [
    ("csv", "csv."),
    ("npy", "npy."),
    ("rpc3", "rpc3."),
    ("npz", "npz."),
    ("mat", "mat."),
    ("hdf5", "hdf5."),
    ("uff58", "uff58."),
    ("json", "json."),
    ("safetensors", "weights."),
];

/// Starts every series whose labels are known in advance at zero, so that its first rise is visible.
pub fn begin(http: &Http) {
    let count = |name, labels: &[(&'static str, &'static str)]| metrics::counter!(name, labels).increment(0);
    for route in ROUTES {
        // Series of other statuses begin with their first answer; alarms watch for 500.
        let labels = [("route", route.path), ("method", method_label(&route.method)), ("status", "500")];
        count(names::REQUESTS, &labels);
        let _ = metrics::histogram!(names::REQUEST_SECONDS, &labels[..2]);
    }
    names::LIMITS.iter().for_each(|limit| count(names::CONNECTIONS_REFUSED, &[("limit", limit)]));
    names::SLOW_IN.iter().for_each(|slow| count(names::CONNECTIONS_ENDED, &[("slow_in", slow)]));
    let compute = [Class::Predict, Class::Long, Class::Fit].map(|class| http.compute.queue(class));
    for queue in http.admission.all().into_iter().chain(compute).chain([http.predictions.queue()]) {
        let class = ("class", queue.depth().0);
        metrics::gauge!(names::QUEUE_DEPTH, &[class]).increment(0.0);
        metrics::gauge!(names::TURNS, &[class]).increment(0.0);
        let _ = metrics::histogram!(names::QUEUE_SECONDS, &[class]);
        names::SHED_REASONS.iter().for_each(|reason| count(names::SHED, &[class, ("reason", reason)]));
    }
    for kind in VersionKind::ALL.map(|kind| [("kind", kind.as_str())]) {
        count(names::PREDICTIONS, &kind);
        let _ = metrics::histogram!(names::PREDICTION_SECONDS, &kind);
    }
    for stage in names::STAGES {
        let _ = metrics::histogram!(names::STAGE_SECONDS, "stage" => stage);
    }
    for outcome in names::OUTCOMES.map(|outcome| ("outcome", outcome)) {
        JobKind::ALL.iter().for_each(|kind| count(names::ATTEMPTS, &[("kind", kind.as_str()), outcome]));
        let _ = metrics::histogram!(names::FIT_SECONDS, &[outcome]);
    }
    for (format, own) in FORMATS {
        let reasons = codes::ALL.iter().filter(|code| code.name.starts_with(own));
        reasons.for_each(|code| count(names::PARSE_ERRORS, &[("format", format), ("reason", code.name)]));
    }
    count(names::DEADLINES, &[]);
    count(names::ABANDONED, &[]);
    count(names::ROWS_MENDED, &[]);
    names::STORE_FAILURES.iter().for_each(|kind| count(names::STORE_ERRORS, &[("kind", kind)]));
}

/// `GET /metrics`. Figures of the store and the system are read now, because other processes change them
/// too.
pub async fn show(State(http): State<Shared>, _: NoParams) -> Answer {
    let counts = http.store.count_jobs().await?;
    for state in JobState::ALL {
        let n = counts.iter().find(|(s, _)| *s == state).map_or(0, |(_, n)| *n);
        metrics::gauge!(names::JOBS, "state" => state.as_str()).set(n as f64);
    }
    metrics::gauge!(names::LOADED_MODELS).set(http.models.loaded() as f64);
    metrics::gauge!(names::DEGRADED).set(http.models.degraded().await?.len() as f64);
    let usage = http.store.usage().await?;
    for (part, bytes) in usage.parts() {
        metrics::gauge!(names::DATA_BYTES, "part" => part).set(bytes as f64);
    }
    metrics::gauge!(names::DATA_FREE_BYTES).set(usage.free as f64);
    let errors = validation_errors(&http.store.validation_errors(MAX_RIGS).await?);
    let ratios = http.store.error_ratios(MAX_RIGS).await?;
    let ratios: Vec<(String, f64)> = ratios.into_iter().map(|(rig, ratio)| (of_rig(&rig), ratio)).collect();
    let mut text = http.metrics.render();
    telemetry::write_by_hand(&mut text, names::VALIDATION_ERROR, &errors);
    telemetry::write_by_hand(&mut text, names::MODEL_ERROR_RATIO, &ratios);
    process::write(&mut text);
    Ok(([(CONTENT_TYPE, "text/plain; version=0.0.4; charset=utf-8")], text).into_response())
}

/// The labels of a series of a rig. Rig ids are slugs and need no escaping.
fn of_rig(rig: &str) -> String {
    format!("{{rig=\"{rig}\"}}")
}

/// Written anew each time, so that a deleted rig disappears here too.
fn validation_errors(rigs: &[(String, Vec<Option<f64>>)]) -> Vec<(String, f64)> {
    let known =
        rigs.iter().map(|(rig, errors)| (rig, errors.iter().copied().flatten().collect::<Vec<f64>>()));
    known
        .filter(|(_, errors)| !errors.is_empty())
        .map(|(rig, errors)| (of_rig(rig), errors.iter().sum::<f64>() / errors.len() as f64))
        .collect()
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;

    use super::*;

    #[test]
    fn a_rigs_error_is_the_mean_of_what_is_known() {
        let rigs = [("a".to_owned(), vec![Some(0.1), None, Some(0.3)]), ("b".to_owned(), vec![None])];
        assert_eq!(validation_errors(&rigs), [("{rig=\"a\"}".to_owned(), 0.2)]);
    }

    #[test]
    fn every_format_has_codes_of_its_own() {
        let with_codes: BTreeSet<&str> = FORMATS
            .into_iter()
            .filter(|(_, own)| codes::ALL.iter().any(|code| code.name.starts_with(own)))
            .map(|(format, _)| format)
            .collect();
        assert_eq!(with_codes.len(), FORMATS.len(), "{with_codes:?}");
    }
}
