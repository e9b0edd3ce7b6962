//! The model version that answers as `active`.

use axum::extract::State;
use axum::http::HeaderMap;
use axum::http::header::ETAG;
use axum::response::IntoResponse;
use serde::{Deserialize, Deserializer};

use super::etag::{self, if_match};
use super::json::{self, Json};
use super::params::NoParams;
use super::paths::{OfRig, no_model, no_rig};
use super::problem::{Answer, FieldError, Problem};
use super::{Shared, codes};
use crate::domain::ActiveModel;
use crate::storage::ActiveUpdate;

/// Body of the change.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Wanted {
    /// The version, or null for none; the field must be there.
    #[serde(deserialize_with = "present")]
    version: Option<u32>,
}

fn present<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Option<u32>, D::Error> {
    Option::deserialize(deserializer)
}

/// `GET /v1/rigs/{rig}/active-model`
pub async fn show(State(http): State<Shared>, OfRig(rig): OfRig, _: NoParams) -> Answer {
    let active = http.store.active_model(&rig).await?.ok_or_else(|| no_rig(rig.as_str()))?;
    tagged(&active)
}

/// `PUT /v1/rigs/{rig}/active-model`
pub async fn change(
    State(http): State<Shared>,
    OfRig(rig): OfRig,
    _: NoParams,
    headers: HeaderMap,
    Json(wanted): Json<Wanted>,
) -> Answer {
    let tags = if_match(&headers)?;
    let current = http.store.active_model(&rig).await?.ok_or_else(|| no_rig(rig.as_str()))?.etag();
    match http.store.set_active_model(&rig, wanted.version, tags.check(&current)?, http.now()).await? {
        ActiveUpdate::Updated(active) => {
            http.drift.wake();
            tagged(&active)
        }
        ActiveUpdate::MissingRig => Err(no_rig(rig.as_str())),
        ActiveUpdate::MissingModel => Err(no_model(&wanted.version.unwrap_or_default().to_string())),
        ActiveUpdate::NotForward => {
            let limit = "a version that maps all drives of the rig to all its responses";
            Err(Problem::new(codes::MODEL_NOT_FORWARD, format!("The active model must be {limit}."))
                .with(FieldError::new("/version", limit)))
        }
        ActiveUpdate::Stale(active) => Err(etag::stale(&active.etag())),
    }
}

fn tagged(active: &ActiveModel) -> Answer {
    Ok(([(ETAG, active.etag())], json::answer(active)?).into_response())
}
