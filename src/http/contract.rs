//! The contract and the pages to try it out, both compiled in: they work without internet.

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

/// Where the pages are.
const PAGES_AT: &str = "/docs";

/// Largest page; what it loads is larger, and not looked into.
const MAX_PAGE_BYTES: usize = 64 << 10;

/// `GET /openapi.yaml`
pub async fn openapi(_: NoParams) -> Answer {
    Ok(([(CONTENT_TYPE, "application/yaml")], OPENAPI).into_response())
}

/// `GET /docs` and what its page needs below.
pub async fn docs(_: NoParams, uri: Uri) -> Answer {
    static PAGES: LazyLock<Router> = LazyLock::new(|| {
        swagger_ui_dist::generate_routes(ApiDefinition {
            uri_prefix: PAGES_AT,
            api_definition: OpenApiSource::Uri("/openapi.yaml"),
            title: Some("Rigcast"),
        })
    });
    let mut request = Request::new(Body::empty());
    // The path alone: the page repeats its address, and a client may write anything in front of it.
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
