//! The service as a whole: built from its settings, served until it is told to stop.

mod connections;
mod farewell;
mod stalled;

use std::net::SocketAddr;
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::Duration;

use axum::Router;
use hyper::server::conn::http1;
use hyper_util::rt::{TokioIo, TokioTimer};
use hyper_util::server::graceful::GracefulShutdown;
use hyper_util::service::TowerToHyperService;
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::watch;

use crate::compute::{Compute, ComputeError, ComputeSettings};
use crate::config::Config;
use crate::domain::TokenRole;
use crate::http::{self, Admission, Connection, Doors, Http, Shared};
use crate::jobs::Jobs;
use crate::models::Models;
use crate::storage::{Store, StoreError};
use crate::telemetry::{self, names};
use connections::{Connections, Place};
use stalled::Stalled;

pub use connections::ConnectionSettings;

/// Models that stay in memory; one of the usual size takes some three megabytes, most of it the
/// FRF's spectra.
const MODEL_CACHE: usize = 32;

/// How long answers under way may take after the wish to stop. Jobs then have the rest of the
/// 30 seconds that a stop may take.
const DRAIN: Duration = Duration::from_secs(20);

/// How long connections are still accepted after the wish to stop: who came before readiness said no is
/// answered.
const LAST_CALL: Duration = Duration::from_millis(100);

/// How long the last of them have to send a request.
const LAST_WORDS: Duration = Duration::from_millis(500);

/// How often measured times are put into their buckets, whether somebody asks for them or not: until
/// then each takes memory of its own.
const UPKEEP: Duration = Duration::from_secs(5);

/// Pause after an accept that failed for want of file handles, so that closing ones can catch up.
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
    /// Without a token only loopback is safe.
    #[error(
        "refusing to listen on {0}: there is no admin's token in force, and everybody who reaches that address \
         could read and delete everything; make one with `rigcast token create --role admin`, or listen on 127.0.0.1"
    )]
    OpenToNetwork(SocketAddr),
}

/// A service that is ready to be served; its jobs run already.
pub struct App {
    router: Router,
    http: Shared,
    store: Store,
    jobs: Jobs,
    draining: watch::Sender<bool>,
    settings: ConnectionSettings,
    connections: Arc<Connections>,
}

/// The one place that reads the clock; everything below is handed this function.
pub fn now() -> jiff::Timestamp {
    jiff::Timestamp::now()
}

/// Whether somebody holds a token with which all others can be made.
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
        let store = Store::open(&config.data_dir).await?;
        let on_loopback = config.listen.ip().is_loopback();
        if !on_loopback && !has_admin(&store).await? {
            store.close().await;
            return Err(AppError::OpenToNetwork(config.listen));
        }
        let settings = ComputeSettings { fit_permits: config.jobs.workers, ..config.compute.clone() };
        let compute = Compute::new(&settings)?;
        let models = Models::new(store.clone(), compute.clone(), MODEL_CACHE);
        let jobs = Jobs::start(store.clone(), compute.clone(), now, config.jobs.clone()).await?;
        let (draining, seen) = watch::channel(false);
        let http = Arc::new(Http {
            store: store.clone(),
            jobs: jobs.clone(),
            doors: Doors::new(store.clone(), on_loopback),
            models,
            compute,
            admission: Admission::new(config.admission.clone()),
            limits: config.limits,
            clock: now,
            draining: seen,
            metrics: telemetry::metrics_handle(),
        });
        let settings = config.connections.clone();
        let connections = Connections::new(&settings);
        Ok(Self { router: http::router(http.clone()), http, store, jobs, draining, settings, connections })
    }

    /// What answers requests, for whoever brings them by another way than [`App::serve`].
    pub fn router(&self) -> Router {
        self.router.clone()
    }

    /// Answers requests until `shutdown` comes, then ends: readiness says no at once, soon no
    /// connection is accepted any more, answers under way are finished, running jobs go back
    /// into the queue, the database is closed.
    pub async fn serve(self, listener: TcpListener, shutdown: impl Future<Output = ()>) {
        let connections = GracefulShutdown::new();
        tokio::select! {
            () = self.accept(&listener, &connections) => {}
            () = self.upkeep() => {}
            () = shutdown => {}
        }
        tracing::info!("stopping: soon no more connections are accepted");
        self.draining.send_replace(true);
        let doors = async {
            let _ = tokio::time::timeout(LAST_CALL, self.accept(&listener, &connections)).await;
            self.accept_last(listener, &connections);
            tokio::time::sleep(LAST_WORDS).await;
            tokio::time::timeout(DRAIN, connections.shutdown()).await
        };
        // Jobs stop at once: the longer they go on, the less of the time for a stop is left to put them by.
        // That also ends the streams that follow jobs.
        let (drained, ()) = tokio::join!(doors, self.jobs.shutdown());
        if drained.is_err() {
            tracing::warn!(drain_s = DRAIN.as_secs(), "connections were still open and are cut");
        }
        self.store.close().await;
        tracing::info!("stopped");
    }

    /// Accepts connections for ever.
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

    /// Accepts who is connected already, of which the runtime may not have heard yet, and nobody more:
    /// closing a listener cuts them off.
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
            Some(place) => self.answer(stream, place, connections),
            None => self.connections.refuse(stream, http::too_many_connections(&self.http)),
        }
    }

    /// Sorts measured times in for ever.
    async fn upkeep(&self) {
        let mut upkeep = tokio::time::interval(UPKEEP);
        loop {
            upkeep.tick().await;
            self.http.metrics.run_upkeep();
        }
    }

    /// Serves one connection on a task of its own.
    fn answer(&self, stream: TcpStream, place: Place, connections: &GracefulShutdown) {
        // A failure costs a few milliseconds a request, no more.
        let _ = stream.set_nodelay(true);
        let mut server = http1::Builder::new();
        // The time for a head runs while none is there: it ends idle connections too.
        server.timer(TokioTimer::new()).header_read_timeout(self.settings.head_timeout).half_close(true);
        let service = TowerToHyperService::new(self.router.clone());
        let stream = Stalled::new(stream, self.settings.answer_timeout);
        let begun = stream.begun();
        let stream = Connection::new(stream, self.http.clone());
        let connection = connections.watch(server.serve_connection(TokioIo::new(stream), service));
        tokio::spawn(async move {
            if let Err(error) = connection.await {
                if error.is_timeout() {
                    let slow_in = if begun.load(Ordering::Relaxed) { "head" } else { "idle" };
                    metrics::counter!(names::CONNECTIONS_ENDED, "slow_in" => slow_in).increment(1);
                }
                // Clients that go away are everyday business.
                tracing::debug!(error = %error, "a connection ended early");
            }
            drop(place);
        });
    }
}
