//! The contract and its documentation pages, compiled in so that they work without internet.

use std::sync::LazyLock;

use axum::Router;
use axum::body::{Body, to_bytes};
use axum::extract::Request;
use axum::http::header::{CONTENT_SECURITY_POLICY, CONTENT_TYPE};
use axum::http::{HeaderValue, StatusCode, Uri};
use axum::response::IntoResponse;
use swagger_ui_dist::{ApiDefinition, OpenApiSource};
use tower::ServiceExt;

use super::headers::page_with_script;
use super::params::NoParams;
use super::problem::{self, Answer, Problem};

/// The contract, as it is in the repository.
pub const OPENAPI: &str = include_str!("../../openapi.yaml");

/// Path of the pages.
const PAGES_AT: &str = "/docs";

/// Largest page that is searched for scripts; the files that a page loads are larger.
const MAX_PAGE_BYTES: usize = 64 << 10;

/// `GET /openapi.yaml`
pub async fn openapi(_: NoParams) -> Answer {
    Ok(([(CONTENT_TYPE, "application/yaml")], OPENAPI).into_response())
}

/// `GET /docs` and the files that its page loads.
pub async fn docs(_: NoParams, uri: Uri) -> Answer {
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
    if response.status() == StatusCode::NOT_FOUND {
        return Err(problem::no_route(uri).await);
    }
    if uri.path() != PAGES_AT {
        return Ok(response);
    }
    let (mut head, page) = response.into_parts();
    let page = to_bytes(page, MAX_PAGE_BYTES).await.map_err(Problem::internal)?;
    let policy = page_with_script(&String::from_utf8_lossy(&page));
    let policy = HeaderValue::try_from(policy).map_err(Problem::internal)?;
    head.headers.insert(CONTENT_SECURITY_POLICY, policy);
    Ok((head, page).into_response())
}
