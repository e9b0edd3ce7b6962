//! The HTTP contract: routes, problem documents, one file a resource.
//!
//! Handlers parse, call and map. Work for the processor goes through [`crate::compute`]. An error
//! becomes a problem (`problem`), whose document the outermost layer (`observe`) writes. The routes are
//! one table ([`routes`]), which a test compares with `openapi.yaml`. For each route the table gives the
//! right, which [`Auth`] checks, and the class of traffic ([`Traffic`]), whose permit a request waits
//! for.

mod active_model;
mod admission;
mod adopt;
mod auth;
mod body;
pub mod codes;
mod compression;
mod contract;
mod damage;
mod deadline;
mod diagnoses;
mod drift;
mod errors;
mod etag;
mod evaluations;
mod fits;
mod frf;
mod headers;
mod health;
mod idempotency;
mod inference;
mod iterations;
mod jobs;
mod measurement;
mod metrics;
mod model_report;
mod models;
mod negotiate;
mod observe;
mod pages;
mod params;
mod paths;
mod predict;
mod problem;
mod refusals;
mod rigs;
pub mod routes;
mod runs;
mod studies;
mod tokens;
mod upload;

use std::sync::Arc;
use std::time::Duration;

use axum::Router;
use axum::http::header::AUTHORIZATION;
use axum::middleware::from_fn_with_state;
use metrics_exporter_prometheus::PrometheusHandle;
use tokio::sync::watch;
use tower_http::sensitive_headers::SetSensitiveRequestHeadersLayer;

use crate::compute::{Class, Compute};
use crate::domain::{self, Clock};
use crate::jobs::{DriftWatch, Jobs};
use crate::models::Models;
use crate::storage::Store;
use body::json;
use problem::Answer;

pub use admission::{Admission, AdmissionSettings, Traffic};
pub use auth::{Auth, Right};
pub use body::Pace;
pub use metrics::begin as begin_metrics;
pub use observe::ClientAddress;
pub use pages::RunViews;
pub use predict::{Comparisons, PredictionMemory};
pub use refusals::{too_many_connections, unreadable_request};

/// Largest bodies, and longest times for a body and for an answer.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Limits {
    /// JSON bodies, bytes.
    pub json_bytes: u64,
    /// NPY drives of predictions, bytes.
    pub drive_bytes: u64,
    /// Run files and weights, bytes.
    pub upload_bytes: u64,
    /// Slowest bodies.
    pub pace: Pace,
    /// Memory of all large predictions together, their answers included, bytes.
    pub prediction_bytes: usize,
    /// Longest time for an answer once its request was read, the wait in the queue included.
    pub deadline: Duration,
}

impl Default for Limits {
    /// 64 MiB; 128 MiB, which hold an hour of three drives at 1 kHz in either precision; 4 GiB; 224 MiB, so
    /// that all that predictions take stays below 256 MiB; a minute.
    fn default() -> Self {
        Self {
            json_bytes: 64 << 20,
            drive_bytes: 128 << 20,
            upload_bytes: 4 << 30,
            pace: Pace::default(),
            prediction_bytes: 224 << 20,
            deadline: Duration::from_secs(60),
        }
    }
}

/// Everything that a handler may need.
pub struct Http {
    /// Registry and objects.
    pub store: Store,
    /// Jobs.
    pub jobs: Jobs,
    /// Errors of active models on the runs that arrive.
    pub drift: DriftWatch,
    /// Tokens and rights.
    pub auth: Auth,
    /// Loaded models.
    pub models: Models,
    /// Work for the processor.
    pub compute: Compute,
    /// Permits for requests.
    pub admission: Admission,
    /// Memory of large predictions.
    pub predictions: PredictionMemory,
    /// Comparisons that are being looked at.
    pub comparisons: Comparisons,
    /// Runs that are being looked at.
    pub views: RunViews,
    /// Largest and slowest bodies.
    pub limits: Limits,
    /// The time.
    pub clock: Clock,
    /// True once the service was told to stop.
    pub draining: watch::Receiver<bool>,
    /// Renders the process' metrics.
    pub metrics: PrometheusHandle,
}

/// As handlers get it.
pub type Shared = Arc<Http>;

impl Http {
    fn now(&self) -> jiff::Timestamp {
        (self.clock)()
    }

    fn new_id(&self) -> uuid::Uuid {
        domain::new_id(self.now())
    }

    /// Does work that takes longer than a millisecond off the async threads.
    async fn off_thread<T, F>(&self, class: Class, work: F) -> Answer<T>
    where
        T: Send + 'static,
        F: FnOnce() -> T + Send + 'static,
    {
        self.compute.run(class, admission::asker(), work).await.map_err(Into::into)
    }
}

/// The router: every route of the table, behind the checks of its right and its class of traffic.
pub fn router(http: Shared) -> Router {
    router_of(http, |_| true)
}

/// The router of a process that only runs jobs: what monitors ask for.
pub fn monitors_router(http: Shared) -> Router {
    router_of(http, |route| ["/livez", "/readyz", "/metrics"].contains(&route.path))
}

fn router_of(http: Shared, has: impl Fn(&routes::Route) -> bool) -> Router {
    routes::ROUTES
        .iter()
        .filter(|route| has(route))
        .fold(Router::new(), |router, route| {
            let guard = from_fn_with_state((http.clone(), route.right), auth::guard);
            // Inside the guard, so that a repeated answer goes only to the caller that got it first.
            let idempotent = from_fn_with_state(http.clone(), idempotency::answer_once);
            let admit = from_fn_with_state((http.clone(), route.traffic), admission::admit);
            let handler = (route.handler)().route_layer(idempotent).route_layer(admit).route_layer(guard);
            router.route(route.path, handler)
        })
        .fallback(problem::no_route)
        .method_not_allowed_fallback(problem::no_method)
        .layer(compression::layer())
        .layer(from_fn_with_state(http.clone(), observe::observe))
        .layer(SetSensitiveRequestHeadersLayer::new([AUTHORIZATION]))
        .with_state(http)
}
