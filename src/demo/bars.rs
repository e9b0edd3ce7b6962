//! Progress on the terminal: one line on standard error, written over. Nothing where that is no terminal.

use std::io::{IsTerminal, Write};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use serde_json::Value;

/// Characters between the ends of a bar.
const WIDTH: u64 = 32;

/// Least time between two drawings.
const PAUSE: Duration = Duration::from_millis(100);

/// A bar. Clones draw the same one.
#[derive(Debug, Clone)]
pub struct Bar {
    started: Instant,
    shown: bool,
    state: Arc<Mutex<State>>,
}

#[derive(Debug)]
struct State {
    label: String,
    position: u64,
    length: u64,
    /// Text after the bar; without one the position and the length.
    note: Option<String>,
    drawn: Option<Instant>,
}

/// A bar that counts steps.
pub fn steps(what: &str) -> Bar {
    Bar::new(what, 0)
}

/// A bar for a job of the service.
pub fn job() -> Bar {
    Bar::new("waiting", 1000)
}

/// Shows a job's progress on its bar.
pub fn show(bar: &Bar, job: &Value) {
    let progress = job["progress"].as_f64().unwrap_or(0.0);
    let left = job["eta_s"].as_f64().map(|s| format!(", about {s:.0} s left")).unwrap_or_default();
    bar.change(|state| {
        state.position = (progress * 1000.0) as u64;
        state.note = Some(format!("{:>3.0} %{left}", 100.0 * progress));
        job["stage"].as_str().unwrap_or("waiting").clone_into(&mut state.label);
    });
}

impl Bar {
    fn new(label: &str, length: u64) -> Self {
        let state = State { label: label.to_owned(), position: 0, length, note: None, drawn: None };
        let shown = std::io::stderr().is_terminal();
        Self { started: Instant::now(), shown, state: Arc::new(Mutex::new(state)) }
    }

    /// Sets the number of steps.
    pub fn set_length(&self, length: u64) {
        self.change(|state| state.length = length);
    }

    /// Counts steps that are done.
    pub fn inc(&self, steps: u64) {
        self.change(|state| state.position += steps);
    }

    /// Time since the bar was made.
    pub fn elapsed(&self) -> Duration {
        self.started.elapsed()
    }

    /// Takes the bar off the terminal.
    pub fn finish_and_clear(&self) {
        if self.shown {
            // A terminal that is gone shows no progress, and needs none.
            let _ = write!(std::io::stderr(), "\r\x1b[2K");
        }
    }

    fn change(&self, change: impl FnOnce(&mut State)) {
        let mut state = self.state.lock().unwrap_or_else(PoisonError::into_inner);
        change(&mut state);
        if self.shown && state.drawn.is_none_or(|drawn| drawn.elapsed() >= PAUSE) {
            state.drawn = Some(Instant::now());
            let _ = write!(std::io::stderr(), "\r\x1b[2K{}", state.line(self.elapsed()));
        }
    }
}

impl State {
    fn line(&self, elapsed: Duration) -> String {
        let done = (self.position.min(self.length) * WIDTH).checked_div(self.length).unwrap_or(0) as usize;
        let bar = "█".repeat(done) + &"░".repeat(WIDTH as usize - done);
        let note = self.note.clone().unwrap_or_else(|| format!("{}/{}", self.position, self.length));
        format!("{:24} {bar} {note} ({} s)", self.label, elapsed.as_secs())
    }
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    #[test]
    fn a_bar_fills_with_its_steps_and_a_jobs_says_what_is_done_and_left() {
        let line = |bar: &Bar| bar.state.lock().unwrap().line(Duration::from_secs(7));
        let bar = steps("uploading");
        assert!(line(&bar).ends_with("0/0 (7 s)"), "{}", line(&bar));
        bar.set_length(4);
        bar.clone().inc(1);
        assert_eq!(line(&bar), format!("{:24} {}{} 1/4 (7 s)", "uploading", "█".repeat(8), "░".repeat(24)));
        let bar = job();
        show(&bar, &json!({"progress": 0.5, "eta_s": 12.4, "stage": "training"}));
        let shown = line(&bar);
        assert!(shown.starts_with("training ") && shown.ends_with(" 50 %, about 12 s left (7 s)"), "{shown}");
        assert_eq!(shown.matches('█').count(), 16);
    }
}
