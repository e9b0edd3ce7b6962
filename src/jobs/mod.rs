//! Long work: claim, heartbeat, finish; one file a kind of job.
//!
//! A job is claimed in one short transaction, worked on outside of any, and published in another, which
//! succeeds only while the lease is held.

mod activate;
mod checkpoints;
mod control;
mod core_version;
mod diagnosis;
mod drift;
mod evaluation;
mod events;
pub mod fit;
mod fit_plan;
mod helping;
mod iteration;
mod memory;
mod predicted;
pub mod problem;
mod process;
mod publish;
mod runner;
mod seed_shares;
mod selection;
mod spec;
mod study;
mod warm_start;
mod work_context;

use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use futures::Stream;
use tokio::task::JoinHandle;

use crate::compute::Compute;
use crate::domain::fits::FitRequest;
use crate::domain::{
    Clock, DiagnosisRequest, EvaluationRequest, IterationRequest, Job, JobId, ModelRef, Rig, StudyRequest,
    TokenId,
};
use crate::engine::Signal;
use crate::storage::{Asker, CancelOutcome, IdempotencyKey, JobInsert, PrepareError, Store, StoreError};

use control::Stop;
use fit::FitFunction;
use iteration::TargetOutline;
use problem::NotQueued;
use runner::{Executor, Runner};
use work_context::WorkContext;

pub use diagnosis::DiagnosisProblem;
pub use drift::DriftWatch;
pub use evaluation::EvaluationProblem;
pub use fit::{FitPlan, FitProblem};
pub use iteration::IterationProblem;
pub use process::{WorkError, WorkerProgram, work};
pub use study::StudyProblem;

/// Settings of the runner.
#[derive(Debug, Clone)]
pub struct JobSettings {
    /// Jobs at once in this process.
    pub workers: usize,
    /// How long a lease lasts without a heartbeat.
    pub lease: Duration,
    /// Most time between two heartbeats.
    pub heartbeat: Duration,
    /// How often the runner looks for expired leases, and for queued jobs that were not announced.
    pub sweep: Duration,
    /// Most time between two checkpoints of a fit.
    pub checkpoint_every: Duration,
    /// How jobs get processes of their own; with `None` they run on threads of this process.
    pub program: Option<WorkerProgram>,
    /// Least time between two progress writes of a job.
    pub progress_every: Duration,
    /// Most jobs that one token asked for and that wait for their turn.
    pub max_waiting: u64,
}

impl Default for JobSettings {
    fn default() -> Self {
        Self {
            workers: 1,
            lease: Duration::from_secs(30),
            heartbeat: Duration::from_secs(5),
            sweep: Duration::from_secs(10),
            checkpoint_every: Duration::from_secs(30),
            program: None,
            progress_every: Duration::from_millis(500),
            max_waiting: 1000,
        }
    }
}

impl JobSettings {
    /// Memory that one job may take.
    fn job_memory_bytes(&self) -> u64 {
        let own = self.program.as_ref().map(|program| program.memory_bytes);
        own.unwrap_or_else(|| process::default_memory_bytes(self.workers))
    }
}

/// The runner of jobs. Clones share it.
#[derive(Debug, Clone)]
pub struct Jobs {
    runner: Arc<Runner>,
    workers: Arc<Mutex<Vec<JoinHandle<()>>>>,
}

impl Jobs {
    /// Puts jobs that a previous process left running back into the queue, and starts the workers.
    ///
    /// # Errors
    /// The store's failures.
    pub async fn start(
        store: Store,
        compute: Compute,
        clock: Clock,
        settings: JobSettings,
    ) -> Result<Self, StoreError> {
        Self::start_with(store, compute, clock, settings, crate::engine::model::fit_resumable).await
    }

    async fn start_with(
        store: Store,
        compute: Compute,
        clock: Clock,
        settings: JobSettings,
        fit: FitFunction,
    ) -> Result<Self, StoreError> {
        // A data directory is locked, so the process that had these jobs is gone. Those of a registry that is shared may
        // be at work elsewhere: their leases tell.
        if !store.is_shared() {
            for id in store.requeue_interrupted(clock()).await? {
                tracing::warn!(job.id = %id, "a job was interrupted when the service died");
            }
        }
        let count = settings.workers;
        let executor = match settings.program.clone() {
            Some(program) => Executor::Subprocess(program),
            None => {
                let (store, checkpoint_every) = (store.clone(), settings.checkpoint_every);
                let memory_bytes = settings.job_memory_bytes();
                Executor::InProcess(WorkContext { store, compute, fit, checkpoint_every, memory_bytes })
            }
        };
        let runner = Arc::new(Runner::new(store, clock, settings, executor));
        let mut workers: Vec<_> =
            (0..count).map(|i| tokio::spawn(Arc::clone(&runner).work(runner::worker_name(i)))).collect();
        workers.push(tokio::spawn(Arc::clone(&runner).sweep()));
        if runner.store.is_shared() {
            workers.push(tokio::spawn(Arc::clone(&runner).listen()));
        }
        Ok(Self { runner, workers: Arc::new(Mutex::new(workers)) })
    }

    /// Checks a fit and queues it for a token.
    ///
    /// # Errors
    /// [`FitProblem`]: an error of the request, or the store's failure.
    pub async fn submit_fit(
        &self,
        rig: &Rig,
        request: &FitRequest,
        token: Option<TokenId>,
        key: Option<&IdempotencyKey>,
    ) -> Result<Job, FitProblem> {
        let Runner { store, clock, .. } = &*self.runner;
        let plan = fit::check(store, rig, request).await?;
        memory::check_limit(&plan, self.runner.settings.job_memory_bytes())?;
        let asker = self.asker(token);
        let inserted = store.insert_job(&rig.id, request, asker, key, clock()).await?;
        Ok(self.queued(inserted, asker)?)
    }

    fn asker(&self, token: Option<TokenId>) -> Asker {
        Asker { token, max_waiting: self.runner.settings.max_waiting }
    }

    /// Checks a diagnosis and queues it for a token, its model and runs resolved.
    ///
    /// # Errors
    /// [`DiagnosisProblem`]: an error of the request, or the store's failure.
    pub async fn submit_diagnosis(
        &self,
        rig: &Rig,
        request: &DiagnosisRequest,
        token: Option<TokenId>,
        key: Option<&IdempotencyKey>,
    ) -> Result<Job, DiagnosisProblem> {
        let Runner { store, clock, .. } = &*self.runner;
        let plan = diagnosis::check(store, rig, request).await?;
        let asker = self.asker(token);
        let inserted = store.insert_job(&rig.id, &plan.request, asker, key, clock()).await?;
        Ok(self.queued(inserted, asker)?)
    }

    /// Checks an iteration and queues it for a token, its model resolved.
    ///
    /// # Errors
    /// [`IterationProblem`]: an error of the request, or the store's failure.
    pub async fn submit_iteration(
        &self,
        rig: &Rig,
        request: &IterationRequest,
        token: Option<TokenId>,
        key: Option<&IdempotencyKey>,
    ) -> Result<Job, IterationProblem> {
        let Runner { store, clock, .. } = &*self.runner;
        let (plan, _) = iteration::check(store, rig, request).await?;
        let request = IterationRequest { model: ModelRef::Version(plan.model.version), ..request.clone() };
        let asker = self.asker(token);
        let inserted = store.insert_job(&rig.id, &request, asker, key, clock()).await?;
        Ok(self.queued(inserted, asker)?)
    }

    /// [`Jobs::submit_iteration`] for a target that comes with the request, its channels in the order of `names`: it
    /// becomes a run of the rig, which the request that is stored names.
    ///
    /// # Errors
    /// [`IterationProblem`]: an error of the request, or the store's failure.
    pub async fn submit_iteration_for(
        &self,
        rig: &Rig,
        mut request: IterationRequest<()>,
        (names, target): (&[String], Signal),
        token: Option<TokenId>,
        key: Option<IdempotencyKey>,
    ) -> Result<Job, IterationProblem> {
        let Runner { store, clock, .. } = &*self.runner;
        let outline = TargetOutline {
            name: "",
            channels: names,
            wanted: Some(names),
            samples: target.n_samples() as u64,
            sample_rate_hz: target.sample_rate_hz(),
            is_sent: true,
        };
        let plan = iteration::check_for(store, rig, &request, &outline).await?;
        request.model = ModelRef::Version(plan.model.version);
        let places: Vec<usize> =
            plan.channels.iter().filter_map(|name| names.iter().position(|n| n == name)).collect();
        let target = target.select(&places);
        let prepared = store.prepare_target(rig, request.name.as_deref(), plan.channels, target).await;
        let target = prepared.map_err(|error| match error {
            PrepareError::Store(error) => IterationProblem::Store(error),
            PrepareError::Unsuitable(errors) => IterationProblem::Invalid(errors),
        })?;
        let asker = self.asker(token);
        let inserted = store.insert_iteration_job_for(&rig.id, request, target, asker, key, clock()).await?;
        Ok(self.queued(inserted, asker)?)
    }

    /// The job that was inserted; the workers are told.
    fn queued(&self, inserted: JobInsert, asker: Asker) -> Result<Job, NotQueued> {
        match inserted {
            JobInsert::Queued(job) => {
                self.wake();
                Ok(*job)
            }
            JobInsert::MissingRig => Err(NotQueued::RigGone),
            JobInsert::TooManyWaiting => Err(NotQueued::TooManyWaiting(asker.max_waiting)),
        }
    }

    /// Checks an evaluation and queues it for a token, its models and runs resolved.
    ///
    /// # Errors
    /// [`EvaluationProblem`]: an error of the request, or the store's failure.
    pub async fn submit_evaluation(
        &self,
        rig: &Rig,
        request: &EvaluationRequest,
        token: Option<TokenId>,
        key: Option<&IdempotencyKey>,
    ) -> Result<Job, EvaluationProblem> {
        let Runner { store, clock, .. } = &*self.runner;
        let plan = evaluation::check(store, rig, request).await?;
        let asker = self.asker(token);
        let inserted = store.insert_job(&rig.id, &plan.request, asker, key, clock()).await?;
        Ok(self.queued(inserted, asker)?)
    }

    /// Checks a study and queues it for a token, its fit resolved.
    ///
    /// # Errors
    /// [`StudyProblem`]: an error of the request, or the store's failure.
    pub async fn submit_study(
        &self,
        rig: &Rig,
        request: &StudyRequest,
        token: Option<TokenId>,
        key: Option<&IdempotencyKey>,
    ) -> Result<Job, StudyProblem> {
        let Runner { store, clock, .. } = &*self.runner;
        let plan = study::check(store, rig, request).await?;
        let asker = self.asker(token);
        let inserted = store.insert_job(&rig.id, &plan.request, asker, key, clock()).await?;
        Ok(self.queued(inserted, asker)?)
    }

    /// Records the request to cancel, and stops the work if it runs here. Idempotent.
    ///
    /// # Errors
    /// The store's failures.
    pub async fn cancel(&self, id: JobId) -> Result<CancelOutcome, StoreError> {
        let outcome = self.runner.store.request_cancel(id, (self.runner.clock)()).await?;
        self.runner.stop(id, Stop::Cancelled);
        self.runner.hub.changed(id);
        Ok(outcome)
    }

    /// Tells idle workers that jobs were queued (by an accepted run).
    pub fn wake(&self) {
        self.runner.queued.notify_one();
    }

    /// The job's snapshots from now on, each with a greater [`Job::event`], ending after a
    /// terminal state; `None` when there is no such job. The first is the job as it is now,
    /// unless `last_event` (the client's `Last-Event-ID`) says that it was seen. The stream also
    /// ends when the job is deleted, the store fails or the service stops.
    ///
    /// # Errors
    /// The store's failures.
    pub async fn subscribe(
        &self,
        id: JobId,
        last_event: Option<u64>,
    ) -> Result<Option<impl Stream<Item = Job> + Send + 'static + use<>>, StoreError> {
        self.runner.hub.subscribe(self.runner.store.clone(), id, last_event).await
    }

    /// Stops claiming, cancels the work at hand, puts its jobs back into the queue, and returns
    /// when that is done, or when work has not stopped within 25 seconds: its jobs are queued
    /// again at the next start.
    pub async fn shutdown(&self) {
        self.runner.shut_down();
        let workers = std::mem::take(&mut *self.workers.lock().unwrap_or_else(PoisonError::into_inner));
        let all = futures::future::join_all(workers);
        match tokio::time::timeout(runner::SHUTDOWN_PATIENCE, all).await {
            Err(_) => tracing::error!("work did not stop in time; its jobs start again with the service"),
            Ok(ends) => {
                for error in ends.into_iter().filter_map(Result::err) {
                    tracing::error!(%error, "a worker ended badly");
                }
            }
        }
    }
}

#[cfg(test)]
mod tests;
