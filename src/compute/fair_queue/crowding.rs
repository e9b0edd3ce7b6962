//! How many tasks may wait: as many as a wait of the queue's patience has room for, but no fewer than a burst of a
//! few clients has; and few once more work comes than can be done.
//!
//! A burst may fill the queue. A queue that has not been empty for a while means more work than can be done,
//! and a longer wait helps nobody (after Nichols and Jacobson's controlled delay, 2012). It is then kept short
//! until hardly a task is refused any more. That it has been empty for a moment says little: a short queue
//! often is, and the next burst would have to wait behind all of a long one.

use std::time::Duration;

use tokio::time::Instant;

use super::QueueSettings;

/// Tasks for each permit in a queue that is kept short.
const SHORT_QUEUE: usize = 2;

/// Tasks for each permit that a burst may bring, however long each takes.
const BURST: usize = 16;

/// Time over which arrivals and refusals are counted.
const WINDOW: Duration = Duration::from_secs(1);

/// The queue is kept short while more than one in so many tasks are refused.
const RARE: u32 = 10;

/// Weight of one task in the mean time of work.
const WEIGHT: f64 = 1.0 / 16.0;

/// Arrivals, refusals and times of work of late.
#[derive(Debug)]
pub(super) struct Crowding {
    /// When the queue was last empty.
    emptied: Instant,
    /// Whether more work comes than can be done.
    crowded: bool,
    /// Begin of the window, and the tasks that came and were refused in it.
    began: Instant,
    asked: u32,
    refused: u32,
    /// Mean time that a permit is held, seconds; `None` before the first.
    work_s: Option<f64>,
}

impl Crowding {
    pub(super) fn new() -> Self {
        let now = Instant::now();
        Self { emptied: now, crowded: false, began: now, asked: 0, refused: 0, work_s: None }
    }

    /// The queue is empty.
    pub(super) fn emptied(&mut self) {
        self.emptied = Instant::now();
    }

    /// A permit was held for this time.
    pub(super) fn worked(&mut self, held: Duration) {
        let held = held.as_secs_f64();
        let before = self.work_s.unwrap_or(held);
        self.work_s = Some(before + WEIGHT * (held - before));
    }

    /// A task came while no permit was free.
    pub(super) fn asked(&mut self, refused: bool) {
        if self.began.elapsed() > WINDOW {
            if self.crowded && self.refused * RARE <= self.asked {
                self.crowded = false;
                self.emptied();
            }
            self.begin_window();
        }
        self.asked = self.asked.saturating_add(1);
        self.refused = self.refused.saturating_add(u32::from(refused));
    }

    /// Tasks that may wait, where so many wait now.
    pub(super) fn room(&mut self, waiting: usize, settings: &QueueSettings) -> usize {
        if !self.crowded && waiting > 0 && self.emptied.elapsed() > settings.patience {
            self.crowded = true;
            self.begin_window();
        }
        if self.crowded {
            return settings.max_waiting.min(SHORT_QUEUE * settings.permits);
        }
        let in_time = self.work_s.map_or(f64::INFINITY, |work_s| {
            settings.patience.as_secs_f64() * settings.permits as f64 / work_s.max(f64::MIN_POSITIVE)
        });
        // A float beyond the range becomes the largest number.
        (in_time as usize).max(BURST * settings.permits).min(settings.max_waiting)
    }

    fn begin_window(&mut self) {
        (self.began, self.asked, self.refused) = (Instant::now(), 0, 0);
    }
}
