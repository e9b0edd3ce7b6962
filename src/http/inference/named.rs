//! The model that a path names.

use axum::extract::{FromRequestParts, MatchedPath};
use axum::http::request::Parts;

use crate::domain::{ModelRef, RigId};
use crate::http::paths::{OfModel, OfRig};
use crate::http::problem::{Answer, Problem};

/// `/v2/models/{rig}...`, the active version, or `/v2/models/{rig}/versions/{version}...`
#[derive(Debug)]
pub struct NamedModel(pub RigId, pub ModelRef);

impl<S: Send + Sync> FromRequestParts<S> for NamedModel {
    type Rejection = Problem;

    async fn from_request_parts(parts: &mut Parts, state: &S) -> Answer<Self> {
        let versioned =
            parts.extensions.get::<MatchedPath>().is_some_and(|path| path.as_str().contains("{version}"));
        if versioned {
            let OfModel(rig, version) = OfModel::from_request_parts(parts, state).await?;
            return Ok(Self(rig, ModelRef::Version(version)));
        }
        let OfRig(rig) = OfRig::from_request_parts(parts, state).await?;
        Ok(Self(rig, ModelRef::Active))
    }
}
