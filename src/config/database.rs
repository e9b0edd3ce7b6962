//! Settings of where the registry is.

use clap::Args;

use crate::storage::PostgresSettings;

/// Where rigs, runs, models, jobs and tokens are listed.
#[derive(Clone, Args)]
pub struct DatabaseArgs {
    /// PostgreSQL of the registry, as `postgres://user@host/database` [default: a file in the data directory]. Any number
    /// of processes may share it. A password is better in PGPASSWORD or PGPASSFILE than in the URL. Needs --objects.
    #[arg(long, env = "RIGCAST_DATABASE", hide_env_values = true)]
    pub database: Option<String>,
}

/// Without the URL, which may hold a password.
impl std::fmt::Debug for DatabaseArgs {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("DatabaseArgs").field("is_given", &self.database.is_some()).finish()
    }
}

impl DatabaseArgs {
    /// The PostgreSQL, if one is named.
    pub fn postgres(&self) -> Option<PostgresSettings> {
        let url = self.database.clone().filter(|url| !url.is_empty())?;
        Some(PostgresSettings { url })
    }
}
