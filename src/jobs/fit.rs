//! The fit job: runs in, a model version out.

use std::collections::HashMap;
use std::collections::hash_map::Entry;
use std::sync::Arc;

use bytes::Bytes;

use crate::compute::Class;
use crate::domain::fits::FitRequest;
use crate::domain::{Origin, Rig, Run};
use crate::engine::checkpoint::Keeper;
use crate::engine::model::{
    FitData, FitReport, FitSettings, Fitted, Pair, RigModel, Validation, to_safetensors,
};
use crate::engine::simd::Isa;
use crate::engine::{EngineError, Signal, Watch};
use crate::storage::{Digest, NewModel, StoreError};

use super::activate;
use super::control::Control;
use super::order::{MadeModel, Order};
use super::problem::{JobError, of_engine};
use super::shelf::Shelf;
use super::workbench::Workbench;

pub use super::fit_plan::{FitPlan, FitProblem, check};

/// The engine's fit; tests of the runner put others in its place.
pub(super) type FitFunction =
    fn(&FitData, &FitSettings, &dyn Keeper, Watch<'_>) -> Result<Fitted, EngineError>;

impl From<FitProblem> for JobError {
    fn from(problem: FitProblem) -> Self {
        match problem {
            FitProblem::Store(error) => error.into(),
            problem => Self::failed(problem.problem()),
        }
    }
}

/// Fits, from the request to a model that is ready to be published.
pub(super) async fn make(
    bench: &Workbench,
    order: &Order,
    control: &Arc<Control>,
) -> Result<MadeModel, JobError> {
    let request: FitRequest = order.request()?;
    let rig = bench.store.rig(&order.rig).await?.ok_or(FitProblem::RigGone)?;
    // Again, because runs came and went since it was queued.
    let plan = check(&bench.store, &rig, &request).await?;
    control.report("loading runs", 0.0);
    let data = load(bench, &plan, control).await?;
    let isa = Isa::of_process().map_err(|error| of_engine(&error, &plan.channels()))?;
    let (store, every) = (&bench.store, bench.checkpoint_every);
    let shelf = Shelf::open(store, order.job, fingerprint(&plan, isa), every, control).await?;
    let (model, report, weights) = fit(bench, &plan, data, shelf, control).await?;
    let model = Arc::new(model);
    control.report("comparing with the active model", 1.0);
    let activate::Decision { activation, why } =
        activate::decide(bench, &rig, &plan, &model, control).await?;
    let model = NewModel {
        kind: model.kind,
        inputs: model.inputs.clone(),
        outputs: model.outputs.clone(),
        sample_rate_hz: model.sample_rate_hz,
        weights,
        origin: Origin::Fit,
        job: Some(order.job),
        request: Some(plan.request.clone()),
        report: Some(report),
        lineage: plan.lineage(),
        instruction_set: isa.name().into(),
    };
    Ok(MadeModel { model, activation, why })
}

/// Loads every run once and cuts it to the fit's channels.
async fn load(bench: &Workbench, plan: &FitPlan, control: &Control) -> Result<FitData, JobError> {
    // Each run with the number of its uses.
    let mut pairs: HashMap<_, (Pair, usize)> = HashMap::new();
    let runs = plan.training.iter().chain(plan.frf.iter().flatten()).chain(&plan.validation);
    for run in runs {
        if control.stopped().is_some() {
            return Err(JobError::Stopped);
        }
        match pairs.entry(run.id) {
            Entry::Vacant(place) => {
                let signal = bench.store.load_signal(run).await?;
                place.insert((pair(run, signal, &plan.inputs, &plan.outputs)?, 1));
            }
            Entry::Occupied(mut place) => place.get_mut().1 += 1,
        }
    }
    // Only a run that is used twice is copied: all together they may be gigabytes.
    Ok(assemble(plan, |run| match pairs.entry(run.id) {
        Entry::Occupied(mut place) if place.get().1 > 1 => {
            place.get_mut().1 -= 1;
            place.get().0.clone()
        }
        Entry::Occupied(place) => place.remove().0,
        Entry::Vacant(_) => unreachable!("every run was loaded as often as it is used"),
    }))
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
    // Samples are moved, not copied: hours of runs fill memory as it is.
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

/// Splits the runs as the plan's lineage says.
fn assemble(plan: &FitPlan, mut load: impl FnMut(&Run) -> Pair) -> FitData {
    let mut validation: Vec<Validation> =
        plan.validation.iter().map(|run| Validation { pair: load(run), score_from: 0 }).collect();
    let mut training = Vec::with_capacity(plan.training.len());
    for run in &plan.training {
        let whole = load(run);
        if plan.validation.is_empty() {
            let (kept, held_out) = whole.hold_out();
            training.push(kept);
            // A run of less than ten samples has nothing to hold out.
            if held_out.score_from < held_out.pair.x.n_samples() {
                validation.push(held_out);
            }
        } else {
            training.push(whole);
        }
    }
    let until = |run: &Run| usize::try_from(plan.frf_until(run)).unwrap_or(usize::MAX);
    let cut = |run: &Run| {
        let (end, whole) = (until(run), load(run));
        Pair { x: whole.x.truncated(end), y: whole.y.truncated(end) }
    };
    let frf = plan.frf.as_ref().map(|runs| runs.iter().map(cut).collect());
    FitData { training, frf, validation }
}

fn settings(plan: &FitPlan) -> FitSettings {
    FitSettings {
        kind: plan.request.kind,
        inputs: plan.inputs.clone(),
        outputs: plan.outputs.clone(),
        preprocess: plan.request.preprocess,
        frf: plan.request.frf.settings(),
        lstm: plan.request.lstm.clone(),
        preset: plan.request.preset,
    }
}

/// Digest of all that a fit's course depends on: of another program, other settings or other data
/// no checkpoint is of use.
fn fingerprint(plan: &FitPlan, isa: Isa) -> String {
    let all = (env!("CARGO_PKG_VERSION"), isa.name(), &plan.request, plan.lineage());
    let json = serde_json::to_vec(&all).expect("a request and a lineage always serialise");
    Digest::of(&json).as_str().to_owned()
}

/// Fits on the threads for fits, and writes the weights there too.
async fn fit(
    bench: &Workbench,
    plan: &FitPlan,
    data: FitData,
    shelf: Shelf,
    control: &Arc<Control>,
) -> Result<(RigModel, FitReport, Bytes), JobError> {
    let (settings, watched, function) = (settings(plan), Arc::clone(control), bench.fit);
    let started = std::time::Instant::now();
    let fitted = bench
        .compute
        .run(Class::Fit, None, move || {
            let fitted = function(&data, &settings, &shelf, &|progress| watched.watch(progress))?;
            let weights = Bytes::from(to_safetensors(&fitted.model));
            Ok((fitted.model, fitted.report, weights))
        })
        .await?;
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
    use crate::jobs::fit_plan::testing::{plan_of, run};

    /// A run whose samples count up, so that a cut shows.
    fn ramp(run: &Run) -> Pair {
        let n = u32::try_from(run.samples).unwrap();
        let ramp = Signal::new(100.0, vec![(0..n).map(f64::from).collect()]).unwrap();
        Pair { x: ramp.clone(), y: ramp }
    }

    fn last(pair: &Pair) -> f64 {
        *pair.x.channel(0).last().unwrap()
    }

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

    #[test]
    fn without_validation_runs_each_training_run_gives_its_last_tenth() {
        let runs =
            [run(1, RunKind::Noise, Split::Training, 1000), run(2, RunKind::Noise, Split::Training, 9)];
        let plan = plan_of(&runs, r#"{"kind": "frf"}"#).unwrap();
        let data = assemble(&plan, ramp);
        assert_eq!(data.training.iter().map(last).collect::<Vec<_>>(), [899.0, 8.0]);
        assert_eq!(data.validation.len(), 1, "nine samples have no tenth");
        let held_out = &data.validation[0];
        assert_eq!(held_out.pair.x.channel(0)[held_out.score_from], 900.0);
        assert_eq!(last(&held_out.pair), 999.0);
    }

    #[test]
    fn frf_runs_that_are_held_out_are_cut_at_the_same_sample() {
        let mut linear = run(2, RunKind::Noise, Split::Training, 500);
        linear.tags = vec!["linear".into()];
        let runs = [run(1, RunKind::Noise, Split::Training, 1000), linear];
        let plan = plan_of(&runs, r#"{"kind": "hybrid2", "frf": {"runs": {"tags": ["linear"]}}}"#).unwrap();
        let data = assemble(&plan, ramp);
        assert_eq!(data.frf.unwrap().iter().map(last).collect::<Vec<_>>(), [449.0]);
        // Trained on other runs only, they are whole.
        let request = format!(
            r#"{{"kind": "hybrid2", "runs": ["{}"], "frf": {{"runs": {{"tags": ["linear"]}}}}}}"#,
            runs[0].id
        );
        let plan = plan_of(&runs, &request).unwrap();
        assert_eq!(assemble(&plan, ramp).frf.unwrap().iter().map(last).collect::<Vec<_>>(), [499.0]);
    }

    #[test]
    fn what_is_loaded_is_what_the_lineage_says() {
        let mut linear = run(2, RunKind::Noise, Split::Training, 500);
        linear.tags = vec!["linear".into()];
        let runs = [run(1, RunKind::Noise, Split::Training, 1000), linear];
        let plan = plan_of(&runs, r#"{"kind": "hybrid1", "frf": {"runs": {"tags": ["linear"]}}}"#).unwrap();
        let (data, lineage) = (assemble(&plan, ramp), plan.lineage());
        let ends = |pairs: &[Pair]| pairs.iter().map(|p| p.x.n_samples() as u64).collect::<Vec<_>>();
        let spans = |spans: &[crate::domain::Span]| {
            spans.iter().map(|span| span.to_sample - span.from_sample).collect::<Vec<_>>()
        };
        assert_eq!(ends(&data.training), spans(&lineage.training));
        assert_eq!(ends(&data.frf.unwrap()), spans(&lineage.frf));
        let scored = |v: &Validation| (v.pair.x.n_samples() - v.score_from) as u64;
        assert_eq!(data.validation.iter().map(scored).collect::<Vec<_>>(), spans(&lineage.validation));
        assert!(!lineage.validation.iter().any(|span| lineage.was_trained_on(span)));
    }
}
