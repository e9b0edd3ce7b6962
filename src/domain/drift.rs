//! Drift (`GET /v1/rigs/{rig}/drift`): the error of the active model on each run that arrives, held against its errors
//! on the runs that were held out of its fit.

use std::collections::{BTreeMap, HashMap};

use jiff::Timestamp;
use serde::{Deserialize, Serialize};

use super::evaluation::Seen;
use super::ids::{RigId, RunId};
use super::model::{Model, UsedModel};
use super::run::Run;
use crate::engine::RunKind;

/// The limit over the largest error on many held-out stretches of data.
const FACTOR: f64 = 2.0;

/// Addition to [`FACTOR`] for a single held-out stretch: few of them say little about how much the error of an unchanged
/// rig varies from run to run. On the virtual rig it was up to 4.9 times that on the one stretch.
const FACTOR_FOR_ONE: f64 = 3.0;

/// How much wider limits are that rest on runs of other kinds: service loads are harder than noise.
const OTHER_KINDS: f64 = 2.0;

/// Least share of samples inside what the model was fitted on: below it the error of a run says nothing of the rig.
pub const LEAST_INSIDE: f64 = 0.95;

/// Most runs that a proposed diagnosis names.
const MOST_NAMED: usize = 8;

/// The runs that a control limit rests on.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Basis {
    /// Held-out runs of the kind of the judged run.
    SameKind,
    /// Held-out runs of other kinds, because none of the same kind was held out.
    OtherKinds,
}

impl Basis {
    /// The limit over the largest error on so many stretches of held-out data; `None` without any.
    pub fn factor(self, held_out: usize) -> Option<f64> {
        let factor = FACTOR + FACTOR_FOR_ONE / held_out as f64;
        let wider = match self {
            Self::SameKind => 1.0,
            Self::OtherKinds => OTHER_KINDS,
        };
        (held_out > 0).then_some(factor * wider)
    }
}

/// The control limits of runs of one kind.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct ControlLimit {
    /// The kind.
    pub kind: RunKind,
    /// What they rest on.
    pub basis: Basis,
    /// Number of stretches of held-out data that they rest on.
    pub held_out: usize,
    /// Limit over the largest error of these.
    pub factor: f64,
    /// Limit of the relative RMS error by output; an output that was zero in all of them has none.
    pub channels: BTreeMap<String, f64>,
}

impl ControlLimit {
    /// The limits of a model for runs of a kind; `None` if no data were held out of its fit. `kinds` are those of the
    /// rig's runs; held-out data of a run that is gone count as of another kind.
    pub fn of(model: &Model, kind: RunKind, kinds: &HashMap<RunId, RunKind>) -> Option<Self> {
        let scores = &model.report.as_ref()?.comparison.as_ref()?.scores;
        let held_out: Vec<_> = model.lineage.validation.iter().zip(scores).collect();
        let same = |run: &RunId| kinds.get(run) == Some(&kind);
        let found: Vec<_> = held_out.iter().filter(|(span, _)| same(&span.run)).collect();
        let (basis, found) = match found.is_empty() {
            false => (Basis::SameKind, found),
            true => (Basis::OtherKinds, held_out.iter().collect()),
        };
        let factor = basis.factor(found.len())?;
        let limit = |(output, name): (usize, &String)| {
            let errors = found.iter().filter_map(|(_, score)| score.outputs.get(output)?.rms());
            let largest = errors.fold(None, |most: Option<f64>, rms| Some(most.map_or(rms, |m| m.max(rms))));
            Some((name.clone(), factor * largest?))
        };
        let channels = model.outputs.iter().enumerate().filter_map(limit).collect();
        Some(Self { kind, basis, held_out: found.len(), factor, channels })
    }
}

/// Why a run is not predicted.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum NotPredicted {
    /// A part of it set weights or parameters of the model.
    Training,
    /// A part of it stopped the training, or chose among networks or effects.
    Choice,
    /// It was held out: the limits rest on it.
    HeldOut,
    /// It is a second upload of a run.
    Duplicate,
    /// It lacks inputs of the model, or all of its outputs.
    MissingChannels,
    /// It has another sample rate.
    SampleRate,
    /// The prediction is not finite.
    NotFinite,
    /// Its samples could not be read.
    Unreadable,
}

impl From<Seen> for NotPredicted {
    fn from(seen: Seen) -> Self {
        match seen {
            Seen::Training => Self::Training,
            Seen::Choice => Self::Choice,
            Seen::Comparison => Self::HeldOut,
        }
    }
}

/// Why the errors of a run are held against no limit.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum NoLimit {
    /// No data were held out of the model's fit, or it has none.
    NoHeldOutRuns,
    /// The drive leaves what the model was fitted on.
    Outside,
}

/// One output of a judged run.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct ChannelDrift {
    /// RMS error relative to the measured RMS; `None` where the output is zero throughout.
    pub rms: Option<f64>,
    /// Its limit.
    pub limit: Option<f64>,
    /// `rms` over `limit`.
    pub ratio: Option<f64>,
    /// Whether it is above the limit.
    pub past: bool,
}

/// The errors of a model on a run.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Judgement {
    /// Length of the part that was predicted, from the start.
    pub judged_s: f64,
    /// Share of samples inside what the model was fitted on.
    pub inside: f64,
    /// By output.
    pub channels: BTreeMap<String, ChannelDrift>,
    /// What the limits rest on.
    pub basis: Option<Basis>,
    /// Why there are no limits.
    pub no_limit: Option<NoLimit>,
    /// Largest ratio of the outputs.
    pub ratio: Option<f64>,
    /// Whether an output is past its limit.
    pub past: bool,
}

impl Judgement {
    /// Holds errors by output against the limits.
    pub fn new(
        errors: BTreeMap<String, Option<f64>>,
        judged_s: f64,
        inside: f64,
        limit: Option<&ControlLimit>,
    ) -> Self {
        let no_limit = match limit {
            None => Some(NoLimit::NoHeldOutRuns),
            Some(_) if inside < LEAST_INSIDE => Some(NoLimit::Outside),
            Some(_) => None,
        };
        let limit = limit.filter(|_| no_limit.is_none());
        let judged = |(name, rms): (String, Option<f64>)| {
            let limit = limit.and_then(|limit| limit.channels.get(&name).copied()).filter(|l| *l > 0.0);
            let ratio = rms.zip(limit).map(|(rms, limit)| rms / limit).filter(|ratio| ratio.is_finite());
            (name, ChannelDrift { rms, limit, ratio, past: ratio.is_some_and(|ratio| ratio > 1.0) })
        };
        let channels: BTreeMap<String, ChannelDrift> = errors.into_iter().map(judged).collect();
        let ratios = channels.values().filter_map(|channel| channel.ratio);
        let ratio = ratios.reduce(f64::max);
        Self {
            judged_s,
            inside,
            basis: limit.map(|limit| limit.basis),
            no_limit,
            ratio,
            past: channels.values().any(|channel| channel.past),
            channels,
        }
    }
}

/// The outcome of one run under one model, as it is stored.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Outcome {
    /// It was predicted.
    Judged(Judgement),
    /// It was not.
    Omitted(NotPredicted),
}

/// A run and its outcome.
#[derive(Debug, Clone, PartialEq)]
pub struct DriftRow {
    /// The run.
    pub run: RunId,
    /// Its name, may be empty.
    pub name: String,
    /// Its kind.
    pub kind: RunKind,
    /// Begin of the measurement; where the client did not say, the time of acceptance.
    pub at: Timestamp,
    /// The outcome.
    pub outcome: Outcome,
}

/// A run that waits to be predicted by the active model of its rig.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct DueRun {
    /// The rig.
    pub rig: RigId,
    /// Its active version.
    pub version: u32,
    /// The run.
    pub run: RunId,
}

/// A judged run of the answer.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct JudgedRun {
    /// The run.
    pub run: RunId,
    /// Its name, may be empty.
    pub name: String,
    /// Its kind.
    pub kind: RunKind,
    /// Begin of the measurement; where the client did not say, the time of acceptance.
    pub at: Timestamp,
    /// Its errors.
    #[serde(flatten)]
    pub judgement: Judgement,
}

/// A run that was not predicted.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct OmittedFromDrift {
    /// The run.
    pub run: RunId,
    /// Why.
    pub reason: NotPredicted,
}

/// The diagnosis to ask for.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct ProposedDiagnosis {
    /// Path to post it to.
    pub href: String,
    /// Its body.
    pub body: ProposedBody,
}

/// The body of a proposed diagnosis; everything else has its default.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct ProposedBody {
    /// The version to diagnose.
    pub model: u32,
    /// The runs past the limit.
    pub runs: Vec<RunId>,
}

/// The answer.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Drift {
    /// The rig.
    pub rig: RigId,
    /// The active model; `None`: nothing is judged.
    pub model: Option<UsedModel>,
    /// Limits of the kinds of the judged runs.
    pub limits: Vec<ControlLimit>,
    /// Why there are none.
    pub no_limit: Option<NoLimit>,
    /// Judged runs, in the order of their time; the newest of them all.
    pub runs: Vec<JudgedRun>,
    /// Judged runs before these.
    pub earlier: usize,
    /// Runs that were not predicted.
    pub omitted: Vec<OmittedFromDrift>,
    /// Runs that wait to be predicted.
    pub pending: u64,
    /// Largest ratio of error to limit of the newest run that is held against limits.
    pub ratio: Option<f64>,
    /// Whether that run is past its limit.
    pub past: bool,
    /// Past the limit: the diagnosis that would tell the effect.
    pub diagnosis: Option<ProposedDiagnosis>,
}

impl Drift {
    /// The answer for a rig without an active model.
    pub fn without_model(rig: RigId) -> Self {
        Self {
            rig,
            model: None,
            limits: Vec::new(),
            no_limit: None,
            runs: Vec::new(),
            earlier: 0,
            omitted: Vec::new(),
            pending: 0,
            ratio: None,
            past: false,
            diagnosis: None,
        }
    }

    /// The answer for an active model; `rows` are its runs by time, `runs` those of its rig. Of the judged runs it
    /// shows the last `most`.
    pub fn of(model: &Model, rows: Vec<DriftRow>, runs: &[Run], pending: u64, most: usize) -> Self {
        let kinds: HashMap<RunId, RunKind> = runs.iter().map(|run| (run.id, run.kind)).collect();
        let (mut judged, mut omitted) = (Vec::new(), Vec::new());
        for DriftRow { run, name, kind, at, outcome } in rows {
            match outcome {
                Outcome::Judged(judgement) => judged.push(JudgedRun { run, name, kind, at, judgement }),
                Outcome::Omitted(reason) => omitted.push(OmittedFromDrift { run, reason }),
            }
        }
        let of_kind = |kind: RunKind| {
            judged.iter().any(|run| run.kind == kind).then(|| ControlLimit::of(model, kind, &kinds)).flatten()
        };
        let limits: Vec<ControlLimit> = RunKind::ALL.into_iter().filter_map(of_kind).collect();
        let none = ControlLimit::of(model, RunKind::Noise, &kinds).is_none();
        let newest = judged.iter().rev().find(|run| run.judgement.ratio.is_some());
        let (ratio, past) = newest.map_or((None, false), |run| (run.judgement.ratio, run.judgement.past));
        let diagnosis = past.then(|| proposed(model, &judged));
        let earlier = judged.len().saturating_sub(most);
        Self {
            rig: model.rig.clone(),
            model: Some(UsedModel { version: model.version, sha256: model.sha256.clone() }),
            limits,
            no_limit: none.then_some(NoLimit::NoHeldOutRuns),
            runs: judged.split_off(earlier),
            earlier,
            omitted,
            pending,
            ratio,
            past,
            diagnosis,
        }
    }
}

/// The diagnosis of the last runs that are past the limit, back to the last one that is not.
fn proposed(model: &Model, judged: &[JudgedRun]) -> ProposedDiagnosis {
    let with_limit = judged.iter().rev().filter(|run| run.judgement.ratio.is_some());
    let mut runs: Vec<RunId> =
        with_limit.take_while(|run| run.judgement.past).take(MOST_NAMED).map(|run| run.run).collect();
    runs.reverse();
    ProposedDiagnosis {
        href: format!("/v1/rigs/{}/diagnoses", model.rig),
        body: ProposedBody { model: model.version, runs },
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn limit(basis: Basis) -> ControlLimit {
        ControlLimit {
            kind: RunKind::Noise,
            basis,
            held_out: 1,
            factor: 2.0,
            channels: BTreeMap::from([("x".into(), 0.1), ("perfect".into(), 0.0)]),
        }
    }

    fn judge(rms: Option<f64>, inside: f64, limit: Option<&ControlLimit>) -> Judgement {
        let errors =
            BTreeMap::from([("x".into(), rms), ("perfect".into(), Some(0.3)), ("new".into(), Some(9.0))]);
        Judgement::new(errors, 60.0, inside, limit)
    }

    #[test]
    fn limits_are_wider_where_they_rest_on_less() {
        assert_eq!((Basis::SameKind.factor(0), Basis::SameKind.factor(1)), (None, Some(5.0)));
        assert_eq!((Basis::SameKind.factor(6), Basis::OtherKinds.factor(6)), (Some(2.5), Some(5.0)));
    }

    #[test]
    fn an_error_is_past_its_limit_where_there_is_one() {
        let limit = limit(Basis::SameKind);
        let fine = judge(Some(0.05), 1.0, Some(&limit));
        assert_eq!((fine.ratio, fine.past, fine.no_limit), (Some(0.5), false, None));
        let past = judge(Some(0.2), 1.0, Some(&limit));
        assert_eq!((past.ratio, past.past, past.basis), (Some(2.0), true, Some(Basis::SameKind)));
        assert!(past.channels["x"].past && !past.channels["new"].past);
        assert_eq!(past.channels["perfect"].limit, None, "nothing can be held against a limit of zero");
        let still = judge(None, 1.0, Some(&limit));
        assert_eq!((still.ratio, still.past), (None, false));
    }

    #[test]
    fn a_drive_outside_the_model_and_a_model_without_held_out_runs_have_errors_and_no_limits() {
        let limit = limit(Basis::OtherKinds);
        let outside = judge(Some(0.9), 0.9, Some(&limit));
        assert_eq!((outside.no_limit, outside.ratio, outside.past), (Some(NoLimit::Outside), None, false));
        assert_eq!((outside.channels["x"].rms, outside.basis), (Some(0.9), None));
        let bare = judge(Some(0.9), 0.9, None);
        assert_eq!((bare.no_limit, bare.past), (Some(NoLimit::NoHeldOutRuns), false));
    }
}
