//! Settings of the demo.

use std::net::SocketAddr;
use std::path::PathBuf;

use clap::Args;

use super::address;

/// How `rigcast demo` runs.
#[derive(Debug, Clone, Args)]
pub struct DemoArgs {
    /// End after the table instead of leaving the service up to explore.
    #[arg(long)]
    pub exit: bool,

    /// Seed of the virtual rig and of its loads.
    #[arg(long, default_value_t = 1)]
    pub seed: u64,

    /// Minutes of training noise.
    #[arg(long, default_value_t = 20.0, value_parser = minutes)]
    pub minutes: f64,

    /// Epochs of each network.
    #[arg(long, default_value_t = 24, value_parser = clap::value_parser!(u32).range(1..=10_000))]
    pub epochs: u32,

    /// Address to listen on; port 0 takes a free one.
    #[arg(long, default_value = "127.0.0.1:0", value_parser = address)]
    pub listen: SocketAddr,

    /// Data directory, which must be empty or missing; left out: a temporary one.
    #[arg(long)]
    pub data_dir: Option<PathBuf>,

    /// Token to send to the service, for a data directory that has tokens.
    #[arg(long, env = "RIGCAST_TOKEN", hide_env_values = true)]
    pub token: Option<String>,

    /// Log filter of the service.
    #[arg(long, env = "RIGCAST_LOG", default_value = "warn")]
    pub log: String,
}

fn minutes(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(m) if (1.0..=240.0).contains(&m) => Ok(m),
        _ => Err("1 to 240 minutes".into()),
    }
}
