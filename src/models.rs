//! From a rig to its loaded model: a small cache whose entries are swapped whole.

use std::sync::Arc;

use crate::compute::{Compute, ComputeError};
use crate::domain::RigId;
use crate::engine::EngineError;
use crate::engine::model::RigModel;
use crate::storage::{Store, StoreError};

/// A model in memory. A prediction holds one of these from start to end.
#[derive(Debug, Clone, PartialEq)]
pub struct LoadedModel {
    /// Version.
    pub version: u32,
    /// SHA-256 of its weight file, verified when it was loaded.
    pub sha256: String,
    /// The model.
    pub model: RigModel,
}

/// Why a model cannot be loaded.
#[derive(Debug, thiserror::Error)]
pub enum ModelError {
    /// The store failed, or the weight file is damaged.
    #[error(transparent)]
    Store(#[from] StoreError),
    /// The weight file cannot be read as a model.
    #[error("model {rig} version {version}: {source}")]
    Weights {
        /// Rig.
        rig: RigId,
        /// Version.
        version: u32,
        /// What is wrong.
        source: EngineError,
    },
    /// No thread for it.
    #[error(transparent)]
    Compute(#[from] ComputeError),
}

/// A model that could not be loaded when it was last wanted: what `readyz` calls degraded.
#[derive(Debug, Clone, PartialEq, Eq, serde::Serialize)]
pub struct Degraded {
    /// Rig.
    pub rig: RigId,
    /// Version.
    pub version: u32,
    /// Why.
    pub reason: String,
}

/// The cache. Clones share it.
#[derive(Debug, Clone)]
pub struct Models {
    _inner: Arc<()>,
}

impl Models {
    /// A cache of at most `capacity` models (at least one).
    pub fn new(_store: Store, _compute: Compute, _capacity: usize) -> Self {
        todo!()
    }

    /// The rig's active model; `None` when there is none, or no such rig.
    ///
    /// # Errors
    /// See [`ModelError`].
    pub async fn active(&self, _rig: &RigId) -> Result<Option<Arc<LoadedModel>>, ModelError> {
        todo!()
    }

    /// One version; `None` when there is no such one.
    ///
    /// # Errors
    /// See [`ModelError`].
    pub async fn version(&self, _rig: &RigId, _version: u32) -> Result<Option<Arc<LoadedModel>>, ModelError> {
        todo!()
    }

    /// Models that could not be loaded when they were last wanted.
    pub fn degraded(&self) -> Vec<Degraded> {
        todo!()
    }
}
