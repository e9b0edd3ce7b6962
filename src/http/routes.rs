//! The table of all operations and the right to each: it builds the router, so that there is no route
//! without a right, and `openapi.yaml` must list the same ones.

use axum::http::Method;
use axum::routing::{MethodRouter, delete, get, patch, post, put};

use super::rights::Right::{self, AllRigs, Public, Role};
use super::{
    Shared, active_model, adopt, contract, damage, diagnoses, fits, health, jobs, metrics, models, predict,
    rigs, run_data, runs, tokens,
};
use crate::domain::TokenRole::{Admin, Operator, Reader};

/// One operation.
pub struct Route {
    /// Method.
    pub method: Method,
    /// Path, with its parameters in braces.
    pub path: &'static str,
    /// What it asks of whoever calls it.
    pub right: Right,
    /// What answers.
    pub handler: fn() -> MethodRouter<Shared>,
}

const fn route(
    method: Method,
    path: &'static str,
    right: Right,
    handler: fn() -> MethodRouter<Shared>,
) -> Route {
    Route { method, path, right, handler }
}

/// All operations.
pub static ROUTES: &[Route] = &[
    route(Method::GET, "/v1/rigs", Role(Reader), || get(rigs::list)),
    route(Method::POST, "/v1/rigs", Role(Operator), || post(rigs::create)),
    route(Method::GET, "/v1/rigs/{rig}", Role(Reader), || get(rigs::show)),
    route(Method::PATCH, "/v1/rigs/{rig}", Role(Operator), || patch(rigs::change)),
    route(Method::DELETE, "/v1/rigs/{rig}", Role(Admin), || delete(rigs::remove)),
    route(Method::GET, "/v1/rigs/{rig}/runs", Role(Reader), || get(runs::list)),
    route(Method::POST, "/v1/rigs/{rig}/runs", Role(Operator), || post(runs::upload)),
    route(Method::GET, "/v1/rigs/{rig}/runs/{run}", Role(Reader), || get(runs::show)),
    route(Method::PATCH, "/v1/rigs/{rig}/runs/{run}", Role(Operator), || patch(runs::change)),
    route(Method::DELETE, "/v1/rigs/{rig}/runs/{run}", Role(Admin), || delete(runs::remove)),
    route(Method::GET, "/v1/rigs/{rig}/runs/{run}/data", Role(Reader), || get(run_data::show)),
    route(Method::POST, "/v1/rigs/{rig}/fits", Role(Operator), || post(fits::start)),
    route(Method::GET, "/v1/rigs/{rig}/diagnoses", Role(Reader), || get(diagnoses::list)),
    route(Method::POST, "/v1/rigs/{rig}/diagnoses", Role(Operator), || post(diagnoses::start)),
    route(Method::GET, "/v1/rigs/{rig}/diagnoses/{diagnosis}", Role(Reader), || get(diagnoses::show)),
    route(Method::POST, "/v1/rigs/{rig}/diagnoses/{diagnosis}/adopt", Role(Operator), || post(adopt::adopt)),
    route(Method::GET, "/v1/jobs", Role(Reader), || get(jobs::list)),
    route(Method::GET, "/v1/jobs/{job}", Role(Reader), || get(jobs::show)),
    route(Method::GET, "/v1/jobs/{job}/events", Role(Reader), || get(jobs::events)),
    route(Method::POST, "/v1/jobs/{job}/cancel", Role(Operator), || post(jobs::cancel)),
    route(Method::GET, "/v1/rigs/{rig}/models", Role(Reader), || get(models::list)),
    route(Method::POST, "/v1/rigs/{rig}/models", Role(Admin), || post(models::import)),
    route(Method::GET, "/v1/rigs/{rig}/models/{version}", Role(Reader), || get(models::show)),
    route(Method::DELETE, "/v1/rigs/{rig}/models/{version}", Role(Admin), || delete(models::remove)),
    route(Method::GET, "/v1/rigs/{rig}/models/{version}/weights", Role(Operator), || get(models::weights)),
    route(Method::GET, "/v1/rigs/{rig}/active-model", Role(Reader), || get(active_model::show)),
    route(Method::PUT, "/v1/rigs/{rig}/active-model", Role(Operator), || put(active_model::change)),
    route(Method::POST, "/v1/rigs/{rig}/predict", Role(Reader), || post(predict::predict)),
    route(Method::POST, "/v1/damage", Role(Reader), || post(damage::damage)),
    route(Method::GET, "/v1/tokens", AllRigs(Admin), || get(tokens::list)),
    route(Method::POST, "/v1/tokens", AllRigs(Admin), || post(tokens::create)),
    route(Method::DELETE, "/v1/tokens/{token}", AllRigs(Admin), || delete(tokens::remove)),
    route(Method::GET, "/livez", Public, || get(health::live)),
    route(Method::GET, "/readyz", Public, || get(health::ready)),
    route(Method::GET, "/metrics", AllRigs(Reader), || get(metrics::show)),
    route(Method::GET, "/openapi.yaml", Public, || get(contract::openapi)),
    route(Method::GET, "/docs", Public, || get(contract::docs)),
    route(Method::GET, "/docs/{asset}", Public, || get(contract::docs)),
];
