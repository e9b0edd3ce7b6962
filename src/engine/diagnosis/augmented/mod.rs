//! The sim with the effect in it: `sim(u) + [augmented(u) - core(u)]`.
//!
//! Where the sim has adopted effects already, `core(u)` is the linear core's free run with all that they
//! add to it: the law of a further effect then acts on the motion that the rig has with them.

mod added;
mod adopted;

pub(super) use added::Added;

use std::sync::Arc;

use serde::{Deserialize, Serialize};

use super::core::Core;
use crate::diagnosis::effects::candidate::{Candidate, Other, Part};
use crate::diagnosis::effects::effect::Effect;
use crate::diagnosis::effects::kernel::Clock;
use crate::diagnosis::effects::plant::{Course, Plant};
use crate::diagnosis::numerics::linear::rms;
use crate::{EngineError, Signal};

/// Beyond this many times the core's own RMS an augmented free run is not bounded.
const BOUND: f64 = 20.0;

/// An effect ready to be simulated on any drive: at its host, and at the other responses that feel
/// what it does there.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Augmented {
    /// A law that was found by transfer between runs, in place of members.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(super) added: Option<Box<Added>>,
    /// The host first.
    pub(super) members: Vec<Member>,
    /// Time of the programme at which laws that drift are evaluated: that of the last run.
    pub(super) time: f64,
    /// Whether the effect was found on a sim with adopted effects, which its core then runs with.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub(super) on_effects: bool,
    /// Effects that were found after it in the same diagnosis: each acts in the motion with those before it.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub(super) further: Vec<Self>,
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
        self.free_run(course)
    }

    /// The augmented core without the sim.
    fn free_run(&self, course: &Course) -> Option<Vec<f64>> {
        let mut simulated = course.simulated.to_vec();
        simulated[self.plant.response] = course.core.to_vec();
        let course = Course { simulated: simulated.into(), ..course.clone() };
        self.candidate.predict(&self.plant, &course, &self.p)
    }

    /// What the effect adds to the core.
    fn addition(&self, course: &Course) -> Option<Vec<f64>> {
        let free = self.free_run(course)?;
        Some(free.iter().zip(course.core.iter()).map(|(y, core)| y - core).collect())
    }
}

impl Augmented {
    /// A law that was found by transfer between runs.
    pub(super) fn of_transfer(added: Added, on_effects: bool) -> Self {
        Self { added: Some(Box::new(added)), members: Vec::new(), time: 1.0, on_effects, further: Vec::new() }
    }

    /// An effect that was found on some responses of a rig, as one of all `count` of them; `kept` says which they were.
    pub(super) fn among(mut self, kept: &[usize], count: usize) -> Self {
        self.added = self.added.map(|added| Box::new(added.among(kept, count)));
        let spread = |of_kept: &[f64], else_is: f64| {
            let mut all = vec![else_is; count];
            kept.iter().zip(of_kept).for_each(|(&r, value)| all[r] = *value);
            all
        };
        for Member { plant, candidate, .. } in &mut self.members {
            plant.response = kept[plant.response];
            plant.other_scale = spread(&plant.other_scale, 1.0);
            plant.other_mean = spread(&plant.other_mean, 0.0);
            for part in &mut candidate.parts {
                if let Some(Other::Response(response)) = &mut part.other {
                    *response = kept[*response];
                }
            }
        }
        self.further = self.further.into_iter().map(|next| next.among(kept, count)).collect();
        self
    }

    /// Takes out the taps of a law that was found by transfer; empty of any other. What is left is small text.
    pub fn detach_taps(&mut self) -> Vec<f64> {
        self.added.as_mut().map_or_else(Vec::new, |added| added.forward.detach_taps())
    }

    /// Whether taps were taken out.
    pub fn lacks_taps(&self) -> bool {
        self.added.as_ref().is_some_and(|added| added.forward.lacks_taps())
    }

    /// Puts them back.
    ///
    /// # Errors
    /// [`EngineError::Weights`]: another number of them.
    pub fn attach_taps(&mut self, taps: &[f64]) -> Result<(), EngineError> {
        let Some(added) = &mut self.added else { return Ok(()) };
        added.forward.attach_taps(taps).map_err(|what| EngineError::Weights(format!("effect: {what}")))
    }

    /// Responses with the effect and none of the further ones, `[response][sample]`, as [`Augmented::apply`]; `None`
    /// where the free run diverges.
    pub(super) fn predict(
        &self,
        drives: &[Vec<f64>],
        simulated: &[Vec<f64>],
        before: Option<&[Vec<f64>]>,
    ) -> Option<Vec<Vec<f64>>> {
        if let Some(added) = &self.added {
            return added.predict(drives, simulated, before);
        }
        let mut out = simulated.to_vec();
        let found = self.run(drives.to_vec(), simulated.to_vec(), before, Member::predict)?;
        for (member, predicted) in self.members.iter().zip(found) {
            out[member.plant.response] = predicted;
        }
        Some(out)
    }

    /// Each effect and the index of the response where it acts, the first one first.
    pub fn effects(&self) -> Vec<(Effect, usize)> {
        if let Some(added) = &self.added {
            return vec![(added.effect, added.response)];
        }
        let mut all = Vec::new();
        for (k, member) in self.members.iter().enumerate() {
            // What the host's effects do at other responses is no effect of its own.
            let mapped = |part: &Part| part.input.is_some() && self.members[0].candidate.parts.contains(part);
            let of_host = |part: &Part| k > 0 && (part.is_carried() || mapped(part));
            let own = member.candidate.parts.iter().filter(|part| !of_host(part));
            all.extend(own.map(|part| (part.effect, member.plant.response)));
        }
        all.extend(self.further.iter().flat_map(Self::effects));
        all
    }

    /// Index of the response where it acts.
    pub fn response(&self) -> usize {
        if let Some(added) = &self.added {
            return added.response;
        }
        self.members[0].plant.response
    }

    /// Whether it was found on a sim with adopted effects, whose additions [`Augmented::apply`] then needs.
    pub fn on_effects(&self) -> bool {
        self.on_effects
    }

    /// The sim's responses with the effect, `[response, sample]`; a response that does not feel it stays the
    /// sim's. `before`, of the same shape, is what effects adopted earlier add to their cores; an effect
    /// that was found without any disregards it.
    ///
    /// # Errors
    /// Another number of drives or responses, another length, a free run that diverges.
    pub fn apply(
        &self,
        drive: &Signal,
        simulated: &Signal,
        before: Option<&Signal>,
    ) -> Result<Signal, EngineError> {
        Ok(self.with_further(drive, simulated, before, false)?.0)
    }

    /// What the effect adds to its linear core, `[response, sample]`; zero where it is not felt. Arguments
    /// and errors as [`Augmented::apply`].
    pub fn addition(
        &self,
        drive: &Signal,
        simulated: &Signal,
        before: Option<&Signal>,
    ) -> Result<Signal, EngineError> {
        let with_further = || self.with_further(drive, simulated, before, true);
        match if self.further.is_empty() { None } else { with_further()?.1 } {
            Some(added) => Ok(added),
            None => self.addition_alone(drive, simulated, before),
        }
    }

    /// The responses with all effects, and what they add; of the last that only where it is `wanted`.
    fn with_further(
        &self,
        drive: &Signal,
        simulated: &Signal,
        before: Option<&Signal>,
        wanted: bool,
    ) -> Result<(Signal, Option<Signal>), EngineError> {
        let mut response = self.apply_alone(drive, simulated, before)?;
        if self.further.is_empty() && !wanted {
            return Ok((response, None));
        }
        let mut added = self.addition_alone(drive, simulated, before)?;
        for (k, next) in self.further.iter().enumerate() {
            let all = before.map_or_else(|| Ok(added.clone()), |before| sum(before, &added))?;
            let with = next.apply_alone(drive, &response, Some(&all))?;
            if wanted || k + 1 < self.further.len() {
                added = sum(&added, &next.addition_alone(drive, &response, Some(&all))?)?;
            }
            response = with;
        }
        Ok((response, Some(added)))
    }

    /// The responses with the effect and none of the further ones.
    fn apply_alone(
        &self,
        drive: &Signal,
        simulated: &Signal,
        before: Option<&Signal>,
    ) -> Result<Signal, EngineError> {
        if let Some(added) = &self.added {
            let before = self.before(before, simulated)?;
            let found = added.predict(self.drives_of(drive, simulated)?, simulated.channels(), before);
            return Signal::new(drive.sample_rate_hz(), found.ok_or_else(|| self.runaway())?);
        }
        let mut channels = simulated.channels().to_vec();
        for (response, predicted) in self.of_members(drive, simulated, before, Member::predict)? {
            channels[response] = predicted;
        }
        Signal::new(drive.sample_rate_hz(), channels)
    }

    /// What it adds without the further ones.
    fn addition_alone(
        &self,
        drive: &Signal,
        simulated: &Signal,
        before: Option<&Signal>,
    ) -> Result<Signal, EngineError> {
        if let Some(added) = &self.added {
            let found = added.addition(self.drives_of(drive, simulated)?, self.before(before, simulated)?);
            return Signal::new(drive.sample_rate_hz(), found.ok_or_else(|| self.runaway())?);
        }
        let mut channels = vec![vec![0.0; simulated.n_samples()]; simulated.n_channels()];
        for (response, added) in self.of_members(drive, simulated, before, Member::addition)? {
            channels[response] = added;
        }
        Signal::new(drive.sample_rate_hz(), channels)
    }

    /// What effects that were adopted earlier add, where this one was found beside them.
    fn before<'a>(
        &self,
        before: Option<&'a Signal>,
        simulated: &Signal,
    ) -> Result<Option<&'a [Vec<f64>]>, EngineError> {
        let before = before.filter(|_| self.on_effects);
        if let Some(before) = before {
            belongs("adopted effects", before, simulated.n_channels(), simulated.n_samples())?;
        }
        Ok(before.map(Signal::channels))
    }

    fn runaway(&self) -> EngineError {
        EngineError::NonFiniteResult { what: "augmented response", channel: self.response(), sample: 0 }
    }

    /// The drives of a law that was found by transfer, checked beside the sim's responses.
    fn drives_of<'a>(&self, drive: &'a Signal, simulated: &Signal) -> Result<&'a [Vec<f64>], EngineError> {
        let Some(added) = &self.added else { return Ok(drive.channels()) };
        let (drives, responses) = added.forward.channels();
        belongs("drive", drive, drives, drive.n_samples())?;
        belongs("simulated response", simulated, responses, drive.n_samples())?;
        Ok(drive.channels())
    }

    /// One signal for each response that feels the effect.
    fn of_members(
        &self,
        drive: &Signal,
        simulated: &Signal,
        before: Option<&Signal>,
        of: fn(&Member, &Course) -> Option<Vec<f64>>,
    ) -> Result<Vec<(usize, Vec<f64>)>, EngineError> {
        let plant = &self.members[0].plant;
        let (drives, responses) = (plant.drive_peak.len(), plant.other_scale.len());
        belongs("drive", drive, drives, drive.n_samples())?;
        belongs("simulated response", simulated, responses, drive.n_samples())?;
        let before = self.before(before, simulated)?;
        let found = self.run(drive.channels().to_vec(), simulated.channels().to_vec(), before, of);
        let responses = self.members.iter().map(|member| member.plant.response);
        Ok(responses.zip(found.ok_or_else(|| self.runaway())?).collect())
    }

    /// One signal for each member, in their order; `None` if the effect's free run diverges.
    fn run(
        &self,
        drives: Vec<Vec<f64>>,
        simulated: Vec<Vec<f64>>,
        before: Option<&[Vec<f64>]>,
        of: fn(&Member, &Course) -> Option<Vec<f64>>,
    ) -> Option<Vec<Vec<f64>>> {
        let host = self.members.first()?;
        let core = |member: &Member, drives: &[Vec<f64>]| {
            let mut core = member.plant.core.simulate(drives);
            if let Some(before) = before {
                core.iter_mut().zip(&before[member.plant.response]).for_each(|(core, added)| *core += added);
            }
            Arc::new(core)
        };
        let mut course = Course {
            core: core(host, &drives),
            drives: drives.into(),
            simulated: simulated.into(),
            clock: Clock { start: self.time, step: 0.0 },
            carried: Arc::default(),
        };
        let mut out = vec![of(host, &course)?];
        if self.members.len() > 1 {
            course.carried = host.candidate.carry(&host.plant, &course, &host.p)?.into();
        }
        for member in &self.members[1..] {
            course.core = core(member, &course.drives);
            out.push(of(member, &course)?);
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
        let Some(responses) = self.run(scaled, simulated, None, Member::predict) else { return false };
        let y = &responses[0];
        let about = |y: &[f64]| rms(&y.iter().map(|y| y - core.response_mean).collect::<Vec<f64>>());
        let (all, reference) = (about(y), about(&linear));
        let end = &y[y.len() - 100..];
        let swing = end.iter().fold(f64::NEG_INFINITY, |m, y| m.max(*y))
            - end.iter().fold(f64::INFINITY, |m, y| m.min(*y));
        let own = all < BOUND * reference && swing < 0.5 * reference;
        own && self.further.iter().all(|next| next.bounded(drives, limit))
    }
}

/// The sum of two signals of one shape.
///
/// # Errors
/// A sum that is not finite.
pub(crate) fn sum(a: &Signal, b: &Signal) -> Result<Signal, EngineError> {
    let of = |(a, b): (&Vec<f64>, &Vec<f64>)| a.iter().zip(b).map(|(a, b)| a + b).collect();
    Signal::new(a.sample_rate_hz(), a.channels().iter().zip(b.channels()).map(of).collect())
}

/// Checks the shape of a signal.
fn belongs(what: &'static str, signal: &Signal, channels: usize, samples: usize) -> Result<(), EngineError> {
    if signal.n_channels() != channels {
        return Err(EngineError::ChannelCount { what, expected: channels, found: signal.n_channels() });
    }
    if signal.n_samples() != samples {
        let found = signal.n_samples();
        return Err(EngineError::UnequalLength { what, channel: 0, expected: samples, found });
    }
    Ok(())
}
