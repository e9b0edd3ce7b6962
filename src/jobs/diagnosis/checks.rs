//! Checks on the runs of a diagnosis, from their rows alone.

use crate::domain::{Channel, FieldError, FitChannels, Run};
use crate::engine::{Signal, rounded};

use super::plan::DiagnosisPlan;
use super::problem::DiagnosisProblem;

/// Fewest samples of a run that can be scored.
const MIN_SAMPLES: u64 = 64;

impl DiagnosisPlan {
    /// Refuses runs that lack a channel, have another rate, are too short, or are constant.
    pub(super) fn suits_runs(&self) -> Result<(), DiagnosisProblem> {
        self.holds_channels()?;
        self.suits_lengths()?;
        self.moves()
    }

    /// Every list of runs, with its pointer in the request.
    fn lists(&self) -> [(&'static str, Vec<&Run>); 3] {
        [
            ("/runs", self.runs.iter().collect()),
            ("/baseline_runs", self.baseline.iter().map(|b| &b.run).collect()),
            ("/simulated", self.simulated.iter().collect()),
        ]
    }

    fn holds_channels(&self) -> Result<(), DiagnosisProblem> {
        let FitChannels { inputs, outputs } = self.channels();
        // A model may have measured channels as inputs beside the drives.
        let inputs = self.model.as_ref().map_or(&inputs, |model| &model.inputs);
        let mut errors = Vec::new();
        for (pointer, runs) in self.lists() {
            let needed: Vec<&String> = if pointer == "/simulated" {
                outputs.iter().collect()
            } else {
                inputs.iter().chain(&outputs).collect()
            };
            for run in runs {
                for name in needed.iter().filter(|name| !run.channels.contains(name)) {
                    let limit = format!("runs that hold every channel of the diagnosis: {} does not", run.id);
                    errors.push(FieldError::new(pointer, limit).on_channel(name.as_str()));
                }
            }
        }
        if errors.is_empty() { Ok(()) } else { Err(DiagnosisProblem::MissingChannel(errors)) }
    }

    fn suits_lengths(&self) -> Result<(), DiagnosisProblem> {
        let rate = self.model.as_ref().map_or(self.runs[0].sample_rate_hz, |model| model.sample_rate_hz);
        let mut other_rate = Vec::new();
        let mut short = Vec::new();
        for (pointer, runs) in self.lists() {
            for run in runs {
                if !Signal::same_rate(run.sample_rate_hz, rate) {
                    let limit = format!(
                        "{} Hz: run {} has {} Hz",
                        rounded(rate, 10),
                        run.id,
                        rounded(run.sample_rate_hz, 10)
                    );
                    other_rate.push(FieldError::new(pointer, limit));
                }
                if run.samples < MIN_SAMPLES {
                    let limit = format!("at least {MIN_SAMPLES} samples: run {} has {}", run.id, run.samples);
                    short.push(FieldError::new(pointer, limit));
                }
            }
        }
        let unequal: Vec<FieldError> = self
            .runs
            .iter()
            .zip(&self.simulated)
            .filter(|(run, simulated)| run.samples != simulated.samples)
            .map(|(run, simulated)| {
                let limit = format!(
                    "{} samples, as many as the run: {} has {}",
                    run.samples, simulated.id, simulated.samples
                );
                FieldError::new(format!("/simulated/{}", run.id), limit)
            })
            .collect();
        match (other_rate.is_empty(), short.is_empty(), unequal.is_empty()) {
            (false, _, _) => Err(DiagnosisProblem::SampleRate(other_rate)),
            (_, false, _) => Err(DiagnosisProblem::TooShort(short)),
            (_, _, false) => Err(DiagnosisProblem::UnequalLengths(unequal)),
            _ => Ok(()),
        }
    }

    /// Refuses responses that are constant in every run, and runs in which every drive is constant.
    fn moves(&self) -> Result<(), DiagnosisProblem> {
        let mut errors = Vec::new();
        let [runs, baseline, _] = self.lists();
        for (pointer, runs) in [runs, baseline] {
            let dead =
                |channel: &Channel| runs.iter().all(|r| r.quality.dead_channels.contains(&channel.name));
            let place =
                |c: &Channel| FieldError::new(pointer, "runs in which the channel moves").on_channel(&c.name);
            if self.drives.iter().all(dead) {
                errors.extend(self.drives.iter().map(place));
            }
            errors.extend(self.responses.iter().filter(|c| dead(c)).map(place));
        }
        if errors.is_empty() { Ok(()) } else { Err(DiagnosisProblem::DeadChannel(errors)) }
    }
}
