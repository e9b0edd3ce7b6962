//! Style sheet and scripts of the pages, which a browser keeps: their path changes with their content.

use axum::extract::RawPathParams;
use axum::http::HeaderValue;
use axum::http::header::CONTENT_TYPE;
use axum::response::IntoResponse;

use crate::http::codes;
use crate::http::headers::Immutable;
use crate::http::params::NoParams;
use crate::http::problem::{Answer, Problem};
use crate::ui::assets;

/// `GET /assets/{digest}/{file}`
pub async fn show(path: RawPathParams, _: NoParams) -> Answer {
    let part = |name: &str| path.iter().find(|(key, _)| *key == name).map_or("", |(_, value)| value);
    let found = assets::find(part("digest"), part("file"));
    let asset = found.ok_or_else(|| {
        Problem::new(codes::ROUTE_NOT_FOUND, "The program has changed: load the page again.")
    })?;
    let mut response =
        ([(CONTENT_TYPE, HeaderValue::from_static(asset.media_type))], asset.content).into_response();
    response.extensions_mut().insert(Immutable);
    Ok(response)
}
