//! The fit job: runs in, a model version out.

use std::sync::Arc;
use std::time::Duration;

use bytes::Bytes;

use crate::compute::Class;
use crate::domain::fits::FitRequest;
use crate::domain::{JobId, Lineage, Origin, Rig, Run, Span, faults_of_runs};
use crate::engine::checkpoint::CheckpointStore;
use crate::engine::model::{
    FitData, FitReport, FitSettings, Fitted, LstmPart, Pair, RigModel, SplitRule, to_safetensors,
};
use crate::engine::simd::Isa;
use crate::engine::{EngineError, Signal, Watch};
use crate::storage::{Digest, NewModel, StoreError};

use super::activate;
use super::control::Control;
use super::helping::OPENED;
use super::problem::{JobError, of_engine};
use super::seed_shares::SeedShares;
use super::spec::{JobSpec, ModelOutput};
use super::work_context::WorkContext;
use super::{core_version, memory, warm_start};

pub use super::fit_plan::{FitPlan, FitProblem, check};

/// The engine's fit; tests of the runner replace it.
pub(super) type FitFunction =
    fn(&FitData, &FitSettings, &dyn CheckpointStore, Watch<'_>) -> Result<Fitted, EngineError>;

impl From<FitProblem> for JobError {
    fn from(problem: FitProblem) -> Self {
        match problem {
            FitProblem::Store(error) => error.into(),
            // Others may give memory back.
            FitProblem::Memory { needed, limit, .. } if needed <= limit => Self::retry(problem.problem()),
            problem => Self::failed(problem.problem()),
        }
    }
}

/// Does a fit job, from the request to a model that is ready to be published.
pub(super) async fn make(
    context: &WorkContext,
    spec: &JobSpec,
    control: &Arc<Control>,
) -> Result<ModelOutput, JobError> {
    let request: FitRequest = spec.request()?;
    let rig = context.store.rig(&spec.rig).await?.ok_or(FitProblem::RigGone)?;
    fit_model(context, &rig, &request, (spec.job, spec.helps.then_some(OPENED)), control).await
}

/// Fits a model for a job, to a version that is ready to be published. For a job of another worker that this one helps
/// with it waits for so long for networks that it is given, and trains them; there is no model.
pub(super) async fn fit_model(
    context: &WorkContext,
    rig: &Rig,
    request: &FitRequest,
    (job, helps): (JobId, Option<Duration>),
    control: &Arc<Control>,
) -> Result<ModelOutput, JobError> {
    // Checked again, because runs may have come and gone since the job was queued.
    let mut plan = check(&context.store, rig, request).await?;
    memory::check_now(&plan, context.memory_bytes)?;
    control.report("loading runs", 0.0);
    let given = GivenParts::load(context, &mut plan).await?;
    let isa = Isa::of_process().map_err(|error| of_engine(&error, &plan.channels()))?;
    let (work, every) = ((job, fingerprint(&plan, isa)), context.checkpoint_every);
    let shares = SeedShares::open(&context.store, work, every, control, helps.is_some()).await?;
    if let Some(patience) = helps {
        shares.wait_for_offer(patience).await?;
    }
    let data = load(context, &plan, control).await?;
    let (fitted, weights) = fit(context, (&plan, &given), data, shares, control).await?;
    if helps.is_some() {
        return Err(JobError::Stopped);
    }
    let Fitted { model, mut report, record } = fitted;
    tell_of_split(&plan, &mut report);
    let runs: Vec<&Run> = plan.training.iter().chain(plan.frf_only()).chain(&plan.validation).collect();
    report.warnings.extend(faults_of_runs(&runs, plan.inputs.iter().chain(&plan.outputs)));
    let lineage = plan.lineage(report.comparison.as_ref().is_some_and(|c| c.refitted));
    tell_of_seen(&lineage, &mut report);
    let model = Arc::new(model);
    control.report("comparing with the active model", 1.0);
    let activate::Decision { activation, why } = activate::decide(
        context,
        rig,
        &plan,
        activate::Candidate { model: &model, report: &report, lineage: &lineage },
        control,
    )
    .await?;
    let model = NewModel {
        kind: model.kind,
        adoption: None,
        inputs: model.inputs.clone(),
        outputs: model.outputs.clone(),
        sample_rate_hz: model.sample_rate_hz,
        weights,
        origin: Origin::Fit,
        job: Some(job),
        request: Some(plan.request.clone()),
        report: Some(report),
        record: Some(record),
        frf: model.frf_summary(),
        lineage,
        instruction_set: isa.name().into(),
    };
    Ok(ModelOutput { model, activation, why })
}

/// Notes the reason if the data were divided in an unusual way.
fn tell_of_split(plan: &FitPlan, report: &mut FitReport) {
    let (Some(why), Some(comparison)) = (&plan.split_reason, &mut report.comparison) else { return };
    comparison.reason = Some(why.clone());
    if comparison.rule == SplitRule::LastTenths {
        report.warnings.push(format!(
            "no whole run was left out to compare models: {why}; the last tenth of each run compares them"
        ));
    }
}

/// Warns if the version that the training began at, or the core, has seen data that compare the model.
fn tell_of_seen(lineage: &Lineage, report: &mut FitReport) {
    let compares = |seen: &[Span]| lineage.validation.iter().any(|v| seen.iter().any(|s| s.overlaps(v)));
    let start = lineage.start.as_ref().filter(|start| compares(&start.seen));
    let start = start.map(|start| format!("{}, at which the training began,", start.version));
    let core = lineage.core.as_ref().filter(|core| compares(&core.seen));
    let core = core.and_then(|core| core.version).map(|version| format!("{version}, the core,"));
    for version in start.into_iter().chain(core) {
        report.warnings.push(format!(
            "model version {version} has seen data that compare this model: its errors on them \
             are too small, and they activate nothing; leave out a run that the version has not seen"
        ));
    }
}

/// Loads every run once and cuts it to the fit's channels.
pub(super) async fn load(
    context: &WorkContext,
    plan: &FitPlan,
    control: &Control,
) -> Result<FitData, JobError> {
    let load = async |runs: Vec<&Run>| -> Result<Vec<Pair>, JobError> {
        let mut pairs = Vec::new();
        for run in runs {
            if control.stopped().is_some() {
                return Err(JobError::Stopped);
            }
            let signal = context.store.load_signal(run).await?;
            pairs.push(pair(run, signal, &plan.inputs, &plan.outputs)?);
        }
        Ok(pairs)
    };
    Ok(FitData {
        training: load(plan.training.iter().collect()).await?,
        validation: load(plan.validation.iter().collect()).await?,
        frf_only: load(plan.frf_only().collect()).await?,
        frf: plan.frf_places(),
        split: plan.split.clone(),
    })
}

/// A run as inputs and outputs, in the order of `inputs` and `outputs`.
pub(super) fn pair(
    run: &Run,
    signal: Signal,
    inputs: &[String],
    outputs: &[String],
) -> Result<Pair, StoreError> {
    let place = |name: &String| {
        run.channels.iter().position(|channel| channel == name).ok_or_else(|| StoreError::Row {
            table: "runs",
            key: run.id.to_string(),
            what: format!("it was checked to hold channel {name:?}"),
        })
    };
    let inputs: Vec<usize> = inputs.iter().map(place).collect::<Result<_, _>>()?;
    let outputs: Vec<usize> = outputs.iter().map(place).collect::<Result<_, _>>()?;
    let bad = |error: EngineError| StoreError::Row {
        table: "runs",
        key: run.id.to_string(),
        what: error.to_string(),
    };
    // Samples are moved, not copied, because hours of runs take much memory.
    let rate = signal.sample_rate_hz();
    let mut channels = signal.into_channels();
    let mut select = |places: &[usize], later: &[usize]| {
        let select = places.iter().enumerate().map(|(i, &place)| {
            let again = later.contains(&place) || places[i + 1..].contains(&place);
            if again { channels[place].clone() } else { std::mem::take(&mut channels[place]) }
        });
        Signal::new(rate, select.collect()).map_err(bad)
    };
    Ok(Pair { x: select(&inputs, &outputs)?, y: select(&outputs, &[])? })
}

/// The parts of other versions that a fit begins with or builds on.
#[derive(Debug, Clone, Default)]
pub(super) struct GivenParts {
    /// The network that the training begins at.
    start: Option<LstmPart>,
    /// The core in place of the FRF.
    core: Option<RigModel>,
}

impl GivenParts {
    /// Reads the parts of a plan. Blocks that are still open become those of the network.
    pub(super) async fn load(context: &WorkContext, plan: &mut FitPlan) -> Result<Self, JobError> {
        Ok(Self {
            start: warm_start::load(context, plan).await?,
            core: core_version::load(context, plan).await?,
        })
    }
}

pub(super) fn settings(plan: &FitPlan, given: &GivenParts) -> FitSettings {
    FitSettings {
        kind: plan.request.kind,
        task: plan.task,
        inputs: plan.inputs.clone(),
        outputs: plan.outputs.clone(),
        preprocess: plan.request.preprocess,
        frf: plan.request.frf.settings(plan.request.preset),
        lstm: plan.request.lstm.clone(),
        preset: plan.request.preset,
        start: given.start.clone(),
        core: given.core.clone(),
    }
}

/// Digest of all that a fit depends on. Checkpoints of another program, other settings or other data are
/// of no use.
pub(super) fn fingerprint(plan: &FitPlan, isa: Isa) -> String {
    let all = (crate::VERSION, isa.name(), &plan.request, plan.lineage(false));
    let json = serde_json::to_vec(&all).expect("a request and a lineage always serialise");
    Digest::of(&json).as_str().to_owned()
}

/// Fits on the threads for fits, and writes the weights there too.
async fn fit(
    context: &WorkContext,
    (plan, given): (&FitPlan, &GivenParts),
    data: FitData,
    shares: SeedShares,
    control: &Arc<Control>,
) -> Result<(Fitted, Bytes), JobError> {
    let (settings, watched, function) = (settings(plan, given), Arc::clone(control), context.fit);
    let started = std::time::Instant::now();
    let shares = Arc::new(shares);
    let checkpoints = Arc::clone(&shares);
    let work = context.compute.run(Class::Fit, None, move || {
        let fitted = function(&data, &settings, &*checkpoints, &|progress| watched.watch(progress))?;
        let weights = Bytes::from(to_safetensors(&fitted.model));
        Ok((fitted, weights))
    });
    let fitted = tokio::select! {
        fitted = work => fitted,
        never = shares.tend() => match never {},
    };
    shares.leave();
    let fitted = fitted?;
    let fitted = fitted.map_err(|error| of_engine(&error, &plan.channels()))?;
    let seconds = started.elapsed().as_secs_f64();
    tracing::info!(fit.kind = ?plan.request.kind, fit.seconds = seconds, "fitted a model");
    Ok(fitted)
}

/// Whether the fit's model can be the rig's active one.
pub(super) fn is_forward(rig: &Rig, plan: &FitPlan) -> bool {
    crate::domain::model::is_forward(rig, &plan.inputs, &plan.outputs)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::domain::{RunKind, Split};
    use crate::jobs::fit_plan::testing::run;

    #[test]
    fn a_run_is_cut_to_its_channels_in_their_order_even_if_one_is_on_both_sides() {
        let mut run = run(1, RunKind::Noise, Split::Training, 2);
        run.channels = ["a", "b", "c"].map(String::from).to_vec();
        let samples = |v: f64| vec![v, v + 0.5];
        let signal = Signal::new(100.0, vec![samples(1.0), samples(2.0), samples(3.0)]).unwrap();
        let names = |names: &[&str]| names.iter().map(|n| (*n).to_owned()).collect::<Vec<_>>();
        let found = pair(&run, signal.clone(), &names(&["c", "a"]), &names(&["b", "a"])).unwrap();
        assert_eq!(found, Pair { x: signal.select(&[2, 0]), y: signal.select(&[1, 0]) });
        assert!(pair(&run, signal, &names(&["d"]), &names(&["a"])).is_err());
    }
}
