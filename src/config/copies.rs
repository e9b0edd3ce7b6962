//! Settings of backup, restore, recovery and moves.

use std::path::PathBuf;

use clap::Args;

use super::{ObjectArgs, StoreArgs};

/// Arguments of `rigcast backup`.
#[derive(Debug, Clone, Args)]
pub struct BackupArgs {
    /// The two directories.
    #[command(flatten)]
    pub copy: CopyArgs,

    /// An earlier backup; what it has is linked and not copied again.
    #[arg(long)]
    pub previous: Option<PathBuf>,

    /// Registry and objects. With a registry on PostgreSQL there is no data directory to back up.
    #[command(flatten)]
    pub store: StoreArgs,
}

/// Arguments of `rigcast restore`, and some of `rigcast backup`.
#[derive(Debug, Clone, Args)]
pub struct CopyArgs {
    /// Directory of the backup.
    pub backup: PathBuf,

    /// Directory of the registry, the signals and the weights.
    #[arg(long, env = "RIGCAST_DATA_DIR", default_value = "./rigcast-data")]
    pub data_dir: PathBuf,
}

/// Arguments of `rigcast recover`.
#[derive(Debug, Clone, Args)]
pub struct RecoverArgs {
    /// Directory of the registry, the signals and the weights.
    #[arg(long, env = "RIGCAST_DATA_DIR", default_value = "./rigcast-data")]
    pub data_dir: PathBuf,

    /// Objects.
    #[command(flatten)]
    pub objects: ObjectArgs,
}

/// Arguments of `rigcast move`.
#[derive(Debug, Clone, Args)]
pub struct MoveArgs {
    /// Directory of the registry, the signals and the weights.
    #[arg(long, env = "RIGCAST_DATA_DIR", default_value = "./rigcast-data")]
    pub data_dir: PathBuf,

    /// Make the data directory from the PostgreSQL and the bucket, which stay as they are.
    #[arg(long)]
    pub back: bool,

    /// Registry and objects.
    #[command(flatten)]
    pub store: StoreArgs,
}
