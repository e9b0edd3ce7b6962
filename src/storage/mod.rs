//! The store: rows in SQLite, signals and weights as objects named by their SHA-256.
//!
//! Every SQL string of the program is in this folder. A missing row is `None`, a failure is
//! `Err`; an update says whether it met the row that it was meant for.

pub mod backup;
mod checkpoints;
mod damage;
mod diagnoses;
mod error;
mod jobs;
mod models;
mod npy;
mod objects;
mod once;
mod policy;
mod prepare;
mod rigs;
mod rows;
mod runs;
mod store;
#[cfg(test)]
pub(crate) mod testing;
#[cfg(test)]
mod tests;
mod tokens;

pub use checkpoints::Checkpoint;
pub use damage::Of;
pub use diagnoses::NewDiagnosis;
pub use error::StoreError;
pub use jobs::{Beat, CancelOutcome, Claim, JobQuery, Lease, Outcome};
pub use models::{Activation, ActiveUpdate, ModelDelete, NewModel, OnceModel};
pub use objects::{Digest, Objects};
pub use once::{Before, Once};
pub use prepare::PreparedRun;
pub use rigs::RigUpdate;
pub use runs::{RunInsert, RunQuery, RunUpdate};
pub use store::Store;
pub use tokens::{TokenInsert, TokenTable};
