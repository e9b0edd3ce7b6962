//! The service's nouns and their legal moves: rigs, runs, fits, jobs, models, diagnoses, tokens.

mod created;
pub mod diagnosis;
mod fit_check;
pub mod fits;
pub mod ids;
pub mod job;
pub mod model;
mod model_name;
pub mod page;
pub mod problem;
pub mod quality;
pub mod rig;
pub mod run;
pub mod token;

pub use crate::engine::Quantity;
pub use created::Created;
pub use diagnosis::{DiagnosisRequest, DiagnosisSummary, StoredDiagnosis};
pub use fit_check::FitChannels;
pub use ids::{DiagnosisId, JobId, RigId, RunId, new_id};
pub use job::{Job, JobKind, JobResult, JobState};
pub use model::{ActiveModel, Adopted, Lineage, Model, Origin, Span};
pub use model_name::ModelName;
pub use page::{Cursor, Page, PageRequest};
pub use problem::{FieldError, Problem};
pub use quality::{ChannelQuality, Quality};
pub use rig::{Channel, FitPolicy, Rig, RigDraft, Role};
pub use run::{InsertedRun, Run, RunKind, RunMeta, RunPatch, Split};
pub use token::{Secret, SecretDigest, Token, TokenDraft, TokenId, TokenRole};

/// Where the time comes from; `app` passes the one real clock in, tests pass their own.
pub type Clock = fn() -> jiff::Timestamp;
