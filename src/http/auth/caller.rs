//! The caller of an operation.

use std::collections::BTreeSet;
use std::sync::Arc;

use axum::extract::{FromRequestParts, OptionalFromRequestParts};
use axum::http::request::Parts;

use crate::domain::{RigId, Token, TokenId, TokenRole};
use crate::http::Shared;
use crate::http::problem::{Answer, Problem};

/// The caller of an operation, as the guard identified it.
#[derive(Debug, Clone)]
pub enum Caller {
    /// Any program on this machine, while there is no token.
    Everybody,
    /// The holder of this token.
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

    /// The token's id, once there are any.
    pub fn token_id(&self) -> Option<TokenId> {
        self.token().map(|token| token.id)
    }

    /// The caller's role.
    pub fn role(&self) -> TokenRole {
        self.token().map_or(TokenRole::Admin, |token| token.role)
    }

    /// Rigs that the caller is limited to; `None` for all rigs.
    pub fn scope(&self) -> Option<&BTreeSet<RigId>> {
        self.token().and_then(|token| token.rigs.as_ref())
    }

    /// Whether the caller may see the rig of this id, which need not exist.
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

/// For public operations that show more to a caller with a token.
impl OptionalFromRequestParts<Shared> for Caller {
    type Rejection = Problem;

    async fn from_request_parts(parts: &mut Parts, http: &Shared) -> Answer<Option<Self>> {
        Ok(http.auth.identify(parts, http.now()).await.ok().map(|identity| identity.caller))
    }
}
