//! The store: rows in SQLite or PostgreSQL, signals and weights as objects named by their SHA-256, on the local disk or in a bucket.
//!
//! Every SQL string of the program is in this folder. A missing row is `None`, a failure is `Err`. An
//! update says whether it found its row in the expected state.

mod adoptions;
pub mod backup;
mod bucket;
mod checkpoints;
mod corruption;
mod database;
mod diagnoses;
mod drift;
mod error;
mod evaluations;
mod files;
mod fit_records;
mod idempotency;
mod interruptions;
mod iterations;
mod jobs;
mod journal;
mod losses;
mod migrations;
mod models;
mod npy;
mod object_file;
mod object_locks;
mod objects;
mod pages;
mod policy;
mod prepare;
mod quarantine;
mod reserve;
mod rigs;
mod rows;
mod runs;
mod samples;
#[cfg(test)]
mod shared_tests;
mod shares;
mod store;
mod studies;
#[cfg(test)]
pub(crate) mod testing;
#[cfg(test)]
mod tests;
mod tokens;
mod transfer;
mod turns;
mod usage;
mod write;

pub use bucket::BucketSettings;
pub use checkpoints::Checkpoint;
pub use corruption::CorruptObject;
pub use database::PostgresSettings;
pub use diagnoses::NewDiagnosis;
pub use drift::DriftTurn;
pub use error::{Acknowledged, StoreError};
pub use evaluations::NewEvaluation;
pub use idempotency::{IdempotencyKey, StoredAnswer};
pub use iterations::NewIteration;
pub use jobs::{Asker, Beat, CancelOutcome, Claim, JobInsert, JobQuery, Lease, Outcome};
pub use journal::{Lost, Recovered, recover};
pub use models::{Activation, ActiveUpdate, KeyedImport, ModelDelete, NewModel};
pub use objects::{Digest, Objects};
pub use prepare::{PrepareError, PreparedRun};
pub use rigs::{RigAtAGlance, RigUpdate};
pub use runs::{RunInsert, RunQuery, RunUpdate};
pub use samples::StoredSamples;
pub use store::{Store, StoreSettings};
pub use studies::{NewStudy, STUDY_PART};
pub use tokens::{TokenInsert, TokenTable};
pub use transfer::{Moved, move_into};
pub use usage::Usage;
