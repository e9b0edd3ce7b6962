//! The resources of the service and their rules: rigs, runs, fits, jobs, models, diagnoses, iterations,
//! evaluations, studies, tokens.

pub mod columns;
mod created;
pub mod diagnosis;
pub mod drift;
pub mod evaluation;
mod fit_check;
pub mod fits;
pub mod ids;
pub mod iteration;
pub mod job;
mod losses;
pub mod model;
mod model_ref;
pub mod model_report;
pub mod page;
pub mod problem;
pub mod quality;
pub mod rig;
pub mod run;
pub mod strict;
pub mod study;
pub mod text;
pub mod token;
pub mod turns;
pub mod units;

pub use crate::engine::{Quantity, RunKind, Split};
pub use created::Created;
pub use diagnosis::{DiagnosisRequest, DiagnosisSummary, StoredDiagnosis};
pub use evaluation::{EvaluationRequest, EvaluationSummary, StoredEvaluation};
pub use fit_check::{FitChannels, task};
pub use ids::{DiagnosisId, EvaluationId, IterationId, JobId, RigId, RunId, StudyId, new_id};
pub use iteration::{IterationRequest, IterationSummary, StoredIteration};
pub use job::{Job, JobKind, JobResult, JobState};
pub use losses::{JobLosses, LossCurve};
pub use model::{
    ActiveModel, Adopted, AdoptedEffect, Adoption, Base, Lineage, Model, ModelFrf, Origin, Span, StartedFrom,
    UsedCore, UsedModel,
};
pub use model_ref::ModelRef;
pub use model_report::ModelReport;
pub use page::{Cursor, Page, PageRequest};
pub use problem::{FieldError, Problem};
pub use quality::{ChannelQuality, Quality, faults_of_runs};
pub use rig::{Channel, FitPolicy, Rig, RigDraft, Role};
pub use run::{InsertedRun, Run, RunMeta, RunOutlook, RunPatch};
pub use study::{StoredStudy, StudyReport, StudyRequest, StudySummary};
pub use token::{Secret, SecretDigest, Token, TokenDraft, TokenId, TokenRole};

/// Source of the time. `app` passes the real clock in, tests pass their own.
pub type Clock = fn() -> jiff::Timestamp;
