//! `rigcast token`: tokens made on the machine itself, while the service is stopped, or beside services that share a
//! PostgreSQL.

use std::collections::BTreeSet;
use std::path::PathBuf;

use jiff::Timestamp;

use crate::config::CreateArgs;
use crate::domain::{FieldError, RigId, Secret, Token, TokenDraft};
use crate::storage::{Store, StoreError, TokenInsert};

/// The reason why no token was made.
#[derive(Debug, thiserror::Error)]
pub enum TokenError {
    /// The data directory is in use.
    #[error(
        "the data directory {0} is in use by a running rigcast: stop it first, or ask it for the token: \
         POST /v1/tokens with an admin's token, or without one while there is none"
    )]
    InUse(PathBuf),
    /// The store.
    #[error(transparent)]
    Store(StoreError),
    /// The system gives no randomness.
    #[error("no random bits: {0}")]
    Random(#[from] rand::rngs::SysError),
    /// From the first token on the service needs tokens, so that its holder must be able to make others.
    #[error("the first token must be an admin's for all rigs: rigcast token create --role admin")]
    FirstMustBeAdmin,
    /// Settings outside their limits.
    #[error("{} must be {}", .0.pointer.trim_start_matches('/'), .0.limit.as_deref().unwrap_or("otherwise"))]
    Invalid(FieldError),
    /// An expiry beyond the calendar.
    #[error("--expires-in is too long")]
    TooLong,
}

/// Makes a token in the data directory.
///
/// # Errors
/// A directory that is in use or cannot be read; settings outside their limits.
pub async fn create(args: &CreateArgs, now: Timestamp) -> Result<(Token, Secret), TokenError> {
    let rigs: BTreeSet<RigId> = args.rigs.iter().cloned().collect();
    let expires_at = args.expires_in.map(|duration| now.checked_add(duration)).transpose();
    let draft = TokenDraft {
        name: args.name.clone(),
        role: args.role,
        rigs: (!rigs.is_empty()).then_some(rigs),
        expires_at: expires_at.map_err(|_| TokenError::TooLong)?,
    };
    draft.check(now).map_err(|errors| TokenError::Invalid(errors.into_iter().next().unwrap_or_default()))?;
    let store = Store::open_rows(&args.data_dir, args.database.postgres().as_ref()).await.map_err(
        |error| match error {
            StoreError::Locked { path } => TokenError::InUse(path),
            error => TokenError::Store(error),
        },
    )?;
    let now = store.shared_time().await.map_err(TokenError::Store)?.unwrap_or(now);
    let secret = Secret::draw()?;
    let inserted = store.insert_token(&draft, secret.digest(), None, now).await.map_err(TokenError::Store);
    store.close().await;
    match inserted? {
        TokenInsert::Inserted(token) => Ok((token, secret)),
        TokenInsert::FirstMustBeAdmin => Err(TokenError::FirstMustBeAdmin),
    }
}
