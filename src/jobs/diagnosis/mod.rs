//! The diagnosis job: runs and a sim in, a report out.

mod checks;
mod plan;
mod problem;
mod runs;

use std::sync::Arc;
use std::time::Instant;

use bytes::Bytes;

use crate::compute::Class;
use crate::domain::diagnosis::{Findings, VerdictSummary};
use crate::domain::{Channel, DiagnosisRequest, FieldError, Problem, Run, Span, UsedModel, units};
use crate::engine::diagnosis::{self, Diagnosis, Input, Mode, RunPart, VerdictKind};
use crate::engine::model::{AddedEffect, ModelKind, Pair, Predictor, Preprocess, RigModel, apply_effects};
use crate::engine::{EngineError, Progress, Signal};
use crate::storage::NewDiagnosis;

use super::control::Control;
use super::fit::pair;
use super::problem::JobError;
use super::spec::{DiagnosisOutput, JobSpec};
use super::work_context::WorkContext;
use plan::DiagnosisPlan;
use problem::of_diagnosis;

pub(super) use plan::check;
pub use problem::DiagnosisProblem;

/// Share of the progress for loading and simulating; the rest is the engine's.
const LOADED: f64 = 0.1;

/// Seed of the bootstrap and of the next experiment's drives, so that the same request gives the same
/// report.
const SEED: u64 = 1;

/// Does a diagnosis, from the request to a report that is ready to be stored.
pub(super) async fn make(
    context: &WorkContext,
    spec: &JobSpec,
    control: &Arc<Control>,
) -> Result<DiagnosisOutput, JobError> {
    let started = Instant::now();
    let request: DiagnosisRequest = spec.request()?;
    let rig = context.store.rig(&spec.rig).await?.ok_or(DiagnosisProblem::RigGone)?;
    // Checked again, because runs and models may have gone since the job was queued.
    let plan = Arc::new(check(&context.store, &rig, &request).await?);
    let input = load(context, &plan, control).await?;
    let found = diagnose(context, &plan, input, control).await?;
    written(context, &plan, found, started).await
}

/// The simulation that is compared with the rig.
enum Sim {
    /// A model, and the adopted effects on top of it.
    Model(Box<Predictor>, Vec<AddedEffect>),
    /// Simulated responses, one run for each run of the diagnosis.
    Outside,
}

async fn sim(context: &WorkContext, plan: &DiagnosisPlan) -> Result<Sim, JobError> {
    let Some(model) = &plan.model else { return Ok(Sim::Outside) };
    let apart = |mut model: RigModel| {
        let effects = std::mem::take(&mut model.effects);
        Ok(Sim::Model(Box::new(Predictor::new(model)?), effects))
    };
    context.read_model(model, apart).await
}

/// Loads every run, and simulates those to explain.
async fn load(
    context: &WorkContext,
    plan: &Arc<DiagnosisPlan>,
    control: &Arc<Control>,
) -> Result<Input, JobError> {
    control.report("loading runs", 0.0);
    let sim = Arc::new(sim(context, plan).await?);
    let places = times(&plan.runs);
    let steps = (plan.baseline.len() + plan.runs.len()) as f64;
    let mut baseline = Vec::with_capacity(plan.baseline.len());
    for part in &plan.baseline {
        let signal = context.store.load_signal(&part.run).await?;
        let (plan, sim, part) = (Arc::clone(plan), Arc::clone(&sim), part.clone());
        let cut = move || {
            let span = |sample: u64| usize::try_from(sample.min(part.run.samples)).unwrap_or(usize::MAX);
            let whole = halves(&plan, &sim, &part.run, signal)?;
            let range = span(part.from_sample)..span(part.to_sample);
            // Only a model from before a change is held against its own runs. In situ these are searched too, beside
            // what adopted effects add to them.
            let external = plan.request.mode == Mode::External;
            let (simulated, added) = match &*sim {
                Sim::Model(predictor, effects) if external || !effects.is_empty() => {
                    let (simulated, added) = predicted(predictor, effects, &whole.x)
                        .map_err(|error| diverged(&error, &plan, &part.run))?;
                    (external.then_some(simulated), added.filter(|_| !external))
                }
                _ => (None, None),
            };
            let kept = |signal: Option<Signal>| signal.map(|signal| signal.slice(range.clone()));
            let (simulated, added) = (kept(simulated), kept(added));
            let cut = Pair { x: whole.x.slice(range.clone()), y: whole.y.slice(range.clone()) };
            let measured = measured(&plan, &sim, &part.run, &cut)?;
            Ok::<_, JobError>(diagnosis::Run { simulated, added, ..measured })
        };
        baseline.push(context.compute.run(Class::Fit, None, cut).await??);
        step(control, "loading runs", baseline.len() as f64 / steps)?;
    }
    let mut runs = Vec::with_capacity(plan.runs.len());
    for (i, run) in plan.runs.iter().enumerate() {
        let signal = context.store.load_signal(run).await?;
        let outside = match plan.simulated.get(i) {
            Some(simulated) => Some((simulated.clone(), context.store.load_signal(simulated).await?)),
            None => None,
        };
        let (plan, sim, run) = (Arc::clone(plan), Arc::clone(&sim), run.clone());
        let started_s = places[i];
        let simulate = move || {
            let whole = halves(&plan, &sim, &run, signal)?;
            let (simulated, added) = match (&*sim, outside) {
                (Sim::Model(predictor, effects), _) => {
                    predicted(predictor, effects, &whole.x).map_err(|error| diverged(&error, &plan, &run))?
                }
                (Sim::Outside, Some((row, signal))) => {
                    let names: Vec<String> = plan.responses.iter().map(|c| c.name.clone()).collect();
                    // Only the outputs of the pair are used.
                    (pair(&row, signal, &names[..1], &names)?.y, None)
                }
                (Sim::Outside, None) => unreachable!("the plan has a simulated run for each run"),
            };
            let measured = measured(&plan, &sim, &run, &whole)?;
            Ok::<_, JobError>(diagnosis::Run { simulated: Some(simulated), added, started_s, ..measured })
        };
        runs.push(context.compute.run(Class::Fit, None, simulate).await??);
        step(control, "simulating runs", (baseline.len() + runs.len()) as f64 / steps)?;
    }
    let channel = |c: &Channel| diagnosis::Channel {
        name: c.name.clone(),
        axis: c.axis.clone(),
        unit: c.unit.clone(),
        size: units::size(&c.unit),
        quantity: c.quantity,
    };
    Ok(Input {
        drives: plan.drives.iter().map(channel).collect(),
        responses: plan.responses.iter().map(channel).collect(),
        baseline,
        runs,
        roles: plan.roles.clone(),
        repeats: plan.repeats.clone(),
        // An FRF from elsewhere names no runs that it was fitted to.
        sim_is_linear: plan.model.as_ref().is_some_and(|m| {
            m.parts == ModelKind::Frf && (!m.lineage.training.is_empty() || plan.request.mode == Mode::InSitu)
        }),
        mode: plan.request.mode,
        catalogue: plan.effects.clone(),
        material_gap: plan.request.material_gap,
        drive_limit: Some(plan.drive_limit.clone()),
        seed: SEED,
    })
}

/// What a model with these effects says, and what the effects add to their linear cores.
fn predicted(
    predictor: &Predictor,
    effects: &[AddedEffect],
    x: &Signal,
) -> Result<(Signal, Option<Signal>), EngineError> {
    let without = predictor.predict(x.clone())?;
    if effects.is_empty() {
        return Ok((without, None));
    }
    apply_effects(effects, &predictor.model().preprocess.apply(x)?, without)
}

fn step(control: &Control, stage: &str, share: f64) -> Result<(), JobError> {
    control.report(stage, LOADED * share);
    if control.stopped().is_some() { Err(JobError::Stopped) } else { Ok(()) }
}

/// A run as inputs of the sim and responses to compare, as uploaded.
fn halves(plan: &DiagnosisPlan, sim: &Sim, run: &Run, signal: Signal) -> Result<Pair, JobError> {
    let channels = plan.channels();
    let inputs = match sim {
        Sim::Model(predictor, _) => &predictor.model().inputs,
        Sim::Outside => &channels.inputs,
    };
    Ok(pair(run, signal, inputs, &channels.outputs)?)
}

/// A run for the diagnosis. Drives and responses pass the model's filter, as in its fit, so that the
/// filter makes no gap.
fn measured(plan: &DiagnosisPlan, sim: &Sim, run: &Run, whole: &Pair) -> Result<diagnosis::Run, JobError> {
    let (filter, drives): (Preprocess, Vec<usize>) = match sim {
        Sim::Model(predictor, _) => {
            let model = predictor.model();
            let place = |c: &Channel| model.inputs.iter().position(|name| *name == c.name);
            (model.preprocess, plan.drives.iter().filter_map(place).collect())
        }
        Sim::Outside => (Preprocess::default(), (0..plan.drives.len()).collect()),
    };
    let refused = |error: EngineError| of_diagnosis(&error, &plan.channels());
    Ok(diagnosis::Run {
        name: run.id.to_string(),
        drive: filter.apply_to(whole.x.select(&drives)).map_err(refused)?,
        response: filter.apply(&whole.y).map_err(refused)?,
        simulated: None,
        added: None,
        started_s: 0.0,
    })
}

/// The error of a sim that diverges on a run.
fn diverged(error: &EngineError, plan: &DiagnosisPlan, run: &Run) -> JobError {
    let EngineError::NonFiniteResult { channel, sample, .. } = error else {
        return of_diagnosis(error, &plan.channels());
    };
    let name = plan.responses.get(*channel).map(|c| c.name.clone()).unwrap_or_default();
    let mut place = FieldError::new("/model", "a model that stays finite on every run").on_channel(&name);
    place.sample = Some(*sample as u64);
    let detail = format!(
        "The model's response to run {} is not finite at sample {sample} (channel {name:?}).",
        run.id
    );
    JobError::failed(
        Problem::new(422, "result.non_finite", "The result is not finite", detail).with(vec![place]),
    )
}

/// Start of each run in seconds: by `started_at` if all runs have one, else one run after the other in
/// the order of upload.
fn times(runs: &[Run]) -> Vec<f64> {
    let started: Option<Vec<f64>> =
        runs.iter().map(|run| run.started_at.map(|at| at.as_microsecond() as f64 * 1e-6)).collect();
    started.unwrap_or_else(|| {
        let before = |run: &Run| runs.iter().filter(|r| r.id < run.id).map(|r| r.duration_s).sum();
        runs.iter().map(before).collect()
    })
}

/// Runs the diagnosis on the threads for fits.
async fn diagnose(
    context: &WorkContext,
    plan: &DiagnosisPlan,
    input: Input,
    control: &Arc<Control>,
) -> Result<Diagnosis, JobError> {
    let watched = Arc::clone(control);
    let watch =
        move |p: Progress<'_>| watched.watch(Progress::new(p.stage, LOADED + (1.0 - LOADED) * p.fraction));
    let found = context.compute.run(Class::Fit, None, move || diagnosis::diagnose(&input, &watch)).await?;
    found.map_err(|error| of_diagnosis(&error, &plan.channels()))
}

/// The report in the form in which it is stored.
async fn written(
    context: &WorkContext,
    plan: &DiagnosisPlan,
    found: Diagnosis,
    started: Instant,
) -> Result<DiagnosisOutput, JobError> {
    let Diagnosis { report, views, augmented } = found;
    let (verdict, mode) = (VerdictSummary::from(&report.verdict), report.mode);
    let (fit, select) = (spans(plan, &report.data_split.fit), spans(plan, &report.data_split.select));
    let findings = Findings { report, views, augmented, fit, select };
    let encode = move || {
        let bytes = serde_json::to_vec(&findings)?;
        // JSON has no NaN, so a report with one could not be read back and must not be stored.
        serde_json::from_slice::<Findings>(&bytes)?;
        Ok::<_, serde_json::Error>(bytes)
    };
    let findings = context.compute.run(Class::Fit, None, encode).await?.map_err(|error| {
        tracing::error!(%error, "a diagnosis cannot be written: this is a bug");
        let detail = "A number of the report is not finite; the report is not stored.";
        JobError::failed(Problem::new(422, "result.non_finite", "The result is not finite", detail))
    })?;
    let model = plan.model.as_ref();
    let stage = last_words(&verdict, mode);
    let diagnosis = NewDiagnosis {
        model: model.map(|m| UsedModel { version: m.version, sha256: m.sha256.clone() }),
        request: plan.request.clone(),
        verdict,
        findings: Bytes::from(findings),
        elapsed_s: started.elapsed().as_secs_f64(),
    };
    Ok(DiagnosisOutput { diagnosis, stage })
}

/// Parts of runs as a lineage names them.
fn spans(plan: &DiagnosisPlan, parts: &[RunPart]) -> Vec<Span> {
    let of = |part: &RunPart| {
        let run = plan.runs.iter().find(|run| run.id.to_string() == part.run)?;
        let sample = |seconds: f64| ((seconds * run.sample_rate_hz).round() as u64).min(run.samples);
        let (from_sample, to_sample) = (sample(part.from_s), sample(part.to_s));
        Some(Span { run: run.id, sha256: run.sha256.clone(), from_sample, to_sample })
    };
    parts.iter().filter_map(of).collect()
}

/// The last stage text of a job, about its verdict.
fn last_words(verdict: &VerdictSummary, mode: Mode) -> String {
    let kind = match verdict.kind {
        VerdictKind::Identified => "identified",
        VerdictKind::Partial => "partly explained",
        VerdictKind::FamilyOnly => "family only",
        VerdictKind::NotDistinguishable => "not distinguishable",
        VerdictKind::NoneOfCatalogue => "none of the catalogue",
        VerdictKind::Undecided => "undecided",
        VerdictKind::NoiseOrUnmeasuredDisturbance => "noise or an unmeasured disturbance",
        VerdictKind::NoMaterialGap => "no material gap",
    };
    let effect = verdict.effect.map(|effect| format!(": {}", effect.name())).unwrap_or_default();
    let channel = verdict.channel.as_ref().map(|c| format!(" on {c}")).unwrap_or_default();
    let mode = if mode == Mode::External { "external" } else { "in situ" };
    format!("{kind}{effect}{channel} ({mode}, probability {:.2})", verdict.probability)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::domain::{RunKind, Split};
    use crate::jobs::fit_plan::testing::run;

    #[test]
    fn a_run_without_a_start_takes_its_place_by_upload() {
        let mut runs = [
            run(3, RunKind::Noise, Split::Training, 1000),
            run(1, RunKind::Noise, Split::Training, 500),
            run(2, RunKind::Noise, Split::Training, 200),
        ];
        let seconds = |runs: &[Run]| -> Vec<f64> { runs.iter().map(|r| r.duration_s).collect() };
        let lens = seconds(&runs);
        assert_eq!(times(&runs), [lens[1] + lens[2], 0.0, lens[1]]);
        for (run, at) in runs.iter_mut().zip(["2026-03-01T12:00:00Z", "2026-03-01T11:00:00Z"]) {
            run.started_at = Some(at.parse().unwrap());
        }
        assert_eq!(times(&runs)[2], lens[1], "one without: all by upload");
        runs[2].started_at = runs[0].started_at;
        let found = times(&runs);
        assert_eq!((found[0] - found[1], found[2]), (3600.0, found[0]));
    }
}
