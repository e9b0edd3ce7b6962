//! Who asks.

use std::collections::BTreeSet;
use std::sync::Arc;

use axum::extract::{FromRequestParts, OptionalFromRequestParts};
use axum::http::request::Parts;

use crate::domain::{RigId, Token, TokenRole};
use crate::http::Shared;
use crate::http::problem::{Answer, Problem};

/// Who asks, as the guard found.
#[derive(Debug, Clone)]
pub enum Caller {
    /// Whoever is on this machine, while there is no token.
    Everybody,
    /// Whoever holds this token.
    Token(Arc<Token>),
}

impl Caller {
    /// The token, once there are any.
    pub fn token(&self) -> Option<&Arc<Token>> {
        match self {
            Self::Everybody => None,
            Self::Token(token) => Some(token),
        }
    }

    /// What the caller may do.
    pub fn role(&self) -> TokenRole {
        self.token().map_or(TokenRole::Admin, |token| token.role)
    }

    /// Rigs that the caller is limited to; `None`: all.
    pub fn scope(&self) -> Option<&BTreeSet<RigId>> {
        self.token().and_then(|token| token.rigs.as_ref())
    }

    /// Whether the caller may see a rig, be there one of that id or not.
    pub fn reaches(&self, rig: &RigId) -> bool {
        self.token().is_none_or(|token| token.reaches(rig))
    }
}

impl FromRequestParts<Shared> for Caller {
    type Rejection = Problem;

    async fn from_request_parts(parts: &mut Parts, _: &Shared) -> Answer<Self> {
        let caller = parts.extensions.get::<Self>().cloned();
        caller.ok_or_else(|| Problem::internal("a handler asks for the caller of a public operation"))
    }
}

/// For public operations that tell more to those who may know more.
impl OptionalFromRequestParts<Shared> for Caller {
    type Rejection = Problem;

    async fn from_request_parts(parts: &mut Parts, http: &Shared) -> Answer<Option<Self>> {
        Ok(http.doors.identify(parts, http.now()).await.ok())
    }
}
