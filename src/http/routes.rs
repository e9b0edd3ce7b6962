//! The table of all operations: it builds the router, and `openapi.yaml` must list the same ones.

use axum::http::Method;
use axum::routing::{MethodRouter, delete, get, patch, post, put};

use super::{
    Shared, active_model, adopt, contract, damage, diagnoses, fits, health, jobs, metrics, models, predict,
    rigs, run_data, runs,
};

/// One operation.
pub struct Route {
    /// Method.
    pub method: Method,
    /// Path, with its parameters in braces.
    pub path: &'static str,
    /// What answers.
    pub handler: fn() -> MethodRouter<Shared>,
}

const fn route(method: Method, path: &'static str, handler: fn() -> MethodRouter<Shared>) -> Route {
    Route { method, path, handler }
}

/// All operations.
pub static ROUTES: &[Route] = &[
    route(Method::GET, "/v1/rigs", || get(rigs::list)),
    route(Method::POST, "/v1/rigs", || post(rigs::create)),
    route(Method::GET, "/v1/rigs/{rig}", || get(rigs::show)),
    route(Method::PATCH, "/v1/rigs/{rig}", || patch(rigs::change)),
    route(Method::DELETE, "/v1/rigs/{rig}", || delete(rigs::remove)),
    route(Method::GET, "/v1/rigs/{rig}/runs", || get(runs::list)),
    route(Method::POST, "/v1/rigs/{rig}/runs", || post(runs::upload)),
    route(Method::GET, "/v1/rigs/{rig}/runs/{run}", || get(runs::show)),
    route(Method::PATCH, "/v1/rigs/{rig}/runs/{run}", || patch(runs::change)),
    route(Method::DELETE, "/v1/rigs/{rig}/runs/{run}", || delete(runs::remove)),
    route(Method::GET, "/v1/rigs/{rig}/runs/{run}/data", || get(run_data::show)),
    route(Method::POST, "/v1/rigs/{rig}/fits", || post(fits::start)),
    route(Method::GET, "/v1/rigs/{rig}/diagnoses", || get(diagnoses::list)),
    route(Method::POST, "/v1/rigs/{rig}/diagnoses", || post(diagnoses::start)),
    route(Method::GET, "/v1/rigs/{rig}/diagnoses/{diagnosis}", || get(diagnoses::show)),
    route(Method::POST, "/v1/rigs/{rig}/diagnoses/{diagnosis}/adopt", || post(adopt::adopt)),
    route(Method::GET, "/v1/jobs", || get(jobs::list)),
    route(Method::GET, "/v1/jobs/{job}", || get(jobs::show)),
    route(Method::GET, "/v1/jobs/{job}/events", || get(jobs::events)),
    route(Method::POST, "/v1/jobs/{job}/cancel", || post(jobs::cancel)),
    route(Method::GET, "/v1/rigs/{rig}/models", || get(models::list)),
    route(Method::POST, "/v1/rigs/{rig}/models", || post(models::import)),
    route(Method::GET, "/v1/rigs/{rig}/models/{version}", || get(models::show)),
    route(Method::DELETE, "/v1/rigs/{rig}/models/{version}", || delete(models::remove)),
    route(Method::GET, "/v1/rigs/{rig}/models/{version}/weights", || get(models::weights)),
    route(Method::GET, "/v1/rigs/{rig}/active-model", || get(active_model::show)),
    route(Method::PUT, "/v1/rigs/{rig}/active-model", || put(active_model::change)),
    route(Method::POST, "/v1/rigs/{rig}/predict", || post(predict::predict)),
    route(Method::POST, "/v1/damage", || post(damage::damage)),
    route(Method::GET, "/livez", || get(health::live)),
    route(Method::GET, "/readyz", || get(health::ready)),
    route(Method::GET, "/metrics", || get(metrics::show)),
    route(Method::GET, "/openapi.yaml", || get(contract::openapi)),
    route(Method::GET, "/docs", || get(contract::docs)),
    route(Method::GET, "/docs/{asset}", || get(contract::docs)),
];
