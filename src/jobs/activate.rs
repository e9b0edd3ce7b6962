//! Whether a model that was just fitted becomes the active one.
//!
//! `if_better` compares on data that neither model was trained on, and asks for one percent: less
//! is within what another seed would do.

use std::sync::Arc;

use crate::compute::Class;
use crate::domain::fits::Activate;
use crate::domain::{FitChannels, Lineage, Model, Rig, Span};
use crate::engine::model::{Pair, RigModel, from_safetensors};
use crate::engine::{EngineError, Progress};
use crate::storage::{Activation, StoreError};

use super::control::Control;
use super::fit::{FitPlan, is_forward, pair};
use super::problem::{JobError, of_engine};
use super::workbench::Workbench;

/// A new model must have this much of the active one's error or less.
const BETTER: f64 = 0.99;

/// Samples before a scored stretch that both models see, so that neither is scored on its start.
const CONTEXT_SAMPLES: u64 = 8192;

/// What to do with the pointer, and why, in an engineer's words.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Decision {
    pub(super) activation: Activation,
    pub(super) why: String,
}

impl Decision {
    fn leave(why: impl Into<String>) -> Self {
        Self { activation: Activation::Leave, why: why.into() }
    }
}

/// A job's last words about its model.
pub(super) fn last_words(version: u32, active: bool, why: &str) -> String {
    let state = if active { "active" } else { "not active" };
    format!("model {version}, {state}: {why}")
}

/// Decides about a fitted model before it has a number.
pub(super) async fn decide(
    bench: &Workbench,
    rig: &Rig,
    plan: &FitPlan,
    fitted: &Arc<RigModel>,
    control: &Arc<Control>,
) -> Result<Decision, JobError> {
    if plan.request.activate == Activate::Never {
        return Ok(Decision::leave("the fit was told never to activate"));
    }
    if !is_forward(rig, plan) {
        return Ok(Decision::leave("it does not map all drives to all responses of the rig"));
    }
    if plan.request.activate == Activate::Always {
        return Ok(Decision { activation: Activation::Always, why: "the fit was told to activate".into() });
    }
    let active = bench.store.active_model(&rig.id).await?.and_then(|active| active.version);
    let Some(version) = active else {
        return Ok(Decision { activation: Activation::IfStill(None), why: "no model was active".into() });
    };
    let Some(row) = bench.store.model(&rig.id, version).await? else {
        return Ok(Decision::leave("the active model changed meanwhile"));
    };
    compare(bench, plan, fitted, &row, control).await
}

async fn compare(
    bench: &Workbench,
    plan: &FitPlan,
    fitted: &Arc<RigModel>,
    active: &Model,
    control: &Arc<Control>,
) -> Result<Decision, JobError> {
    let version = active.version;
    let stretches = stretches(bench, plan, active).await?;
    if stretches.is_empty() {
        return Ok(Decision::leave(format!(
            "there are no validation data that neither it nor active model {version} was trained on"
        )));
    }
    let weights = bench.store.weights(active).await?;
    let (fitted, watched) = (Arc::clone(fitted), Arc::clone(control));
    let seconds: f64 = stretches.iter().map(Stretch::scored_s).sum();
    let scored = bench
        .compute
        .run(Class::Fit, None, move || {
            let active = from_safetensors(&weights)?;
            let stretches = reference(stretches, &fitted, &active)?;
            let new = mean_rms(&fitted, &stretches, &watched)?;
            Ok((new, mean_rms(&active, &stretches, &watched)?))
        })
        .await?;
    match scored {
        Ok((Some(new), Some(old))) => Ok(verdict(version, new, old, seconds)),
        Ok(_) => Ok(Decision::leave("the responses of the common validation data are zero")),
        Err(EngineError::Cancelled) => Err(JobError::Stopped),
        // The new model predicted its own validation data in the fit: this is about the active one.
        Err(
            EngineError::Weights(_) | EngineError::TensorShape { .. } | EngineError::NonFiniteResult { .. },
        ) => Ok(Decision::leave(format!("active model {version} cannot be compared with"))),
        Err(error) => Err(of_engine(&error, &plan.channels())),
    }
}

fn verdict(version: u32, new: f64, old: f64, seconds: f64) -> Decision {
    let figures = format!(
        "RMS error {new:.4} against {old:.4} of model {version} on {seconds:.1} s that neither was trained on"
    );
    // Written so that NaN, which no error is, would not activate either.
    if new <= BETTER * old {
        Decision { activation: Activation::IfStill(Some(version)), why: figures }
    } else {
        Decision::leave(format!("{figures}; one percent less is asked for"))
    }
}

/// A stretch of a run that both models are scored on.
struct Stretch {
    /// Context, then the scored part, in the fit's order of channels.
    pair: Pair,
    channels: FitChannels,
    score_from: usize,
}

impl Stretch {
    fn scored_s(&self) -> f64 {
        (self.pair.x.n_samples() - self.score_from) as f64 / self.pair.x.sample_rate_hz()
    }
}

/// Validation spans of either model that shaped the weights of neither, each measurement once.
fn common_spans(new: &Lineage, old: &Lineage) -> Vec<Span> {
    let mut common: Vec<Span> = Vec::new();
    for span in new.validation.iter().chain(&old.validation) {
        let fair = !new.was_trained_on(span) && !old.was_trained_on(span);
        if fair && !common.iter().any(|other| other.overlaps(span)) {
            common.push(span.clone());
        }
    }
    common
}

async fn stretches(bench: &Workbench, plan: &FitPlan, active: &Model) -> Result<Vec<Stretch>, StoreError> {
    let channels = plan.channels();
    let runs = bench.store.all_runs(&active.rig).await?;
    let mut stretches = Vec::new();
    for span in common_spans(&plan.lineage(), &active.lineage) {
        // A deleted run may have left a duplicate.
        let by_id = runs.iter().find(|run| run.id == span.run);
        let Some(run) = by_id.or_else(|| runs.iter().find(|run| run.sha256 == span.sha256)) else { continue };
        let mut needed = channels.inputs.iter().chain(&channels.outputs);
        if span.to_sample > run.samples || !needed.all(|name| run.channels.contains(name)) {
            continue;
        }
        let signal = bench.store.load_signal(run).await?;
        let whole = pair(run, signal, &channels.inputs, &channels.outputs)?;
        let index = |sample: u64| usize::try_from(sample).unwrap_or(usize::MAX).min(whole.x.n_samples());
        let first = index(span.from_sample.saturating_sub(CONTEXT_SAMPLES));
        let range = first..index(span.to_sample);
        stretches.push(Stretch {
            pair: Pair { x: whole.x.slice(range.clone()), y: whole.y.slice(range) },
            channels: channels.clone(),
            score_from: index(span.from_sample) - first,
        });
    }
    Ok(stretches)
}

/// What both models are measured against: the responses as recorded, or, where both models have
/// the same filter, behind that filter, as in their fits.
fn reference(
    mut stretches: Vec<Stretch>,
    new: &RigModel,
    active: &RigModel,
) -> Result<Vec<Stretch>, EngineError> {
    if new.preprocess == active.preprocess {
        for stretch in &mut stretches {
            stretch.pair.y = new.preprocess.apply(&stretch.pair.y)?;
        }
    }
    Ok(stretches)
}

/// Mean over the outputs of `sqrt(sum (y - y*)^2 / sum y*^2)` (Heindel et al., section 4), each
/// over all stretches together; `None` when every output is zero throughout.
fn mean_rms(model: &RigModel, stretches: &[Stretch], control: &Control) -> Result<Option<f64>, EngineError> {
    let mut sums: Vec<(f64, f64)> = Vec::new();
    for stretch in stretches {
        let progress = Progress { stage: "comparing with the active model", fraction: 1.0 };
        if control.watch(progress).is_break() {
            return Err(EngineError::Cancelled);
        }
        let order = |names: &[String], wanted: &[String]| -> Option<Vec<usize>> {
            wanted.iter().map(|name| names.iter().position(|n| n == name)).collect()
        };
        let (Some(inputs), Some(outputs)) = (
            order(&stretch.channels.inputs, &model.inputs),
            order(&stretch.channels.outputs, &model.outputs),
        ) else {
            return Err(EngineError::Weights("the model has other channels than its row says".into()));
        };
        let predicted = model.predict(&stretch.pair.x.select(&inputs))?;
        let measured = stretch.pair.y.select(&outputs);
        sums.resize(outputs.len(), (0.0, 0.0));
        for (k, (error, power)) in sums.iter_mut().enumerate() {
            let both = predicted.channel(k).iter().zip(measured.channel(k)).skip(stretch.score_from);
            for (predicted, measured) in both {
                *error += (predicted - measured).powi(2);
                *power += measured * measured;
            }
        }
    }
    let errors: Vec<f64> = sums.iter().filter(|(_, p)| *p > 0.0).map(|(e, p)| (e / p).sqrt()).collect();
    if errors.is_empty() {
        return Ok(None);
    }
    Ok(Some(errors.iter().sum::<f64>() / errors.len() as f64))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::domain::RunId;

    fn span(run: u128, from_sample: u64, to_sample: u64) -> Span {
        Span { run: RunId::from_u128(run), sha256: format!("{run}"), from_sample, to_sample }
    }

    #[test]
    fn only_data_that_neither_model_was_trained_on_is_common() {
        let old = Lineage {
            training: vec![span(1, 0, 900), span(2, 0, 900)],
            frf: vec![],
            validation: vec![span(1, 900, 1000), span(2, 900, 1000), span(5, 0, 1000)],
            diagnoses: vec![],
        };
        let new = Lineage {
            training: vec![span(1, 0, 900), span(5, 0, 900)],
            frf: vec![span(2, 0, 1000)],
            validation: vec![span(1, 900, 1000), span(5, 900, 1000), span(6, 0, 1000)],
            diagnoses: vec![],
        };
        // Run 1: held out by both. Run 2: the new FRF saw it. Run 5: the old model's span reaches
        // into the new one's training, the new one's does not. Run 6: unknown to the old model.
        assert_eq!(common_spans(&new, &old), [span(1, 900, 1000), span(5, 900, 1000), span(6, 0, 1000)]);
        let seen = Lineage { training: vec![span(1, 0, 1000), span(6, 0, 1000)], ..Lineage::default() };
        assert_eq!(common_spans(&new, &seen), [span(5, 900, 1000)]);
    }

    #[test]
    fn one_percent_less_error_activates_and_less_than_that_does_not() {
        assert_eq!(verdict(2, 0.0989, 0.1, 3.0).activation, Activation::IfStill(Some(2)));
        assert_eq!(verdict(2, 0.0995, 0.1, 3.0).activation, Activation::Leave);
        assert_eq!(verdict(2, f64::NAN, 0.1, 3.0).activation, Activation::Leave);
        let words = last_words(3, false, &verdict(2, 0.2, 0.1, 3.0).why);
        assert!(
            words.starts_with("model 3, not active: RMS error 0.2000 against 0.1000 of model 2"),
            "{words}"
        );
    }
}
