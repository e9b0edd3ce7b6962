//! What the screen is given: channels and records.

use std::ops::Range;

use serde::{Deserialize, Serialize};

use crate::{EngineError, Quantity, Signal};

/// A channel of the rig.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Channel {
    /// Its name.
    pub name: String,
    /// What it measures: laws of stiffness, friction and damping act on motion.
    pub quantity: Quantity,
    /// Size of its unit in SI units; `None` where that is not known.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub size: Option<f64>,
}

impl Channel {
    /// Factor from this channel's unit to that of another, both of them of one kind; 1 where neither is known, `None` where
    /// one is.
    pub(super) fn to_unit_of(&self, other: &Self) -> Option<f64> {
        match (self.size, other.size) {
            (Some(own), Some(other)) => Some(own / other),
            (None, None) => Some(1.0),
            _ => None,
        }
    }
}

/// One measured run.
#[derive(Debug, Clone, PartialEq)]
pub struct Record {
    /// Commanded or measured drives, `[drive, sample]`.
    pub drive: Signal,
    /// Measured responses, `[response, sample]`.
    pub response: Signal,
    /// What effects that are known already add to each response, `[response, sample]`: laws are sought beside it, over
    /// the motion that holds it. `None` without any.
    pub added: Option<Signal>,
    /// Its place in time, seconds after any fixed instant.
    pub started_s: f64,
}

/// Runs of one rig in one condition.
#[derive(Debug, Clone, PartialEq)]
pub struct Recording {
    /// Drives, in the order of the signals.
    pub drives: Vec<Channel>,
    /// Responses, in the order of the signals.
    pub responses: Vec<Channel>,
    /// At least one run.
    pub records: Vec<Record>,
}

impl Record {
    /// Some of its samples, as a record of their own.
    pub fn piece(&self, samples: Range<usize>) -> Self {
        Self {
            drive: self.drive.slice(samples.clone()),
            response: self.response.slice(samples.clone()),
            added: self.added.as_ref().map(|added| added.slice(samples.clone())),
            started_s: self.started_s + samples.start as f64 / self.drive.sample_rate_hz(),
        }
    }

    /// Samples of a response without what known effects add to it.
    pub fn beside_added(&self, response: usize, samples: Range<usize>) -> Vec<f64> {
        let y = &self.response.channel(response)[samples.clone()];
        match &self.added {
            Some(added) => y.iter().zip(&added.channel(response)[samples]).map(|(y, a)| y - a).collect(),
            None => y.to_vec(),
        }
    }
}

impl Recording {
    /// Samples a second.
    ///
    /// # Panics
    /// Without records.
    pub fn sample_rate_hz(&self) -> f64 {
        self.records[0].drive.sample_rate_hz()
    }

    /// Checks that the parts belong together.
    ///
    /// # Errors
    /// No records, signals of other channels, rates or lengths than the first, a time that is not finite, too
    /// few samples in all, no drive that moves.
    pub(super) fn check(&self, needed: usize) -> Result<(), EngineError> {
        let Some(first) = self.records.first() else {
            return Err(EngineError::TooShort { what: "runs of the screen", needed: 1, found: 0 });
        };
        let rate = first.drive.sample_rate_hz();
        for record in &self.records {
            let signals = [
                ("drive of a run", &record.drive, self.drives.len()),
                ("response of a run", &record.response, self.responses.len()),
            ];
            let added = record.added.iter().map(|s| ("adopted effects of a run", s, self.responses.len()));
            for (what, signal, expected) in signals.into_iter().chain(added) {
                if signal.n_channels() != expected {
                    let found = signal.n_channels();
                    return Err(EngineError::ChannelCount { what, expected, found });
                }
                if !Signal::same_rate(signal.sample_rate_hz(), rate) {
                    let found_hz = signal.sample_rate_hz();
                    return Err(EngineError::SampleRate { what, expected_hz: rate, found_hz });
                }
                if signal.n_samples() != record.drive.n_samples() {
                    let (expected, found) = (record.drive.n_samples(), signal.n_samples());
                    return Err(EngineError::UnequalLength { what, channel: 0, expected, found });
                }
            }
            if !record.started_s.is_finite() {
                return Err(EngineError::Setting {
                    setting: "started_at",
                    found: record.started_s.to_string(),
                    limit: "a finite time".into(),
                });
            }
        }
        let found = self.records.iter().map(|r| r.drive.n_samples()).sum();
        if found < needed {
            return Err(EngineError::TooShort { what: "runs of the screen", needed, found });
        }
        let moves = |signal: &Signal, channel: usize| {
            let samples = signal.channel(channel);
            samples.iter().any(|x| *x != samples[0])
        };
        let alive = |drive: usize| self.records.iter().any(|r| moves(&r.drive, drive));
        if !(0..self.drives.len()).any(alive) {
            return Err(EngineError::DeadChannel { what: "drives of the screen", channel: 0 });
        }
        Ok(())
    }
}
