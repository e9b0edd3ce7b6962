//! Settings of backup and restore.

use std::path::PathBuf;

use clap::Args;

/// Arguments of `rigcast backup` and `rigcast restore`.
#[derive(Debug, Clone, Args)]
pub struct CopyArgs {
    /// Directory of the backup.
    pub backup: PathBuf,

    /// Directory of the registry, the signals and the weights.
    #[arg(long, env = "RIGCAST_DATA_DIR", default_value = "./rigcast-data")]
    pub data_dir: PathBuf,
}
