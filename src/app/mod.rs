//! The service as a whole: built from its settings, served until it is told to stop.

mod address;
mod connection;

use std::net::SocketAddr;
use std::sync::atomic::Ordering;
use std::sync::{Arc, PoisonError, RwLock};
use std::time::{Duration, Instant};

use axum::{Extension, Router};
use hyper::server::conn::http1;
use hyper::service::{Service, service_fn};
use hyper_util::rt::{TokioIo, TokioTimer};
use hyper_util::server::graceful::GracefulShutdown;
use hyper_util::service::TowerToHyperService;
use jiff::SignedDuration;
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::watch;
use tower::Layer;

use crate::compute::{Compute, ComputeError, ComputeSettings};
use crate::config::{Config, ConnectionSettings, Part};
use crate::domain::TokenRole;
use crate::http::{
    self, Admission, Auth, ClientAddress, Comparisons, Http, PredictionMemory, RunViews, Shared,
};
use crate::jobs::{DriftWatch, Jobs};
use crate::models::Models;
use crate::storage::{Store, StoreError};
use crate::telemetry::{self, names};
use connection::{Client, ConnectionSlot, Connections, ProblemStream, WriteTimeout};

pub use address::{Address, AddressError};

/// Models that stay in memory; one of the usual size takes some three megabytes, most of it the
/// FRF's spectra.
const MODEL_CACHE: usize = 32;

/// How long answers under way may take once the service is told to stop. Jobs then have the rest of the
/// 30 seconds of a stop.
const DRAIN: Duration = Duration::from_secs(20);

/// How long connections are still accepted once the service is told to stop: clients that connected
/// before readiness changed get an answer.
const LAST_CALL: Duration = Duration::from_millis(100);

/// How long the last of these connections have to send a request.
const LAST_WORDS: Duration = Duration::from_millis(500);

/// How often recorded durations are sorted into histogram buckets, even if nobody reads the metrics:
/// until then each takes memory of its own.
const UPKEEP: Duration = Duration::from_secs(5);

/// How often all rows of the registry are held against the journal.
const ROWS_CHECK: Duration = Duration::from_secs(600);

/// Pause after an accept that failed because no file handle was free, so that closing connections can
/// catch up.
const ACCEPT_PAUSE: Duration = Duration::from_millis(100);

/// Why the service did not start.
#[derive(Debug, thiserror::Error)]
pub enum AppError {
    /// The store.
    #[error(transparent)]
    Store(#[from] StoreError),
    /// Threads.
    #[error(transparent)]
    Compute(#[from] ComputeError),
    /// The address is beyond loopback, and no admin's token is in force.
    #[error(
        "refusing to listen on {0}: there is no admin's token in force, and everybody who reaches that address \
         could read and delete everything; make one with `rigcast token create --role admin`, or listen on 127.0.0.1"
    )]
    OpenToNetwork(SocketAddr),
    /// The address.
    #[error(transparent)]
    Address(#[from] AddressError),
}

/// A service that is ready to accept connections; its jobs run already.
pub struct App {
    router: Router,
    http: Shared,
    store: Store,
    jobs: Jobs,
    draining: watch::Sender<bool>,
    settings: ConnectionSettings,
    connections: Arc<Connections>,
}

/// The one place that reads the clock; everything below receives this function. Where processes share a registry they go
/// by the clock of its database, so that clocks that differ end no lease and no token.
pub fn now() -> jiff::Timestamp {
    let shared = SHARED_CLOCK.read().unwrap_or_else(PoisonError::into_inner);
    match *shared {
        None => jiff::Timestamp::now(),
        Some((read, time)) => time.checked_add(read.elapsed()).unwrap_or(time),
    }
}

/// When the database's clock was read last, and what it said.
static SHARED_CLOCK: RwLock<Option<(Instant, jiff::Timestamp)>> = RwLock::new(None);

/// How often the database's clock is read.
const CLOCK_CHECK: Duration = Duration::from_secs(20);

/// A clock that is off by more than this at the start is worth a warning.
const CLOCK_OFFSET: SignedDuration = SignedDuration::from_mins(1);

/// Reads the clock of a registry that is shared; how far this machine's clock is ahead of it.
async fn read_clock(store: &Store) -> Result<SignedDuration, StoreError> {
    let Some(time) = store.shared_time().await? else { return Ok(SignedDuration::ZERO) };
    // As of after the answer, so that the time never runs ahead of the database's.
    let read = Instant::now();
    *SHARED_CLOCK.write().unwrap_or_else(PoisonError::into_inner) = Some((read, time));
    let ahead = jiff::Timestamp::now().duration_since(time);
    metrics::gauge!(names::CLOCK_OFFSET).set(ahead.as_secs_f64());
    Ok(ahead)
}

/// Tells whoever starts a process on a machine whose clock is wrong.
fn tell_of_offset(ahead: SignedDuration) {
    if ahead.abs() > CLOCK_OFFSET {
        let (seconds, side) =
            (ahead.abs().as_secs(), if ahead.is_positive() { "ahead of" } else { "behind" });
        tracing::warn!(
            "this machine's clock is {seconds} s {side} that of the database, whose clock is the one that counts; storage in the \
             cloud refuses requests of a machine that is a quarter of an hour off: set the clock"
        );
    }
}

/// Whether there is a token in force that can create all others.
async fn has_admin(store: &Store) -> Result<bool, StoreError> {
    let tokens = store.token_table().await?.tokens;
    Ok(tokens
        .iter()
        .any(|(_, token)| token.role == TokenRole::Admin && token.rigs.is_none() && token.is_in_force(now())))
}

impl App {
    /// Opens and locks the data directory, and starts the workers that run jobs.
    ///
    /// # Errors
    /// A data directory that is in use, damaged or from a newer version; an address beyond loopback
    /// without an admin's token; no threads.
    pub async fn build(config: &Config) -> Result<Self, AppError> {
        let on_loopback = config.listen.ip().is_loopback();
        // Who only works answers nothing but monitors.
        let is_closed = on_loopback || config.part == Part::Work;
        if !is_closed && config.store.database.is_none() && !Store::exists(&config.data_dir) {
            // A missing directory holds no token, and a refused start must not create it.
            return Err(AppError::OpenToNetwork(config.listen));
        }
        let store = Store::open_with(&config.data_dir, &config.store).await?;
        let metrics = telemetry::metrics_handle();
        tell_of_offset(read_clock(&store).await?);
        if !is_closed && !has_admin(&store).await? {
            store.close().await;
            return Err(AppError::OpenToNetwork(config.listen));
        }
        let settings = ComputeSettings { fit_permits: config.jobs.workers, ..config.compute.clone() };
        let compute = Compute::new(&settings)?;
        let models = Models::new(store.clone(), compute.clone(), MODEL_CACHE);
        let jobs = Jobs::start(store.clone(), compute.clone(), now, config.jobs.clone()).await?;
        let drift = DriftWatch::start(store.clone(), compute.clone(), models.clone(), now);
        let (draining, seen) = watch::channel(false);
        let http = Arc::new(Http {
            store: store.clone(),
            jobs: jobs.clone(),
            drift,
            auth: Auth::new(store.clone(), on_loopback),
            models,
            compute,
            admission: Admission::new(config.admission.clone()),
            predictions: PredictionMemory::new(config.limits.prediction_bytes),
            comparisons: Comparisons::default(),
            views: RunViews::default(),
            limits: config.limits,
            clock: now,
            draining: seen,
            metrics,
        });
        http::begin_metrics(&http);
        let settings = config.connections.clone();
        let connections = Connections::new(&settings);
        let router = match config.part {
            Part::Serve => http::router(http.clone()),
            Part::Work => http::monitors_router(http.clone()),
        };
        Ok(Self { router, http, store, jobs, draining, settings, connections })
    }

    /// The router, for callers that bring requests another way than [`App::serve`].
    pub fn router(&self) -> Router {
        self.router.clone()
    }

    /// Answers requests until `shutdown` resolves, then stops in order: readiness turns to 503, new
    /// connections are no longer accepted, answers under way are finished, running jobs go back into the
    /// queue, and the database is closed.
    pub async fn serve(self, listener: TcpListener, shutdown: impl Future<Output = ()>) {
        let connections = GracefulShutdown::new();
        tokio::select! {
            () = self.accept(&listener, &connections) => {}
            () = self.upkeep() => {}
            () = self.check_rows() => {}
            () = self.check_clock() => {}
            () = shutdown => {}
        }
        tracing::info!("stopping: soon no more connections are accepted");
        self.draining.send_replace(true);
        let last_answers = async {
            let _ = tokio::time::timeout(LAST_CALL, self.accept(&listener, &connections)).await;
            self.accept_last(listener, &connections);
            tokio::time::sleep(LAST_WORDS).await;
            tokio::time::timeout(DRAIN, connections.shutdown()).await
        };
        // Jobs stop at once: the longer they go on, the less time is left to store their checkpoints.
        // Stopping them also ends the streams that follow jobs.
        let (drained, (), ()) = tokio::join!(last_answers, self.jobs.shutdown(), self.http.drift.shutdown());
        if drained.is_err() {
            tracing::warn!(drain_s = DRAIN.as_secs(), "connections were still open and are cut");
        }
        if let Err(error) = self.store.empty_quarantine(now()).await {
            tracing::warn!(%error, "the quarantine was left as it is");
        }
        self.store.close().await;
        tracing::info!("stopped");
    }

    /// Accepts connections until it is dropped.
    async fn accept(&self, listener: &TcpListener, connections: &GracefulShutdown) {
        loop {
            match listener.accept().await {
                Ok((stream, peer)) => self.enter(stream, peer, connections),
                Err(error) => {
                    tracing::warn!(error = %error, "a connection could not be accepted");
                    tokio::time::sleep(ACCEPT_PAUSE).await;
                }
            }
        }
    }

    /// Accepts the connections that the system has completed but the runtime has not seen yet. Closing
    /// the listener would reset them.
    fn accept_last(&self, listener: TcpListener, connections: &GracefulShutdown) {
        let Ok(listener) = listener.into_std() else { return };
        for _ in 0..self.settings.most {
            let Ok((stream, peer)) = listener.accept() else { break };
            if let Ok(stream) = stream.set_nonblocking(true).and_then(|()| TcpStream::from_std(stream)) {
                self.enter(stream, peer, connections);
            }
        }
    }

    fn enter(&self, stream: TcpStream, peer: SocketAddr, connections: &GracefulShutdown) {
        match self.connections.enter(peer.ip()) {
            Some(slot) => self.answer(stream, peer, slot, connections),
            None => self.connections.refuse(stream, http::too_many_connections(&self.http)),
        }
    }

    /// Sorts recorded durations into their buckets until it is dropped.
    async fn upkeep(&self) {
        let mut upkeep = tokio::time::interval(UPKEEP);
        loop {
            upkeep.tick().await;
            self.http.metrics.run_upkeep();
        }
    }

    /// Follows the clock of a registry that is shared, until it is dropped.
    async fn check_clock(&self) {
        loop {
            tokio::time::sleep(CLOCK_CHECK).await;
            if let Err(error) = read_clock(&self.store).await {
                error.count();
                tracing::warn!(%error, "the database's clock could not be read: the last time that was read goes on");
            }
        }
    }

    /// Holds the rows of the registry against the journal now and then, and at once when one could not be read,
    /// until it is dropped.
    async fn check_rows(&self) {
        loop {
            // Either way it is time.
            let _ = tokio::time::timeout(ROWS_CHECK, self.store.rows_in_doubt()).await;
            if let Err(error) = self.store.mend_rows().await {
                error.count();
                tracing::warn!(%error, "rows could not be held against the journal");
            }
        }
    }

    /// Serves one connection on a task of its own.
    fn answer(
        &self,
        stream: TcpStream,
        peer: SocketAddr,
        slot: ConnectionSlot,
        connections: &GracefulShutdown,
    ) {
        // Without it each request takes a few milliseconds longer.
        let _ = stream.set_nodelay(true);
        let mut server = http1::Builder::new();
        // The timeout of a head also runs while a connection is idle, and ends it. A client that has closed
        // its sending half may wait for its answer: with `half_close` hyper does not read while a request is
        // being answered, and `Client::gone` sees the end of a connection in its place.
        server.timer(TokioTimer::new()).header_read_timeout(self.settings.head_timeout).half_close(true);
        let client = Client::new(stream);
        let router = Extension(ClientAddress(peer.ip())).layer(self.router.clone());
        let router = TowerToHyperService::new(router);
        let asked = Arc::clone(&client);
        let service = service_fn(move |request| {
            let (answering, answer) = (asked.answering(), router.call(request));
            async move {
                let answer = answer.await;
                drop(answering);
                answer
            }
        });
        let stream = WriteTimeout::new(client.stream(), self.settings.answer_timeout);
        let begun = stream.begun();
        let stream = ProblemStream::new(stream, self.http.clone());
        let connection = connections.watch(server.serve_connection(TokioIo::new(stream), service));
        tokio::spawn(async move {
            // The work for an answer ends with the connection that waits for it.
            let served = tokio::select! {
                biased;
                served = connection => served,
                () = client.gone() => Ok(()),
            };
            if let Err(error) = served {
                if error.is_timeout() {
                    let slow_in = if begun.load(Ordering::Relaxed) { "head" } else { "idle" };
                    metrics::counter!(names::CONNECTIONS_ENDED, "slow_in" => slow_in).increment(1);
                }
                // A client that goes away is no fault.
                tracing::debug!(error = %error, "a connection ended early");
            }
            drop(slot);
        });
    }
}
