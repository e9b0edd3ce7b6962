//! The command line: flags, each with an environment variable as its default.

mod connections;
mod copies;
mod database;
mod demo;
mod health;
mod jobs;
mod load;
mod objects;
mod store;
mod token;

use std::net::SocketAddr;
use std::path::PathBuf;
use std::time::Duration;

use clap::{Args, Parser, Subcommand};

use crate::compute::ComputeSettings;
use crate::http::{AdmissionSettings, Limits};
use crate::jobs::JobSettings;
use crate::storage::StoreSettings;
use crate::telemetry::LogFormat;

pub use connections::ConnectionSettings;
pub use copies::{BackupArgs, CopyArgs, MoveArgs, RecoverArgs};
pub use database::DatabaseArgs;
pub use demo::DemoArgs;
pub use health::HealthArgs;
pub use jobs::JobArgs;
pub use load::LoadArgs;
pub use objects::ObjectArgs;
pub use store::StoreArgs;
pub use token::{CreateArgs, TokenCommand};

/// The `rigcast` command line.
#[derive(Debug, Parser)]
#[command(version = crate::VERSION, about, propagate_version = true)]
pub struct Cli {
    /// Subcommand.
    #[command(subcommand)]
    pub command: Command,
}

/// Subcommands.
#[derive(Debug, Subcommand)]
pub enum Command {
    /// Answer HTTP requests and run jobs until told to stop (SIGTERM or Ctrl-C).
    Serve(Box<ServeArgs>),
    /// Run an example on a virtual rig: upload, fit, predict, compare.
    Demo(DemoArgs),
    /// Make tokens while the service is stopped.
    #[command(subcommand)]
    Token(TokenCommand),
    /// Check whether a running service is alive; the exit status is 0 if it answers (for containers and monitors).
    Health(HealthArgs),
    /// Copy a data directory, which may be in use, into a new directory.
    Backup(BackupArgs),
    /// Make a new data directory from a backup.
    Restore(CopyArgs),
    /// Make the database of a stopped service anew from its journal, after a start was refused.
    Recover(RecoverArgs),
    /// Copy a data directory, whose service is stopped, into a PostgreSQL and a bucket, or back.
    Move(MoveArgs),
    /// Run jobs of services that share a PostgreSQL, on this or another machine, until told to stop.
    Work(Box<WorkArgs>),
    /// Do one job for the `rigcast serve` or `rigcast work` that starts this process.
    #[command(hide = true)]
    Job(LogArgs),
}

/// Settings of logs.
#[derive(Debug, Clone, Args)]
pub struct LogArgs {
    /// Log filter: a level (error, warn, info, debug, trace) or directives like `rigcast=debug,info`.
    #[arg(long, env = "RIGCAST_LOG", default_value = "info")]
    pub log: String,

    /// Format of log lines.
    #[arg(long, env = "RIGCAST_LOG_FORMAT", value_enum, default_value_t = LogFormat::Text)]
    pub log_format: LogFormat,
}

/// How `rigcast serve` runs.
#[derive(Debug, Clone, Args)]
pub struct ServeArgs {
    /// Address and port to listen on; port 0 takes a free one. Beyond loopback only once there is an
    /// admin's token (`rigcast token create --role admin`).
    #[arg(long, env = "RIGCAST_LISTEN", default_value = "127.0.0.1:8080", value_parser = address)]
    pub listen: SocketAddr,

    /// Directory of the registry, the signals and the weights; made if missing, locked while in use.
    #[arg(long, env = "RIGCAST_DATA_DIR", default_value = "./rigcast-data")]
    pub data_dir: PathBuf,

    /// Registry and objects.
    #[command(flatten)]
    pub store: StoreArgs,

    /// Jobs.
    #[command(flatten)]
    pub jobs: JobArgs,

    /// Load.
    #[command(flatten)]
    pub load: LoadArgs,

    /// Logs.
    #[command(flatten)]
    pub log: LogArgs,

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

/// How `rigcast work` runs.
#[derive(Debug, Clone, Args)]
pub struct WorkArgs {
    /// Address and port that answer `/livez`, `/readyz` and `/metrics`; port 0 takes a free one.
    #[arg(long, env = "RIGCAST_LISTEN", default_value = "127.0.0.1:8081", value_parser = address)]
    pub listen: SocketAddr,

    /// Directory of copies of objects; made if missing, locked while in use.
    #[arg(long, env = "RIGCAST_DATA_DIR", default_value = "./rigcast-work")]
    pub data_dir: PathBuf,

    /// Registry and objects.
    #[command(flatten)]
    pub store: StoreArgs,

    /// Jobs.
    #[command(flatten)]
    pub jobs: JobArgs,

    /// Logs.
    #[command(flatten)]
    pub log: LogArgs,
}

/// What a process of the service does.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Part {
    /// Answers requests, and runs jobs if it has workers.
    Serve,
    /// Runs jobs; tells monitors how it is.
    Work,
}

/// Everything that the service needs to know to start.
#[derive(Debug, Clone)]
pub struct Config {
    /// What the process does.
    pub part: Part,
    /// Directory of the registry, the signals and the weights.
    pub data_dir: PathBuf,
    /// Where registry and objects are, if not in the data directory.
    pub store: StoreSettings,
    /// Address to listen on. Without a token the service answers on loopback only.
    pub listen: SocketAddr,
    /// Settings of jobs.
    pub jobs: JobSettings,
    /// Limits on bodies and on the work for an answer.
    pub limits: Limits,
    /// Limits on work at once.
    pub compute: ComputeSettings,
    /// Limits on requests at once.
    pub admission: AdmissionSettings,
    /// Limits on connections.
    pub connections: ConnectionSettings,
}

impl Config {
    /// The default settings, with jobs on threads of this process.
    pub fn new(data_dir: PathBuf, listen: SocketAddr) -> Self {
        Self {
            part: Part::Serve,
            data_dir,
            store: StoreSettings::default(),
            listen,
            jobs: JobSettings::default(),
            limits: Limits::default(),
            compute: ComputeSettings::default(),
            admission: AdmissionSettings::default(),
            connections: ConnectionSettings::default(),
        }
    }
}

/// A combination of settings that is refused.
#[derive(Debug, thiserror::Error)]
pub enum ConfigError {
    /// A lease must outlast heartbeats that fail.
    #[error(
        "--heartbeat-s {} and --lease-s {} do not go together: a heartbeat is at most a third of the lease",
        heartbeat.as_secs_f64(), lease.as_secs_f64()
    )]
    Heartbeat {
        /// Most time between two heartbeats.
        heartbeat: Duration,
        /// The lease.
        lease: Duration,
    },
    /// Nobody would ever do a job.
    #[error("--workers 0 is for services that share a PostgreSQL (--database) with a `rigcast work`")]
    NoWorkers,
    /// A move needs both.
    #[error(
        "`rigcast move` needs --database and --objects: where the registry and the objects go, or come from"
    )]
    Nowhere,
    /// A process that only works needs jobs of others.
    #[error("`rigcast work` runs jobs of services that share a PostgreSQL: name it with --database")]
    NothingShared,
}

/// An address with its port; `localhost` is this machine's IPv4 loopback.
fn address(text: &str) -> Result<SocketAddr, String> {
    let numeric = match text.split_once(':') {
        Some((host, port)) if host.eq_ignore_ascii_case("localhost") => format!("127.0.0.1:{port}"),
        _ => text.to_owned(),
    };
    numeric
        .parse()
        .map_err(|_| "an IP address and a port, like 127.0.0.1:8080, 0.0.0.0:8080 or [::1]:8080".to_owned())
}

/// A time of a tenth of a second to a year; fractions are for tests.
fn seconds(text: &str) -> Result<Duration, String> {
    let limit = "a number of seconds from 0.1 to 31536000";
    let seconds: f64 = text.parse().map_err(|_| limit.to_owned())?;
    if (0.1..=31_536_000.0).contains(&seconds) {
        Ok(Duration::from_secs_f64(seconds))
    } else {
        Err(limit.into())
    }
}

impl ServeArgs {
    /// The settings of the service, checked together.
    ///
    /// # Errors
    /// [`ConfigError::Heartbeat`], [`ConfigError::NoWorkers`].
    pub fn check(&self) -> Result<Config, ConfigError> {
        if self.jobs.workers == 0 && self.store.database.postgres().is_none() {
            return Err(ConfigError::NoWorkers);
        }
        Ok(Config {
            part: Part::Serve,
            data_dir: self.data_dir.clone(),
            store: self.store.settings(),
            listen: self.listen,
            jobs: self.jobs.check(&self.log)?,
            limits: Limits {
                json_bytes: self.json_limit_bytes,
                drive_bytes: self.drive_limit_bytes,
                upload_bytes: self.upload_limit_bytes,
                pace: self.load.pace(),
                prediction_bytes: self.load.predict_memory_bytes,
                deadline: self.load.predict_deadline_s,
            },
            compute: self.load.compute(),
            admission: self.load.admission(),
            connections: self.load.connections(),
        })
    }
}

impl WorkArgs {
    /// The settings of the process, checked together.
    ///
    /// # Errors
    /// [`ConfigError`].
    pub fn check(&self) -> Result<Config, ConfigError> {
        if self.jobs.workers == 0 {
            return Err(ConfigError::NoWorkers);
        }
        let store = self.store.settings();
        if store.database.is_none() {
            return Err(ConfigError::NothingShared);
        }
        Ok(Config {
            part: Part::Work,
            store,
            jobs: self.jobs.check(&self.log)?,
            ..Config::new(self.data_dir.clone(), self.listen)
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn serve(arguments: &[&str]) -> ServeArgs {
        let cli = Cli::try_parse_from(["rigcast", "serve"].iter().chain(arguments)).expect("valid arguments");
        match cli.command {
            Command::Serve(args) => *args,
            other => panic!("{other:?}"),
        }
    }

    #[test]
    fn the_default_listens_on_loopback_with_the_contracts_limits() {
        let args = serve(&[]);
        assert_eq!(args.listen.to_string(), "127.0.0.1:8080");
        let config = args.check().expect("sound settings");
        let bytes = [config.limits.json_bytes, config.limits.drive_bytes, config.limits.upload_bytes];
        assert_eq!(bytes, [67_108_864, 134_217_728, 4_294_967_296]);
        assert_eq!(config.data_dir, PathBuf::from("./rigcast-data"));
    }

    #[test]
    fn what_the_program_starts_with_is_what_the_modules_call_their_defaults() {
        let config = serve(&[]).check().expect("sound settings");
        assert_eq!(config.limits, Limits::default());
        assert_eq!(config.compute, ComputeSettings::default());
        assert_eq!(config.admission, AdmissionSettings::default());
        assert_eq!(config.connections, ConnectionSettings::default());
        assert_eq!(config.jobs.max_waiting, JobSettings::default().max_waiting);
    }

    #[test]
    fn an_address_has_a_port_and_may_be_called_localhost() {
        assert_eq!(serve(&["--listen", "localhost:9000"]).listen.to_string(), "127.0.0.1:9000");
        assert_eq!(serve(&["--listen", "[::1]:9000"]).listen.to_string(), "[::1]:9000");
        for text in ["8080", "localhost", "lab-pc:8080", "127.0.0.1:99999", ""] {
            let refused =
                Cli::try_parse_from(["rigcast", "serve", "--listen", text]).expect_err(text).to_string();
            assert!(refused.contains("like 127.0.0.1:8080"), "{refused}");
        }
    }

    #[test]
    fn no_workers_at_all_is_refused_unless_others_share_the_registry() {
        assert!(matches!(serve(&["--workers", "0"]).check(), Err(ConfigError::NoWorkers)));
        let shared = ["--workers", "0", "--database", "postgres://lab:hunter2@db/rigcast"];
        assert_eq!(serve(&shared).check().expect("sound settings").jobs.workers, 0);
        let shown = format!("{:?} {:?}", serve(&shared), serve(&shared).check());
        assert!(!shown.contains("hunter2"), "{shown}");
    }

    #[test]
    fn who_only_works_shares_a_registry() {
        let work = |arguments: &[&str]| {
            let cli =
                Cli::try_parse_from(["rigcast", "work"].iter().chain(arguments)).expect("valid arguments");
            match cli.command {
                Command::Work(args) => args.check(),
                other => panic!("{other:?}"),
            }
        };
        assert!(matches!(work(&[]), Err(ConfigError::NothingShared)));
        let config = work(&["--database", "postgres://db/rigcast"]).expect("sound settings");
        assert_eq!((config.part, config.jobs.workers), (Part::Work, 1));
    }

    #[test]
    fn jobs_get_processes_that_log_as_the_service_does() {
        let jobs = serve(&["--log", "debug", "--job-memory-mib", "7"]).check().expect("sound").jobs;
        let program = jobs.program.expect("a process for each job");
        assert_eq!(program.arguments, ["job", "--log", "debug", "--log-format", "text"]);
        assert_eq!(program.memory_bytes, 7 << 20);
        let job = Cli::try_parse_from(["rigcast".into()].into_iter().chain(program.arguments));
        assert!(matches!(job.expect("its arguments are read").command, Command::Job(_)));
    }

    #[test]
    fn a_lease_outlasts_heartbeats_that_fail() {
        assert!(serve(&["--lease-s", "3", "--heartbeat-s", "1"]).check().is_ok());
        let message = serve(&["--lease-s", "3"]).check().expect_err("refused").to_string();
        assert!(message.contains("--heartbeat-s 5 and --lease-s 3"), "{message}");
        assert!(Cli::try_parse_from(["rigcast", "serve", "--lease-s", "NaN"]).is_err());
    }
}
