//! Model versions and the active model in the store.

use bytes::Bytes;
use jiff::Timestamp;

use super::{Lease, Store, StoreError};
use crate::domain::fits::FitRequest;
use crate::domain::{ActiveModel, JobId, Lineage, Model, Origin, Page, PageRequest, RigId};
use crate::engine::model::{FitReport, ModelKind};

/// A model on its way into the store.
#[derive(Debug, Clone)]
pub struct NewModel {
    /// Kind.
    pub kind: ModelKind,
    /// Input channels, in order.
    pub inputs: Vec<String>,
    /// Output channels, in order.
    pub outputs: Vec<String>,
    /// Sample rate.
    pub sample_rate_hz: f64,
    /// The safetensors file.
    pub weights: Bytes,
    /// Fitted or imported.
    pub origin: Origin,
    /// The job that fitted it.
    pub job: Option<JobId>,
    /// What was asked for, resolved.
    pub request: Option<FitRequest>,
    /// What the fit found.
    pub report: Option<FitReport>,
    /// The data behind it.
    pub lineage: Lineage,
    /// Instruction set that it was computed with.
    pub instruction_set: String,
}

/// What a fit wants done with the active model, decided against the version it was compared to.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Activation {
    /// Nothing.
    Leave,
    /// Make the new one active, whatever is.
    Always,
    /// Make the new one active if this is still what is active.
    IfStill(Option<u32>),
}

/// What came of a change of the active model.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum ActiveUpdate {
    /// The pointer as it is now.
    Updated(ActiveModel),
    /// No such rig.
    MissingRig,
    /// No such model version.
    MissingModel,
    /// The model does not map the rig's drives to its responses.
    NotForward,
    /// The pointer has changed since the client read it: as it is now.
    Stale(ActiveModel),
}

/// What came of a deletion.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ModelDelete {
    /// It is gone.
    Deleted,
    /// No such model version.
    Missing,
    /// It is the active model, which stays.
    Active,
}

impl Store {
    /// Adds an imported model, inactive; `None` when there is no such rig.
    ///
    /// # Errors
    /// The store's failures.
    pub async fn insert_model(
        &self,
        _rig: &RigId,
        _model: NewModel,
        _now: Timestamp,
    ) -> Result<Option<Model>, StoreError> {
        todo!()
    }

    /// Publishes a fitted model and ends its job, in one transaction, if the lease still holds.
    /// `None`: the lease is lost, and nothing was changed.
    ///
    /// `stage` makes the job's last words from the version number and whether it became active.
    ///
    /// # Errors
    /// The store's failures.
    pub async fn publish_model(
        &self,
        _lease: &Lease,
        _model: NewModel,
        _activation: Activation,
        _stage: impl FnOnce(u32, bool) -> String + Send,
        _now: Timestamp,
    ) -> Result<Option<Model>, StoreError> {
        todo!()
    }

    /// One model version of a rig.
    ///
    /// # Errors
    /// The store's failures.
    pub async fn model(&self, _rig: &RigId, _version: u32) -> Result<Option<Model>, StoreError> {
        todo!()
    }

    /// Model versions of a rig, oldest first; `None` when there is no such rig.
    ///
    /// # Errors
    /// The store's failures.
    pub async fn models(&self, _rig: &RigId, _page: &PageRequest) -> Result<Option<Page<Model>>, StoreError> {
        todo!()
    }

    /// The weight file of a model, verified.
    ///
    /// # Errors
    /// The store's failures, a damaged or missing object among them.
    pub async fn weights(&self, _model: &Model) -> Result<Bytes, StoreError> {
        todo!()
    }

    /// Removes a model version that is not active. Its number is not given again.
    ///
    /// # Errors
    /// The store's failures.
    pub async fn delete_model(&self, _rig: &RigId, _version: u32) -> Result<ModelDelete, StoreError> {
        todo!()
    }

    /// The active model; `None` when there is no such rig.
    ///
    /// # Errors
    /// The store's failures.
    pub async fn active_model(&self, _rig: &RigId) -> Result<Option<ActiveModel>, StoreError> {
        todo!()
    }

    /// Makes `version` (or none) the active model if the pointer still has the `ETag` that the
    /// client names (`*` names any).
    ///
    /// # Errors
    /// The store's failures.
    pub async fn set_active_model(
        &self,
        _rig: &RigId,
        _version: Option<u32>,
        _if_match: &str,
        _now: Timestamp,
    ) -> Result<ActiveUpdate, StoreError> {
        todo!()
    }
}
