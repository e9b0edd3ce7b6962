//! The table of all operations, with the right and the class of traffic of each. The router is built
//! from it, so that every route has both. A test compares it with `openapi.yaml`.

use axum::http::Method;
use axum::routing::{MethodRouter, delete, get, patch, post, put};

use super::admission::Traffic::{self, Control, Jobs, Predict, Registry, Upload};
use super::auth::Right::{self, AllRigs, Public, Role};
use super::{
    Shared, active_model, adopt, contract, damage, diagnoses, drift, evaluations, fits, frf, health,
    inference, iterations, jobs, metrics, model_report, models, pages, predict, rigs, runs, studies, tokens,
};
use crate::domain::TokenRole::{Admin, Operator, Reader};

/// One operation.
pub struct Route {
    /// Method.
    pub method: Method,
    /// Path, with its parameters in braces.
    pub path: &'static str,
    /// The right that the caller needs.
    pub right: Right,
    /// Class of traffic, whose permit a request waits for.
    pub traffic: Traffic,
    /// Whom it answers.
    pub audience: Audience,
    /// The handler.
    pub handler: fn() -> MethodRouter<Shared>,
}

/// Whom a route answers.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Audience {
    /// Programs: the route is an operation of the contract.
    Programs,
    /// People: a page, or what pages load. It is no part of the contract.
    People,
}

const fn route(
    method: Method,
    path: &'static str,
    right: Right,
    traffic: Traffic,
    handler: fn() -> MethodRouter<Shared>,
) -> Route {
    Route { method, path, right, traffic, audience: Audience::Programs, handler }
}

/// A page.
const fn page(
    path: &'static str,
    right: Right,
    traffic: Traffic,
    handler: fn() -> MethodRouter<Shared>,
) -> Route {
    Route { method: Method::GET, path, right, traffic, audience: Audience::People, handler }
}

/// What the forms of pages send before there is a session.
const fn form(path: &'static str, handler: fn() -> MethodRouter<Shared>) -> Route {
    Route { method: Method::POST, path, right: Public, traffic: Control, audience: Audience::People, handler }
}

/// All operations.
pub static ROUTES: &[Route] = &[
    route(Method::GET, "/v1/rigs", Role(Reader), Registry, || get(rigs::list)),
    route(Method::POST, "/v1/rigs", Role(Operator), Registry, || post(rigs::create)),
    route(Method::GET, "/v1/rigs/{rig}", Role(Reader), Registry, || get(rigs::show)),
    route(Method::PATCH, "/v1/rigs/{rig}", Role(Operator), Registry, || patch(rigs::change)),
    route(Method::DELETE, "/v1/rigs/{rig}", Role(Admin), Registry, || delete(rigs::remove)),
    route(Method::GET, "/v1/rigs/{rig}/runs", Role(Reader), Registry, || get(runs::list)),
    route(Method::POST, "/v1/rigs/{rig}/runs", Role(Operator), Upload, || post(runs::upload)),
    route(Method::GET, "/v1/rigs/{rig}/runs/{run}", Role(Reader), Registry, || get(runs::show)),
    route(Method::PATCH, "/v1/rigs/{rig}/runs/{run}", Role(Operator), Registry, || patch(runs::change)),
    route(Method::DELETE, "/v1/rigs/{rig}/runs/{run}", Role(Admin), Registry, || delete(runs::remove)),
    route(Method::GET, "/v1/rigs/{rig}/runs/{run}/data", Role(Reader), Predict, || get(runs::data::show)),
    route(Method::POST, "/v1/rigs/{rig}/fits", Role(Operator), Jobs, || post(fits::start)),
    route(Method::GET, "/v1/rigs/{rig}/diagnoses", Role(Reader), Registry, || get(diagnoses::list)),
    route(Method::POST, "/v1/rigs/{rig}/diagnoses", Role(Operator), Jobs, || post(diagnoses::start)),
    route(Method::GET, "/v1/rigs/{rig}/diagnoses/{diagnosis}", Role(Reader), Registry, || {
        get(diagnoses::show)
    }),
    route(Method::GET, "/v1/rigs/{rig}/drift", Role(Reader), Registry, || get(drift::show)),
    route(Method::GET, "/v1/rigs/{rig}/iterations", Role(Reader), Registry, || get(iterations::list)),
    route(Method::POST, "/v1/rigs/{rig}/iterations", Role(Operator), Jobs, || post(iterations::start)),
    route(Method::GET, "/v1/rigs/{rig}/iterations/{iteration}", Role(Reader), Registry, || {
        get(iterations::show)
    }),
    route(Method::GET, "/v1/rigs/{rig}/evaluations", Role(Reader), Registry, || get(evaluations::list)),
    route(Method::POST, "/v1/rigs/{rig}/evaluations", Role(Operator), Jobs, || post(evaluations::start)),
    route(Method::GET, "/v1/rigs/{rig}/evaluations/{evaluation}", Role(Reader), Registry, || {
        get(evaluations::show)
    }),
    route(Method::GET, "/v1/rigs/{rig}/studies", Role(Reader), Registry, || get(studies::list)),
    route(Method::POST, "/v1/rigs/{rig}/studies", Role(Operator), Jobs, || post(studies::start)),
    route(Method::GET, "/v1/rigs/{rig}/studies/{study}", Role(Reader), Registry, || get(studies::show)),
    route(Method::POST, "/v1/rigs/{rig}/diagnoses/{diagnosis}/adopt", Role(Operator), Jobs, || {
        post(adopt::adopt)
    }),
    route(Method::GET, "/v1/jobs", Role(Reader), Registry, || get(jobs::list)),
    route(Method::GET, "/v1/jobs/{job}", Role(Reader), Registry, || get(jobs::show)),
    route(Method::GET, "/v1/jobs/{job}/losses", Role(Reader), Registry, || get(jobs::losses)),
    route(Method::GET, "/v1/jobs/{job}/events", Role(Reader), Registry, || get(jobs::events)),
    route(Method::POST, "/v1/jobs/{job}/cancel", Role(Operator), Control, || post(jobs::cancel)),
    route(Method::GET, "/v1/rigs/{rig}/models", Role(Reader), Registry, || get(models::list)),
    route(Method::POST, "/v1/rigs/{rig}/models", Role(Admin), Upload, || post(models::import)),
    route(Method::GET, "/v1/rigs/{rig}/models/{version}", Role(Reader), Registry, || get(models::show)),
    route(Method::DELETE, "/v1/rigs/{rig}/models/{version}", Role(Admin), Registry, || {
        delete(models::remove)
    }),
    route(Method::GET, "/v1/rigs/{rig}/models/{version}/weights", Role(Operator), Registry, || {
        get(models::weights)
    }),
    route(Method::GET, "/v1/rigs/{rig}/models/{version}/report", Role(Reader), Registry, || {
        get(model_report::show)
    }),
    route(Method::GET, "/v1/rigs/{rig}/models/{version}/frf", Role(Reader), Predict, || get(frf::show)),
    route(Method::GET, "/v1/rigs/{rig}/active-model", Role(Reader), Registry, || get(active_model::show)),
    route(Method::PUT, "/v1/rigs/{rig}/active-model", Role(Operator), Registry, || put(active_model::change)),
    route(Method::POST, "/v1/rigs/{rig}/predict", Role(Reader), Predict, || post(predict::predict)),
    route(Method::POST, "/v1/damage", Role(Reader), Predict, || post(damage::damage)),
    route(Method::GET, "/v2", Role(Reader), Control, || get(inference::server)),
    route(Method::GET, "/v2/health/live", Public, Control, || get(inference::live)),
    route(Method::GET, "/v2/health/ready", Public, Control, || get(inference::ready)),
    route(Method::POST, "/v2/repository/index", Role(Reader), Registry, || post(inference::index)),
    route(Method::GET, "/v2/models/{rig}", Role(Reader), Registry, || get(inference::metadata)),
    route(Method::GET, "/v2/models/{rig}/config", Role(Reader), Registry, || get(inference::config)),
    route(Method::GET, "/v2/models/{rig}/ready", Role(Reader), Registry, || get(inference::model_ready)),
    route(Method::POST, "/v2/models/{rig}/infer", Role(Reader), Predict, || post(inference::infer)),
    route(Method::GET, "/v2/models/{rig}/versions/{version}", Role(Reader), Registry, || {
        get(inference::metadata)
    }),
    route(Method::GET, "/v2/models/{rig}/versions/{version}/config", Role(Reader), Registry, || {
        get(inference::config)
    }),
    route(Method::GET, "/v2/models/{rig}/versions/{version}/ready", Role(Reader), Registry, || {
        get(inference::model_ready)
    }),
    route(Method::POST, "/v2/models/{rig}/versions/{version}/infer", Role(Reader), Predict, || {
        post(inference::infer)
    }),
    route(Method::GET, "/v1/tokens", AllRigs(Admin), Control, || get(tokens::list)),
    route(Method::POST, "/v1/tokens", AllRigs(Admin), Control, || post(tokens::create)),
    route(Method::DELETE, "/v1/tokens/{token}", AllRigs(Admin), Control, || delete(tokens::remove)),
    route(Method::GET, "/", Public, Registry, || get(pages::rigs)),
    page("/rigs/{rig}", Role(Reader), Registry, || get(pages::rig)),
    page("/rigs/{rig}/drift", Role(Reader), Registry, || get(pages::drift)),
    page("/rigs/{rig}/upload", Role(Operator), Registry, || get(pages::upload)),
    page("/rigs/{rig}/fit", Role(Operator), Registry, || get(pages::fit)),
    page("/rigs/{rig}/predict", Role(Reader), Predict, || get(pages::predict)),
    page("/rigs/{rig}/diagnose", Role(Operator), Registry, || get(pages::diagnose)),
    page("/rigs/{rig}/diagnoses/{diagnosis}", Role(Reader), Registry, || get(pages::diagnosis)),
    page("/rigs/{rig}/iterate", Role(Operator), Registry, || get(pages::iterate)),
    page("/rigs/{rig}/iterations/{iteration}", Role(Reader), Registry, || get(pages::iteration)),
    page("/rigs/{rig}/evaluate", Role(Operator), Registry, || get(pages::evaluate)),
    page("/rigs/{rig}/study", Role(Operator), Registry, || get(pages::start_study)),
    page("/rigs/{rig}/evaluations/{evaluation}", Role(Reader), Registry, || get(pages::evaluation)),
    page("/rigs/{rig}/studies/{study}", Role(Reader), Registry, || get(pages::study)),
    page("/rigs/{rig}/runs/{run}", Role(Reader), Predict, || get(pages::run)),
    page("/rigs/{rig}/runs/{run}/file", Role(Reader), Predict, || get(pages::run_file)),
    page("/rigs/{rig}/models/{version}", Role(Reader), Predict, || get(pages::model)),
    page("/rigs/{rig}/models/{version}/report", Role(Reader), Registry, || get(pages::model_report)),
    page("/jobs", Role(Reader), Registry, || get(pages::jobs)),
    page("/jobs/{job}", Role(Reader), Registry, || get(pages::job)),
    page("/tokens", AllRigs(Admin), Control, || get(pages::tokens)),
    page("/operations", Role(Reader), Control, || get(pages::operations)),
    page("/assets/{digest}/{file}", Public, Control, || get(pages::asset)),
    page("/sign-in", Public, Control, || get(pages::sign_in)),
    page("/signed-in", Public, Control, || get(pages::signed_in)),
    page("/session", Role(Reader), Control, || get(pages::session)),
    form("/sign-in", || post(pages::begin_session)),
    form("/sign-out", || post(pages::sign_out)),
    route(Method::GET, "/livez", Public, Control, || get(health::live)),
    route(Method::GET, "/readyz", Public, Control, || get(health::ready)),
    route(Method::GET, "/metrics", AllRigs(Reader), Control, || get(metrics::show)),
    route(Method::GET, "/openapi.yaml", Public, Registry, || get(contract::openapi)),
    route(Method::GET, "/docs", Public, Registry, || get(pages::docs)),
    route(Method::GET, "/docs/{asset}", Public, Registry, || get(contract::asset)),
];
