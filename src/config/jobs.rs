//! Settings of jobs and of their processes.

use std::ffi::OsString;
use std::path::PathBuf;
use std::time::Duration;

use clap::Args;

use super::{ConfigError, LogArgs, seconds};
use crate::jobs::{JobSettings, WorkerProgram};

/// Settings of jobs.
#[derive(Debug, Clone, Args)]
pub struct JobArgs {
    /// Jobs that run at the same time, each in a process of its own; a fit uses all cores by itself. 0 leaves all jobs to
    /// other processes of a shared registry.
    #[arg(long, env = "RIGCAST_WORKERS", default_value_t = 1, value_parser = clap::value_parser!(u16).range(0..=64))]
    pub workers: u16,

    /// Lease of a job: a job is taken from a worker after so many seconds without a heartbeat, and a worker
    /// process that is silent for as long is killed.
    #[arg(long, env = "RIGCAST_LEASE_S", default_value = "30", value_parser = seconds)]
    pub lease_s: Duration,

    /// Most time between two heartbeats of a job, seconds; at most a third of the lease.
    #[arg(long, env = "RIGCAST_HEARTBEAT_S", default_value = "5", value_parser = seconds)]
    pub heartbeat_s: Duration,

    /// Seconds between two searches for jobs of lost workers.
    #[arg(long, env = "RIGCAST_SWEEP_S", default_value = "10", value_parser = seconds)]
    pub sweep_s: Duration,

    /// Most time between two checkpoints of a fit, seconds.
    #[arg(long, env = "RIGCAST_CHECKPOINT_S", default_value = "30", value_parser = at_most_a_minute)]
    pub checkpoint_s: Duration,

    /// Memory that the process of one job may hold, MiB [default: three quarters of the machine's, shared by
    /// the workers].
    #[arg(long, env = "RIGCAST_JOB_MEMORY_MIB", value_parser = clap::value_parser!(u64).range(1..=1 << 40))]
    pub job_memory_mib: Option<u64>,

    /// Longest time for one attempt of a job, seconds.
    #[arg(long, env = "RIGCAST_JOB_TIME_LIMIT_S", default_value = "86400", value_parser = seconds)]
    pub job_time_limit_s: Duration,

    /// Jobs that one token asked for and that wait for their turn; further ones are refused.
    #[arg(long, env = "RIGCAST_WAITING_JOBS", default_value_t = JobSettings::default().max_waiting, value_parser = clap::value_parser!(u64).range(1..=1 << 20))]
    pub waiting_jobs: u64,
}

/// A time of a tenth of a second to a minute: a crash costs two of them at most.
fn at_most_a_minute(text: &str) -> Result<Duration, String> {
    let minute = Duration::from_secs(60);
    seconds(text)
        .ok()
        .filter(|time| *time <= minute)
        .ok_or_else(|| "a number of seconds from 0.1 to 60".into())
}

impl JobArgs {
    /// The settings, checked together.
    pub(super) fn check(&self, log: &LogArgs) -> Result<JobSettings, ConfigError> {
        if self.heartbeat_s * 3 > self.lease_s {
            return Err(ConfigError::Heartbeat { heartbeat: self.heartbeat_s, lease: self.lease_s });
        }
        let memory = self.job_memory_mib.map(|mib| mib << 20);
        let program = WorkerProgram {
            program: own_program(),
            arguments: log.as_arguments("job"),
            memory_bytes: memory.unwrap_or_else(|| WorkerProgram::default_memory_bytes(self.workers)),
            time_limit: self.job_time_limit_s,
        };
        Ok(JobSettings {
            workers: self.workers.into(),
            lease: self.lease_s,
            heartbeat: self.heartbeat_s,
            sweep: self.sweep_s,
            checkpoint_every: self.checkpoint_s,
            program: Some(program),
            max_waiting: self.waiting_jobs,
            ..JobSettings::default()
        })
    }
}

/// This program, even after its file was replaced by another version.
fn own_program() -> PathBuf {
    if cfg!(target_os = "linux") {
        return PathBuf::from("/proc/self/exe");
    }
    std::env::current_exe().unwrap_or_else(|_| PathBuf::from("rigcast"))
}

impl LogArgs {
    /// Arguments that start a subcommand with the same logging.
    fn as_arguments(&self, subcommand: &str) -> Vec<OsString> {
        use clap::ValueEnum;
        let format =
            self.log_format.to_possible_value().map_or_else(String::new, |v| v.get_name().to_owned());
        [subcommand, "--log", &self.log, "--log-format", &format].map(OsString::from).to_vec()
    }
}
