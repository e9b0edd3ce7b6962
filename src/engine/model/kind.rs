//! Kinds of models: what a fit makes, and what a model version may be.

use serde::{Deserialize, Serialize};

/// The parts of a model and their combination (Heindel et al., section 2.3).
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case", try_from = "VersionKind")]
pub enum ModelKind {
    /// `y = FRF(x)`.
    Frf,
    /// `y = LSTM(x)`.
    Lstm,
    /// `y = FRF(x) + LSTM(x)`, the LSTM trained on the FRF's error.
    Hybrid1,
    /// `y = LSTM(x, FRF(x))`.
    Hybrid2,
}

/// The kind of a model version: one of the kinds that a fit makes, or one of them with adopted effects on top.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum VersionKind {
    /// [`ModelKind::Frf`].
    Frf,
    /// [`ModelKind::Lstm`].
    Lstm,
    /// [`ModelKind::Hybrid1`].
    Hybrid1,
    /// [`ModelKind::Hybrid2`].
    Hybrid2,
    /// A model of any of these kinds, its base, with effects that diagnoses found:
    /// `y = base(x) + [augmented(x) - core(x)]` for each.
    Adopted,
}

impl ModelKind {
    /// Its name in the contract.
    pub fn as_str(self) -> &'static str {
        VersionKind::from(self).as_str()
    }
}

impl VersionKind {
    /// All kinds.
    pub const ALL: [Self; 5] = [Self::Frf, Self::Lstm, Self::Hybrid1, Self::Hybrid2, Self::Adopted];

    /// Its name in the contract.
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Frf => "frf",
            Self::Lstm => "lstm",
            Self::Hybrid1 => "hybrid1",
            Self::Hybrid2 => "hybrid2",
            Self::Adopted => "adopted",
        }
    }
}

impl From<ModelKind> for VersionKind {
    fn from(kind: ModelKind) -> Self {
        match kind {
            ModelKind::Frf => Self::Frf,
            ModelKind::Lstm => Self::Lstm,
            ModelKind::Hybrid1 => Self::Hybrid1,
            ModelKind::Hybrid2 => Self::Hybrid2,
        }
    }
}

/// The kind `adopted` where a kind that a fit makes is needed.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error(
    "adopted is no kind that a fit makes (frf, lstm, hybrid1, hybrid2): it comes of adopting a diagnosis's effect"
)]
pub struct NotFitted;

impl TryFrom<VersionKind> for ModelKind {
    type Error = NotFitted;

    fn try_from(kind: VersionKind) -> Result<Self, NotFitted> {
        match kind {
            VersionKind::Frf => Ok(Self::Frf),
            VersionKind::Lstm => Ok(Self::Lstm),
            VersionKind::Hybrid1 => Ok(Self::Hybrid1),
            VersionKind::Hybrid2 => Ok(Self::Hybrid2),
            VersionKind::Adopted => Err(NotFitted),
        }
    }
}
