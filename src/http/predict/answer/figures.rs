//! The figures of a prediction, as fields of a JSON object: model, damage, errors, trust.

use serde::Serialize;

use super::comparison::{DamageAnswer, damages, distances};
use super::{Predicted, Setting};
use crate::domain::Base;
use crate::engine::model::{FallbackUse, Preprocess, TrustSpan, VersionKind};
use crate::http::json::Object;
use crate::http::problem::Answer;

/// Trust; unknown for imported weights without a range.
#[derive(Debug, Serialize)]
struct TrustAnswer<'a> {
    inside: Option<f64>,
    #[serde(flatten, skip_serializing_if = "Option::is_none")]
    fallback: Option<&'a FallbackUse>,
    spans: &'a [TrustSpan],
}

#[derive(Debug, Serialize)]
struct ModelAnswer<'a> {
    version: u32,
    kind: VersionKind,
    #[serde(skip_serializing_if = "Option::is_none")]
    base: Option<&'a Base>,
    sha256: &'a str,
}

impl Setting<'_> {
    /// Adds the model, and the sample rates that its inputs were converted from.
    pub(super) fn add_model(&self, answer: &mut Object) -> Answer<()> {
        let loaded = self.loaded;
        let model = ModelAnswer {
            version: loaded.version,
            kind: loaded.model().version_kind(),
            base: loaded.base.as_ref(),
            sha256: &loaded.sha256,
        };
        answer.add("model", &model)?;
        if !self.converted_from.is_none() {
            answer.add("resampled_from_hz", &self.converted_from)?;
        }
        Ok(())
    }

    /// Adds what is asked for of damage, errors, trust and the band.
    ///
    /// # Errors
    /// Settings outside their limits, a figure beyond its range; the deadline.
    pub(super) fn add_figures(&self, answer: &mut Object, predicted: &Predicted) -> Answer<()> {
        let model = self.loaded.model();
        let Predicted { response, half_width, trust, fallback } = predicted;
        let outputs = &model.outputs;
        let target = self.target.as_ref();
        // Side by side: Multi-Rain alone keeps all threads busy, but not from its first direction to its last.
        let damage = || {
            self.deadline.check()?;
            damages(self.rig, outputs, response, target, &self.damage)
        };
        let errors = |target| {
            self.deadline.check()?;
            distances(outputs, response, target, model.preprocess)
        };
        let (damage, errors) = rayon::join(
            || self.include.damage.then(damage).transpose(),
            || target.filter(|_| self.include.errors).map(errors).transpose(),
        );
        if let Some(report) = damage? {
            let preprocess = if target.is_some() { model.preprocess } else { Preprocess::default() };
            answer.add("damage", &DamageAnswer { report, preprocess })?;
        }
        if let Some(report) = errors? {
            answer.add("errors", &report)?;
        }
        if self.include.trust {
            let known = !model.range.is_empty();
            let inside = known.then_some(trust.inside);
            let trust = TrustAnswer { inside, fallback: fallback.as_ref(), spans: &trust.spans };
            answer.add("trust", &trust)?;
        }
        if self.include.band {
            self.deadline.check()?;
            self.add_band(answer, response, half_width.as_ref())?;
        }
        Ok(())
    }
}
