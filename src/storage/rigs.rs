//! Rigs in the store.

use jiff::Timestamp;
use serde_json::Value;

use super::{Store, StoreError};
use crate::domain::{FieldError, Page, PageRequest, Rig, RigDraft, RigId};

/// What came of a patch.
#[derive(Debug, Clone, PartialEq)]
pub enum RigUpdate {
    /// The rig as it is now.
    Updated(Rig),
    /// No such rig.
    Missing,
    /// The rig has changed since the client read it: its `ETag` now.
    Stale(String),
    /// Channels and sample rate are fixed once a run exists.
    ChannelsFixed,
    /// Fields that do not fit.
    Invalid(Vec<FieldError>),
}

impl Store {
    /// Adds a rig; `None` when its id is taken. The draft must have passed its check.
    ///
    /// # Errors
    /// The store's failures.
    pub async fn insert_rig(&self, _draft: &RigDraft, _now: Timestamp) -> Result<Option<Rig>, StoreError> {
        todo!()
    }

    /// The rig of this id.
    ///
    /// # Errors
    /// The store's failures.
    pub async fn rig(&self, _id: &RigId) -> Result<Option<Rig>, StoreError> {
        todo!()
    }

    /// Rigs by id.
    ///
    /// # Errors
    /// The store's failures.
    pub async fn rigs(&self, _page: &PageRequest) -> Result<Page<Rig>, StoreError> {
        todo!()
    }

    /// Applies a merge patch (RFC 7396) if the rig still has the `ETag` that the client names
    /// (`*` names any).
    ///
    /// # Errors
    /// The store's failures.
    pub async fn patch_rig(
        &self,
        _id: &RigId,
        _if_match: &str,
        _patch: &Value,
        _now: Timestamp,
    ) -> Result<RigUpdate, StoreError> {
        todo!()
    }

    /// Removes a rig with its runs, models and jobs; whether it was there. Objects that nothing
    /// else refers to are removed after the rows are.
    ///
    /// # Errors
    /// The store's failures.
    pub async fn delete_rig(&self, _id: &RigId) -> Result<bool, StoreError> {
        todo!()
    }
}
