//! The workers: tasks that claim jobs and run them to their end.

use std::collections::HashMap;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use jiff::Timestamp;
use tokio::sync::{Notify, watch};
use tokio::task::JoinHandle;
use tokio::time::MissedTickBehavior;
use tracing::Instrument;

use crate::domain::turns::Urgency;
use crate::domain::{Clock, JobId, JobKind};
use crate::storage::{Beat, Claim, Lease, Outcome, Store, StoreError};
use crate::telemetry::names;

use super::JobSettings;
use super::control::{Control, Stop};
use super::events::Hub;
use super::helping::{HELP_EVERY, HELP_SOON};
use super::problem::{JobError, codes, panicked};
use super::process::{Begin, WorkerProgram};
use super::publish::publish;
use super::spec::{JobOutput, JobSpec};
use super::work_context::WorkContext;

/// Where the work of a job runs.
#[derive(Debug)]
pub(super) enum Executor {
    /// On this process' threads.
    InProcess(WorkContext),
    /// In a process of its own for each job.
    Subprocess(WorkerProgram),
}

/// Shared by all workers of a process.
#[derive(Debug)]
pub(super) struct Runner {
    pub(super) store: Store,
    pub(super) clock: Clock,
    executor: Executor,
    pub(super) settings: JobSettings,
    pub(super) hub: Hub,
    /// Notified when a job was queued.
    pub(super) queued: Notify,
    pub(super) stopping: watch::Sender<bool>,
    /// Jobs at work in this process.
    at_work: Mutex<HashMap<JobId, Arc<Control>>>,
    /// Jobs of other processes that this one has helped with, and when.
    pub(super) helped: Mutex<Vec<(Lease, Instant)>>,
}

impl Runner {
    pub(super) fn new(store: Store, clock: Clock, settings: JobSettings, executor: Executor) -> Self {
        let stopping = watch::Sender::new(false);
        let hub = Hub::new(stopping.clone());
        let (queued, at_work, helped) = (Notify::new(), Mutex::default(), Mutex::default());
        Self { store, clock, executor, settings, hub, queued, stopping, at_work, helped }
    }

    /// Asks a job to stop if it runs in this process; tells whether it does.
    pub(super) fn stop(&self, id: JobId, why: Stop) -> bool {
        let at_work = self.at_work();
        let found = at_work.get(&id);
        if let Some(control) = found {
            control.stop(why);
        }
        found.is_some()
    }

    /// Stops claiming and asks all work to stop.
    pub(super) fn shut_down(&self) {
        self.stopping.send_replace(true);
        for control in self.at_work().values() {
            control.stop(Stop::Shutdown);
        }
    }

    pub(super) fn at_work(&self) -> MutexGuard<'_, HashMap<JobId, Arc<Control>>> {
        self.at_work.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn lease_until(&self, now: Timestamp) -> Timestamp {
        now.checked_add(self.settings.lease).unwrap_or(Timestamp::MAX)
    }

    /// Claims and does jobs until the service stops.
    pub(super) async fn work(self: Arc<Self>, name: String) {
        let mut stopping = self.stopping.subscribe();
        while !*stopping.borrow() {
            match self.claim(&name).await {
                Ok(Some(claim)) => {
                    // Other workers may find more jobs.
                    self.queued.notify_one();
                    Arc::clone(&self).run_claimed(claim).await;
                    continue;
                }
                Ok(None) if self.store.is_shared() => {
                    if self.help().await {
                        continue;
                    }
                }
                Ok(None) => {}
                Err(error) => {
                    error.count();
                    tracing::error!(%error, "no job could be claimed");
                }
            }
            let look = tokio::time::sleep(self.settings.sweep);
            tokio::pin!(look);
            let mut idle = HELP_SOON;
            loop {
                let wants_to_help = tokio::select! {
                    // What was announced since the queue was read is announced here too.
                    () = self.queued.notified() => false,
                    _ = stopping.wait_for(|stopping| *stopping) => false,
                    () = &mut look => false,
                    () = tokio::time::sleep(idle), if self.store.is_shared() => true,
                };
                idle = HELP_EVERY;
                if !wants_to_help || self.help().await {
                    break;
                }
            }
        }
    }

    /// Takes jobs from silent workers, until the service stops. Jobs that run in this process are never
    /// taken, even if a clock jump has ended their leases.
    pub(super) async fn sweep(self: Arc<Self>) {
        let mut stopping = self.stopping.subscribe();
        let mut ticks = tokio::time::interval(self.settings.sweep);
        ticks.set_missed_tick_behavior(MissedTickBehavior::Delay);
        loop {
            tokio::select! {
                _ = stopping.wait_for(|stopping| *stopping) => return,
                _ = ticks.tick() => {}
            }
            let here: Vec<JobId> = self.at_work().keys().copied().collect();
            let now = (self.clock)();
            match self.store.requeue_expired(now, &here, now).await {
                Ok(expired) => {
                    for id in expired {
                        lost();
                        tracing::warn!(job.id = %id, "took a job from a worker that was not heard of");
                        self.hub.changed(id);
                        self.queued.notify_one();
                    }
                }
                // One unreadable row must not hold up the others.
                Err(error) => {
                    error.count();
                    tracing::error!(%error, "jobs of lost workers could not be queued again");
                }
            }
        }
    }

    /// Hears of jobs that other processes queue or change, until the service stops. What is missed while the database is
    /// away is found by looking, as without announcements.
    pub(super) async fn listen(self: Arc<Self>) {
        let mut stopping = self.stopping.subscribe();
        while !*stopping.borrow() {
            let heard = self.store.hear_of_jobs(|id, waits| {
                self.hub.changed(id);
                if waits {
                    self.queued.notify_one();
                }
            });
            tokio::select! {
                error = heard => {
                    error.count();
                    tracing::warn!(%error, "jobs of other processes are not announced for now");
                }
                _ = stopping.wait_for(|stopping| *stopping) => return,
            }
            tokio::select! {
                () = tokio::time::sleep(self.settings.sweep) => {}
                _ = stopping.wait_for(|stopping| *stopping) => {}
            }
        }
    }

    async fn claim(&self, name: &str) -> Result<Option<Claim>, StoreError> {
        let now = (self.clock)();
        self.store.claim_job(name, self.lease_until(now), now).await
    }

    /// Does a job, renews its lease meanwhile, and records its end.
    async fn run_claimed(self: Arc<Self>, claim: Claim) {
        let id = claim.job.id;
        let span = tracing::info_span!(
            "job", job.id = %id, job.kind = claim.job.kind.as_str(), rig.id = %claim.job.rig,
            job.attempt = claim.job.attempt
        );
        let control = Arc::new(Control::default());
        self.at_work().insert(id, Arc::clone(&control));
        // The service may have begun to stop between the claim and the line above.
        if *self.stopping.borrow() {
            control.stop(Stop::Shutdown);
        }
        self.hub.changed(id);
        async {
            tracing::info!("a job starts");
            // A task of its own: heartbeats go on while the work waits for the store, and the work goes
            // on while a heartbeat waits.
            let work = Arc::clone(&self).perform(claim.clone(), Arc::clone(&control));
            let started = Instant::now();
            let end = self.heartbeat_until_done(&claim, &control, tokio::spawn(work.in_current_span())).await;
            note_end(claim.job.kind, &end, control.stopped(), started.elapsed());
            if let Err(error) = self.finish(&claim, &control, end).await {
                error.count();
                // Its lease will expire, and another attempt will follow.
                tracing::error!(%error, "the end of a job could not be written");
            }
        }
        .instrument(span)
        .await;
        self.at_work().remove(&id);
        self.hub.changed(id);
    }

    async fn perform(self: Arc<Self>, claim: Claim, control: Arc<Control>) -> Result<(), JobError> {
        let made = self.make(&claim, &control).await?;
        if control.stopped().is_some() {
            return Err(JobError::Stopped);
        }
        control.report("publishing", 1.0);
        // Publishing ends the job, and with it the right to write about it.
        self.store_losses(&claim, &control).await;
        self.publish_when_there(&claim, &control, made).await
    }

    /// Publishes an output. While the store is out of reach it is kept: the work may have taken hours.
    async fn publish_when_there(
        &self,
        claim: &Claim,
        control: &Control,
        made: JobOutput,
    ) -> Result<(), JobError> {
        let began = Instant::now();
        loop {
            match publish(self, claim, made.clone()).await {
                Err(JobError::Retry(problem))
                    if problem.code == codes::STORE_UNAVAILABLE
                        && control.stopped().is_none()
                        && began.elapsed() < STORE_PATIENCE =>
                {
                    control.report("waiting for the store", 1.0);
                    tokio::time::sleep(RETRY_PAUSE).await;
                }
                done => return done,
            }
        }
    }

    /// Whether registry or objects are out of reach, for every job alike.
    async fn store_is_away(&self) -> bool {
        self.store.ping().await.is_err() || self.store.ping_bucket().await.is_err()
    }

    async fn make(&self, claim: &Claim, control: &Arc<Control>) -> Result<JobOutput, JobError> {
        self.make_as(JobSpec::from(claim), control).await
    }

    pub(super) async fn make_as(&self, spec: JobSpec, control: &Arc<Control>) -> Result<JobOutput, JobError> {
        match &self.executor {
            Executor::InProcess(context) => context.make(&spec, control).await,
            Executor::Subprocess(program) => {
                let (data_dir, checkpoint_every) =
                    (self.store.data_dir().to_owned(), self.settings.checkpoint_every);
                let (store, memory_bytes) = (self.store.settings().clone(), program.memory_bytes);
                let begin = Begin { data_dir, store, spec, checkpoint_every, memory_bytes };
                program.make(begin, self.settings.lease, control).await
            }
        }
    }

    /// Sends heartbeats until the work ends.
    async fn heartbeat_until_done(
        &self,
        claim: &Claim,
        control: &Control,
        mut work: JoinHandle<Result<(), JobError>>,
    ) -> Result<(), JobError> {
        let mut ticks = tokio::time::interval(self.settings.progress_every);
        ticks.set_missed_tick_behavior(MissedTickBehavior::Delay);
        let mut written = (String::new(), 0.0);
        let mut at = Instant::now();
        let began = Instant::now();
        loop {
            tokio::select! {
                biased;
                end = &mut work => {
                    self.store_checkpoints(claim, control).await;
                    self.store_losses(claim, control).await;
                    return match end {
                        Ok(end) => end,
                        Err(error) => Err(panicked(&error.to_string())),
                    };
                }
                // Before the checkpoints, which a slow store takes long for.
                _ = ticks.tick() => {
                    self.store_checkpoints(claim, control).await;
                    self.store_losses(claim, control).await;
                    let progress = control.progress();
                    if progress != written || at.elapsed() >= self.settings.heartbeat {
                        self.beat(claim, control, &progress).await;
                        (written, at) = (progress, Instant::now());
                    }
                    if claim.job.kind == JobKind::Study && self.gives_way(claim, began.elapsed()).await {
                        control.stop(Stop::Yield);
                    }
                }
                () = control.kept() => self.store_checkpoints(claim, control).await,
            }
        }
    }

    /// Whether a study has to give its turn to a job that waits. It may take hours, so it does not keep the last free
    /// worker from work that somebody waits for; nor does it meet the time limit of an attempt.
    async fn gives_way(&self, claim: &Claim, lasted: Duration) -> bool {
        let limit = match &self.executor {
            Executor::InProcess(_) => Duration::MAX,
            Executor::Subprocess(program) => program.time_limit / 2,
        };
        if lasted >= limit {
            return true;
        }
        if self.at_work().len() < self.settings.workers {
            return false;
        }
        match self.store.goes_before(&claim.lease, (self.clock)()).await {
            Ok(urgency) => urgency.is_some_and(|urgency| lasted >= least_turn(urgency)),
            Err(error) => {
                error.count();
                tracing::warn!(%error, "the queue could not be read");
                false
            }
        }
    }

    /// Stores the checkpoints that the work has handed over.
    pub(super) async fn store_checkpoints(&self, claim: &Claim, control: &Control) {
        for checkpoint in control.take_kept() {
            match self.store.keep_checkpoint(&claim.lease, &checkpoint, (self.clock)()).await {
                Ok(true) => tracing::debug!(part = checkpoint.part, "put a checkpoint by"),
                // The job was cancelled or has another worker; the next heartbeat will tell.
                Ok(false) => {}
                // The previous checkpoint is still there, and the work goes on.
                Err(error) => {
                    error.count();
                    tracing::warn!(%error, "a checkpoint could not be stored");
                }
            }
        }
    }

    /// Stores the errors of the epochs that have ended, for people who watch the job.
    pub(super) async fn store_losses(&self, claim: &Claim, control: &Control) {
        let new = control.take_losses();
        if new.is_empty() {
            return;
        }
        // Their absence changes nothing about the work.
        if let Err(error) = self.store.add_losses(&claim.lease, new.anew, &new.losses).await {
            error.count();
            tracing::warn!(%error, "the errors of some epochs could not be stored");
        }
    }

    async fn beat(&self, claim: &Claim, control: &Control, (stage, fraction): &(String, f64)) {
        let now = (self.clock)();
        let beat = self.store.heartbeat(&claim.lease, stage, *fraction, self.lease_until(now), now).await;
        match beat {
            Ok(Beat::Held) => {}
            Ok(Beat::CancelRequested) => control.stop(Stop::Cancelled),
            Ok(Beat::Lost) => control.stop(Stop::Lost),
            // The lease outlasts a few failures. If it does not, the next heartbeat will tell.
            Err(error) => {
                error.count();
                tracing::warn!(%error, "a heartbeat could not be written");
            }
        }
        self.hub.changed(claim.job.id);
    }

    async fn finish(
        &self,
        claim: &Claim,
        control: &Control,
        end: Result<(), JobError>,
    ) -> Result<(), StoreError> {
        let outcome = match end {
            // Publishing has ended the job.
            Ok(()) => return Ok(()),
            Err(JobError::Failed(problem)) => {
                if problem.code == codes::STORE_DAMAGED {
                    // The server does not know which objects the worker process has read.
                    self.store.verify_rig(&claim.job.rig).await?;
                }
                Outcome::Failed(*problem)
            }
            Err(JobError::Retry(problem)) => {
                // Memory or disk may be free again in a moment.
                let mut stopping = self.stopping.subscribe();
                let _ = tokio::time::timeout(RETRY_PAUSE, stopping.wait_for(|stopping| *stopping)).await;
                if problem.code == codes::STORE_UNAVAILABLE && self.store_is_away().await {
                    // No fault of the job, which waits for the store as all others do.
                    Outcome::Released
                } else {
                    Outcome::Retry(*problem)
                }
            }
            Err(JobError::Stopped) => match control.stopped() {
                Some(Stop::Cancelled) => Outcome::Cancelled,
                Some(Stop::Shutdown) => Outcome::Released,
                Some(Stop::Yield) => Outcome::Yielded,
                Some(Stop::Lost) | None => {
                    lost();
                    return Ok(());
                }
            },
        };
        tracing::info!(job.outcome = ?outcome, "a job ends without a result");
        if !self.store.finish_job(&claim.lease, outcome, (self.clock)()).await? {
            lost();
        }
        Ok(())
    }
}

/// How long the output of a job is kept while the store is out of reach.
const STORE_PATIENCE: Duration = Duration::from_secs(3600);

/// How long the turn of a study lasts at least before a job of this urgency ends it: each change costs the start of a
/// process and the loading of the runs.
fn least_turn(urgency: Urgency) -> Duration {
    match urgency {
        Urgency::Awaited => Duration::ZERO,
        Urgency::Requested => Duration::from_secs(60),
        Urgency::Background => Duration::from_secs(600),
    }
}

/// Counts a lost lease: the job has another worker, or is gone.
fn lost() {
    metrics::counter!(names::LEASES_LOST).increment(1);
}

/// Records in the metrics how an attempt ended and, for a fit, how long it ran.
fn note_end(kind: JobKind, end: &Result<(), JobError>, stopped: Option<Stop>, elapsed: Duration) {
    let outcome = match end {
        Ok(()) => "succeeded",
        Err(JobError::Failed(_)) => "failed",
        Err(JobError::Retry(_)) => "retry",
        Err(JobError::Stopped) => match stopped {
            Some(Stop::Cancelled) => "cancelled",
            Some(Stop::Shutdown | Stop::Yield) => "released",
            Some(Stop::Lost) | None => "lost",
        },
    };
    debug_assert!(names::OUTCOMES.contains(&outcome), "{outcome} is not in the table");
    metrics::counter!(names::ATTEMPTS, "kind" => kind.as_str(), "outcome" => outcome).increment(1);
    if kind == JobKind::Fit {
        metrics::histogram!(names::FIT_SECONDS, "outcome" => outcome).record(elapsed.as_secs_f64());
    }
    if let Err(JobError::Failed(problem) | JobError::Retry(problem)) = end
        && let Some(kind) = problem.code.strip_prefix("store.")
    {
        // The kinds are few: full, unavailable, damaged.
        metrics::counter!(names::STORE_ERRORS, "kind" => kind.to_owned()).increment(1);
    }
}

/// Pause before a job that failed for a passing reason goes back into the queue.
const RETRY_PAUSE: Duration = Duration::from_secs(1);

/// Name of a worker, with the process id.
pub(super) fn worker_name(index: usize) -> String {
    format!("{}-{index}", std::process::id())
}

/// How long [`super::Jobs::shutdown`] waits for work to stop; the engine checks several times a second.
pub(super) const SHUTDOWN_PATIENCE: Duration = Duration::from_secs(25);
