//! Whether a model that was just fitted becomes the active one.
//!
//! `if_better` compares on data that neither model was trained or stopped on. It requires an improvement of
//! one percent, because another seed may change the error by less than that. A model that was fitted again on
//! all runs is compared by the scores that it had before, when it had not seen the data.

use std::sync::Arc;

use crate::compute::Class;
use crate::domain::fits::Activate;
use crate::domain::{Lineage, Model, Origin, Rig, Run, Span};
use crate::engine::model::{
    FitReport, Pair, Preprocess, RigModel, SectionScore, Squares, from_safetensors, with_context,
};
use crate::engine::{EngineError, Progress};
use crate::storage::Activation;

use super::control::Control;
use super::fit::{FitPlan, is_forward, pair};
use super::problem::{JobError, of_engine};
use super::work_context::WorkContext;

/// A new model must have at most this share of the active one's mean error.
const BETTER: f64 = 0.99;

/// On no output may the new model have more than this many times the active one's error.
const WORST: f64 = 1.05;

/// A fitted model, its report and the data behind it.
pub(super) struct Candidate<'a> {
    pub(super) model: &'a Arc<RigModel>,
    pub(super) report: &'a FitReport,
    pub(super) lineage: &'a Lineage,
}

/// The decision about the active model, and its reason in an engineer's words.
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
    context: &WorkContext,
    rig: &Rig,
    plan: &FitPlan,
    fitted: Candidate<'_>,
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
    let active = context.store.active_model(&rig.id).await?.and_then(|active| active.version);
    let Some(version) = active else {
        return Ok(Decision { activation: Activation::IfStill(None), why: "no model was active".into() });
    };
    let Some(row) = context.store.model(&rig.id, version).await? else {
        return Ok(Decision::leave("the active model changed meanwhile"));
    };
    compare(context, plan, &fitted, &row, control).await
}

async fn compare(
    context: &WorkContext,
    plan: &FitPlan,
    fitted: &Candidate<'_>,
    row: &Model,
    control: &Arc<Control>,
) -> Result<Decision, JobError> {
    let version = row.version;
    let unreadable = || Ok(Decision::leave(format!("active model {version} cannot be compared with")));
    let active = match from_safetensors(&context.store.weights(row).await?) {
        Ok(model) => model,
        Err(_) => return unreadable(),
    };
    let channels = plan.channels();
    let same_filter = fitted.model.preprocess == active.preprocess;
    let new = Side::of_fit(fitted, &channels.outputs, same_filter);
    let Some(old) = Side::of_row(row, &channels.outputs, same_filter) else { return unreadable() };
    let common = common(&new, &old);
    let noted = |common: &Common| matches!((&common.new, &common.old), (Score::Noted(_), Score::Noted(_)));
    // Where a score is to be computed, the run of its span is looked for by its id and by its digest.
    let runs = if common.iter().all(noted) { Vec::new() } else { context.store.all_runs(&row.rig).await? };
    let filter = if same_filter { active.preprocess } else { Preprocess::default() };
    let active = Arc::new(active);
    let mut sums: Vec<(Squares, Squares)> = vec![Default::default(); channels.outputs.len()];
    let mut seconds = 0.0;
    for Common { span, new, old } in common {
        let span_s = (span.to_sample - span.from_sample) as f64 / fitted.model.sample_rate_hz;
        let (new, old) = match (new, old) {
            (Score::Noted(new), Score::Noted(old)) => (new, old),
            (new, old) => {
                let Some(run) = run_of(&runs, &span, plan) else { continue };
                let signal = context.store.load_signal(run).await?;
                let measured =
                    ScoredSegment::cut(pair(run, signal, &channels.inputs, &channels.outputs)?, &span);
                let work = Work {
                    measured,
                    inputs: channels.inputs.clone(),
                    outputs: channels.outputs.clone(),
                    filter,
                };
                let (fitted, active) = (Arc::clone(fitted.model), Arc::clone(&active));
                let watched = Arc::clone(control);
                let scored = context
                    .compute
                    .run(Class::Fit, None, move || {
                        Ok((work.score(new, &fitted, &watched)?, work.score(old, &active, &watched)?))
                    })
                    .await?;
                match scored {
                    Ok(scores) => scores,
                    Err(EngineError::Cancelled) => return Err(JobError::Stopped),
                    // The new model has predicted its own data in the fit, so the active one is at fault.
                    Err(
                        EngineError::Weights(_)
                        | EngineError::TensorShape { .. }
                        | EngineError::NonFiniteResult { .. },
                    ) => return unreadable(),
                    Err(error) => return Err(of_engine(&error, &channels)),
                }
            }
        };
        seconds += span_s;
        for (sum, (new, old)) in sums.iter_mut().zip(new.into_iter().zip(old)) {
            *sum = (sum.0.plus(new), sum.1.plus(old));
        }
    }
    if seconds == 0.0 {
        return Ok(Decision::leave(format!(
            "there are no data that neither it nor active model {version} was trained or stopped on"
        )));
    }
    Ok(verdict(version, &channels.outputs, &sums, seconds))
}

/// `sums`: of the new and the active model, per output.
fn verdict(version: u32, outputs: &[String], sums: &[(Squares, Squares)], seconds: f64) -> Decision {
    let errors: Vec<(&String, f64, f64)> = outputs
        .iter()
        .zip(sums)
        .filter_map(|(name, (new, old))| Some((name, new.rms()?, old.rms()?)))
        .collect();
    if errors.is_empty() {
        return Decision::leave("the responses of the common data are zero");
    }
    let n = errors.len() as f64;
    let new = errors.iter().map(|(_, new, _)| new).sum::<f64>() / n;
    let old = errors.iter().map(|(_, _, old)| old).sum::<f64>() / n;
    let figures = format!(
        "RMS error {new:.4} against {old:.4} of model {version} on {seconds:.1} s that neither was trained or stopped on"
    );
    // Written so that NaN would not activate a model.
    let better = new <= BETTER * old;
    let worst = errors.iter().find(|(_, new, old)| *new > WORST * old || new.is_nan());
    match worst {
        _ if !better => Decision::leave(format!("{figures}; one percent less is asked for")),
        Some((name, new, old)) => {
            Decision::leave(format!("{figures}, but {new:.4} against {old:.4} on output {name}"))
        }
        None => Decision { activation: Activation::IfStill(Some(version)), why: figures },
    }
}

/// One of the models that are compared.
struct Side<'a> {
    lineage: &'a Lineage,
    /// Its scores on each span of its lineage's validation data, in the fit's order of outputs; empty if the
    /// report has none.
    noted: Vec<Vec<Squares>>,
}

impl<'a> Side<'a> {
    fn of_fit(fitted: &Candidate<'a>, outputs: &[String], same_filter: bool) -> Self {
        let order: Vec<usize> = (0..outputs.len()).collect();
        Self { lineage: fitted.lineage, noted: noted(fitted.report, &order, same_filter) }
    }

    /// `None` where the model has other outputs than its rig.
    fn of_row(row: &'a Model, outputs: &[String], same_filter: bool) -> Option<Self> {
        let order: Vec<usize> = places(&row.outputs, outputs)?;
        let report = row.report.as_ref().filter(|_| row.origin == Origin::Fit);
        let noted = report.map(|report| noted(report, &order, same_filter)).unwrap_or_default();
        Some(Self { lineage: &row.lineage, noted })
    }

    /// Its score on a span. `None` if it has seen the span.
    fn score(&self, span: &Span) -> Option<Score> {
        // Scores on such data are no measure, whether they are noted or not.
        if self.lineage.had_been_seen(span) {
            return None;
        }
        let place = self.lineage.validation.iter().position(|own| same_data(own, span));
        if let Some(noted) = place.and_then(|place| self.noted.get(place)) {
            return Some(Score::Noted(noted.clone()));
        }
        (!self.lineage.has_seen(span)).then_some(Score::ToCompute)
    }
}

/// Score of a model on a span of data, in the fit's order of outputs.
#[derive(Debug, PartialEq)]
enum Score {
    /// As its report has it.
    Noted(Vec<Squares>),
    /// From a prediction that is still to be made.
    ToCompute,
}

/// Scores of a report against the filtered responses, or, where the other model has another filter,
/// against those recorded.
fn noted(report: &FitReport, order: &[usize], same_filter: bool) -> Vec<Vec<Squares>> {
    let of = |score: &SectionScore| -> Option<Vec<Squares>> {
        let recorded = score.recorded.as_ref().filter(|_| !same_filter);
        let squares = recorded.unwrap_or(&score.outputs);
        order.iter().map(|&k| squares.get(k).copied()).collect()
    };
    let scores = report.comparison.iter().flat_map(|comparison| &comparison.scores);
    scores.map(of).collect::<Option<_>>().unwrap_or_default()
}

/// Place of each wanted name.
fn places(names: &[String], wanted: &[String]) -> Option<Vec<usize>> {
    wanted.iter().map(|name| names.iter().position(|n| n == name)).collect()
}

fn same_data(a: &Span, b: &Span) -> bool {
    a.sha256 == b.sha256 && (a.from_sample, a.to_sample) == (b.from_sample, b.to_sample)
}

/// A span that both models are scored on.
#[derive(Debug, PartialEq)]
struct Common {
    span: Span,
    new: Score,
    old: Score,
}

/// Spans of either model's validation data that both can be scored on, each measurement once.
fn common(new: &Side<'_>, old: &Side<'_>) -> Vec<Common> {
    let mut common: Vec<Common> = Vec::new();
    for span in new.lineage.validation.iter().chain(&old.lineage.validation) {
        if common.iter().any(|other| other.span.overlaps(span)) {
            continue;
        }
        if let (Some(new), Some(old)) = (new.score(span), old.score(span)) {
            common.push(Common { span: span.clone(), new, old });
        }
    }
    common
}

/// The run of a span, if it is there and holds every channel of the fit. A deleted run may have left a
/// duplicate.
fn run_of<'a>(runs: &'a [Run], span: &Span, plan: &FitPlan) -> Option<&'a Run> {
    let by_id = runs.iter().find(|run| run.id == span.run);
    let run = by_id.or_else(|| runs.iter().find(|run| run.sha256 == span.sha256))?;
    let mut needed = plan.inputs.iter().chain(&plan.outputs);
    (span.to_sample <= run.samples && needed.all(|name| run.channels.contains(name))).then_some(run)
}

/// Samples of a span, in the fit's order of channels, with real context before them.
struct ScoredSegment {
    pair: Pair,
    score_from: usize,
}

impl ScoredSegment {
    fn cut(whole: Pair, span: &Span) -> Self {
        let index = |sample: u64| usize::try_from(sample).unwrap_or(usize::MAX).min(whole.x.n_samples());
        let scored = index(span.from_sample)..index(span.to_sample);
        let known = with_context(&scored);
        let score_from = scored.start - known.start;
        Self { pair: Pair { x: whole.x.slice(known.clone()), y: whole.y.slice(known) }, score_from }
    }
}

/// The data from which a span's scores are computed.
struct Work {
    measured: ScoredSegment,
    /// The fit's inputs and outputs.
    inputs: Vec<String>,
    outputs: Vec<String>,
    /// Filter of the responses: that of both models, or none where they differ.
    filter: Preprocess,
}

impl Work {
    /// The noted scores, or else the sums over the span.
    fn score(&self, score: Score, model: &RigModel, control: &Control) -> Result<Vec<Squares>, EngineError> {
        if let Score::Noted(noted) = score {
            return Ok(noted);
        }
        let segment = &self.measured;
        let progress = Progress::new("comparing with the active model", 1.0);
        if control.watch(progress).is_break() {
            return Err(EngineError::Cancelled);
        }
        let places = (places(&self.inputs, &model.inputs), places(&model.outputs, &self.outputs));
        let (Some(inputs), Some(outputs)) = places else {
            return Err(EngineError::Weights("the model has other channels than its row says".into()));
        };
        let predicted = model.predict(&segment.pair.x.select(&inputs))?;
        let measured = self.filter.apply(&segment.pair.y)?;
        Ok(outputs
            .iter()
            .enumerate()
            .map(|(k, &output)| {
                let from = segment.score_from;
                Squares::of(&predicted.channel(output)[from..], &measured.channel(k)[from..])
            })
            .collect())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::domain::RunId;

    fn span(run: u128, from_sample: u64, to_sample: u64) -> Span {
        Span { run: RunId::from_u128(run), sha256: format!("{run}"), from_sample, to_sample }
    }

    fn squares(error: f64) -> Vec<Squares> {
        vec![Squares { error, measured: 100.0 }]
    }

    fn spans(common: &[Common]) -> Vec<Span> {
        common.iter().map(|c| c.span.clone()).collect()
    }

    #[test]
    fn only_data_that_neither_model_was_trained_or_stopped_on_is_common() {
        let old = Lineage {
            training: vec![span(1, 0, 800), span(2, 0, 800)],
            stopping: Some(vec![span(1, 800, 900), span(2, 800, 900)]),
            validation: vec![span(1, 900, 1000), span(2, 900, 1000), span(5, 0, 1000)],
            ..Lineage::default()
        };
        let new = Lineage {
            training: vec![span(1, 0, 800), span(5, 0, 900)],
            frf: vec![span(2, 0, 1000)],
            stopping: Some(vec![span(7, 0, 500)]),
            validation: vec![span(1, 900, 1000), span(5, 900, 1000), span(6, 0, 1000)],
            ..Lineage::default()
        };
        let side = |lineage| Side { lineage, noted: Vec::new() };
        // Run 1: held out by both. Run 2: the new FRF saw it. Run 5: the old model's span reaches
        // into the new one's training, the new one's does not. Run 6: unknown to the old model.
        let found = spans(&common(&side(&new), &side(&old)));
        assert_eq!(found, [span(1, 900, 1000), span(5, 900, 1000), span(6, 0, 1000)]);
        let stopped =
            Lineage { stopping: Some(vec![span(1, 0, 1000), span(6, 0, 1000)]), ..Lineage::default() };
        assert_eq!(spans(&common(&side(&stopped), &side(&old))), [span(2, 900, 1000), span(5, 0, 1000)]);
        let before = Lineage { stopping: None, ..old.clone() };
        let found = spans(&common(&side(&new), &side(&before)));
        assert_eq!(found, [span(6, 0, 1000)], "what stopped a model of before is not known apart");
    }

    #[test]
    fn a_model_fitted_again_on_all_runs_is_scored_as_it_was_before() {
        let left_out = |run| Lineage {
            training: vec![span(1, 0, 1000), span(2, 0, 1000)],
            stopping: Some(vec![]),
            validation: vec![span(run, 0, 1000)],
            ..Lineage::default()
        };
        let (a, b) = (left_out(2), left_out(1));
        let side = |lineage, error| Side { lineage, noted: vec![squares(error)] };
        let found = common(&side(&a, 1.0), &side(&a, 2.0));
        assert_eq!(
            found,
            [Common {
                span: span(2, 0, 1000),
                new: Score::Noted(squares(1.0)),
                old: Score::Noted(squares(2.0))
            }]
        );
        assert_eq!(common(&side(&a, 1.0), &side(&b, 2.0)), [], "each has seen what the other left out");
        // A run from after the active model's fit is new to it as it is.
        let seen = vec![span(2, 0, 10)];
        let warm = Lineage {
            start: Some(crate::domain::StartedFrom { version: 1, sha256: "a".into(), seen }),
            ..left_out(2)
        };
        assert_eq!(common(&side(&warm, 1.0), &side(&a, 2.0)), [], "its start was trained on the data");
        let newer = Lineage { training: vec![span(3, 0, 1000)], ..left_out(3) };
        let found = common(&side(&newer, 1.0), &side(&a, 2.0));
        assert_eq!(
            found[0],
            Common { span: span(3, 0, 1000), new: Score::Noted(squares(1.0)), old: Score::ToCompute }
        );
    }

    #[test]
    fn one_percent_less_error_activates_and_less_than_that_does_not() {
        let of = |new: f64, old: f64| {
            let squares = |rms: f64| Squares { error: rms * rms, measured: 1.0 };
            verdict(2, &["y".into()], &[(squares(new), squares(old))], 3.0)
        };
        assert_eq!(of(0.0989, 0.1).activation, Activation::IfStill(Some(2)));
        assert_eq!(of(0.0995, 0.1).activation, Activation::Leave);
        assert_eq!(of(f64::NAN, 0.1).activation, Activation::Leave);
        let words = last_words(3, false, &of(0.2, 0.1).why);
        assert!(
            words.starts_with("model 3, not active: RMS error 0.2000 against 0.1000 of model 2"),
            "{words}"
        );
    }

    #[test]
    fn no_output_may_be_more_than_five_percent_worse() {
        let squares = |rms: f64| Squares { error: rms * rms, measured: 1.0 };
        let of = |second: f64| {
            let sums = [(squares(0.1), squares(0.3)), (squares(second), squares(0.1))];
            verdict(2, &["a".into(), "b".into()], &sums, 3.0)
        };
        assert_eq!(of(0.1049).activation, Activation::IfStill(Some(2)));
        let refused = of(0.1051);
        assert_eq!(refused.activation, Activation::Leave);
        assert!(refused.why.ends_with("but 0.1051 against 0.1000 on output b"), "{}", refused.why);
    }
}
