//! `rigcast token`: tokens made on the machine itself, while the service is stopped.

use std::collections::BTreeSet;
use std::path::PathBuf;

use clap::{Args, Subcommand};
use jiff::{SignedDuration, Span, SpanRelativeTo, Timestamp};

use crate::config::DatabaseArgs;
use crate::domain::{FieldError, RigId, Secret, Token, TokenDraft, TokenRole};
use crate::storage::{Store, StoreError, TokenInsert};

/// Subcommands of `rigcast token`.
#[derive(Debug, Subcommand)]
pub enum TokenCommand {
    /// Make a token and print its secret, this once. The first one must be an admin's; from then on
    /// every request needs a token.
    Create(CreateArgs),
}

/// Arguments of `rigcast token create`.
#[derive(Debug, Clone, Args)]
pub struct CreateArgs {
    /// Role; each role includes those before it.
    #[arg(long, value_enum)]
    pub role: TokenRole,

    /// Name for people.
    #[arg(long, default_value = "")]
    pub name: String,

    /// Limit it to this rig; may be repeated. Left out: all rigs.
    #[arg(long = "rig", value_name = "RIG")]
    pub rigs: Vec<RigId>,

    /// Time until it expires: 30d, 8h, 2w. Left out: never.
    #[arg(long, value_parser = duration)]
    pub expires_in: Option<SignedDuration>,

    /// Directory of the registry, as for `rigcast serve`.
    #[arg(long, env = "RIGCAST_DATA_DIR", default_value = "./rigcast-data")]
    pub data_dir: PathBuf,

    /// Registry. On PostgreSQL services may run meanwhile.
    #[command(flatten)]
    pub database: DatabaseArgs,
}

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

/// A length of time like `30d` or `8h`; a day has 24 hours.
fn duration(text: &str) -> Result<SignedDuration, String> {
    let span: Span = text.parse().map_err(|_| "a length of time like 30d, 8h or 2w")?;
    let duration = span.to_duration(SpanRelativeTo::days_are_24_hours());
    let duration = duration.map_err(|_| "weeks, days, hours, minutes or seconds")?;
    if duration.is_positive() { Ok(duration) } else { Err("a positive length of time".into()) }
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
    let secret = Secret::draw()?;
    let inserted = store.insert_token(&draft, secret.digest(), None, now).await.map_err(TokenError::Store);
    store.close().await;
    match inserted? {
        TokenInsert::Inserted(token) => Ok((token, secret)),
        TokenInsert::FirstMustBeAdmin => Err(TokenError::FirstMustBeAdmin),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lengths_of_time_are_read_and_nothing_else() {
        assert_eq!(duration("30d"), Ok(SignedDuration::from_hours(30 * 24)));
        assert_eq!(duration("1w 8h"), Ok(SignedDuration::from_hours(7 * 24 + 8)));
        for text in ["", "30", "-1d", "0s", "1 month", "soon"] {
            assert!(duration(text).is_err(), "{text}");
        }
    }
}
