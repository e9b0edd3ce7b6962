//! The contract and the files of its documentation page, compiled in so that they work without internet.

use std::sync::LazyLock;

use axum::Router;
use axum::body::Body;
use axum::extract::Request;
use axum::http::header::CONTENT_TYPE;
use axum::http::{StatusCode, Uri};
use axum::response::IntoResponse;
use swagger_ui_dist::{ApiDefinition, OpenApiSource};
use tower::ServiceExt;

use super::params::NoParams;
use super::problem::{self, Answer, Problem};

/// The contract, as it is in the repository.
pub const OPENAPI: &str = include_str!("../../openapi.yaml");

/// Path of the pages.
const PAGES_AT: &str = "/docs";

/// `GET /openapi.yaml`
pub async fn openapi(_: NoParams) -> Answer {
    Ok(([(CONTENT_TYPE, "application/yaml")], OPENAPI).into_response())
}

/// `GET /docs/{asset}`: the files that the page loads; the page that the crate has is not used, for its script stands in it.
pub async fn asset(_: NoParams, uri: Uri) -> Answer {
    static PAGES: LazyLock<Router> = LazyLock::new(|| {
        swagger_ui_dist::generate_routes(ApiDefinition {
            uri_prefix: PAGES_AT,
            api_definition: OpenApiSource::Uri("/openapi.yaml"),
            title: Some("Rigcast"),
        })
    });
    let mut request = Request::new(Body::empty());
    // Only the path: the page repeats its own address, and a client may write anything in front of the
    // path.
    *request.uri_mut() = uri.path().parse().map_err(Problem::internal)?;
    let response = PAGES.clone().oneshot(request).await.map_err(Problem::internal)?;
    let is_page =
        response.headers().get(CONTENT_TYPE).is_some_and(|kind| kind.as_bytes().starts_with(b"text/html"));
    if response.status() == StatusCode::NOT_FOUND || is_page {
        return Err(problem::no_route(uri).await);
    }
    Ok(response)
}
