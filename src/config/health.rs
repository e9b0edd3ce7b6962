//! Settings of `rigcast health`.

use std::net::SocketAddr;
use std::time::Duration;

use clap::Args;

use super::{address, seconds};

/// Arguments of `rigcast health`.
#[derive(Debug, Clone, Args)]
pub struct HealthArgs {
    /// Address and port that the service listens on, as for `rigcast serve`. For all addresses (`0.0.0.0`, `[::]`) the
    /// request goes to loopback.
    #[arg(long, env = "RIGCAST_LISTEN", default_value = "127.0.0.1:8080", value_parser = address)]
    pub listen: SocketAddr,

    /// Longest time for the answer, seconds.
    #[arg(long, default_value = "4", value_parser = seconds)]
    pub timeout_s: Duration,
}
