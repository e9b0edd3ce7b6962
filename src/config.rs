//! What the program can be told: flags, each with an environment variable behind it.

use std::net::SocketAddr;
use std::path::PathBuf;

use clap::{Args, Parser, Subcommand};

use crate::demo::DemoArgs;
use crate::http::Limits;
use crate::telemetry::LogFormat;
use crate::token::TokenCommand;

/// The `rigcast` command line.
#[derive(Debug, Parser)]
#[command(version, about, propagate_version = true)]
pub struct Cli {
    /// What to do.
    #[command(subcommand)]
    pub command: Command,
}

/// Subcommands.
#[derive(Debug, Subcommand)]
pub enum Command {
    /// Answer HTTP requests and run jobs until told to stop (SIGTERM or Ctrl-C).
    Serve(ServeArgs),
    /// Show the whole job on a virtual rig: upload, fit, predict, compare.
    Demo(DemoArgs),
    /// Make tokens while the service is stopped.
    #[command(subcommand)]
    Token(TokenCommand),
}

/// How `rigcast serve` runs.
#[derive(Debug, Clone, Args)]
pub struct ServeArgs {
    /// Address and port to listen on; port 0 takes a free one. Beyond loopback only once there is an
    /// admin's token (`rigcast token create --role admin`).
    #[arg(long, env = "RIGCAST_LISTEN", default_value = "127.0.0.1:8080")]
    pub listen: SocketAddr,

    /// Directory of the registry, the signals and the weights; made if missing, locked while in use.
    #[arg(long, env = "RIGCAST_DATA_DIR", default_value = "./rigcast-data")]
    pub data_dir: PathBuf,

    /// Jobs that run at the same time; a fit uses all cores by itself.
    #[arg(long, env = "RIGCAST_WORKERS", default_value_t = 1, value_parser = clap::value_parser!(u16).range(1..=64))]
    pub workers: u16,

    /// Log filter: a level (error, warn, info, debug, trace) or directives like `rigcast=debug,info`.
    #[arg(long, env = "RIGCAST_LOG", default_value = "info")]
    pub log: String,

    /// How log lines look.
    #[arg(long, env = "RIGCAST_LOG_FORMAT", value_enum, default_value_t = LogFormat::Text)]
    pub log_format: LogFormat,

    /// Largest upload (run file or weights), bytes.
    #[arg(long, env = "RIGCAST_UPLOAD_LIMIT_BYTES", default_value_t = Limits::default().upload_bytes)]
    pub upload_limit_bytes: u64,

    /// Largest JSON body, bytes.
    #[arg(long, env = "RIGCAST_JSON_LIMIT_BYTES", default_value_t = Limits::default().json_bytes)]
    pub json_limit_bytes: u64,

    /// Largest NPY drive of a prediction, bytes; a prediction takes several times that in memory.
    #[arg(long, env = "RIGCAST_DRIVE_LIMIT_BYTES", default_value_t = Limits::default().drive_bytes)]
    pub drive_limit_bytes: u64,
}

/// Everything that [`crate::app::App::build`] needs to know.
#[derive(Debug, Clone)]
pub struct Config {
    /// Directory of the registry, the signals and the weights.
    pub data_dir: PathBuf,
    /// Where it will listen: what is open on loopback is not open beyond.
    pub listen: SocketAddr,
    /// Jobs that run at the same time.
    pub workers: u16,
    /// Largest bodies that are read.
    pub limits: Limits,
}

impl ServeArgs {
    /// The settings of the service.
    pub fn config(&self) -> Config {
        Config {
            data_dir: self.data_dir.clone(),
            listen: self.listen,
            workers: self.workers,
            limits: Limits {
                json_bytes: self.json_limit_bytes,
                drive_bytes: self.drive_limit_bytes,
                upload_bytes: self.upload_limit_bytes,
            },
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn serve(arguments: &[&str]) -> ServeArgs {
        let cli = Cli::try_parse_from(["rigcast", "serve"].iter().chain(arguments)).expect("valid arguments");
        match cli.command {
            Command::Serve(args) => args,
            other => panic!("{other:?}"),
        }
    }

    #[test]
    fn the_default_listens_on_loopback_with_the_contracts_limits() {
        let args = serve(&[]);
        assert_eq!(args.listen.to_string(), "127.0.0.1:8080");
        let config = args.config();
        assert_eq!(
            config.limits,
            Limits { json_bytes: 67_108_864, drive_bytes: 134_217_728, upload_bytes: 4_294_967_296 }
        );
        assert_eq!(config.data_dir, PathBuf::from("./rigcast-data"));
    }

    #[test]
    fn no_workers_at_all_is_refused() {
        assert!(Cli::try_parse_from(["rigcast", "serve", "--workers", "0"]).is_err());
    }
}
