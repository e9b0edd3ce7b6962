//! The request of a prediction.

use serde::Deserialize;

use crate::domain::ModelRef;
use crate::engine::fatigue::DamageSettings;
use crate::http::body::HoldsSignals;
use crate::http::body::signals::Channels;
use crate::http::codes;
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
}

/// Signals, or a run that holds them. One flat object, so that errors point at a field and no sample is
/// buffered twice.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Source {
    /// The run.
    #[serde(default)]
    pub run: Option<uuid::Uuid>,
    /// Sample rate of the signals.
    #[serde(default)]
    pub sample_rate_hz: Option<f64>,
    /// The signals.
    #[serde(default)]
    pub channels: Option<Channels>,
}

/// A part of the answer.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "snake_case")]
enum AnswerPart {
    Response,
    Damage,
    Errors,
    Trust,
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
        let Some(parts) = &self.include else {
            let target = self.target.is_some();
            return Ok(Include {
                response: true,
                damage: target || self.damage.is_some(),
                errors: target,
                trust: true,
            });
        };
        let wants = |part| parts.contains(&part);
        if wants(AnswerPart::Errors) && self.target.is_none() {
            let detail = "Errors compare a prediction with a target; the request has none.";
            return Err(Problem::new(codes::PREDICT_TARGET_MISSING, detail)
                .with(FieldError::new("/target", "needed for errors")));
        }
        Ok(Include {
            response: wants(AnswerPart::Response),
            damage: wants(AnswerPart::Damage),
            errors: wants(AnswerPart::Errors),
            trust: wants(AnswerPart::Trust),
        })
    }
}

/// The query beside an NPY body.
#[derive(Debug)]
pub struct NpyQuery {
    /// Which model.
    pub model: ModelRef,
    /// Sample rate of the drive.
    pub sample_rate_hz: f64,
}

/// The query beside a measurement file.
#[derive(Debug)]
pub struct MeasurementQuery {
    /// Which model.
    pub model: ModelRef,
    /// How the file is read.
    pub file: FileQuery,
}

impl MeasurementQuery {
    /// Takes `model` and the parameters of a file.
    ///
    /// # Errors
    /// `query.*`
    pub fn take(mut params: Params) -> Answer<Self> {
        let model = model(&mut params)?;
        let file = FileQuery::take(&mut params)?;
        params.finish()?;
        Ok(Self { model, file })
    }
}

/// The parameter `model`; the active one without it.
fn model(params: &mut Params) -> Answer<ModelRef> {
    params.one("model")?.map_or(Ok(ModelRef::Active), |text| {
        ModelRef::parse(&text).ok_or_else(|| invalid("model", format!("is {text:?}"), MODEL_LIMIT))
    })
}

impl NpyQuery {
    /// Takes `model` and `sample_rate_hz`.
    ///
    /// # Errors
    /// `query.*`; the sample rate is required, because an NPY file has none.
    pub fn take(mut params: Params) -> Answer<Self> {
        let model = model(&mut params)?;
        let limit = "the drive's sample rate, a positive number";
        let sample_rate_hz = params.number("sample_rate_hz", limit)?;
        params.finish()?;
        let sample_rate_hz = sample_rate_hz.ok_or_else(|| invalid("sample_rate_hz", "is missing", limit))?;
        if sample_rate_hz <= 0.0 {
            return Err(invalid("sample_rate_hz", format!("is {sample_rate_hz}"), limit));
        }
        Ok(Self { model, sample_rate_hz })
    }
}

const MODEL_LIMIT: &str = "active or the number of a version";

#[cfg(test)]
mod tests {
    use super::*;

    fn includes(json: &str) -> Answer<Include> {
        serde_json::from_str::<PredictRequest>(json).expect("a request").includes()
    }

    #[test]
    fn the_parts_follow_from_what_was_sent_unless_they_are_named() {
        let all = Include { response: true, damage: true, errors: true, trust: true };
        assert_eq!(includes(r#"{"drive": {}, "target": {}}"#).expect("parts"), all);
        assert_eq!(
            includes(r#"{"drive": {}, "damage": {}}"#).expect("parts"),
            Include { errors: false, ..all }
        );
        assert_eq!(
            includes(r#"{"drive": {}}"#).expect("parts"),
            Include { errors: false, damage: false, ..all }
        );
        let only = Include { response: false, damage: true, errors: false, trust: false };
        assert_eq!(includes(r#"{"drive": {}, "include": ["damage"]}"#).expect("parts"), only);
        let refused = includes(r#"{"drive": {}, "include": ["errors"]}"#).expect_err("no target");
        assert_eq!(refused.code(), "predict.target_missing");
    }
}
