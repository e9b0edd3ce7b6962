//! Model versions: immutable, numbered, with everything that says where they came from.

use jiff::Timestamp;
use serde::{Deserialize, Serialize};

use super::fits::FitRequest;
use super::ids::{DiagnosisId, JobId, RigId, RunId};
use super::rig::Rig;
use crate::engine::model::{FitReport, ModelKind};

/// How a model came into the registry.
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

/// A stretch of a run: samples `from_sample..to_sample`.
///
/// The digest of the uploaded bytes tells two uploads of one measurement, and outlives the run.
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
    /// What the LSTM (or, without one, the FRF) was trained on.
    pub training: Vec<Span>,
    /// What the FRF part was estimated on, where that was something else.
    pub frf: Vec<Span>,
    /// What chose among models; its errors are the report's.
    pub validation: Vec<Span>,
    /// Effects that diagnoses added to it, the first adopted first; the rest of the lineage is that
    /// of the version that they were added to.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub diagnoses: Vec<Adopted>,
}

/// Where an adopted effect came from.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Adopted {
    /// The diagnosis.
    pub id: DiagnosisId,
    /// Place of the hypothesis in its report.
    pub hypothesis: usize,
    /// The version that was diagnosed.
    pub version: u32,
    /// What the effect's parameters were fitted to.
    pub fit: Vec<Span>,
    /// What the effect was chosen on.
    pub select: Vec<Span>,
}

impl Lineage {
    /// Whether a sample of `span` shaped the model's weights or the parameters of its effects.
    pub fn was_trained_on(&self, span: &Span) -> bool {
        let effects = self.diagnoses.iter().flat_map(|adopted| &adopted.fit);
        self.training.iter().chain(&self.frf).chain(effects).any(|used| used.overlaps(span))
    }

    /// All data that the model has seen, for weights, parameters or choices.
    pub fn spans(&self) -> impl Iterator<Item = &Span> {
        let effects = self.diagnoses.iter().flat_map(|adopted| adopted.fit.iter().chain(&adopted.select));
        self.training.iter().chain(&self.frf).chain(&self.validation).chain(effects)
    }
}

/// A model version as the contract shows it.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Model {
    /// Number within the rig, from 1, never given twice.
    pub version: u32,
    /// Its rig.
    pub rig: RigId,
    /// Kind.
    pub kind: ModelKind,
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
    /// What was asked for, with runs and channels resolved.
    pub request: Option<FitRequest>,
    /// What the fit found, with all settings used.
    pub report: Option<FitReport>,
    /// The data behind it.
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

impl Model {
    /// Whether it maps the rig's drives to the rig's responses, all of them, in whatever order.
    pub fn is_forward(&self, rig: &Rig) -> bool {
        is_forward(rig, &self.inputs, &self.outputs)
    }
}

/// Whether `inputs` are the rig's drives and `outputs` its responses, in whatever order.
pub fn is_forward(rig: &Rig, inputs: &[String], outputs: &[String]) -> bool {
    let same = |mut wanted: Vec<&str>, found: &[String]| {
        let mut found: Vec<&str> = found.iter().map(String::as_str).collect();
        wanted.sort_unstable();
        found.sort_unstable();
        wanted == found
    };
    same(rig.drives().collect(), inputs) && same(rig.responses().collect(), outputs)
}

/// Which model answers when a client asks for `active`.
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
            validation: vec![span(3, "cc", 0, 10)],
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
        assert_eq!(lineage.spans().count(), 5);
    }
}
