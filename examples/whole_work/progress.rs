//! Progress on standard error.

use indicatif::{ProgressBar, ProgressStyle};

#[path = "../support/progress.rs"]
mod jobs;

pub use jobs::{bar, show};

/// A bar for so many steps.
pub fn steps(name: &str, count: usize) -> ProgressBar {
    let style = ProgressStyle::with_template("{prefix:>8} {bar:32} {pos} of {len}, {eta} left")
        .unwrap_or_else(|_| ProgressStyle::default_bar());
    ProgressBar::new(count as u64).with_style(style).with_prefix(name.to_owned())
}
