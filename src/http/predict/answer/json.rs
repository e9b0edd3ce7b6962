//! A prediction as JSON: the response, and what was asked about it.

use std::iter;

use serde::Serialize;

use super::comparison::{DamageAnswer, damages, distances};
use super::{Begun, refusal};
use crate::domain::Base;
use crate::engine::Progress;
use crate::engine::model::{Preprocess, TrustSpan, VersionKind};
use crate::http::body::pieces::Written;
use crate::http::body::signal_pieces::JsonPieces;
use crate::http::body::signals::write_json;
use crate::http::json::Object;
use crate::http::predict::stages::Stages;
use crate::http::problem::{Answer, Problem};

/// Most values of a response that is written by all threads at once, before the answer begins to go out:
/// ten seconds of a large rig, some 2.5 MB of text.
const WRITTEN_AT_ONCE: usize = 1 << 17;

/// Trust; unknown for imported weights without a range.
#[derive(Debug, Serialize)]
struct TrustAnswer {
    inside: Option<f64>,
    spans: Vec<TrustSpan>,
}

#[derive(Debug, Serialize)]
struct ModelAnswer<'a> {
    version: u32,
    kind: VersionKind,
    #[serde(skip_serializing_if = "Option::is_none")]
    base: Option<&'a Base>,
    sha256: &'a str,
}

/// Predicts, compares and counts; writes the beginning of the document, or all of a short one.
///
/// # Errors
/// A result that is not finite, settings outside their limits; the deadline.
pub(super) fn write(begun: Begun<'_>, stages: &mut Stages) -> Answer<Written> {
    let Begun { rig, loaded, mut prediction, trust, target, include, damage, mut memory, deadline } = begun;
    let (model, predictor) = (loaded.model(), &loaded.predictor);
    let outputs = &model.outputs;
    let watch = |progress: Progress<'_>| deadline.watch(progress);
    let response = predictor.rest(&mut prediction, &watch).map_err(|error| refusal(&error, outputs))?;
    drop(prediction);
    stages.end("simulate");
    let name = ModelAnswer {
        version: loaded.version,
        kind: model.version_kind(),
        base: loaded.base.as_ref(),
        sha256: &loaded.sha256,
    };
    let mut answer = Object::new();
    answer.add("model", &name)?;
    let mut before = None;
    if include.response {
        let text = answer.field("response");
        if response.n_samples() * outputs.len() <= WRITTEN_AT_ONCE {
            write_json(text, outputs, &response);
        } else {
            before = Some(std::mem::take(text));
        }
    }
    if include.damage {
        deadline.check()?;
        let report = damages(rig, outputs, &response, target.as_ref(), &damage)?;
        let preprocess = if target.is_some() { model.preprocess } else { Preprocess::default() };
        answer.add("damage", &DamageAnswer { report, preprocess })?;
    }
    if let Some(target) = target.as_ref().filter(|_| include.errors) {
        deadline.check()?;
        answer.add("errors", &distances(outputs, &response, target, model.preprocess)?)?;
    }
    if include.trust {
        let known = !model.range.is_empty();
        answer.add("trust", &TrustAnswer { inside: known.then_some(trust.inside), spans: trust.spans })?;
    }
    let written = match before {
        None => Written::Whole(answer.finish()),
        Some(before) => {
            let after = answer.finish();
            memory.keep(response.n_samples() * outputs.len() * size_of::<f64>());
            let response = JsonPieces::new(outputs.clone(), response);
            let pieces = iter::once(Ok(before)).chain(response).chain(iter::once(Ok(after)));
            // The share of the memory is given back when the last piece has gone out.
            let held = pieces.inspect(move |_| {
                let _held = &memory;
            });
            Written::begin(Box::new(held)).map_err(Problem::internal)?
        }
    };
    stages.end("report");
    Ok(written)
}
