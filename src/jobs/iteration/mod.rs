//! The iteration job: a target and a model in, a drive out.

mod plan;
mod problem;

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Instant;

use crate::compute::Class;
use crate::domain::iteration::{IterationReport, IterationStep, StartDrive};
use crate::domain::{IterationRequest, ModelRef, Run, UsedModel};
use crate::engine::iteration::{Found, Problem as Wanted, Start, Step, Stopped, iterate};
use crate::engine::metrics::{ChannelErrors, errors};
use crate::engine::model::Predictor;
use crate::engine::{EngineError, Progress, Signal, rounded};
use crate::storage::NewIteration;

use super::control::Control;
use super::fit::pair;
use super::problem::JobError;
use super::spec::{IterationOutput, JobSpec};
use super::work_context::WorkContext;
use plan::IterationPlan;
use problem::of_iteration;

pub(super) use plan::{TargetOutline, check, check_for};
pub use problem::IterationProblem;

/// Share of a target's power out of the corrections' reach above which the report warns.
const OUT_OF_REACH: f64 = 1e-3;

/// Share of samples inside what the model was fitted on below which the report warns.
const INSIDE: f64 = 0.999;

/// Does an iteration, from the request to a drive that is ready to be stored.
pub(super) async fn make(
    context: &WorkContext,
    spec: &JobSpec,
    control: &Arc<Control>,
) -> Result<IterationOutput, JobError> {
    let started = Instant::now();
    let mut request: IterationRequest = spec.request()?;
    let rig = context.store.rig(&spec.rig).await?.ok_or(IterationProblem::RigGone)?;
    // Checked again, because runs and models may have gone since the job was queued.
    let (plan, target) = check(&context.store, &rig, &request).await?;
    request.model = ModelRef::Version(plan.model.version);
    let plan = Arc::new(plan);
    control.report("loading the target", 0.0);
    let model = context.read_model(&plan.model, Ok).await?;
    let target = signal(context, &target, &plan.channels).await?;
    let start = match (&plan.start, request.start) {
        (Some(run), _) => Start::Drive(signal(context, run, &plan.model.inputs).await?),
        (None, StartDrive::Zero) => Start::Zero,
        (None, _) => Start::Inverse,
    };
    let (planned, watched, settings) = (Arc::clone(&plan), Arc::clone(control), request.settings());
    let search = move || {
        let watch = move |progress: Progress<'_>| watched.watch(progress);
        let refused = |error: EngineError| of_iteration(&error, &planned);
        let predictor = Predictor::new(model).map_err(refused)?;
        let wanted = Wanted {
            predictor: &predictor,
            outputs: &planned.outputs,
            target: &target,
            weights: &planned.weights,
            gains: &planned.gains,
            limits: &planned.limits,
        };
        let found = iterate(&wanted, &start, &settings, &watch).map_err(refused)?;
        let compared = predictor.model().preprocess.apply(&target).map_err(refused)?;
        let errors = errors(&compared, &found.response.select(&planned.outputs)).map_err(refused)?;
        Ok::<_, JobError>((report(&planned, &found, &errors.channels), found.drive))
    };
    let (report, drive) = context.compute.run(Class::Fit, None, search).await??;
    let stage = last_words(&report);
    let model = UsedModel { version: plan.model.version, sha256: plan.model.sha256.clone() };
    let iteration = NewIteration {
        model,
        request,
        report,
        elapsed_s: started.elapsed().as_secs_f64(),
        name: plan.name.clone(),
        drives: plan.model.inputs.clone(),
        samples: NewIteration::bytes_of(&drive),
    };
    Ok(IterationOutput { iteration, stage })
}

/// Some channels of a run.
async fn signal(context: &WorkContext, run: &Run, channels: &[String]) -> Result<Signal, JobError> {
    let whole = context.store.load_signal(run).await?;
    // Only the outputs of the pair are used.
    Ok(pair(run, whole, &channels[..1], channels)?.y)
}

fn named<T>(names: &[String], values: impl IntoIterator<Item = T>) -> BTreeMap<String, T> {
    names.iter().cloned().zip(values).collect()
}

fn report(plan: &IterationPlan, found: &Found, errors: &[ChannelErrors]) -> IterationReport {
    let (targets, drives) = (&plan.channels, &plan.model.inputs);
    let step = |step: &Step| IterationStep {
        iteration: step.iteration,
        kind: step.kind,
        errors: named(targets, step.error.clone()),
        total_error: step.total_error,
        damage: named(targets, step.damage.clone()),
        inside: step.inside,
        drive_peak: named(drives, step.drive_peak.clone()),
        limited: named(drives, step.limited.clone()),
        gain: step.gain,
        better: step.better,
    };
    IterationReport {
        stopped: found.stopped,
        best: found.best,
        errors: named(targets, errors.iter().copied()),
        band_hz: found.band_hz,
        out_of_reach: named(targets, found.out_of_reach.clone()),
        linear_part: found.linear,
        warnings: warnings(plan, found),
        steps: found.steps.iter().map(step).collect(),
    }
}

/// What an engineer should know before the drive goes to the rig.
fn warnings(plan: &IterationPlan, found: &Found) -> Vec<String> {
    let percent = |share: f64| rounded(100.0 * share, 3);
    let mut warnings = Vec::new();
    if found.stopped == Stopped::Diverged {
        warnings.push(format!(
            "The iteration diverged: the last corrections made the error larger, whatever the gain. The drive is that of \
             iteration {}, the best.",
            found.best
        ));
    }
    if let Some([from, to]) = found.band_hz {
        for (name, share) in plan.channels.iter().zip(&found.out_of_reach) {
            if *share > OUT_OF_REACH {
                warnings.push(format!(
                    "{} % of the power of {name} lies where the FRF is not reliable (outside {} to {} Hz, or of low \
                     coherence): no correction reaches it.",
                    percent(*share),
                    rounded(from, 4),
                    rounded(to, 4)
                ));
            }
        }
    }
    let best = found.steps.iter().find(|step| step.iteration == found.best);
    if let Some(best) = best {
        if best.inside < INSIDE {
            warnings.push(format!(
                "The drive is inside what the model was fitted on for {} % of the time only: predict it, and see the spans \
                 under trust, before it goes to the rig.",
                percent(best.inside)
            ));
        }
        for (name, share) in plan.model.inputs.iter().zip(&best.limited) {
            if *share > 0.0 {
                warnings.push(format!("The limits of {name} changed {} % of its samples.", percent(*share)));
            }
        }
    }
    warnings
}

/// The last stage text of the job.
fn last_words(report: &IterationReport) -> String {
    let error = report
        .steps
        .iter()
        .find(|step| step.iteration == report.best)
        .map_or(0.0, |step| rounded(100.0 * step.total_error, 3));
    let why = match report.stopped {
        Stopped::Error => "the error is as small as was asked for",
        Stopped::DamageRatio => "the damage ratios are as was asked for",
        Stopped::Iterations => "as many iterations as were asked for",
        Stopped::Settled => "further iterations gain nothing",
        Stopped::Diverged => "further iterations make it worse",
    };
    format!("error {error} % after iteration {}: {why}", report.best)
}
