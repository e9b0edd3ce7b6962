//! Runs in the store.

use jiff::Timestamp;

use super::{PreparedRun, Store, StoreError};
use crate::domain::{
    FieldError, InsertedRun, Page, PageRequest, RigId, Run, RunId, RunKind, RunPatch, Split,
};
use crate::engine::Signal;

/// Which runs of a rig are wanted; empty: all.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct RunQuery {
    /// Of this kind.
    pub kind: Option<RunKind>,
    /// Of this split.
    pub split: Option<Split>,
    /// With this tag.
    pub tag: Option<String>,
}

/// What came of an upload.
#[derive(Debug, Clone, PartialEq)]
pub enum RunInsert {
    /// Accepted.
    Inserted(Box<InsertedRun>),
    /// No such rig.
    MissingRig,
    /// The rig's channels or sample rate changed while the file came.
    RigChanged,
}

/// What came of a patch.
#[derive(Debug, Clone, PartialEq)]
pub enum RunUpdate {
    /// The run as it is now.
    Updated(Box<Run>),
    /// No such run.
    Missing,
    /// It cannot become a test run: these model versions were fitted on it.
    FittedOn(Vec<u32>),
    /// Fields that do not fit.
    Invalid(Vec<FieldError>),
}

impl Store {
    /// Accepts a run: its object first, then row, fit policy and queued jobs in one transaction.
    ///
    /// # Errors
    /// The store's failures.
    pub async fn insert_run(
        &self,
        _rig: &RigId,
        _run: PreparedRun,
        _now: Timestamp,
    ) -> Result<RunInsert, StoreError> {
        todo!()
    }

    /// One run of a rig.
    ///
    /// # Errors
    /// The store's failures.
    pub async fn run(&self, _rig: &RigId, _id: RunId) -> Result<Option<Run>, StoreError> {
        todo!()
    }

    /// Runs of a rig, oldest first; `None` when there is no such rig.
    ///
    /// # Errors
    /// The store's failures.
    pub async fn runs(
        &self,
        _rig: &RigId,
        _query: &RunQuery,
        _page: &PageRequest,
    ) -> Result<Option<Page<Run>>, StoreError> {
        todo!()
    }

    /// Changes what is said about a run; its samples never change.
    ///
    /// # Errors
    /// The store's failures.
    pub async fn patch_run(
        &self,
        _rig: &RigId,
        _id: RunId,
        _patch: RunPatch,
    ) -> Result<RunUpdate, StoreError> {
        todo!()
    }

    /// Removes a run; whether it was there. Models that were fitted on it stay and keep its id.
    ///
    /// # Errors
    /// The store's failures.
    pub async fn delete_run(&self, _rig: &RigId, _id: RunId) -> Result<bool, StoreError> {
        todo!()
    }

    /// The samples of a run, verified, in the order of its channels.
    ///
    /// # Errors
    /// The store's failures, a damaged or missing object among them.
    pub async fn load_signal(&self, _run: &Run) -> Result<Signal, StoreError> {
        todo!()
    }
}
