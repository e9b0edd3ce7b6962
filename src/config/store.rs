//! Settings of where a store is, beyond its data directory.

use clap::Args;

use super::{DatabaseArgs, ObjectArgs};
use crate::storage::StoreSettings;

/// Where registry and objects are, if not in the data directory.
#[derive(Debug, Clone, Args)]
pub struct StoreArgs {
    /// Registry.
    #[command(flatten)]
    pub database: DatabaseArgs,

    /// Objects.
    #[command(flatten)]
    pub objects: ObjectArgs,
}

impl StoreArgs {
    /// Both, as far as they are named.
    pub fn settings(&self) -> StoreSettings {
        StoreSettings { bucket: self.objects.bucket(), database: self.database.postgres() }
    }
}
