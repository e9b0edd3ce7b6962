//! The link between a job's worker and its work: progress and checkpoints go one way, the request to
//! stop goes the other.

use std::collections::BTreeMap;
use std::ops::{ControlFlow, Range};
use std::sync::atomic::{AtomicU8, Ordering};
use std::sync::{Mutex, PoisonError};
use std::time::{Duration, Instant};

use serde::{Deserialize, Serialize};
use tokio::sync::Notify;

use crate::engine::{Loss, Progress};
use crate::storage::Checkpoint;

/// Time between two signs of life.
const RENEW_EVERY: Duration = Duration::from_secs(2);

/// Why work must stop before its end.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[repr(u8)]
pub(super) enum Stop {
    /// Somebody cancelled the job.
    Cancelled = 1,
    /// The service stops.
    Shutdown = 2,
    /// The lease, or the job, is gone.
    Lost = 3,
    /// A more urgent job waits.
    Yield = 4,
}

/// Errors of epochs that were not stored yet.
#[derive(Debug, Default, Clone, PartialEq, Serialize, Deserialize)]
pub(super) struct NewLosses {
    /// Whether a training began anew, so that what is stored is of another one.
    pub anew: bool,
    pub losses: Vec<Loss>,
}

impl NewLosses {
    pub fn is_empty(&self) -> bool {
        !self.anew && self.losses.is_empty()
    }

    /// Adds later ones.
    pub fn add(&mut self, later: Self) {
        if later.anew {
            *self = later;
        } else {
            self.losses.extend(later.losses);
        }
    }
}

/// Shared by the worker, its work, and the request that cancels.
#[derive(Debug)]
pub(super) struct Control {
    /// 0, or the first [`Stop`].
    stop: AtomicU8,
    progress: Mutex<(String, f64)>,
    /// What stages begin with, and the share of the whole that reported fractions are of.
    scope: Mutex<(String, Range<f64>)>,
    /// Checkpoints that were not stored yet, the latest of each part.
    kept: Mutex<BTreeMap<String, Checkpoint>>,
    /// One that is handed over again and again, and when it was last.
    renewed: Mutex<Option<(Checkpoint, Option<Instant>)>>,
    /// Notified when there is a checkpoint to be stored.
    news: Notify,
    losses: Mutex<NewLosses>,
}

impl Default for Control {
    fn default() -> Self {
        Self {
            stop: AtomicU8::new(0),
            progress: Mutex::default(),
            scope: Mutex::new((String::new(), 0.0..1.0)),
            kept: Mutex::default(),
            renewed: Mutex::default(),
            news: Notify::new(),
            losses: Mutex::default(),
        }
    }
}

impl Control {
    /// Asks the work to stop; the first reason counts.
    pub(super) fn stop(&self, why: Stop) {
        // A failure means that there is a reason already.
        let _ = self.stop.compare_exchange(0, why as u8, Ordering::Relaxed, Ordering::Relaxed);
    }

    /// The reason to stop, if there is one.
    pub(super) fn stopped(&self) -> Option<Stop> {
        [Stop::Cancelled, Stop::Shutdown, Stop::Lost, Stop::Yield]
            .into_iter()
            .find(|why| *why as u8 == self.stop.load(Ordering::Relaxed))
    }

    /// The engine's callback: records the progress, and breaks when the work is to stop.
    pub(super) fn watch(&self, progress: Progress<'_>) -> ControlFlow<()> {
        self.report(progress.stage, progress.fraction);
        if let Some(loss) = progress.loss {
            self.add_losses(NewLosses { anew: false, losses: vec![loss] });
        }
        if self.stopped().is_some() { ControlFlow::Break(()) } else { ControlFlow::Continue(()) }
    }

    /// Records the progress, within the scope.
    pub(super) fn report(&self, stage: &str, fraction: f64) {
        let scope = self.scope.lock().unwrap_or_else(PoisonError::into_inner);
        let (prefix, range) = &*scope;
        let mut progress = self.progress.lock().unwrap_or_else(PoisonError::into_inner);
        if progress.0.strip_prefix(prefix.as_str()) != Some(stage) {
            progress.0 = format!("{prefix}{stage}");
        }
        progress.1 = range.start + (range.end - range.start) * fraction;
    }

    /// Makes all that is reported from here on a part of something larger.
    pub(super) fn scope(&self, prefix: String, range: Range<f64>) {
        *self.scope.lock().unwrap_or_else(PoisonError::into_inner) = (prefix, range);
    }

    /// Hands over a checkpoint to be stored.
    pub(super) fn keep(&self, checkpoint: Checkpoint) {
        let mut kept = self.kept.lock().unwrap_or_else(PoisonError::into_inner);
        kept.insert(checkpoint.part.clone(), checkpoint);
        self.news.notify_one();
    }

    /// Waits until a checkpoint was handed over: other workers may wait for what it says.
    pub(super) async fn kept(&self) {
        self.news.notified().await;
    }

    /// Hands over a checkpoint again and again, as a sign of life, in place of the last such one.
    pub(super) fn renew(&self, checkpoint: Option<Checkpoint>) {
        *self.renewed.lock().unwrap_or_else(PoisonError::into_inner) = checkpoint.map(|one| (one, None));
        self.news.notify_one();
    }

    /// Checkpoints since the last call.
    pub(super) fn take_kept(&self) -> Vec<Checkpoint> {
        let mut renewed = self.renewed.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some((checkpoint, last)) = &mut *renewed
            && last.is_none_or(|last| last.elapsed() >= RENEW_EVERY)
        {
            *last = Some(Instant::now());
            self.keep(checkpoint.clone());
        }
        std::mem::take(&mut *self.kept.lock().unwrap_or_else(PoisonError::into_inner)).into_values().collect()
    }

    /// Hands over errors of epochs to be stored.
    pub(super) fn add_losses(&self, new: NewLosses) {
        self.losses.lock().unwrap_or_else(PoisonError::into_inner).add(new);
    }

    /// Errors of epochs since the last call.
    pub(super) fn take_losses(&self) -> NewLosses {
        std::mem::take(&mut *self.losses.lock().unwrap_or_else(PoisonError::into_inner))
    }

    /// Stage and fraction as last reported.
    pub(super) fn progress(&self) -> (String, f64) {
        self.progress.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_first_reason_to_stop_stays_and_breaks_the_work() {
        let control = Control::default();
        assert!(control.watch(Progress::new("FRF", 0.5)).is_continue());
        control.stop(Stop::Shutdown);
        control.stop(Stop::Cancelled);
        assert_eq!(control.stopped(), Some(Stop::Shutdown));
        assert!(control.watch(Progress::new("LSTM", 0.6)).is_break());
        assert_eq!(control.progress(), ("LSTM".into(), 0.6));
    }

    #[test]
    fn progress_within_a_scope_is_a_part_of_the_whole() {
        let control = Control::default();
        control.scope("trial 2: ".into(), 0.25..0.75);
        control.report("LSTM", 0.5);
        assert_eq!(control.progress(), ("trial 2: LSTM".into(), 0.5));
        control.report("done", 1.0);
        assert_eq!(control.progress(), ("trial 2: done".into(), 0.75));
    }

    #[test]
    fn a_sign_of_life_is_handed_over_at_once_and_not_again_for_a_while() {
        let control = Control::default();
        let at =
            |part: &str| Checkpoint { part: part.into(), fits: String::new(), state: Default::default() };
        control.renew(Some(at("one")));
        assert_eq!(control.take_kept(), [at("one")]);
        assert_eq!(control.take_kept(), []);
        control.renew(Some(at("two")));
        control.keep(at("table"));
        assert_eq!(control.take_kept(), [at("table"), at("two")]);
        control.renew(None);
        assert_eq!(control.take_kept(), []);
    }

    #[test]
    fn losses_are_handed_over_once_and_a_new_training_drops_those_of_another() {
        let control = Control::default();
        let loss = |epoch| Loss { seed: 1, epoch, training: 0.5, stopping: None };
        let told = |epoch| Progress { loss: Some(loss(epoch)), ..Progress::new("LSTM", 0.1) };
        let _ = control.watch(told(1));
        control.add_losses(NewLosses { anew: true, losses: Vec::new() });
        let _ = control.watch(told(2));
        let _ = control.watch(Progress::new("LSTM", 0.2));
        assert_eq!(control.take_losses(), NewLosses { anew: true, losses: vec![loss(2)] });
        assert!(control.take_losses().is_empty());
    }
}
