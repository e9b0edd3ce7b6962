//! A fit request (`POST /v1/rigs/{rig}/fits`, and in a rig's `fit_policy`).

use std::fmt;

use serde::de::value::{MapAccessDeserializer, SeqAccessDeserializer};
use serde::de::{Error, MapAccess, SeqAccess, Visitor};
use serde::{Deserialize, Deserializer, Serialize};

use super::job::{JobKind, JobRequest};
use crate::engine::frf::Estimator;
use crate::engine::model::{LstmOptions, ModelKind, Preprocess, Preset};

/// Runs by id, or by kind, tags and split.
#[derive(Debug, Clone, PartialEq, Serialize)]
#[serde(untagged)]
pub enum RunSelection {
    /// Exactly these.
    Ids(Vec<uuid::Uuid>),
    /// All that match.
    Match(RunFilter),
}

impl<'de> Deserialize<'de> for RunSelection {
    /// By hand: what serde derives for an untagged type says neither where nor what is wrong.
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        struct SelectionVisitor;
        impl<'de> Visitor<'de> for SelectionVisitor {
            type Value = RunSelection;

            fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                f.write_str("ids of runs, or a selection of runs")
            }

            fn visit_str<E: Error>(self, id: &str) -> Result<RunSelection, E> {
                id.parse().map(|id| RunSelection::Ids(vec![id])).map_err(E::custom)
            }

            fn visit_seq<A: SeqAccess<'de>>(self, ids: A) -> Result<RunSelection, A::Error> {
                Vec::deserialize(SeqAccessDeserializer::new(ids)).map(RunSelection::Ids)
            }

            fn visit_map<A: MapAccess<'de>>(self, filter: A) -> Result<RunSelection, A::Error> {
                RunFilter::deserialize(MapAccessDeserializer::new(filter)).map(RunSelection::Match)
            }
        }
        deserializer.deserialize_any(SelectionVisitor)
    }
}

/// A selection by kind, tag and split; an empty list matches all.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct RunFilter {
    /// Run kinds; empty: any. Left out of a request: `["noise"]`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub kinds: Option<Vec<String>>,
    /// The run has every one of these tags.
    pub tags: Vec<String>,
    /// Split; left out: training (validation under `validation_runs`).
    #[serde(skip_serializing_if = "Option::is_none")]
    pub split: Option<String>,
}

/// FRF part of a fit request.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct FrfOptions {
    /// Runs of the FRF part; left out: those of the fit.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub runs: Option<RunSelection>,
    /// See [`crate::engine::frf::FrfSettings`].
    #[serde(skip_serializing_if = "Option::is_none")]
    pub segment_len: Option<usize>,
    /// See [`crate::engine::frf::FrfSettings`].
    #[serde(skip_serializing_if = "Option::is_none")]
    pub overlap: Option<f64>,
    /// See [`crate::engine::frf::FrfSettings`].
    #[serde(skip_serializing_if = "Option::is_none")]
    pub estimator: Option<Estimator>,
    /// See [`crate::engine::frf::FrfSettings`].
    #[serde(skip_serializing_if = "Option::is_none")]
    pub ridge: Option<f64>,
}

/// The condition on which a new model becomes the active one.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Activate {
    /// If none was active, or if it is at least 1 % better on data neither was trained on.
    #[default]
    IfBetter,
    /// Never by the fit.
    Never,
    /// In any case.
    Always,
}

/// The model that a training goes on from.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct StartFrom {
    /// A version of the rig, of the same kind and channels.
    pub version: u32,
}

/// The core that takes the place of a hybrid's FRF.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CoreFrom {
    /// An adopted version of the rig on an FRF, of the same channels and filter.
    pub version: u32,
}

/// The request; every field but `kind` has a default.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct FitRequest {
    /// Kind of model.
    pub kind: ModelKind,
    /// Input channels; left out: all drives.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub inputs: Option<Vec<String>>,
    /// Output channels; left out: all responses.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub outputs: Option<Vec<String>>,
    /// Training runs; left out: noise runs of the training split.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub runs: Option<RunSelection>,
    /// Validation runs; left out: all of the validation split, if any.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub validation_runs: Option<RunSelection>,
    /// Filter.
    #[serde(default)]
    pub preprocess: Preprocess,
    /// FRF part.
    #[serde(default)]
    pub frf: FrfOptions,
    /// The version in place of the FRF of a hybrid; left out: an FRF is estimated.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub core: Option<CoreFrom>,
    /// LSTM part.
    #[serde(default)]
    pub lstm: LstmOptions,
    /// The version whose weights the training begins at; left out: as `lstm.hybrid_start` says. Blocks that are
    /// left open are those of the version.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub start: Option<StartFrom>,
    /// Source of what is left open.
    #[serde(default)]
    pub preset: Preset,
    /// When the model becomes the active one.
    #[serde(default)]
    pub activate: Activate,
}

impl JobRequest for FitRequest {
    const KIND: JobKind = JobKind::Fit;
}
