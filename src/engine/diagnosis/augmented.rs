//! The sim with the effect in it: `sim(u) + [augmented(u) - core(u)]`.

use std::sync::Arc;

use serde::{Deserialize, Serialize};

use super::candidate::Candidate;
use super::core::Core;
use super::kernel::Clock;
use super::problem::{Course, Plant};
use crate::engine::{EngineError, Signal};

/// Beyond this many times the core's own RMS an augmented free run is not bounded.
const BOUND: f64 = 20.0;

/// An effect ready to be simulated on any drive: at its host, and at the other responses that feel
/// what it does there.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Augmented {
    /// The host first.
    pub(super) members: Vec<Member>,
    /// Time of the programme at which laws that drift are evaluated: that of the last run.
    pub(super) time: f64,
}

/// One response with the effect.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(super) struct Member {
    pub plant: Plant,
    pub candidate: Candidate,
    pub p: Vec<f64>,
    /// Whether the augmented core is the whole prediction, with nothing of the sim.
    pub alone: bool,
}

impl Member {
    fn predict(&self, course: &Course) -> Option<Vec<f64>> {
        if !self.alone {
            return self.candidate.predict(&self.plant, course, &self.p);
        }
        let mut simulated = course.simulated.to_vec();
        simulated[self.plant.response] = course.core.to_vec();
        let course = Course { simulated: simulated.into(), ..course.clone() };
        self.candidate.predict(&self.plant, &course, &self.p)
    }
}

impl Augmented {
    /// The sim's responses with the effect, `[response, sample]`; what does not feel it stays the
    /// sim's.
    ///
    /// # Errors
    /// Another number of drives or responses, another length, a free run that runs away.
    pub fn apply(&self, drive: &Signal, simulated: &Signal) -> Result<Signal, EngineError> {
        let plant = &self.members[0].plant;
        let (drives, responses) = (plant.drive_peak.len(), plant.other_scale.len());
        if drive.n_channels() != drives {
            let found = drive.n_channels();
            return Err(EngineError::ChannelCount { what: "drive", expected: drives, found });
        }
        if simulated.n_channels() != responses {
            let found = simulated.n_channels();
            return Err(EngineError::ChannelCount { what: "simulated response", expected: responses, found });
        }
        if simulated.n_samples() != drive.n_samples() {
            let (expected, found) = (drive.n_samples(), simulated.n_samples());
            return Err(EngineError::UnequalLength {
                what: "simulated response",
                channel: 0,
                expected,
                found,
            });
        }
        let runaway =
            EngineError::NonFiniteResult { what: "augmented response", channel: plant.response, sample: 0 };
        let predicted = self.run(drive.channels().to_vec(), simulated.channels().to_vec()).ok_or(runaway)?;
        let mut channels = simulated.channels().to_vec();
        for (member, predicted) in self.members.iter().zip(predicted) {
            channels[member.plant.response] = predicted;
        }
        Signal::new(drive.sample_rate_hz(), channels)
    }

    /// Responses of the members, in their order; `None` if the effect's free run runs away.
    fn run(&self, drives: Vec<Vec<f64>>, simulated: Vec<Vec<f64>>) -> Option<Vec<Vec<f64>>> {
        let host = self.members.first()?;
        let mut course = Course {
            core: host.plant.core.simulate(&drives).into(),
            drives: drives.into(),
            simulated: simulated.into(),
            clock: Clock { start: self.time, step: 0.0 },
            carried: Arc::default(),
        };
        let mut out = vec![host.predict(&course)?];
        if self.members.len() > 1 {
            course.carried = host.candidate.carry(&host.plant, &course, &host.p)?.into();
        }
        for member in &self.members[1..] {
            course.core = member.plant.core.simulate(&course.drives).into();
            out.push(member.predict(&course)?);
        }
        Some(out)
    }

    /// Whether the free run stays bounded for `drives`, `[drive][sample]`, scaled so that each
    /// reaches its limit, and comes to rest after them.
    pub fn bounded(&self, drives: &[Vec<f64>], limit: &[f64]) -> bool {
        let host = &self.members[0];
        let core: &Core = &host.plant.core;
        let rest = core.modes.ring_down(1e-2).min(4 * drives[0].len());
        let scaled: Vec<Vec<f64>> = drives
            .iter()
            .zip(limit)
            .enumerate()
            .map(|(d, (drive, limit))| {
                let peak = drive.iter().fold(0.0_f64, |m, u| m.max(u.abs())).max(f64::MIN_POSITIVE);
                let mut out: Vec<f64> = drive.iter().map(|u| u * limit / peak).collect();
                out.extend(std::iter::repeat_n(core.drive_mean[d], rest + 200));
                out
            })
            .collect();
        let linear = core.simulate(&scaled);
        let simulated = vec![linear.clone(); host.plant.other_scale.len()];
        let Some(responses) = self.run(scaled, simulated) else { return false };
        let y = &responses[0];
        let about =
            |y: &[f64]| super::linear::rms(&y.iter().map(|y| y - core.response_mean).collect::<Vec<f64>>());
        let (all, reference) = (about(y), about(&linear));
        let end = &y[y.len() - 100..];
        let swing = end.iter().fold(f64::NEG_INFINITY, |m, y| m.max(*y))
            - end.iter().fold(f64::INFINITY, |m, y| m.min(*y));
        all < BOUND * reference && swing < 0.5 * reference
    }
}
