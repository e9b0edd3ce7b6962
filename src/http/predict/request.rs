//! The request of a prediction.

use serde::Deserialize;

use super::fallback::FallbackTo;
use crate::domain::ModelRef;
use crate::engine::EngineError;
use crate::engine::fatigue::DamageSettings;
use crate::http::body::HoldsSignals;
use crate::http::body::signals::Channels;
use crate::http::body::source::Source;
use crate::http::codes;
use crate::http::jobs::word;
use crate::http::measurement::FileQuery;
use crate::http::params::{Params, invalid};
use crate::http::problem::{Answer, FieldError, Problem};

/// The JSON body.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PredictRequest {
    /// Which model.
    #[serde(default)]
    pub model: ModelRef,
    /// Its inputs.
    pub drive: Source,
    /// The target.
    #[serde(default)]
    pub target: Option<Source>,
    /// Settings of the damage.
    #[serde(default)]
    pub damage: Option<DamageSettings>,
    /// Parts of the answer.
    #[serde(default)]
    include: Option<Vec<AnswerPart>>,
    /// What answers where the drive is outside what the model was fitted on.
    #[serde(default)]
    pub fallback: FallbackTo,
}

/// A part of the answer.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "snake_case")]
enum AnswerPart {
    Response,
    Damage,
    Errors,
    Trust,
    Band,
}

/// The parts of the answer.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Include {
    /// The predicted signals.
    pub response: bool,
    /// Damage and Multi-Rain.
    pub damage: bool,
    /// Error against the target.
    pub errors: bool,
    /// Whether the drive is inside the range that the model was fitted on.
    pub trust: bool,
    /// The band about the response.
    pub band: bool,
}

impl HoldsSignals for PredictRequest {
    fn signals(&mut self) -> Vec<&mut Channels> {
        let sources = std::iter::once(&mut self.drive).chain(&mut self.target);
        sources.filter_map(|source| source.channels.as_mut()).collect()
    }
}

impl PredictRequest {
    /// The parts of the answer, with the defaults filled in.
    ///
    /// # Errors
    /// `predict.target_missing` for errors without a target.
    pub fn includes(&self) -> Answer<Include> {
        let include = Include::of(self.include.as_deref(), self.target.is_some(), self.damage.is_some());
        include.ok_or_else(|| no_target("/target"))
    }
}

impl Include {
    /// The parts that are asked for, or those that follow from what was sent; none for errors without a target.
    fn of(parts: Option<&[AnswerPart]>, target: bool, damage: bool) -> Option<Self> {
        let Some(parts) = parts else {
            let damage = target || damage;
            return Some(Self { response: true, damage, errors: target, trust: true, band: false });
        };
        let wants = |part| parts.contains(&part);
        (target || !wants(AnswerPart::Errors)).then(|| Self {
            response: wants(AnswerPart::Response),
            damage: wants(AnswerPart::Damage),
            errors: wants(AnswerPart::Errors),
            trust: wants(AnswerPart::Trust),
            band: wants(AnswerPart::Band),
        })
    }
}

fn no_target(pointer: &str) -> Problem {
    let detail = "Errors compare a prediction with a target; the request has none.";
    Problem::new(codes::PREDICT_TARGET_MISSING, detail).with(FieldError::new(pointer, "needed for errors"))
}

/// The query beside a file, of any format.
#[derive(Debug)]
pub struct FileRequest {
    /// Which model.
    pub model: ModelRef,
    /// The run that the response is compared with.
    pub target: Option<Source>,
    /// Parts of the answer.
    pub include: Include,
    /// Settings of the damage.
    pub damage: DamageSettings,
    /// What answers where the drive is outside.
    pub fallback: FallbackTo,
}

/// The query beside an NPY body.
#[derive(Debug)]
pub struct NpyQuery {
    /// What is asked for.
    pub request: FileRequest,
    /// Sample rate of the drive.
    pub sample_rate_hz: f64,
    /// Whether a drive of another rate is converted.
    pub resample: bool,
}

/// The query beside a measurement file.
#[derive(Debug)]
pub struct MeasurementQuery {
    /// What is asked for.
    pub request: FileRequest,
    /// How the file is read.
    pub file: FileQuery,
}

impl FileRequest {
    /// Takes `model`, `target`, `include`, `fallback` and the settings of the damage.
    fn take(params: &mut Params) -> Answer<Self> {
        let model = params.one("model")?.map_or(Ok(ModelRef::Active), |text| {
            ModelRef::parse(&text).ok_or_else(|| invalid("model", format!("is {text:?}"), MODEL_LIMIT))
        })?;
        let target = params.parse("target", "the id of a run")?;
        let target = target.map(Source::run);
        let damage = damage(params)?;
        let include = params.all("include");
        let parts: Vec<&str> = include.iter().flat_map(|text| text.split(',')).map(str::trim).collect();
        let parts: Vec<AnswerPart> = parts.into_iter().map(AnswerPart::parse).collect::<Answer<_>>()?;
        let parts = (!include.is_empty()).then_some(&parts[..]);
        let include = Include::of(parts, target.is_some(), damage.is_some());
        let include = include.ok_or_else(|| no_target("?target"))?;
        let fallback = word(params, "fallback", "none or frf")?.unwrap_or_default();
        Ok(Self { model, target, include, damage: damage.unwrap_or_default(), fallback })
    }
}

impl AnswerPart {
    fn parse(text: &str) -> Answer<Self> {
        let part = serde_json::from_value(text.into());
        part.map_err(|_| {
            invalid("include", format!("is {text:?}"), "some of response, damage, errors, trust, band")
        })
    }
}

/// The settings of the damage, if there are some.
fn damage(params: &mut Params) -> Answer<Option<DamageSettings>> {
    let mut damage = DamageSettings::default();
    let before = damage;
    let slope = params.number("slope", "a number above 0, at most 50")?;
    let constant = params.number("constant", "a positive number")?;
    let residue = word(params, "residue", RESIDUES)?;
    let directions = params.parse("directions", "a number from 1 to 10000")?;
    let given = slope.is_some() || constant.is_some() || residue.is_some() || directions.is_some();
    damage.slope = slope.unwrap_or(before.slope);
    damage.constant = constant.unwrap_or(before.constant);
    damage.residue = residue.unwrap_or(before.residue);
    damage.directions = directions.unwrap_or(before.directions);
    damage.check().map_err(|error| match error {
        EngineError::Setting { setting, found, limit } => {
            invalid(setting.trim_start_matches("damage."), format!("is {found}"), &limit)
        }
        error => Problem::internal(error),
    })?;
    Ok(given.then_some(damage))
}

impl MeasurementQuery {
    /// Takes what is asked for and the parameters of a file.
    ///
    /// # Errors
    /// `query.*`; `predict.target_missing`
    pub fn take(mut params: Params) -> Answer<Self> {
        let request = FileRequest::take(&mut params)?;
        let file = FileQuery::take(&mut params)?;
        params.finish()?;
        Ok(Self { request, file })
    }
}

impl NpyQuery {
    /// Takes what is asked for, `sample_rate_hz` and `resample`.
    ///
    /// # Errors
    /// `query.*`; `predict.target_missing`; the sample rate is required, because an NPY file has none.
    pub fn take(mut params: Params) -> Answer<Self> {
        let request = FileRequest::take(&mut params)?;
        let limit = "the drive's sample rate, a positive number";
        let sample_rate_hz = params.number("sample_rate_hz", limit)?;
        let resample = params.flag("resample")?;
        params.finish()?;
        let sample_rate_hz = sample_rate_hz.ok_or_else(|| invalid("sample_rate_hz", "is missing", limit))?;
        if sample_rate_hz <= 0.0 {
            return Err(invalid("sample_rate_hz", format!("is {sample_rate_hz}"), limit));
        }
        Ok(Self { request, sample_rate_hz, resample })
    }
}

const RESIDUES: &str = "ignore, half or repeated";

const MODEL_LIMIT: &str = "active or the number of a version";

#[cfg(test)]
mod tests {
    use super::*;

    fn includes(json: &str) -> Answer<Include> {
        serde_json::from_str::<PredictRequest>(json).expect("a request").includes()
    }

    #[test]
    fn the_parts_follow_from_what_was_sent_unless_they_are_named() {
        let all = Include { response: true, damage: true, errors: true, trust: true, band: false };
        assert_eq!(includes(r#"{"drive": {}, "target": {}}"#).expect("parts"), all);
        assert_eq!(
            includes(r#"{"drive": {}, "damage": {}}"#).expect("parts"),
            Include { errors: false, ..all }
        );
        assert_eq!(
            includes(r#"{"drive": {}}"#).expect("parts"),
            Include { errors: false, damage: false, ..all }
        );
        let only = Include { response: false, damage: true, errors: false, trust: false, band: false };
        assert_eq!(includes(r#"{"drive": {}, "include": ["damage"]}"#).expect("parts"), only);
        let only = Include { damage: false, band: true, ..only };
        assert_eq!(includes(r#"{"drive": {}, "include": ["band"]}"#).expect("parts"), only);
        let refused = includes(r#"{"drive": {}, "include": ["errors"]}"#).expect_err("no target");
        assert_eq!(refused.code(), "predict.target_missing");
    }
}
