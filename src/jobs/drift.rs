//! Predicts runs by the active models of their rigs, one after the other and at the lowest priority, and stores their
//! errors. What waits is in the store: after a restart it goes on where it was.

use std::collections::HashMap;
use std::collections::hash_map::Entry;
use std::ops::ControlFlow;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use tokio::sync::{Notify, watch};
use tokio::task::JoinHandle;

use crate::compute::{Class, Compute};
use crate::domain::drift::{ControlLimit, DueRun, Judgement, NotPredicted, Outcome};
use crate::domain::evaluation::Omission;
use crate::domain::{Clock, Model, Run, RunId, RunKind};
use crate::engine::model::Squares;
use crate::engine::{EngineError, Signal};
use crate::models::{LoadedModel, ModelError, Models};
use crate::storage::{Store, StoreError};

use super::evaluation::comparable;
use super::predicted::{needed, predicted, seen};

/// How often the store is asked for runs that nobody has announced: those of a model that a fit has made active.
const SWEEP: Duration = Duration::from_secs(5);

/// Most samples in memory at once, inputs, outputs and measurements of the prediction together: 256 MiB. Of a longer
/// run the first part is predicted.
const MAX_VALUES: u64 = 1 << 25;

/// Why a run could not be judged now.
#[derive(Debug, thiserror::Error)]
enum NotNow {
    #[error(transparent)]
    Store(#[from] StoreError),
    #[error(transparent)]
    Model(#[from] ModelError),
    #[error("the service stops")]
    Stopping,
}

/// The watch over all rigs. Clones share it.
#[derive(Debug, Clone)]
pub struct DriftWatch {
    inner: Arc<Inner>,
    task: Arc<Mutex<Option<JoinHandle<()>>>>,
}

#[derive(Debug)]
struct Inner {
    store: Store,
    compute: Compute,
    models: Models,
    clock: Clock,
    due: Notify,
    stopping: watch::Sender<bool>,
}

impl DriftWatch {
    /// Starts to watch.
    pub fn start(store: Store, compute: Compute, models: Models, clock: Clock) -> Self {
        let (due, stopping) = (Notify::new(), watch::channel(false).0);
        let inner = Arc::new(Inner { store, compute, models, clock, due, stopping });
        let task = tokio::spawn(Arc::clone(&inner).watch());
        Self { inner, task: Arc::new(Mutex::new(Some(task))) }
    }

    /// Tells that a run or an active model has come.
    pub fn wake(&self) {
        self.inner.due.notify_one();
    }

    /// Stops, and returns when the prediction under way has ended; its run waits for the next start.
    pub async fn shutdown(&self) {
        self.inner.stopping.send_replace(true);
        let task = self.task.lock().unwrap_or_else(PoisonError::into_inner).take();
        if let Some(Err(error)) = match task {
            Some(task) => Some(task.await),
            None => None,
        } {
            tracing::error!(%error, "the watch over active models ended badly");
        }
    }
}

impl Inner {
    async fn watch(self: Arc<Self>) {
        let mut stopping = self.stopping.subscribe();
        while !*stopping.borrow() {
            // Created before the store is read, so that no notification is missed.
            let due = self.due.notified();
            match self.pass().await {
                Ok(0) => {}
                Ok(_) => continue,
                Err(error) => {
                    error.count();
                    tracing::error!(%error, "the runs that wait for a prediction could not be read");
                }
            }
            tokio::select! {
                () = due => {}
                _ = stopping.wait_for(|stopping| *stopping) => {}
                () = tokio::time::sleep(SWEEP) => {}
            }
        }
    }

    /// Judges one run of each rig that has one waiting, so that no rig waits for all runs of another. Returns how many.
    async fn pass(&self) -> Result<usize, StoreError> {
        let mut judged = 0;
        let Some(_turn) = self.store.drift_turn().await? else { return Ok(0) };
        for due in self.store.due_runs().await? {
            if *self.stopping.borrow() {
                return Ok(0);
            }
            match self.judge(&due).await {
                Ok(()) => judged += 1,
                Err(NotNow::Stopping) => return Ok(0),
                // A model that cannot be read shows as degraded; the run waits until it can.
                Err(error) => {
                    tracing::debug!(rig.id = %due.rig, run.id = %due.run, %error, "a run could not be judged");
                }
            }
        }
        Ok(judged)
    }

    async fn judge(&self, due: &DueRun) -> Result<(), NotNow> {
        let (Some(model), Some(run)) =
            (self.store.model(&due.rig, due.version).await?, self.store.run(&due.rig, due.run).await?)
        else {
            return Ok(());
        };
        let outcome = match to_predict(&model, &run) {
            Ok(outputs) => self.predict(&model, &run, outputs).await?,
            Err(reason) => Some(Outcome::Omitted(reason)),
        };
        if let Some(outcome) = outcome {
            self.store.insert_drift(due, &outcome, (self.clock)()).await?;
        }
        Ok(())
    }

    /// The errors of a model on the outputs that a run holds; `None` if the model is gone.
    async fn predict(
        &self,
        model: &Model,
        run: &Run,
        outputs: Vec<usize>,
    ) -> Result<Option<Outcome>, NotNow> {
        let Some(loaded) = self.models.version(&model.rig, model.version).await? else { return Ok(None) };
        let names = needed(model, &outputs);
        let in_memory = 2 * model.inputs.len() + model.outputs.len() + 2 * outputs.len() + names.len();
        let samples = run.samples.min(MAX_VALUES / in_memory as u64);
        let columns = names.iter().filter_map(|name| run.channels.iter().position(|held| held == name));
        let signal = match self.store.load_stretch(run, columns.collect(), 0..samples).await {
            Ok(signal) => signal,
            Err(error @ (StoreError::ObjectDamaged { .. } | StoreError::ObjectMissing { .. })) => {
                tracing::warn!(run.id = %run.id, %error, "a run cannot be judged");
                return Ok(Some(Outcome::Omitted(NotPredicted::Unreadable)));
            }
            Err(error) => return Err(error.into()),
        };
        let stopping = self.stopping.subscribe();
        let work = move || errors(&loaded, &signal, &names, &outputs, &stopping);
        let work = self.compute.run(Class::Fit, None, work).await.map_err(ModelError::from)?;
        let (inside, errors) = match work {
            Ok(found) => found,
            Err(EngineError::Cancelled) => return Err(NotNow::Stopping),
            Err(error) => {
                tracing::warn!(run.id = %run.id, model.version = model.version, %error, "a run cannot be predicted");
                return Ok(Some(Outcome::Omitted(NotPredicted::NotFinite)));
            }
        };
        let kinds = self.held_out_kinds(model).await?;
        let limit = ControlLimit::of(model, run.kind, &kinds);
        let judged_s = samples as f64 / run.sample_rate_hz;
        Ok(Some(Outcome::Judged(Judgement::new(
            errors.into_iter().collect(),
            judged_s,
            inside,
            limit.as_ref(),
        ))))
    }

    /// The kinds of the runs that were held out of a model's fit; those of runs that are gone are not known.
    async fn held_out_kinds(&self, model: &Model) -> Result<HashMap<RunId, RunKind>, StoreError> {
        let mut kinds = HashMap::new();
        for span in &model.lineage.validation {
            if let Entry::Vacant(place) = kinds.entry(span.run)
                && let Some(run) = self.store.run(&model.rig, span.run).await?
            {
                place.insert(run.kind);
            }
        }
        Ok(kinds)
    }
}

/// The outputs on which a run is predicted, or why it is not.
fn to_predict(model: &Model, run: &Run) -> Result<Vec<usize>, NotPredicted> {
    if let Some(seen) = seen(model, run) {
        return Err(seen.into());
    }
    if run.duplicate_of.is_some() {
        return Err(NotPredicted::Duplicate);
    }
    comparable(model, run).map_err(|(reason, _)| match reason {
        Omission::MissingChannels => NotPredicted::MissingChannels,
        Omission::SampleRate => NotPredicted::SampleRate,
        Omission::NotFinite => NotPredicted::NotFinite,
    })
}

/// Share of samples inside what the model was fitted on, and the relative RMS error by output.
type Errors = (f64, HashMap<String, Option<f64>>);

fn errors(
    loaded: &LoadedModel,
    signal: &Signal,
    names: &[String],
    outputs: &[usize],
    stopping: &watch::Receiver<bool>,
) -> Result<Errors, EngineError> {
    let watch = |_: crate::engine::Progress<'_>| {
        if *stopping.borrow() { ControlFlow::Break(()) } else { ControlFlow::Continue(()) }
    };
    let found = predicted(&loaded.predictor, signal, names, outputs, &watch)?;
    let mut errors = HashMap::new();
    for (channel, &output) in outputs.iter().enumerate() {
        let rms = Squares::of(found.predicted.channel(channel), found.measured.channel(channel)).rms();
        if rms.is_some_and(|rms| !rms.is_finite()) {
            return Err(EngineError::NonFiniteResult { what: "error", channel, sample: 0 });
        }
        errors.insert(loaded.model().outputs[output].clone(), rms);
    }
    Ok((found.inside, errors))
}
