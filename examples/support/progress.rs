//! Progress of a job as a bar on standard error.

use indicatif::{ProgressBar, ProgressStyle};
use serde_json::Value;

/// An empty bar for one job.
pub fn bar(name: &str) -> ProgressBar {
    let style = ProgressStyle::with_template("{prefix:>8} {bar:32} {percent:>3} % {msg}")
        .unwrap_or_else(|_| ProgressStyle::default_bar());
    ProgressBar::new(1000).with_style(style).with_prefix(name.to_owned())
}

/// Shows the job's progress on the bar.
pub fn show(bar: &ProgressBar, job: &Value) {
    bar.set_position((job["progress"].as_f64().unwrap_or(0.0) * 1000.0) as u64);
    let eta = job["eta_s"].as_f64().map(|s| format!(", about {s:.0} s left")).unwrap_or_default();
    bar.set_message(format!("{}{eta}", job["stage"].as_str().unwrap_or("waiting")));
}
