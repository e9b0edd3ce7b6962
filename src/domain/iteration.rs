//! Drive-file iterations as they are requested (`POST /v1/rigs/{rig}/iterations`), listed and stored.

use std::collections::BTreeMap;

use jiff::Timestamp;
use serde::{Deserialize, Deserializer, Serialize};

use super::ids::{IterationId, JobId, RigId, RunId};
use super::job::{JobKind, JobRequest};
use super::model::UsedModel;
use super::model_ref::ModelRef;
use crate::engine::fatigue::{DamageRatio, DamageSettings};
use crate::engine::iteration::{
    DriveLimit, GainBand, IterationSettings, LinearPart, Outside, StepKind, StopAt, Stopped,
};
use crate::engine::metrics::ChannelErrors;

/// The response to reproduce.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct IterationTarget {
    /// The run that holds it.
    pub run: RunId,
    /// Its channels; left out: every response of the run that the model predicts.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub channels: Option<Vec<String>>,
}

/// Where the search begins.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum StartDrive {
    /// The drive that the FRF alone would take for the target.
    #[default]
    Inverse,
    /// No drive.
    Zero,
    /// The drives of this run, as long as the target.
    Run(RunId),
}

/// The request; every field but `target` has a default. Its target is a run, once it is stored.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct IterationRequest<Target = IterationTarget> {
    /// The model; its inputs must be drives.
    #[serde(default)]
    pub model: ModelRef,
    /// The response to reproduce.
    pub target: Target,
    /// Where the search begins.
    #[serde(default)]
    pub start: StartDrive,
    /// Name of the run that will hold the drive.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub name: Option<String>,
    /// Corrections at most.
    #[serde(default = "iterations")]
    pub iterations: usize,
    /// Share of the linear correction that is applied.
    #[serde(default = "gain")]
    pub gain: f64,
    /// Factors on the gain of single target channels.
    #[serde(default)]
    pub gains: BTreeMap<String, f64>,
    /// Factors on the gain over parts of the frequency axis.
    #[serde(default)]
    pub gain_bands: Vec<GainBand>,
    /// First and last frequency of the corrections, Hz; left out: wherever the FRF is reliable.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub band_hz: Option<[f64; 2]>,
    /// Multiple coherence below which a line takes no part.
    #[serde(default = "min_coherence")]
    pub min_coherence: f64,
    /// Tikhonov's parameter of the inverse FRF.
    #[serde(default = "ridge")]
    pub ridge: f64,
    /// Weights of the target channels; 1 where left out.
    #[serde(default)]
    pub weights: BTreeMap<String, f64>,
    /// Limits of the drives.
    #[serde(default)]
    pub limits: BTreeMap<String, DriveLimit>,
    /// Time over which corrections fade to zero at both ends, s.
    #[serde(default)]
    pub taper_s: f64,
    /// Whether the model's own gradient takes over where the linear step leads no further.
    #[serde(default = "gradient")]
    pub gradient: bool,
    /// What happens to drives outside what the model was fitted on.
    #[serde(default)]
    pub outside: Outside,
    /// When the search ends before the last iteration.
    #[serde(default)]
    pub stop: StopAt,
    /// Settings of the damage.
    #[serde(default)]
    pub damage: DamageSettings,
}

impl JobRequest for IterationRequest {
    const KIND: JobKind = JobKind::Iteration;
}

fn iterations() -> usize {
    IterationSettings::default().iterations
}

fn gain() -> f64 {
    IterationSettings::default().gain
}

fn min_coherence() -> f64 {
    IterationSettings::default().min_coherence
}

fn ridge() -> f64 {
    IterationSettings::default().ridge
}

fn gradient() -> bool {
    IterationSettings::default().gradient
}

impl<Target> IterationRequest<Target> {
    /// The same request with another target, and its own.
    pub fn with_target<Other>(self, target: Other) -> (IterationRequest<Other>, Target) {
        let request = IterationRequest {
            model: self.model,
            target,
            start: self.start,
            name: self.name,
            iterations: self.iterations,
            gain: self.gain,
            gains: self.gains,
            gain_bands: self.gain_bands,
            band_hz: self.band_hz,
            min_coherence: self.min_coherence,
            ridge: self.ridge,
            weights: self.weights,
            limits: self.limits,
            taper_s: self.taper_s,
            gradient: self.gradient,
            outside: self.outside,
            stop: self.stop,
            damage: self.damage,
        };
        (request, self.target)
    }

    /// The engine's settings.
    pub fn settings(&self) -> IterationSettings {
        IterationSettings {
            iterations: self.iterations,
            gain: self.gain,
            gain_bands: self.gain_bands.clone(),
            band_hz: self.band_hz,
            min_coherence: self.min_coherence,
            ridge: self.ridge,
            taper_s: self.taper_s,
            gradient: self.gradient,
            outside: self.outside,
            stop: self.stop,
            damage: self.damage,
        }
    }
}

/// One iteration, its channels by name.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct IterationStep {
    /// 0 is the start drive.
    pub iteration: usize,
    /// How this drive was found. Earlier versions knew the linear correction only, and did not say it.
    #[serde(default = "linear")]
    pub kind: StepKind,
    /// RMS error of each target channel, relative to its RMS; `null` where the target is zero.
    pub errors: BTreeMap<String, Option<f64>>,
    /// Weighted root mean square of these errors.
    pub total_error: f64,
    /// Predicted over target damage of each target channel.
    pub damage: BTreeMap<String, DamageRatio>,
    /// Share of the samples at which all drives are inside what the model was fitted on.
    pub inside: f64,
    /// Largest magnitude of each drive.
    pub drive_peak: BTreeMap<String, f64>,
    /// Share of each drive's samples that its limits changed.
    pub limited: BTreeMap<String, f64>,
    /// Mean factor on the gains with which this drive was found; of a step by gradient its length.
    pub gain: f64,
    /// Whether it is better than all before.
    pub better: bool,
}

/// The result.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct IterationReport {
    /// Why there is no further iteration.
    pub stopped: Stopped,
    /// The iteration whose drive was kept: the best.
    pub best: usize,
    /// Errors of the best, as a prediction's.
    pub errors: BTreeMap<String, ChannelErrors>,
    /// First and last frequency of the corrections, Hz.
    pub band_hz: Option<[f64; 2]>,
    /// Share of each target's power that the corrections do not reach.
    pub out_of_reach: BTreeMap<String, f64>,
    /// Where the FRF of the corrections is from.
    pub linear_part: LinearPart,
    /// What an engineer should know before the drive goes to the rig.
    pub warnings: Vec<String>,
    /// All iterations.
    #[serde(deserialize_with = "steps")]
    pub steps: Vec<IterationStep>,
}

fn linear() -> StepKind {
    StepKind::Linear
}

/// Steps of which the first is the start, in the reports of earlier versions too.
fn steps<'de, D: Deserializer<'de>>(from: D) -> Result<Vec<IterationStep>, D::Error> {
    let mut steps = Vec::<IterationStep>::deserialize(from)?;
    steps.iter_mut().filter(|step| step.iteration == 0).for_each(|step| step.kind = StepKind::Start);
    Ok(steps)
}

/// An iteration in lists.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct IterationSummary {
    /// Id.
    pub id: IterationId,
    /// Its rig.
    pub rig: RigId,
    /// When its drive was stored.
    pub created_at: Timestamp,
    /// The job that found it.
    pub job: JobId,
    /// The model.
    pub model: UsedModel,
    /// The run that holds the drive; `null` once it is deleted.
    pub drive: Option<RunId>,
    /// Weighted error of the best iteration.
    pub total_error: f64,
    /// Why the search ended.
    pub stopped: Stopped,
}

/// An iteration with its request and report.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct StoredIteration {
    /// As in lists.
    #[serde(flatten)]
    pub summary: IterationSummary,
    /// The request, its model resolved.
    pub request: IterationRequest,
    /// Seconds that it took.
    pub elapsed_s: f64,
    /// The result.
    #[serde(flatten)]
    pub report: IterationReport,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_left_open_has_the_engines_defaults() {
        let run = "0197e2a0-0000-7000-8000-000000000001";
        let parse = |json: &str| serde_json::from_str::<IterationRequest>(json);
        let request = parse(&format!(r#"{{"target": {{"run": "{run}"}}}}"#)).unwrap();
        assert_eq!((request.model, request.start), (ModelRef::Active, StartDrive::Inverse));
        assert_eq!(request.settings(), IterationSettings::default());
        let again = serde_json::from_str(&serde_json::to_string(&request).unwrap()).unwrap();
        assert_eq!(request, again);
        let start = |start: &str| parse(&format!(r#"{{"target": {{"run": "{run}"}}, "start": {start}}}"#));
        assert_eq!(start(r#""zero""#).unwrap().start, StartDrive::Zero);
        let given = start(&format!(r#"{{"run": "{run}"}}"#)).unwrap().start;
        assert_eq!(given, StartDrive::Run(run.parse().unwrap()));
        assert!(start(r#""random""#).is_err());
        assert!(parse(&format!(r#"{{"target": {{"run": "{run}"}}, "gian": 1}}"#)).is_err());
    }
}
