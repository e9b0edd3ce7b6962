//! A diagnosis as it is requested (`POST /v1/rigs/{rig}/diagnoses`), listed and stored.

use std::collections::{BTreeMap, BTreeSet};
use std::fmt;

use jiff::Timestamp;
use serde::de::value::{MapAccessDeserializer, SeqAccessDeserializer};
use serde::de::{Error, MapAccess, SeqAccess, Unexpected, Visitor};
use serde::{Deserialize, Deserializer, Serialize};

use super::fits::{RunFilter, RunSelection};
use super::ids::{DiagnosisId, JobId, RigId, RunId};
use super::job::{JobKind, JobRequest};
use super::model::{Span, UsedModel};
use super::model_ref::ModelRef;
use super::problem::FieldError;
use crate::engine::diagnosis::{Augmented, Effect, Family, Mode, Report, Verdict, VerdictKind, Views};

/// Systematic error, relative to the response, below which a gap does not matter unless a request
/// says otherwise.
const MATERIAL_GAP: f64 = 0.02;

/// Runs to explain: the service splits them, or each has its role.
#[derive(Debug, Clone, PartialEq, Serialize)]
#[serde(untagged)]
pub enum DiagnosisRuns {
    /// Exactly these.
    Ids(Vec<RunId>),
    /// Exactly these, each for one purpose.
    Roles(RunRoles),
    /// All that match.
    Match(RunFilter),
}

impl<'de> Deserialize<'de> for DiagnosisRuns {
    /// By hand, as for [`RunSelection`].
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        /// Fields of either object.
        #[derive(Deserialize)]
        #[serde(deny_unknown_fields)]
        struct Fields {
            fit: Option<Vec<RunId>>,
            select: Option<Vec<RunId>>,
            test: Option<Vec<RunId>>,
            kinds: Option<Vec<String>>,
            #[serde(default)]
            tags: Vec<String>,
            split: Option<String>,
        }
        struct RunsVisitor;
        impl<'de> Visitor<'de> for RunsVisitor {
            type Value = DiagnosisRuns;

            fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                f.write_str("ids of runs, {fit, select, test} with ids of runs, or a selection of runs")
            }

            fn visit_str<E: Error>(self, id: &str) -> Result<DiagnosisRuns, E> {
                id.parse().map(|id| DiagnosisRuns::Ids(vec![id])).map_err(E::custom)
            }

            fn visit_seq<A: SeqAccess<'de>>(self, ids: A) -> Result<DiagnosisRuns, A::Error> {
                Vec::deserialize(SeqAccessDeserializer::new(ids)).map(DiagnosisRuns::Ids)
            }

            fn visit_map<A: MapAccess<'de>>(self, fields: A) -> Result<DiagnosisRuns, A::Error> {
                match Fields::deserialize(MapAccessDeserializer::new(fields))? {
                    Fields { fit: None, select: None, test: None, kinds, tags, split } => {
                        Ok(DiagnosisRuns::Match(RunFilter { kinds, tags, split }))
                    }
                    Fields {
                        fit: Some(fit),
                        select: Some(select),
                        test: Some(test),
                        kinds: None,
                        tags,
                        split: None,
                    } if tags.is_empty() => Ok(DiagnosisRuns::Roles(RunRoles { fit, select, test })),
                    _ => Err(A::Error::invalid_type(Unexpected::Map, &self)),
                }
            }
        }
        deserializer.deserialize_any(RunsVisitor)
    }
}

/// The use of each run.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RunRoles {
    /// Parameters are fitted to these.
    pub fit: Vec<RunId>,
    /// Effects are chosen on these.
    pub select: Vec<RunId>,
    /// The closure is measured on these, which are used for neither of the others.
    pub test: Vec<RunId>,
}

/// Drives that a next experiment may use and over which an effect must stay stable.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Envelope {
    /// Largest magnitude by drive; left out: that of the runs.
    pub drive_peak: BTreeMap<String, f64>,
}

/// The request; every field but `runs` has a default.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct DiagnosisRequest {
    /// The sim; left out: the active model, unless `simulated` is given.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub model: Option<ModelRef>,
    /// Instead of a model: for each run, the run that holds its simulated responses.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub simulated: Option<BTreeMap<RunId, RunId>>,
    /// Whether the sim has seen the effect.
    #[serde(default)]
    pub mode: Mode,
    /// Low-level runs for the linear core; left out: the model's own fit runs.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub baseline_runs: Option<RunSelection>,
    /// Runs to explain.
    pub runs: DiagnosisRuns,
    /// Runs with the same drive.
    #[serde(default)]
    pub repeats: Vec<Vec<RunId>>,
    /// Effects and families that may be named, or `all`.
    #[serde(default = "all")]
    pub catalogue: Vec<String>,
    /// Limits of the drives.
    #[serde(default)]
    pub envelope: Envelope,
    /// Systematic RMS relative to the response's below which a gap does not matter.
    #[serde(default = "material_gap")]
    pub material_gap: f64,
}

impl JobRequest for DiagnosisRequest {
    const KIND: JobKind = JobKind::Diagnosis;
}

fn all() -> Vec<String> {
    vec!["all".into()]
}

fn material_gap() -> f64 {
    MATERIAL_GAP
}

/// Most names of a catalogue: more than there are.
const MAX_CATALOGUE: usize = 100;

impl DiagnosisRequest {
    /// Effects of the catalogue, each once, in the catalogue's order.
    ///
    /// # Errors
    /// Names that are neither an effect nor a family, with the names that are allowed; an empty list.
    pub fn effects(&self) -> Result<Vec<Effect>, Vec<FieldError>> {
        let named = |name: &str| -> Vec<Effect> {
            let is = |e: &Effect| name == "all" || name == e.name() || name == word(&e.family());
            Effect::ALL.into_iter().filter(is).collect()
        };
        if self.catalogue.is_empty() {
            return Err(vec![FieldError::new("/catalogue", "at least one effect, family or all")]);
        }
        // The error for each wrong name lists all names that are allowed.
        if self.catalogue.len() > MAX_CATALOGUE {
            return Err(vec![FieldError::new("/catalogue", format!("at most {MAX_CATALOGUE} names"))]);
        }
        let mut effects = BTreeSet::new();
        let mut errors = Vec::new();
        for (i, name) in self.catalogue.iter().enumerate() {
            let found = named(name);
            if found.is_empty() {
                errors.push(FieldError::new(format!("/catalogue/{i}"), allowed()));
            }
            effects.extend(found);
        }
        if errors.is_empty() { Ok(effects.into_iter().collect()) } else { Err(errors) }
    }
}

/// Every name that a catalogue may hold.
fn allowed() -> String {
    let families: BTreeSet<Family> = Effect::ALL.into_iter().map(Effect::family).collect();
    let families = families.iter().map(word);
    let names = families.chain(Effect::ALL.into_iter().map(Effect::name));
    format!("one of all, {}", names.collect::<Vec<_>>().join(", "))
}

fn word(family: &Family) -> String {
    match serde_json::to_value(family) {
        Ok(serde_json::Value::String(word)) => word,
        other => unreachable!("a word of the contract, not {other:?}"),
    }
}

/// The verdict without its reasons.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct VerdictSummary {
    /// Kind of verdict.
    pub kind: VerdictKind,
    /// The effect blamed, if one is.
    pub effect: Option<Effect>,
    /// Its family.
    pub family: Option<Family>,
    /// Axis of the effect.
    pub axis: Option<String>,
    /// Response on which it closes most.
    pub channel: Option<String>,
    /// Probability that the verdict is right, 0..1.
    pub probability: f64,
}

impl From<&Verdict> for VerdictSummary {
    fn from(verdict: &Verdict) -> Self {
        Self {
            kind: verdict.kind,
            effect: verdict.effect,
            family: verdict.family,
            axis: verdict.axis.clone(),
            channel: verdict.channel.clone(),
            probability: verdict.probability,
        }
    }
}

/// A diagnosis as lists show it.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct DiagnosisSummary {
    /// Id.
    pub id: DiagnosisId,
    /// Its rig.
    pub rig: RigId,
    /// When its report was stored.
    pub created_at: Timestamp,
    /// The sim; `None` where simulated responses were sent.
    pub model: Option<UsedModel>,
    /// Whether the sim had seen the effect.
    pub mode: Mode,
    /// The verdict in short.
    pub verdict: VerdictSummary,
    /// The job that made it.
    pub job: JobId,
}

/// A diagnosis with everything but its findings.
#[derive(Debug, Clone, PartialEq)]
pub struct StoredDiagnosis {
    /// As lists show it.
    pub summary: DiagnosisSummary,
    /// What was asked for, resolved.
    pub request: DiagnosisRequest,
    /// Seconds that it took, loading and predicting included.
    pub elapsed_s: f64,
    /// SHA-256 of the object that holds its [`Findings`], hex.
    pub findings: String,
}

/// The findings of a diagnosis, which are too large for a row.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Findings {
    /// The report; its runs are named by their ids.
    pub report: Report,
    /// Data of the plots on the report's page.
    pub views: Views,
    /// The sim with the effect in it, one a hypothesis.
    pub augmented: Vec<Augmented>,
    /// What the effects' parameters were fitted to.
    pub fit: Vec<Span>,
    /// What the effects were chosen on.
    pub select: Vec<Span>,
}

#[cfg(test)]
mod tests {
    use super::*;

    fn request(json: &str) -> DiagnosisRequest {
        serde_json::from_str(json).unwrap()
    }

    #[test]
    fn what_is_left_open_has_the_contracts_defaults() {
        let request = request(r#"{"runs": {"tags": ["high"]}}"#);
        assert_eq!((request.model, request.mode), (None, Mode::InSitu));
        assert_eq!(request.material_gap, 0.02);
        assert_eq!(request.effects().unwrap(), Effect::ALL);
        assert!(matches!(request.runs, DiagnosisRuns::Match(RunFilter { kinds: None, .. })));
        let again = serde_json::from_str(&serde_json::to_string(&request).unwrap()).unwrap();
        assert_eq!(request, again);
    }

    #[test]
    fn a_catalogue_is_made_of_effects_and_families_and_an_unknown_name_is_pointed_at() {
        let named = |list: &str| request(&format!(r#"{{"runs": [], "catalogue": {list}}}"#)).effects();
        let damping = [Effect::CubicStiffness, Effect::QuadraticDamping, Effect::FreeDamping];
        assert_eq!(named(r#"["damping", "cubic_stiffness", "damping"]"#).unwrap(), damping);
        let errors = named(r#"["damping", "cubic"]"#).unwrap_err();
        assert_eq!(errors[0].pointer, "/catalogue/1");
        let limit = errors[0].limit.as_deref().unwrap();
        assert!(limit.contains("all, linear") && limit.contains("cubic_stiffness"), "{limit}");
        assert_eq!(named("[]").unwrap_err()[0].pointer, "/catalogue");
        let many = format!("[{}\"\"]", "\"\",".repeat(100));
        assert_eq!(named(&many).unwrap_err().len(), 1, "one answer, not a hundred");
    }

    #[test]
    fn roles_are_complete_or_refused_with_what_is_allowed() {
        let parse = |json: &str| serde_json::from_str::<DiagnosisRequest>(json);
        assert!(parse(r#"{"runs": {"fit": [], "select": [], "test": []}}"#).is_ok());
        let error = parse(r#"{"runs": {"fit": [], "select": []}}"#).unwrap_err().to_string();
        assert!(error.contains("{fit, select, test}"), "{error}");
        assert!(parse(r#"{"runs": [], "run": []}"#).is_err());
        assert!(parse("{}").is_err());
    }
}
