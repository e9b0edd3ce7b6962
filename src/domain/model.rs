//! Model versions: immutable, numbered, with their lineage.

use jiff::Timestamp;
use serde::{Deserialize, Serialize};

use super::fits::FitRequest;
use super::ids::{DiagnosisId, JobId, RigId, RunId};
use super::rig::Rig;
use crate::engine::diagnosis::{Effect, Family};
use crate::engine::frf::FrfSummary;
use crate::engine::model::{AddedEffect, FitReport, ModelKind, RigModel, VersionKind};

/// The version that some work was done with.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct UsedModel {
    /// Version.
    pub version: u32,
    /// SHA-256 of its weight file, hex.
    pub sha256: String,
}

/// The origin of a model.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Origin {
    /// By a fit job.
    Fit,
    /// As a weight file made elsewhere.
    Import,
    /// From another version, by adopting an effect that a diagnosis found.
    Diagnosis,
}

impl Origin {
    /// The word of the contract.
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Fit => "fit",
            Self::Import => "import",
            Self::Diagnosis => "diagnosis",
        }
    }
}

/// A span of a run: samples `from_sample..to_sample`.
///
/// The digest of the uploaded bytes identifies a measurement that was uploaded twice, and outlives the run.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Span {
    /// The run.
    pub run: RunId,
    /// SHA-256 of the file that the run came in, hex.
    pub sha256: String,
    /// First sample.
    pub from_sample: u64,
    /// Sample after the last.
    pub to_sample: u64,
}

impl Span {
    /// Whether both hold a sample of one measurement.
    pub fn overlaps(&self, other: &Self) -> bool {
        (self.run == other.run || self.sha256 == other.sha256)
            && self.from_sample.max(other.from_sample) < self.to_sample.min(other.to_sample)
    }
}

/// The data that made a model.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize)]
pub struct Lineage {
    /// Training data of the LSTM or, without one, of the FRF.
    pub training: Vec<Span>,
    /// Data of the FRF part, if they differ.
    pub frf: Vec<Span>,
    /// Data that stopped the training and chose seed and recombination. Absent from models that were made
    /// before these were told apart from `validation`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub stopping: Option<Vec<Span>>,
    /// Data that compare the model with others; the errors in the report are on these. If the model was fitted
    /// again on all runs, they are in `training` too.
    pub validation: Vec<Span>,
    /// The version whose weights the training began at.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub start: Option<StartedFrom>,
    /// The version that took the place of a hybrid's FRF.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub core: Option<UsedCore>,
    /// Effects that were adopted from diagnoses, in the order of adoption. The rest of the lineage is that of
    /// the version that they were added to.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub diagnoses: Vec<Adopted>,
}

/// The version whose weights a training began at. It may be gone; what it had seen, the new model has seen too.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct StartedFrom {
    /// The version.
    pub version: u32,
    /// SHA-256 of its weight file, hex.
    pub sha256: String,
    /// Data that shaped it, stopped its training or chose it.
    pub seen: Vec<Span>,
}

/// The core in place of a hybrid's FRF: an FRF with adopted effects. The model's weight file holds it, so its version may
/// be gone.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct UsedCore {
    /// The version; none where the model was imported with its core.
    pub version: Option<u32>,
    /// SHA-256 of the version's weight file, hex; none where the version is unknown.
    pub sha256: Option<String>,
    /// Its effects, the first adopted first.
    pub effects: Vec<AdoptedEffect>,
    /// Data to which its FRF and its effects were fitted, or on which they were chosen.
    pub seen: Vec<Span>,
}

impl UsedCore {
    /// The core of weights whose origin is unknown; none where they have none.
    pub fn of_import(model: &RigModel) -> Option<Self> {
        let effects = adopted_effects(model, &model.core);
        (!effects.is_empty()).then(|| Self { version: None, sha256: None, effects, seen: Vec::new() })
    }
}

/// Effects of a model by name.
fn adopted_effects(model: &RigModel, effects: &[AddedEffect]) -> Vec<AdoptedEffect> {
    let named = |(effect, response): (Effect, usize)| AdoptedEffect {
        effect,
        family: effect.family(),
        channel: model.outputs[response].clone(),
    };
    effects.iter().flat_map(|added| added.augmented.effects()).map(named).collect()
}

/// The origin of an adopted effect.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Adopted {
    /// The diagnosis.
    pub id: DiagnosisId,
    /// Place of the hypothesis in its report.
    pub hypothesis: usize,
    /// The version that was diagnosed.
    pub version: u32,
    /// Data to which the effect's parameters were fitted.
    pub fit: Vec<Span>,
    /// Data on which the effect was chosen.
    pub select: Vec<Span>,
}

impl Lineage {
    /// Whether a sample of `span` shaped the model's weights, its core or the parameters of its effects.
    pub fn was_trained_on(&self, span: &Span) -> bool {
        let effects = self.diagnoses.iter().flat_map(|adopted| &adopted.fit);
        let core = self.core.iter().flat_map(|core| &core.seen);
        self.training.iter().chain(&self.frf).chain(effects).chain(core).any(|used| used.overlaps(span))
    }

    /// Whether a sample of `span` shaped the model, or stopped its training, or chose it.
    pub fn has_seen(&self, span: &Span) -> bool {
        self.seen().any(|used| used.overlaps(span))
    }

    /// Data that shaped the model, stopped its training or chose it, or did so for the version that it began at or for
    /// its core.
    pub fn seen(&self) -> impl Iterator<Item = &Span> {
        let effects = self.diagnoses.iter().flat_map(|adopted| adopted.fit.iter().chain(&adopted.select));
        let stopped = self.stopping.as_ref().unwrap_or(&self.validation);
        self.training.iter().chain(&self.frf).chain(stopped).chain(effects).chain(self.seen_before())
    }

    /// Data that the model has seen through the version that its training began at, or through its core.
    fn seen_before(&self) -> impl Iterator<Item = &Span> {
        let start = self.start.iter().flat_map(|start| &start.seen);
        start.chain(self.core.iter().flat_map(|core| &core.seen))
    }

    /// Whether the version that the training began at, or the core, has seen a sample of `span`.
    pub fn had_been_seen(&self, span: &Span) -> bool {
        self.seen_before().any(|used| used.overlaps(span))
    }

    /// All data that the model has seen, for weights, parameters or choices.
    pub fn spans(&self) -> impl Iterator<Item = &Span> {
        let effects = self.diagnoses.iter().flat_map(|adopted| adopted.fit.iter().chain(&adopted.select));
        let stopping = self.stopping.iter().flatten();
        self.training
            .iter()
            .chain(&self.frf)
            .chain(stopping)
            .chain(&self.validation)
            .chain(effects)
            .chain(self.seen_before())
    }
}

/// What an adopted version consists of. Its weight file holds all of it: the base may be deleted.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Adoption {
    /// The model beneath all effects, which a fit or an import made.
    pub base: Base,
    /// The effects on top of it, the first adopted first, as in the lineage's `diagnoses`.
    pub effects: Vec<AdoptedEffect>,
}

/// The model beneath adopted effects.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Base {
    /// Its version of this rig; none where base and effects came in one weight file.
    pub version: Option<u32>,
    /// Its kind.
    pub kind: ModelKind,
    /// SHA-256 of its weight file, hex; none where the version is unknown or was gone when this was written.
    pub sha256: Option<String>,
}

/// An effect of an adopted version.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct AdoptedEffect {
    /// The effect.
    pub effect: Effect,
    /// Its family.
    pub family: Family,
    /// The output at which it acts; others may feel it.
    pub channel: String,
}

impl Adoption {
    /// What a model with effects consists of, on a base of this version and digest; none without effects.
    pub fn of(model: &RigModel, version: Option<u32>, sha256: Option<String>) -> Option<Self> {
        let base = Base { version, kind: model.kind, sha256 };
        let effects = adopted_effects(model, &model.effects);
        (!effects.is_empty()).then_some(Self { base, effects })
    }
}

/// A model version as the contract shows it.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Model {
    /// Number within the rig, from 1, never given twice.
    pub version: u32,
    /// Its rig.
    pub rig: RigId,
    /// Its parts and how they combine; of an adopted version those of its base.
    #[serde(skip)]
    pub parts: ModelKind,
    /// Kind.
    pub kind: VersionKind,
    /// Of kind `adopted`: the model beneath, and the effects on top of it.
    #[serde(flatten, skip_serializing_if = "Option::is_none")]
    pub adoption: Option<Adoption>,
    /// Input channels, in order.
    pub inputs: Vec<String>,
    /// Output channels, in order.
    pub outputs: Vec<String>,
    /// Sample rate of inputs and outputs.
    pub sample_rate_hz: f64,
    /// SHA-256 of the weight file, hex.
    pub sha256: String,
    /// Size of the weight file.
    pub size_bytes: u64,
    /// Fitted, imported or adopted.
    pub origin: Origin,
    /// The job that fitted it, or found its effect.
    pub job: Option<JobId>,
    /// The fit request, with runs and channels resolved.
    pub request: Option<FitRequest>,
    /// Results of the fit, with all settings used.
    pub report: Option<FitReport>,
    /// Figures of its FRF; absent where it has none.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub frf: Option<ModelFrf>,
    /// The data that made it.
    pub lineage: Lineage,
    /// Version of this program that made it.
    pub code_version: String,
    /// Instruction set that it was computed with: another one may round differently.
    pub instruction_set: String,
    /// When it was published.
    pub created_at: Timestamp,
    /// Whether it is the rig's active model.
    pub active: bool,
}

/// A model's FRF in a few figures, with the path of the whole.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct ModelFrf {
    /// Path of all its lines.
    pub href: String,
    /// The figures; `None` for a model that was stored before there were any.
    #[serde(flatten)]
    pub summary: Option<FrfSummary>,
    /// Why figures are missing.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub reason: Option<&'static str>,
}

/// Why an FRF has no coherence to show.
pub const NO_COHERENCE: &str =
    "the weights carry no coherence: they were made elsewhere or by an earlier version";

impl ModelFrf {
    /// Of a version with these parts, whose summary may be stored; `None` for parts without FRF.
    pub fn of(rig: &RigId, version: u32, parts: ModelKind, summary: Option<FrfSummary>) -> Option<Self> {
        if summary.is_none() && parts == ModelKind::Lstm {
            return None;
        }
        let measured = summary.as_ref().is_some_and(|summary| summary.measured.is_some());
        let href = format!("/v1/rigs/{rig}/models/{version}/frf");
        Some(Self { href, summary, reason: (!measured).then_some(NO_COHERENCE) })
    }
}

impl Model {
    /// Its kind and, of an adopted version, that of its base.
    pub fn kind_in_words(&self) -> String {
        match &self.adoption {
            Some(adoption) => format!("{} on {}", self.kind.as_str(), adoption.base.kind.as_str()),
            None => self.kind.as_str().to_owned(),
        }
    }

    /// Whether it maps all of the rig's drives to all of its responses, in any order.
    pub fn is_forward(&self, rig: &Rig) -> bool {
        is_forward(rig, &self.inputs, &self.outputs)
    }
}

/// Whether `inputs` are the rig's drives and `outputs` its responses, in any order.
pub fn is_forward(rig: &Rig, inputs: &[String], outputs: &[String]) -> bool {
    let same = |mut wanted: Vec<&str>, found: &[String]| {
        let mut found: Vec<&str> = found.iter().map(String::as_str).collect();
        wanted.sort_unstable();
        found.sort_unstable();
        wanted == found
    };
    same(rig.drives().collect(), inputs) && same(rig.responses().collect(), outputs)
}

/// The model that a request for `active` refers to.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct ActiveModel {
    /// The version, if any.
    pub version: Option<u32>,
    /// Rises with every change of the pointer.
    #[serde(skip)]
    pub revision: u64,
}

impl ActiveModel {
    /// The `ETag` that a change must name.
    pub fn etag(&self) -> String {
        format!("\"a{}\"", self.revision)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn span(run: u128, sha256: &str, from_sample: u64, to_sample: u64) -> Span {
        Span { run: RunId::from_u128(run), sha256: sha256.into(), from_sample, to_sample }
    }

    #[test]
    fn spans_overlap_by_sample_whichever_upload_they_name() {
        let a = span(1, "aa", 0, 900);
        assert!(!a.overlaps(&span(1, "aa", 900, 1000)));
        assert!(a.overlaps(&span(1, "aa", 899, 1000)));
        assert!(a.overlaps(&span(2, "aa", 0, 1)), "the same bytes under another id");
        assert!(!a.overlaps(&span(2, "bb", 0, 1000)));
        assert!(!a.overlaps(&span(1, "aa", 5, 5)), "an empty span holds no sample");
    }

    #[test]
    fn frf_data_counts_as_training_and_validation_data_does_not() {
        let lineage = Lineage {
            training: vec![span(1, "aa", 0, 10)],
            frf: vec![span(2, "bb", 0, 10)],
            stopping: Some(vec![span(6, "ff", 0, 10)]),
            validation: vec![span(3, "cc", 0, 10)],
            start: None,
            core: None,
            diagnoses: vec![Adopted {
                id: DiagnosisId::nil(),
                hypothesis: 0,
                version: 1,
                fit: vec![span(4, "dd", 0, 10)],
                select: vec![span(5, "ee", 0, 10)],
            }],
        };
        assert!(lineage.was_trained_on(&span(2, "bb", 9, 10)));
        assert!(!lineage.was_trained_on(&span(3, "cc", 0, 10)));
        assert!(lineage.was_trained_on(&span(4, "dd", 0, 1)), "an effect's parameters are weights too");
        assert!(!lineage.was_trained_on(&span(5, "ee", 0, 10)));
        assert_eq!(lineage.spans().count(), 6);
        let started = StartedFrom { version: 1, sha256: "00".into(), seen: vec![span(7, "77", 0, 5)] };
        let warm = Lineage { start: Some(started), ..lineage.clone() };
        assert!(warm.has_seen(&span(7, "77", 4, 9)) && !warm.was_trained_on(&span(7, "77", 4, 9)));
        assert!(!warm.had_been_seen(&span(1, "aa", 0, 1)) && warm.spans().count() == 7);
        let seen = vec![span(8, "88", 0, 5)];
        let core = UsedCore { version: Some(1), sha256: Some("00".into()), effects: Vec::new(), seen };
        let on_core = Lineage { core: Some(core), ..lineage.clone() };
        let of_core = span(8, "88", 4, 9);
        assert!(
            on_core.was_trained_on(&of_core) && on_core.has_seen(&of_core) && on_core.had_been_seen(&of_core)
        );
        let seen = |run, sha256| lineage.has_seen(&span(run, sha256, 0, 1));
        assert!(seen(6, "ff") && seen(5, "ee") && seen(1, "aa") && !seen(3, "cc"));
        let before = Lineage { stopping: None, ..lineage.clone() };
        assert!(before.has_seen(&span(3, "cc", 0, 1)), "validation data stopped the models of before");
    }
}
