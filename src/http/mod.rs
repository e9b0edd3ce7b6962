//! The HTTP contract: routes, problem documents, one file a resource.
//!
//! Handlers parse, call and map. What needs the processor goes through [`crate::compute`]; what
//! is wrong becomes a problem (`problem`), whose document the outermost layer (`observe`)
//! writes. The routes are one table ([`routes`]), which `openapi.yaml` must equal; each stands behind
//! a door ([`Doors`]) that asks for the right that the table gives it, and waits for a turn of the class
//! of traffic ([`Traffic`]) that it has there.

mod active_model;
mod admission;
mod adopt;
mod arrays;
mod body;
pub mod codes;
mod contract;
mod damage;
mod deadline;
mod diagnoses;
mod doors;
mod errors;
mod etag;
mod fits;
mod headers;
mod health;
mod jobs;
mod json;
mod lists;
mod metrics;
mod models;
mod negotiate;
mod observe;
mod once;
mod params;
mod paths;
mod predict;
mod problem;
mod rights;
mod rigs;
pub mod routes;
mod run_data;
mod run_file;
mod runs;
mod signals;
mod strict;
mod tokens;
mod unreadable;
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
use crate::jobs::Jobs;
use crate::models::Models;
use crate::storage::Store;
use problem::Answer;

pub use admission::{Admission, AdmissionSettings, Traffic};
pub use body::Pace;
pub use doors::Doors;
pub use rights::Right;
pub use unreadable::{Connection, too_many_connections};

/// Largest bodies that are read, and the longest that is waited for them and for answers.
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
    /// Longest work for an answer once its request was read, the wait for a turn included.
    pub deadline: Duration,
}

impl Default for Limits {
    /// 64 MiB; 128 MiB, which hold an hour of three drives at 1 kHz in either precision; 4 GiB; a minute.
    fn default() -> Self {
        Self {
            json_bytes: 64 << 20,
            drive_bytes: 128 << 20,
            upload_bytes: 4 << 30,
            pace: Pace::default(),
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
    /// Who comes in.
    pub doors: Doors,
    /// Loaded models.
    pub models: Models,
    /// The door to the processor.
    pub compute: Compute,
    /// Turns of requests.
    pub admission: Admission,
    /// Largest and slowest bodies.
    pub limits: Limits,
    /// The time.
    pub clock: Clock,
    /// True from the wish to stop on.
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

    /// Does work that takes longer than a millisecond where it holds up nobody else.
    async fn off_thread<T, F>(&self, class: Class, work: F) -> Answer<T>
    where
        T: Send + 'static,
        F: FnOnce() -> T + Send + 'static,
    {
        self.compute.run(class, admission::who(), work).await.map_err(Into::into)
    }
}

/// The service, ready to be served: every route of the table behind its door.
pub fn router(http: Shared) -> Router {
    routes::ROUTES
        .iter()
        .fold(Router::new(), |router, route| {
            let guard = from_fn_with_state((http.clone(), route.right), doors::guard);
            // Inside the guard: an answer is given again to whom it was given before.
            let once = from_fn_with_state(http.clone(), once::once);
            let admit = from_fn_with_state((http.clone(), route.traffic), admission::admit);
            let handler = (route.handler)().route_layer(once).route_layer(admit).route_layer(guard);
            router.route(route.path, handler)
        })
        .fallback(problem::no_route)
        .method_not_allowed_fallback(problem::no_method)
        .layer(from_fn_with_state(http.clone(), observe::observe))
        .layer(SetSensitiveRequestHeadersLayer::new([AUTHORIZATION]))
        .with_state(http)
}
