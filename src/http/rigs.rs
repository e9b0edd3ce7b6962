//! Rigs.

use axum::body::Body;
use axum::extract::State;
use axum::http::header::ETAG;
use axum::http::{HeaderMap, StatusCode};
use axum::response::IntoResponse;
use serde_json::Value;

use super::auth::Caller;
use super::etag::{self, if_match};
use super::idempotency::{RequestKey, created};
use super::json::{self, Json};
use super::observe::note_rig;
use super::params::{NoParams, Params, page};
use super::paths::{OfRig, no_rig};
use super::problem::{Answer, FieldError, Problem};
use super::{Shared, codes};
use crate::domain::{Created, Rig, RigDraft};
use crate::storage::RigUpdate;

/// Media types of a merge patch: its own, and plain JSON, which most clients send.
pub const PATCH_TYPES: &[&str] = &["application/merge-patch+json", json::MEDIA_TYPE];

/// `GET /v1/rigs`
pub async fn list(State(http): State<Shared>, caller: Caller, mut params: Params) -> Answer {
    let page = page(&mut params)?;
    params.finish()?;
    json::answer(&http.store.rigs(caller.scope(), &page).await?)
}

/// `POST /v1/rigs`
pub async fn create(
    State(http): State<Shared>,
    caller: Caller,
    _: NoParams,
    key: RequestKey,
    Json(draft): Json<RigDraft>,
) -> Answer {
    note_rig(&tracing::Span::current(), &draft.id);
    if !caller.reaches(&draft.id) {
        let limit = "a rig that the token is for";
        return Err(Problem::new(codes::TOKEN_SCOPE, format!("/id must be {limit}."))
            .with(FieldError::new("/id", limit)));
    }
    draft.check().map_err(invalid)?;
    let Some(rig) = http.store.insert_rig(&draft, key.stored().as_ref(), http.now()).await? else {
        let detail = format!("There is a rig {:?} already.", draft.id.as_str());
        return Err(Problem::new(codes::RIG_EXISTS, detail).with(FieldError::new("/id", "an id of its own")));
    };
    created(Created::rig(&rig))
}

/// `GET /v1/rigs/{rig}`
pub async fn show(State(http): State<Shared>, OfRig(id): OfRig, _: NoParams) -> Answer {
    let rig = http.store.rig(&id).await?.ok_or_else(|| no_rig(id.as_str()))?;
    tagged(&rig)
}

/// `PATCH /v1/rigs/{rig}`
pub async fn change(
    State(http): State<Shared>,
    OfRig(id): OfRig,
    _: NoParams,
    headers: HeaderMap,
    body: Body,
) -> Answer {
    let tags = if_match(&headers)?;
    let patch: Value = json::take(&headers, body, &http, PATCH_TYPES).await?;
    let rig = http.store.rig(&id).await?.ok_or_else(|| no_rig(id.as_str()))?;
    let current = rig.etag();
    match http.store.patch_rig(&id, tags.check(&current)?, &patch, http.now()).await? {
        RigUpdate::Updated(rig) => tagged(&rig),
        RigUpdate::Missing => Err(no_rig(id.as_str())),
        RigUpdate::Stale(current) => Err(etag::stale(&current)),
        RigUpdate::ChannelsFixed => {
            let detail = "The rig has runs: its channels and its sample rate are fixed.";
            Err(Problem::new(codes::RIG_CHANNELS_FIXED, detail)
                .with(FieldError::new("/channels", "fixed once a run exists")))
        }
        RigUpdate::Invalid(errors) => Err(invalid(errors)),
    }
}

/// `DELETE /v1/rigs/{rig}`
pub async fn remove(State(http): State<Shared>, OfRig(id): OfRig, _: NoParams) -> Answer {
    if !http.store.delete_rig(&id).await? {
        return Err(no_rig(id.as_str()));
    }
    http.models.forget(&id, None);
    Ok(StatusCode::NO_CONTENT.into_response())
}

fn tagged(rig: &Rig) -> Answer {
    Ok(([(ETAG, rig.etag())], json::answer(rig)?).into_response())
}

fn invalid(errors: Vec<FieldError>) -> Problem {
    Problem::new(codes::RIG_INVALID, super::errors::summary("The rig does not make sense", &errors))
        .with_all(errors)
}
