//! Evaluations as they are requested (`POST /v1/rigs/{rig}/evaluations`), listed and stored.

use std::fmt;

use jiff::Timestamp;
use serde::de::{Error, Visitor};
use serde::{Deserialize, Deserializer, Serialize, Serializer};

use super::fits::{RunFilter, RunSelection};
use super::ids::{EvaluationId, JobId, RigId, RunId};
use super::job::{JobKind, JobRequest};
use super::model::Origin;
use super::model_ref::ModelRef;
use crate::engine::evaluation::{
    ChannelGroup, ClassAverage, ClassDifference, CompareSettings, RunFigures, Spectra, WorstSpan,
};
use crate::engine::fatigue::DamageSettings;
use crate::engine::model::{Preprocess, VersionKind};
use crate::engine::{RunKind, Split};

/// How runs are sorted into classes.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub enum Classes {
    /// By their kind.
    #[default]
    Kind,
    /// These kinds and tags, each a class of the runs that have it.
    Named(Vec<String>),
}

/// The word for [`Classes::Kind`].
const KIND: &str = "kind";

impl Serialize for Classes {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        match self {
            Self::Kind => serializer.serialize_str(KIND),
            Self::Named(names) => names.serialize(serializer),
        }
    }
}

impl<'de> Deserialize<'de> for Classes {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        struct ClassesVisitor;
        impl<'de> Visitor<'de> for ClassesVisitor {
            type Value = Classes;

            fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                f.write_str("\"kind\", or a list of kinds and tags")
            }

            fn visit_str<E: Error>(self, word: &str) -> Result<Classes, E> {
                Ok(if word == KIND { Classes::Kind } else { Classes::Named(vec![word.to_owned()]) })
            }

            fn visit_seq<A: serde::de::SeqAccess<'de>>(self, names: A) -> Result<Classes, A::Error> {
                Vec::deserialize(serde::de::value::SeqAccessDeserializer::new(names)).map(Classes::Named)
            }
        }
        deserializer.deserialize_any(ClassesVisitor)
    }
}

/// The request; every field has a default.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct EvaluationRequest {
    /// The model versions to evaluate.
    pub models: Vec<ModelRef>,
    /// The runs; a selection has runs of any kind, of the split `test` if it names none.
    pub runs: RunSelection,
    /// How runs are sorted into classes.
    pub classes: Classes,
    /// The version that the others are compared with; it is evaluated too.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub baseline: Option<ModelRef>,
    /// Whether runs that a model was fitted on count in its averages.
    pub include_fitted: bool,
    /// Settings of damage.
    pub damage: DamageSettings,
    /// Length of the spans that are searched for the worst, s.
    pub span_s: f64,
}

impl JobRequest for EvaluationRequest {
    const KIND: JobKind = JobKind::Evaluation;
}

impl Default for EvaluationRequest {
    fn default() -> Self {
        Self {
            models: vec![ModelRef::Active],
            runs: RunSelection::Match(RunFilter::default()),
            classes: Classes::Kind,
            baseline: None,
            include_fitted: false,
            damage: DamageSettings::default(),
            span_s: 1.0,
        }
    }
}

impl EvaluationRequest {
    /// Settings of the engine's figures.
    pub fn settings(&self) -> CompareSettings {
        CompareSettings { damage: self.damage, span_s: self.span_s }
    }
}

/// A model of an evaluation.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct EvaluatedModel {
    /// Version.
    pub version: u32,
    /// Kind.
    pub kind: VersionKind,
    /// SHA-256 of its weight file, hex.
    pub sha256: String,
    /// Where it is from: the runs that an imported model was fitted on are not known.
    pub origin: Origin,
    /// Input channels.
    pub inputs: Vec<String>,
    /// Output channels.
    pub outputs: Vec<String>,
    /// Its filter, which the measured channels have passed before they were compared.
    pub preprocess: Preprocess,
    /// Whether the others are compared with it.
    pub baseline: bool,
}

/// A run of an evaluation.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct EvaluatedRun {
    /// Id.
    pub id: RunId,
    /// Name for people, may be empty.
    pub name: String,
    /// Kind of excitation.
    pub kind: RunKind,
    /// Its use.
    pub split: Split,
    /// Length.
    pub duration_s: f64,
    /// The classes that it is in.
    pub classes: Vec<String>,
}

/// A compared channel.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct EvaluatedChannel {
    /// Name.
    pub name: String,
    /// Unit.
    pub unit: String,
}

/// What a run had been to a model before the evaluation.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Seen {
    /// A sample of it set weights or parameters.
    Training,
    /// A sample of it stopped the training, or chose among networks or effects.
    Choice,
    /// It compared the model with others. It counts in averages.
    Comparison,
}

impl Seen {
    /// Whether the run shaped the model, so that its averages leave it out.
    pub fn shaped(self) -> bool {
        matches!(self, Self::Training | Self::Choice)
    }
}

/// One model on one run.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct RunResult {
    /// Version.
    pub model: u32,
    /// The run.
    pub run: RunId,
    /// What the run had been to the model; `null`: nothing that the service knows of.
    pub seen: Option<Seen>,
    /// Whether it counts in the averages of its classes.
    pub counted: bool,
    /// Share of samples inside what the model was fitted on.
    pub inside: f64,
    /// Figures.
    #[serde(flatten)]
    pub figures: RunFigures,
}

/// Why a model was not compared with a run.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Omission {
    /// The run lacks inputs of the model, or all of its outputs.
    MissingChannels,
    /// The run has another sample rate.
    SampleRate,
    /// The prediction, or a figure of it, is not finite.
    NotFinite,
}

/// A run that a model was not compared with.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct OmittedRun {
    /// Version.
    pub model: u32,
    /// The run.
    pub run: RunId,
    /// Why.
    pub reason: Omission,
    /// The channels that are missing, or on which the prediction is not finite.
    pub channels: Vec<String>,
}

/// The worst span of a class, and its run.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct WorstSpanOfRun {
    /// The run.
    pub run: RunId,
    /// The span.
    #[serde(flatten)]
    pub span: WorstSpan,
}

/// The channel with the largest error.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct WorstChannel {
    /// Its name.
    pub channel: String,
    /// Its mean RMS error.
    pub rms: f64,
}

/// What a model has over the baseline, over the runs that count for both.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct BaselineDifference {
    /// Number of these runs.
    pub runs: usize,
    /// Differences.
    #[serde(flatten)]
    pub figures: ClassDifference,
}

/// A row of the table: one model on one class of runs.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ClassRow {
    /// Class.
    pub class: String,
    /// Version.
    pub model: u32,
    /// Runs that the averages are over.
    pub runs: usize,
    /// Their length together.
    pub duration_s: f64,
    /// Runs of the class that are left out because the model was fitted on them.
    pub left_out: usize,
    /// Averages.
    #[serde(flatten)]
    pub average: ClassAverage,
    /// Share of samples inside what the model was fitted on; `null` without runs.
    pub inside: Option<f64>,
    /// The channel with the largest error.
    pub worst_channel: Option<WorstChannel>,
    /// Where the prediction is farthest off.
    pub worst_span: Option<WorstSpanOfRun>,
    /// Measured and predicted spectra; `null` without runs.
    pub spectra: Option<Spectra>,
    /// Against the baseline; absent for the baseline itself and where none was named.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub difference: Option<BaselineDifference>,
}

/// The result.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct EvaluationReport {
    /// The models, in the order of the request, the baseline last unless the request names it among the models.
    pub models: Vec<EvaluatedModel>,
    /// Compared channels, in the rig's order.
    pub channels: Vec<EvaluatedChannel>,
    /// Groups of these channels.
    pub groups: Vec<ChannelGroup>,
    /// The runs.
    pub runs: Vec<EvaluatedRun>,
    /// Class by class, each with its models in their order.
    pub table: Vec<ClassRow>,
    /// Each model on each run.
    pub results: Vec<RunResult>,
    /// Runs that models were not compared with.
    pub omitted: Vec<OmittedRun>,
    /// What an engineer should know about the figures.
    pub warnings: Vec<String>,
}

/// An evaluation in a few words, for lists.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct EvaluationOutline {
    /// Versions.
    pub models: Vec<u32>,
    /// The version that the others are compared with.
    pub baseline: Option<u32>,
    /// Classes.
    pub classes: Vec<String>,
    /// Number of runs.
    pub runs: usize,
}

impl From<&EvaluationReport> for EvaluationOutline {
    fn from(report: &EvaluationReport) -> Self {
        let mut classes: Vec<String> = Vec::new();
        for row in &report.table {
            if !classes.contains(&row.class) {
                classes.push(row.class.clone());
            }
        }
        Self {
            models: report.models.iter().map(|model| model.version).collect(),
            baseline: report.models.iter().find(|model| model.baseline).map(|model| model.version),
            classes,
            runs: report.runs.len(),
        }
    }
}

/// An evaluation as lists show it.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct EvaluationSummary {
    /// Id.
    pub id: EvaluationId,
    /// Its rig.
    pub rig: RigId,
    /// When its report was stored.
    pub created_at: Timestamp,
    /// The job that made it.
    pub job: JobId,
    /// In a few words.
    #[serde(flatten)]
    pub outline: EvaluationOutline,
}

/// An evaluation with everything but its report.
#[derive(Debug, Clone, PartialEq)]
pub struct StoredEvaluation {
    /// As lists show it.
    pub summary: EvaluationSummary,
    /// What was asked for, models and runs resolved.
    pub request: EvaluationRequest,
    /// Seconds that it took.
    pub elapsed_s: f64,
    /// SHA-256 of the object that holds its [`EvaluationReport`], hex.
    pub report: String,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_left_open_has_the_contracts_defaults() {
        let parse = |json: &str| serde_json::from_str::<EvaluationRequest>(json);
        assert_eq!(parse("{}").unwrap(), EvaluationRequest::default());
        let request = parse(
            r#"{"models": ["active", 3], "runs": {"tags": ["sl"]}, "baseline": 1, "classes": ["sl", "noise"]}"#,
        )
        .unwrap();
        assert_eq!(request.models, [ModelRef::Active, ModelRef::Version(3)]);
        assert_eq!(request.baseline, Some(ModelRef::Version(1)));
        assert_eq!(request.classes, Classes::Named(vec!["sl".into(), "noise".into()]));
        let again = serde_json::from_str(&serde_json::to_string(&request).unwrap()).unwrap();
        assert_eq!(request, again);
        assert_eq!(parse(r#"{"classes": "kind"}"#).unwrap().classes, Classes::Kind);
        assert_eq!(parse(r#"{"classes": "sl"}"#).unwrap().classes, Classes::Named(vec!["sl".into()]));
        for odd in [r#"{"classes": 3}"#, r#"{"model": 3}"#, r#"{"models": "newest"}"#] {
            assert!(parse(odd).is_err(), "{odd}");
        }
    }
}
