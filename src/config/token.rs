//! Settings of tokens that are made on the machine itself.

use std::path::PathBuf;

use clap::{Args, Subcommand};
use jiff::{SignedDuration, Span, SpanRelativeTo};

use super::DatabaseArgs;
use crate::domain::{RigId, TokenRole};

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

/// A length of time like `30d` or `8h`; a day has 24 hours.
fn duration(text: &str) -> Result<SignedDuration, String> {
    let span: Span = text.parse().map_err(|_| "a length of time like 30d, 8h or 2w")?;
    let duration = span.to_duration(SpanRelativeTo::days_are_24_hours());
    let duration = duration.map_err(|_| "weeks, days, hours, minutes or seconds")?;
    if duration.is_positive() { Ok(duration) } else { Err("a positive length of time".into()) }
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
