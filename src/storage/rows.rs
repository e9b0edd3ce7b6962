//! From rows to the domain's types and back.
//!
//! Words and JSON are read strictly: an unexpected value is an error that names the row, never a
//! default.

use jiff::Timestamp;
use serde::Serialize;
use serde::de::DeserializeOwned;

use super::StoreError;
use super::database::{FromRow, Row};
use crate::domain::drift::DriftRow;
use crate::domain::iteration::IterationReport;
use crate::domain::{
    Adoption, Base, DiagnosisSummary, EvaluationSummary, IterationSummary, Job, Lineage, Model, ModelFrf,
    Rig, RigId, Run, SecretDigest, StoredDiagnosis, StoredEvaluation, StoredIteration, StoredStudy,
    StudyRequest, StudySummary, Token, UsedModel,
};
use crate::engine::model::{ModelKind, VersionKind};

/// Reads the columns of one row.
#[derive(Clone, Copy)]
struct Columns<'a> {
    table: &'static str,
    key: &'a str,
}

impl Columns<'_> {
    fn bad(&self, what: impl ToString) -> StoreError {
        StoreError::Row { table: self.table, key: self.key.to_owned(), what: what.to_string() }
    }

    fn json<T: DeserializeOwned>(&self, text: &str) -> Result<T, StoreError> {
        serde_json::from_str(text).map_err(|error| self.bad(error))
    }

    fn json_opt<T: DeserializeOwned>(&self, text: Option<&str>) -> Result<Option<T>, StoreError> {
        text.map(|text| self.json(text)).transpose()
    }

    /// Parses a word of one of the contract's enums.
    fn word<T: DeserializeOwned>(&self, text: &str) -> Result<T, StoreError> {
        serde_json::from_value(serde_json::Value::String(text.to_owned())).map_err(|error| self.bad(error))
    }

    fn time(&self, us: i64) -> Result<Timestamp, StoreError> {
        Timestamp::from_microsecond(us).map_err(|error| self.bad(error))
    }

    fn time_opt(&self, us: Option<i64>) -> Result<Option<Timestamp>, StoreError> {
        us.map(|us| self.time(us)).transpose()
    }

    fn id(&self, text: &str) -> Result<uuid::Uuid, StoreError> {
        text.parse().map_err(|error| self.bad(error))
    }

    fn rig(&self, text: String) -> Result<RigId, StoreError> {
        RigId::try_from(text).map_err(|error| self.bad(error))
    }

    fn number<T: TryFrom<i64, Error: ToString>>(&self, number: i64) -> Result<T, StoreError> {
        T::try_from(number).map_err(|error| self.bad(error.to_string()))
    }
}

/// Parses a text of a row as an id or a number.
pub(super) fn parsed<T: std::str::FromStr<Err: std::fmt::Display>>(
    table: &'static str,
    key: &str,
    text: &str,
) -> Result<T, StoreError> {
    text.parse().map_err(|error: T::Err| StoreError::Row {
        table,
        key: key.to_owned(),
        what: error.to_string(),
    })
}

/// A time as it is stored.
pub(super) fn us(time: Timestamp) -> i64 {
    time.as_microsecond()
}

/// A count as it is stored. Counts come from lengths in memory, which fit into SQLite's integers.
pub(super) fn int(count: u64) -> i64 {
    i64::try_from(count).unwrap_or(i64::MAX)
}

/// JSON of a value of the program. It cannot fail, because all map keys are text.
pub(super) fn json(value: &impl Serialize) -> String {
    serde_json::to_string(value).expect("our types serialise")
}

/// The word of one of the contract's enums.
pub(super) fn word(value: &impl Serialize) -> String {
    match serde_json::to_value(value) {
        Ok(serde_json::Value::String(word)) => word,
        other => unreachable!("a word of the contract, not {other:?}"),
    }
}

/// Defines a row, read from the columns of its fields' names.
macro_rules! row {
    (struct $name:ident { $($visibility:vis $field:ident: $type:ty,)* }) => {
        pub(super) struct $name {
            $($visibility $field: $type,)*
        }

        impl FromRow for $name {
            fn from_row(row: &Row) -> sqlx::Result<Self> {
                Ok(Self { $($field: row.get(stringify!($field))?,)* })
            }
        }
    };
}

row! {
    struct RigRow {
        id: String,
        name: String,
        sample_rate_hz: f64,
        channels: String,
        fit_policy: Option<String>,
        created_us: i64,
        updated_us: i64,
        revision: i64,
    }
}

impl TryFrom<RigRow> for Rig {
    type Error = StoreError;

    fn try_from(row: RigRow) -> Result<Self, StoreError> {
        let columns = Columns { table: "rigs", key: &row.id };
        Ok(Self {
            id: columns.rig(row.id.clone())?,
            channels: columns.json(&row.channels)?,
            fit_policy: columns.json_opt(row.fit_policy.as_deref())?,
            created_at: columns.time(row.created_us)?,
            updated_at: columns.time(row.updated_us)?,
            revision: columns.number(row.revision)?,
            name: row.name,
            sample_rate_hz: row.sample_rate_hz,
        })
    }
}

row! {
    struct RunRow {
        id: String,
        rig: String,
        name: String,
        kind: String,
        split: String,
        tags: String,
        started_us: Option<i64>,
        created_us: i64,
        channels: String,
        units: String,
        samples: i64,
        duration_s: f64,
        sample_rate_hz: f64,
        sha256: String,
        object: String,
        quality: String,
        duplicate_of: Option<String>,
    }
}

impl TryFrom<RunRow> for Run {
    type Error = StoreError;

    fn try_from(row: RunRow) -> Result<Self, StoreError> {
        let columns = Columns { table: "runs", key: &row.id };
        Ok(Self {
            id: columns.id(&row.id)?,
            rig: columns.rig(row.rig.clone())?,
            kind: columns.word(&row.kind)?,
            split: columns.word(&row.split)?,
            tags: columns.json(&row.tags)?,
            started_at: columns.time_opt(row.started_us)?,
            created_at: columns.time(row.created_us)?,
            channels: columns.json(&row.channels)?,
            units: columns.json(&row.units)?,
            samples: columns.number(row.samples)?,
            quality: columns.json(&row.quality)?,
            duplicate_of: row.duplicate_of.as_deref().map(|id| columns.id(id)).transpose()?,
            name: row.name,
            duration_s: row.duration_s,
            sample_rate_hz: row.sample_rate_hz,
            sha256: row.sha256,
            object: row.object,
        })
    }
}

/// In place of an adoption: the row is of a time before there were any, and the weight file has not been
/// asked yet.
pub(super) const UNREAD: &str = "unread";

/// All that is known of an unread row's effects: that the lineage has some.
fn unread(kind: ModelKind, lineage: &Lineage) -> Option<Adoption> {
    let first = lineage.diagnoses.first()?;
    let base = Base { version: Some(first.version), kind, sha256: None };
    Some(Adoption { base, effects: Vec::new() })
}

row! {
    struct ModelRow {
        rig: String,
        version: i64,
        kind: String,
        inputs: String,
        outputs: String,
        sample_rate_hz: f64,
        sha256: String,
        size_bytes: i64,
        origin: String,
        job: Option<String>,
        request: Option<String>,
        report: Option<String>,
        lineage: String,
        code_version: String,
        instruction_set: String,
        created_us: i64,
        adoption: Option<String>,
        frf: Option<String>,
        active: bool,
    }
}

impl TryFrom<ModelRow> for Model {
    type Error = StoreError;

    fn try_from(row: ModelRow) -> Result<Self, StoreError> {
        let key = format!("{}/{}", row.rig, row.version);
        let columns = Columns { table: "models", key: &key };
        let parts: ModelKind = columns.word(&row.kind)?;
        let lineage: Lineage = columns.json(&row.lineage)?;
        let adoption = match row.adoption.as_deref() {
            Some(UNREAD) => unread(parts, &lineage),
            adoption => columns.json_opt(adoption)?,
        };
        let (rig, version) = (columns.rig(row.rig)?, columns.number(row.version)?);
        let frf = columns.json_opt(row.frf.as_deref())?;
        Ok(Self {
            frf: ModelFrf::of(&rig, version, parts, frf),
            version,
            rig,
            parts,
            kind: if adoption.is_some() { VersionKind::Adopted } else { parts.into() },
            adoption,
            inputs: columns.json(&row.inputs)?,
            outputs: columns.json(&row.outputs)?,
            size_bytes: columns.number(row.size_bytes)?,
            origin: columns.word(&row.origin)?,
            job: row.job.as_deref().map(|id| columns.id(id)).transpose()?,
            request: columns.json_opt(row.request.as_deref())?,
            report: columns.json_opt(row.report.as_deref())?,
            lineage,
            created_at: columns.time(row.created_us)?,
            sample_rate_hz: row.sample_rate_hz,
            sha256: row.sha256,
            code_version: row.code_version,
            instruction_set: row.instruction_set,
            active: row.active,
        })
    }
}

row! {
    struct JobRow {
        id: String,
        rig: String,
        kind: String,
        state: String,
        pub(super) request: String,
        stage: Option<String>,
        progress: f64,
        eta_s: Option<f64>,
        attempt: i64,
        created_us: i64,
        started_us: Option<i64>,
        finished_us: Option<i64>,
        result: Option<String>,
        problem: Option<String>,
        cancel_requested: bool,
        event: i64,
        pub(super) lease_token: i64,
        pub(super) service_deaths: i64,
    }
}

impl JobRow {
    pub(super) fn request(&self) -> Result<serde_json::Value, StoreError> {
        Columns { table: "jobs", key: &self.id }.json(&self.request)
    }
}

impl TryFrom<JobRow> for Job {
    type Error = StoreError;

    fn try_from(row: JobRow) -> Result<Self, StoreError> {
        let columns = Columns { table: "jobs", key: &row.id };
        Ok(Self {
            id: columns.id(&row.id)?,
            kind: columns.word(&row.kind)?,
            rig: columns.rig(row.rig.clone())?,
            state: columns.word(&row.state)?,
            attempt: columns.number(row.attempt)?,
            created_at: columns.time(row.created_us)?,
            started_at: columns.time_opt(row.started_us)?,
            finished_at: columns.time_opt(row.finished_us)?,
            result: columns.json_opt(row.result.as_deref())?,
            problem: columns.json_opt(row.problem.as_deref())?,
            event: columns.number(row.event)?,
            stage: row.stage,
            progress: row.progress,
            eta_s: row.eta_s,
            cancel_requested: row.cancel_requested,
        })
    }
}

row! {
    struct DiagnosisRow {
        id: String,
        rig: String,
        job: String,
        version: Option<i64>,
        model_sha256: Option<String>,
        mode: String,
        request: String,
        verdict: String,
        findings: String,
        elapsed_s: f64,
        created_us: i64,
    }
}

impl TryFrom<DiagnosisRow> for DiagnosisSummary {
    type Error = StoreError;

    fn try_from(row: DiagnosisRow) -> Result<Self, StoreError> {
        let columns = Columns { table: "diagnoses", key: &row.id };
        let model = match row.version.zip(row.model_sha256) {
            Some((version, sha256)) => Some(UsedModel { version: columns.number(version)?, sha256 }),
            None => None,
        };
        Ok(Self {
            id: columns.id(&row.id)?,
            rig: columns.rig(row.rig)?,
            created_at: columns.time(row.created_us)?,
            model,
            mode: columns.word(&row.mode)?,
            verdict: columns.json(&row.verdict)?,
            job: columns.id(&row.job)?,
        })
    }
}

impl TryFrom<DiagnosisRow> for StoredDiagnosis {
    type Error = StoreError;

    fn try_from(row: DiagnosisRow) -> Result<Self, StoreError> {
        let request = Columns { table: "diagnoses", key: &row.id }.json(&row.request)?;
        let (elapsed_s, findings) = (row.elapsed_s, row.findings.clone());
        Ok(Self { summary: row.try_into()?, request, elapsed_s, findings })
    }
}

row! {
    struct IterationRow {
        id: String,
        rig: String,
        job: String,
        version: i64,
        model_sha256: String,
        drive: Option<String>,
        request: String,
        report: String,
        elapsed_s: f64,
        created_us: i64,
    }
}

impl TryFrom<IterationRow> for StoredIteration {
    type Error = StoreError;

    fn try_from(row: IterationRow) -> Result<Self, StoreError> {
        let columns = Columns { table: "iterations", key: &row.id };
        let report: IterationReport = columns.json(&row.report)?;
        let best = report.steps.iter().find(|step| step.iteration == report.best);
        let summary = IterationSummary {
            id: columns.id(&row.id)?,
            rig: columns.rig(row.rig)?,
            created_at: columns.time(row.created_us)?,
            job: columns.id(&row.job)?,
            model: UsedModel { version: columns.number(row.version)?, sha256: row.model_sha256 },
            drive: row.drive.as_deref().map(|run| columns.id(run)).transpose()?,
            total_error: best.ok_or_else(|| columns.bad("no best step"))?.total_error,
            stopped: report.stopped,
        };
        Ok(Self { summary, request: columns.json(&row.request)?, elapsed_s: row.elapsed_s, report })
    }
}

row! {
    struct EvaluationRow {
        id: String,
        rig: String,
        job: String,
        request: String,
        outline: String,
        report: String,
        elapsed_s: f64,
        created_us: i64,
    }
}

impl TryFrom<EvaluationRow> for EvaluationSummary {
    type Error = StoreError;

    fn try_from(row: EvaluationRow) -> Result<Self, StoreError> {
        let columns = Columns { table: "evaluations", key: &row.id };
        Ok(Self {
            id: columns.id(&row.id)?,
            rig: columns.rig(row.rig)?,
            created_at: columns.time(row.created_us)?,
            job: columns.id(&row.job)?,
            outline: columns.json(&row.outline)?,
        })
    }
}

impl TryFrom<EvaluationRow> for StoredEvaluation {
    type Error = StoreError;

    fn try_from(row: EvaluationRow) -> Result<Self, StoreError> {
        let request = Columns { table: "evaluations", key: &row.id }.json(&row.request)?;
        let (elapsed_s, report) = (row.elapsed_s, row.report.clone());
        Ok(Self { summary: row.try_into()?, request, elapsed_s, report })
    }
}

row! {
    struct StudyRow {
        id: String,
        rig: String,
        state: String,
        request: String,
        created_us: i64,
        version: Option<i64>,
        report: Option<String>,
    }
}

impl TryFrom<StudyRow> for StoredStudy {
    type Error = StoreError;

    fn try_from(row: StudyRow) -> Result<Self, StoreError> {
        let columns = Columns { table: "studies", key: &row.id };
        let request: StudyRequest = columns.json(&row.request)?;
        let summary = StudySummary {
            id: columns.id(&row.id)?,
            rig: columns.rig(row.rig)?,
            kind: request.kind,
            state: columns.word(&row.state)?,
            created_at: columns.time(row.created_us)?,
            model: row.version.map(|version| columns.number(version)).transpose()?,
        };
        Ok(Self { summary, request, report: columns.json_opt(row.report.as_deref())? })
    }
}

row! {
    struct DriftEntry {
        id: String,
        name: String,
        kind: String,
        at_us: i64,
        outcome: String,
    }
}

impl TryFrom<DriftEntry> for DriftRow {
    type Error = StoreError;

    fn try_from(row: DriftEntry) -> Result<Self, StoreError> {
        let columns = Columns { table: "drift", key: &row.id };
        Ok(Self {
            run: columns.id(&row.id)?,
            kind: columns.word(&row.kind)?,
            at: columns.time(row.at_us)?,
            outcome: columns.json(&row.outcome)?,
            name: row.name,
        })
    }
}

row! {
    struct TokenRow {
        id: String,
        name: String,
        role: String,
        rigs: Option<String>,
        secret_sha256: Vec<u8>,
        created_us: i64,
        expires_us: Option<i64>,
        revoked_us: Option<i64>,
    }
}

impl TokenRow {
    pub(super) fn is_revoked(&self) -> bool {
        self.revoked_us.is_some()
    }

    pub(super) fn digest(&self) -> Result<SecretDigest, StoreError> {
        let bytes = <[u8; 32]>::try_from(&self.secret_sha256[..]);
        bytes
            .map(SecretDigest::stored)
            .map_err(|_| Columns { table: "tokens", key: &self.id }.bad("a digest of another length"))
    }
}

impl TryFrom<TokenRow> for Token {
    type Error = StoreError;

    fn try_from(row: TokenRow) -> Result<Self, StoreError> {
        let columns = Columns { table: "tokens", key: &row.id };
        Ok(Self {
            id: columns.id(&row.id)?,
            role: columns.word(&row.role)?,
            rigs: columns.json_opt(row.rigs.as_deref())?,
            created_at: columns.time(row.created_us)?,
            expires_at: columns.time_opt(row.expires_us)?,
            name: row.name,
        })
    }
}

/// Converts rows of one kind; stops at the first error.
pub(super) fn all<R, T: TryFrom<R, Error = StoreError>>(rows: Vec<R>) -> Result<Vec<T>, StoreError> {
    rows.into_iter().map(T::try_from).collect()
}
