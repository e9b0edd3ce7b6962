//! The evaluation job: models and runs in, the table of their errors out.
//!
//! One run is in memory at a time, with the channels that some model needs, and one prediction. Of each prediction
//! its figures are kept, and the sums of its spectra in a few hundred lines a channel.

mod plan;
mod problem;
mod report;

use std::sync::Arc;
use std::time::Instant;

use bytes::Bytes;

use crate::compute::Class;
use crate::domain::evaluation::{EvaluationOutline, EvaluationReport, Omission, OmittedRun, RunResult, Seen};
use crate::domain::{EvaluationRequest, FitChannels, Problem, Run};
use crate::engine::evaluation::{Compared, compare};
use crate::engine::fatigue::DamageGroup;
use crate::engine::model::Predictor;
use crate::engine::{EngineError, Progress, Signal};
use crate::storage::NewEvaluation;

use super::control::Control;
use super::predicted::{Predicted, predicted};
use super::problem::{JobError, of_engine};
use super::spec::{EvaluationOutput, JobSpec};
use super::work_context::WorkContext;
use plan::{EvaluationPlan, Pairing};
use report::Table;

pub(super) use plan::{check, comparable};
pub use problem::EvaluationProblem;

/// Share of a comparison's progress that is the prediction; the rest is rainflow and spectra.
const PREDICTED: f64 = 0.7;

/// Does an evaluation, from the request to a report that is ready to be stored.
pub(super) async fn make(
    context: &WorkContext,
    spec: &JobSpec,
    control: &Arc<Control>,
) -> Result<EvaluationOutput, JobError> {
    let started = Instant::now();
    let request: EvaluationRequest = spec.request()?;
    let rig = context.store.rig(&spec.rig).await?.ok_or(EvaluationProblem::RigGone)?;
    // Checked again, because runs and models may have gone since the job was queued.
    let plan = Arc::new(check(&context.store, &rig, &request).await?);
    control.report("loading models", 0.0);
    let predictors = Arc::new(predictors(context, &plan).await?);
    let filters = predictors.iter().map(|predictor| predictor.model().preprocess).collect();
    let mut table = Table::new(&plan, filters);
    let all: f64 = plan.pairings.iter().map(|pairing| weight(&plan, pairing)).sum();
    let mut done = 0.0;
    for run in 0..plan.runs.len() {
        let pairings = plan.of_run(run);
        if pairings.is_empty() {
            continue;
        }
        let needed = plan.needed(run);
        let signal = Arc::new(load(context, &plan.runs[run], &needed).await?);
        for pairing in pairings {
            let part = weight(&plan, &pairing) / all;
            let stage = format!(
                "run {} of {}, model {}",
                run + 1,
                plan.runs.len(),
                plan.models[pairing.model].version
            );
            let progress = Part { stage, from: done, length: part };
            let of = (pairing.clone(), needed.clone(), Arc::clone(&signal));
            let made = one(context, (&plan, &predictors), of, progress, control).await?;
            table.add(&pairing, made);
            done += part;
        }
    }
    control.report("averaging", 1.0);
    let report = table.finish();
    written(context, &plan, report, started).await
}

/// Work of a comparison: samples times channels.
fn weight(plan: &EvaluationPlan, pairing: &Pairing) -> f64 {
    let model = &plan.models[pairing.model];
    plan.runs[pairing.run].samples as f64 * (model.inputs.len() + model.outputs.len()) as f64
}

/// A share of the job's progress.
struct Part {
    stage: String,
    from: f64,
    length: f64,
}

async fn predictors(context: &WorkContext, plan: &EvaluationPlan) -> Result<Vec<Predictor>, JobError> {
    let mut predictors = Vec::with_capacity(plan.models.len());
    for model in &plan.models {
        predictors.push(context.read_model(model, Predictor::new).await?);
    }
    Ok(predictors)
}

/// Some channels of a run, in the order of their names.
async fn load(context: &WorkContext, run: &Run, channels: &[String]) -> Result<Signal, JobError> {
    let place = |name: &String| run.channels.iter().position(|channel| channel == name);
    let columns: Vec<usize> = channels.iter().filter_map(place).collect();
    Ok(context.store.load_channels(run, columns).await?)
}

/// A comparison, or why there is none.
type Made = Result<(RunResult, Box<Compared>), OmittedRun>;

/// Predicts one run by one model and compares.
async fn one(
    context: &WorkContext,
    (plan, predictors): (&Arc<EvaluationPlan>, &Arc<Vec<Predictor>>),
    (pairing, needed, signal): (Pairing, Vec<String>, Arc<Signal>),
    part: Part,
    control: &Arc<Control>,
) -> Result<Made, JobError> {
    let (plan, predictors, watched) = (Arc::clone(plan), Arc::clone(predictors), Arc::clone(control));
    let model = &plan.models[pairing.model];
    let names: Vec<String> = pairing.outputs.iter().map(|&output| model.outputs[output].clone()).collect();
    let channels = FitChannels { inputs: model.inputs.clone(), outputs: names.clone() };
    let omitted = OmittedRun {
        model: model.version,
        run: plan.runs[pairing.run].id,
        reason: Omission::NotFinite,
        channels: Vec::new(),
    };
    let (seen, include_fitted) = (pairing.seen, plan.request.include_fitted);
    let work = move || {
        let watch = |progress: Progress<'_>| {
            let fraction = part.from + part.length * PREDICTED * progress.fraction;
            watched.watch(Progress::new(&part.stage, fraction))
        };
        let predictor = &predictors[pairing.model];
        let Predicted { inside, measured, predicted } =
            predicted(predictor, &signal, &needed, &pairing.outputs, &watch)?;
        let groups = vectors(&plan, &names);
        let compared = compare(&names, &groups, &measured, &predicted, &plan.request.settings())?;
        Ok::<_, EngineError>((inside, compared))
    };
    let made = context.compute.run(Class::Fit, None, work).await?;
    if control.stopped().is_some() {
        return Err(JobError::Stopped);
    }
    match made {
        Ok((inside, compared)) => {
            let counted = include_fitted || !seen.is_some_and(Seen::shaped);
            let figures = compared.figures.clone();
            let OmittedRun { model, run, .. } = omitted;
            Ok(Ok((RunResult { model, run, seen, counted, inside, figures }, Box::new(compared))))
        }
        Err(
            EngineError::NonFiniteResult { channel, .. }
            | EngineError::NonFinite { channel, .. }
            | EngineError::DamageOverflow { channel, .. },
        ) => {
            let channels = channels.outputs.get(channel).cloned().into_iter().collect();
            Ok(Err(OmittedRun { channels, ..omitted }))
        }
        Err(error) => Err(of_engine(&error, &channels)),
    }
}

/// The groups with a Multi-Rain of which all channels are compared.
fn vectors<'a>(plan: &'a EvaluationPlan, names: &[String]) -> Vec<DamageGroup<'a>> {
    let place = |member: &String| names.iter().position(|name| name == member);
    let whole = |(name, members): &'a (String, [String; 3])| {
        let [x, y, z] = [place(&members[0])?, place(&members[1])?, place(&members[2])?];
        Some(DamageGroup { name: name.as_str(), channels: [x, y, z] })
    };
    plan.vectors.iter().filter_map(whole).collect()
}

/// The report in the form in which it is stored.
async fn written(
    context: &WorkContext,
    plan: &EvaluationPlan,
    report: EvaluationReport,
    started: Instant,
) -> Result<EvaluationOutput, JobError> {
    let (outline, stage) = (EvaluationOutline::from(&report), last_words(&report));
    let encode = move || {
        let bytes = serde_json::to_vec(&report)?;
        // JSON has no NaN, so a report with one could not be read back and must not be stored.
        serde_json::from_slice::<EvaluationReport>(&bytes)?;
        Ok::<_, serde_json::Error>(bytes)
    };
    let report = context.compute.run(Class::Fit, None, encode).await?.map_err(|error| {
        tracing::error!(%error, "an evaluation cannot be written: this is a bug");
        let detail = "A number of the report is not finite; the report is not stored.";
        JobError::failed(Problem::new(422, "result.non_finite", "The result is not finite", detail))
    })?;
    let evaluation = NewEvaluation {
        request: plan.request.clone(),
        outline,
        report: Bytes::from(report),
        elapsed_s: started.elapsed().as_secs_f64(),
    };
    Ok(EvaluationOutput { evaluation, stage })
}

/// The last stage text of the job.
fn last_words(report: &EvaluationReport) -> String {
    let count = |n: usize, one: &str| if n == 1 { format!("1 {one}") } else { format!("{n} {one}s") };
    let omitted = match report.omitted.len() {
        0 => String::new(),
        n => format!(", {} left out", count(n, "comparison")),
    };
    format!("{} on {}{omitted}", count(report.models.len(), "model"), count(report.runs.len(), "run"))
}
