//! Times of diagnoses.

use std::path::Path;

use serde_json::Value;

use super::case::Case;
use super::row::{Bar, Row};
use super::statistics::{median, quantile};

/// The whole check, s.
const WHOLE_S: f64 = 45.0 * 60.0;

/// Rows of the clocked cases, of all others, and of the check itself where it was whole.
pub fn rows(cases: &[Case], dir: &Path, is_whole: bool) -> Vec<Row> {
    let elapsed = |c: &Case| c.report()["elapsed_s"].as_f64();
    let clocked = |axes: u64| -> Option<f64> {
        cases.iter().filter(|c| c.suite == "time" && c.label["axes"] == axes).filter_map(elapsed).next()
    };
    let mut rows = Vec::new();
    if cases.iter().any(|c| c.suite == "time") {
        rows.push(Row::number("time", "one response, 100 s at 512 Hz, s", clocked(1), Bar::AtMost(5.0)));
        rows.push(Row::number(
            "time",
            "3 drives x 6 responses, 100 s at 512 Hz, s",
            clocked(3),
            Bar::AtMost(60.0),
        ));
    }
    let others = || cases.iter().filter(|c| c.suite != "time").filter_map(elapsed);
    rows.push(Row::number("time", "a case of the other suites, median, s", median(others()), Bar::None));
    rows.push(Row::number("time", "a case, 99th percentile, s", quantile(others(), 0.99), Bar::None));
    let steps = std::fs::read(dir.join("times.json")).ok();
    if let Some(steps) = steps.and_then(|bytes| serde_json::from_slice::<Value>(&bytes).ok()) {
        let total = ["generate_s", "diagnose_s"].iter().map(|step| steps[step].as_f64()).sum();
        let bar = if is_whole { Bar::AtMost(WHOLE_S) } else { Bar::None };
        rows.push(Row::number("time", "cases made and diagnosed, s", total, bar));
    }
    rows
}
