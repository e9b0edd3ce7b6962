//! One run predicted by one model, beside what was measured.

use crate::domain::{Model, evaluation::Seen};
use crate::domain::{Run, Span};
use crate::engine::model::Predictor;
use crate::engine::{EngineError, Signal, Watch};

/// A prediction, and the measurement behind the model's filter, on some of the model's outputs.
pub(super) struct Predicted {
    /// Share of samples inside what the model was fitted on.
    pub inside: f64,
    pub measured: Signal,
    pub predicted: Signal,
}

/// Predicts `signal`, whose channels are `names`, and takes the `outputs` of the model, by their places, which must be
/// among them as its inputs are.
///
/// # Errors
/// Those of the prediction and of the filter.
pub(super) fn predicted(
    predictor: &Predictor,
    signal: &Signal,
    names: &[String],
    outputs: &[usize],
    watch: Watch<'_>,
) -> Result<Predicted, EngineError> {
    let model = predictor.model();
    let place = |name: &String| names.iter().position(|n| n == name).expect("what is needed was loaded");
    let mut prediction =
        predictor.begin(signal.select(&model.inputs.iter().map(place).collect::<Vec<_>>()))?;
    let predicted = predictor.rest(&mut prediction, watch)?;
    let inside = predictor.trust(&prediction).inside;
    drop(prediction);
    let measured: Vec<usize> = outputs.iter().map(|&output| place(&model.outputs[output])).collect();
    Ok(Predicted {
        inside,
        measured: model.preprocess.apply_to(signal.select(&measured))?,
        predicted: predicted.select(outputs),
    })
}

/// The channels of a run that a comparison on these outputs needs, each once.
pub(super) fn needed(model: &Model, outputs: &[usize]) -> Vec<String> {
    let mut needed: Vec<String> = Vec::new();
    for name in model.inputs.iter().chain(outputs.iter().map(|&output| &model.outputs[output])) {
        if !needed.contains(name) {
            needed.push(name.clone());
        }
    }
    needed
}

/// What a run had been to a model.
pub(super) fn seen(model: &Model, run: &Run) -> Option<Seen> {
    let whole = Span { run: run.id, sha256: run.sha256.clone(), from_sample: 0, to_sample: run.samples };
    let lineage = &model.lineage;
    if lineage.was_trained_on(&whole) {
        Some(Seen::Training)
    } else if lineage.has_seen(&whole) {
        Some(Seen::Choice)
    } else {
        lineage.validation.iter().any(|span| span.overlaps(&whole)).then_some(Seen::Comparison)
    }
}
