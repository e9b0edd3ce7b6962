//! Progress on the terminal.

use indicatif::{ProgressBar, ProgressStyle};
use serde_json::Value;

fn styled(bar: ProgressBar, template: &str) -> ProgressBar {
    bar.with_style(ProgressStyle::with_template(template).unwrap_or_else(|_| ProgressStyle::default_bar()))
}

/// A bar that counts steps.
pub fn steps(what: &'static str) -> ProgressBar {
    styled(ProgressBar::new(0), "{msg:24} {bar:32} {pos}/{len} ({elapsed})").with_message(what)
}

/// A bar for a job of the service.
pub fn job() -> ProgressBar {
    styled(ProgressBar::new(1000), "{msg:24} {bar:32} {percent:>3} % ({elapsed}{prefix})")
}

/// Moves a job's bar to where the job stands.
pub fn show(bar: &ProgressBar, job: &Value) {
    bar.set_position((job["progress"].as_f64().unwrap_or(0.0) * 1000.0) as u64);
    bar.set_prefix(job["eta_s"].as_f64().map(|s| format!(", about {s:.0} s left")).unwrap_or_default());
    bar.set_message(job["stage"].as_str().unwrap_or("waiting").to_owned());
}
