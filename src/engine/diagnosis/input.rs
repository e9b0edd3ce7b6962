//! What a diagnosis is asked: runs, their sim, their repeats, and how to judge.

use serde::{Deserialize, Serialize};

use crate::diagnosis::effects::effect::Effect;
use crate::diagnosis::numerics::linear::rms;
use crate::{EngineError, Quantity, Signal};

/// A channel as the report names it.
#[derive(Debug, Clone, PartialEq)]
pub struct Channel {
    /// Its name.
    pub name: String,
    /// The axis that it lies on, if known.
    pub axis: Option<String>,
    /// Its unit.
    pub unit: String,
    /// Size of its unit in SI units; `None` where that is not known.
    pub size: Option<f64>,
    /// What it measures: stiffness and friction act on displacements.
    pub quantity: Quantity,
}

/// One measurement.
#[derive(Debug, Clone, PartialEq)]
pub struct Run {
    /// How the report calls it.
    pub name: String,
    /// Commanded, `[drive, sample]`.
    pub drive: Signal,
    /// Measured, `[response, sample]`.
    pub response: Signal,
    /// What the sim says, `[response, sample]`; without it the linear core is the sim.
    pub simulated: Option<Signal>,
    /// What the sim's adopted effects add to the linear cores that they were found on,
    /// `[response, sample]`, zero where none acts: the core runs with it. `None` for a sim without any.
    pub added: Option<Signal>,
    /// Its place in time, seconds after any fixed instant.
    pub started_s: f64,
}

/// What a run may be used for.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Role {
    /// Parameters are fitted to it.
    Fit,
    /// Effects are chosen on it.
    Select,
    /// Neither: how far the gap closes is measured on it.
    Test,
}

/// Whether the sim has seen the effect.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Mode {
    /// The sim is from before the change: its linear part stays.
    External,
    /// The sim was fitted on the rig with the effect and has absorbed part of it: every candidate
    /// is fitted jointly with a linear retune.
    #[default]
    InSitu,
}

/// All that a diagnosis needs.
#[derive(Debug, Clone, PartialEq)]
pub struct Input {
    /// Drives, in the order of the signals.
    pub drives: Vec<Channel>,
    /// Responses, in the order of the signals.
    pub responses: Vec<Channel>,
    /// Low-level runs for the linear core.
    pub baseline: Vec<Run>,
    /// Runs to explain.
    pub runs: Vec<Run>,
    /// What each run is used for; without it the diagnosis splits them.
    pub roles: Option<Vec<Role>>,
    /// Runs with the same drive, indices into `runs`.
    pub repeats: Vec<Vec<usize>>,
    /// Whether the sim is linear and of the baseline, as any FRF in situ and one that was fitted to it: the
    /// core, which is too and carries less of the estimate's error, then stands for it. What lies between
    /// the two is linear, and nothing that a retuned core could take back from another sim. Where an adopted
    /// effect acts on a response, the sim stays what it is: the effect was adopted with the better of the two.
    pub sim_is_linear: bool,
    /// Whether the sim has seen the effect.
    pub mode: Mode,
    /// Effects that may be named.
    pub catalogue: Vec<Effect>,
    /// Systematic RMS relative to the response's RMS below which a gap does not matter.
    pub material_gap: f64,
    /// Largest magnitude allowed of each drive in a next experiment; without it that of the runs.
    pub drive_limit: Option<Vec<f64>>,
    /// Seed of the bootstrap and of the next experiment's noise drives.
    pub seed: u64,
}

impl Input {
    /// Checks that the parts belong together.
    ///
    /// # Errors
    /// No runs or baseline, signals of other channels, rates or lengths than the first, repeats
    /// or roles that name no run, an empty catalogue, a material gap or a limit that is not positive.
    pub fn check(&self) -> Result<(), EngineError> {
        let setting = |setting, found: String, limit: &str| {
            Err(EngineError::Setting { setting, found, limit: limit.into() })
        };
        if self.runs.is_empty() {
            return Err(EngineError::TooShort { what: "runs of the diagnosis", needed: 1, found: 0 });
        }
        if self.baseline.is_empty() {
            return Err(EngineError::TooShort { what: "baseline runs", needed: 1, found: 0 });
        }
        let rate = self.runs[0].drive.sample_rate_hz();
        for run in self.baseline.iter().chain(&self.runs) {
            check_run(run, self.drives.len(), self.responses.len(), rate)?;
        }
        if self.catalogue.is_empty() {
            return setting("catalogue", "[]".into(), "at least one effect");
        }
        if !(self.material_gap > 0.0 && self.material_gap < 1.0) {
            return setting("material_gap", self.material_gap.to_string(), "between 0 and 1");
        }
        if self.roles.as_ref().is_some_and(|roles| roles.len() != self.runs.len()) {
            return setting("runs", "roles".into(), "one role a run");
        }
        let mut seen = vec![false; self.runs.len()];
        for &run in self.repeats.iter().flatten() {
            match seen.get_mut(run) {
                Some(seen) if !*seen => *seen = true,
                _ => return setting("repeats", run.to_string(), "each names runs of this diagnosis, once"),
            }
        }
        if let Some(limits) = &self.drive_limit
            && (limits.len() != self.drives.len() || limits.iter().any(|l| !(l.is_finite() && *l > 0.0)))
        {
            return setting("envelope.drive_peak", format!("{limits:?}"), "a positive number a drive");
        }
        Ok(())
    }

    /// The same of some responses, in the order of `kept`.
    pub(super) fn of_responses(&self, kept: &[usize]) -> Self {
        let of_runs = |runs: &[Run]| -> Vec<Run> {
            let some = |signal: &Option<Signal>| signal.as_ref().map(|signal| signal.select(kept));
            let of = |run: &Run| Run {
                name: run.name.clone(),
                drive: run.drive.clone(),
                response: run.response.select(kept),
                simulated: some(&run.simulated),
                added: some(&run.added),
                started_s: run.started_s,
            };
            runs.iter().map(of).collect()
        };
        Self {
            drives: self.drives.clone(),
            responses: kept.iter().map(|&r| self.responses[r].clone()).collect(),
            baseline: of_runs(&self.baseline),
            runs: of_runs(&self.runs),
            roles: self.roles.clone(),
            repeats: self.repeats.clone(),
            catalogue: self.catalogue.clone(),
            drive_limit: self.drive_limit.clone(),
            ..*self
        }
    }

    /// Whether the sim was fitted to any of the runs to explain: what it leaves of those says nothing of others.
    pub(super) fn explains_its_own_runs(&self) -> bool {
        self.runs.iter().any(|run| self.baseline.iter().any(|own| own.name == run.name))
    }

    /// What the sim leaves of runs that it has not seen, by what it leaves of the runs to explain and what a `linear` part
    /// leaves of runs that it was not fitted to: a sim that was fitted to these does no better on others.
    pub(super) fn left_of_unseen(&self, left: f64, linear: f64) -> f64 {
        if self.explains_its_own_runs() { left.max(linear) } else { left }
    }

    /// Whether the core stands for the sim at a response.
    pub(super) fn core_stands(&self, response: usize) -> bool {
        let acts = |added: &Signal| added.channel(response).iter().any(|y| *y != 0.0);
        self.sim_is_linear && !self.runs.iter().filter_map(|run| run.added.as_ref()).any(acts)
    }

    /// Whether the sim is from before the change and may bend by itself: it is no linear part, and has no adopted effects.
    pub(super) fn sim_may_bend(&self) -> bool {
        self.mode == Mode::External && !self.sim_is_linear && !self.has_adopted()
    }

    /// Whether the sim has adopted effects.
    pub(super) fn has_adopted(&self) -> bool {
        self.runs.iter().any(|run| run.added.is_some())
    }

    /// Largest magnitude allowed of each drive: what is set, or `reached` by the runs.
    pub(super) fn limits(&self, reached: &[f64]) -> Vec<f64> {
        self.drive_limit.clone().unwrap_or_else(|| reached.to_vec())
    }

    /// The run whose drives are at the highest level.
    pub(super) fn loudest(&self) -> Option<&Run> {
        self.runs.iter().max_by(|a, b| level(a.drive.channels()).total_cmp(&level(b.drive.channels())))
    }

    /// Samples a second.
    ///
    /// # Panics
    /// Without runs, which [`Input::check`] refuses.
    pub fn sample_rate_hz(&self) -> f64 {
        self.runs[0].drive.sample_rate_hz()
    }
}

/// How hard drives drive: the sum of their RMS, which orders runs of one rig by their level.
pub(super) fn level(drives: &[Vec<f64>]) -> f64 {
    drives.iter().map(|u| rms(u)).sum()
}

fn check_run(run: &Run, drives: usize, responses: usize, rate: f64) -> Result<(), EngineError> {
    let signals = [("drive of a run", &run.drive, drives), ("response of a run", &run.response, responses)];
    let simulated = run.simulated.iter().map(|s| ("simulated run", s, responses));
    let added = run.added.iter().map(|s| ("adopted effects of a run", s, responses));
    for (what, signal, expected) in signals.into_iter().chain(simulated).chain(added) {
        if signal.n_channels() != expected {
            return Err(EngineError::ChannelCount { what, expected, found: signal.n_channels() });
        }
        if !Signal::same_rate(signal.sample_rate_hz(), rate) {
            let found_hz = signal.sample_rate_hz();
            return Err(EngineError::SampleRate { what, expected_hz: rate, found_hz });
        }
        if signal.n_samples() != run.drive.n_samples() {
            let (expected, found) = (run.drive.n_samples(), signal.n_samples());
            return Err(EngineError::UnequalLength { what, channel: 0, expected, found });
        }
    }
    Ok(())
}
