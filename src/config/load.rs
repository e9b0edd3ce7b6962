//! Settings of load: work at once, and the time that clients and requests may take.

use std::time::Duration;

use clap::Args;

use super::{ConnectionSettings, seconds};
use crate::compute::ComputeSettings;
use crate::compute::fair_queue::QueueSettings;
use crate::http::{AdmissionSettings, Limits, Pace};

/// Settings of load.
#[derive(Debug, Clone, Args)]
pub struct LoadArgs {
    /// Short predictions and other short work for an answer: number at once, number waiting, longest wait in
    /// seconds [default: one per core, 32 per core, 5].
    #[arg(long, env = "RIGCAST_PREDICT_TURNS", value_parser = queue_limits, value_name = "N:QUEUE:WAIT_S")]
    pub predict_turns: Option<QueueLimits>,

    /// The same for long predictions, of more than about a million samples [default: one per core, 32 per
    /// core, 30].
    #[arg(long, env = "RIGCAST_LONG_TURNS", value_parser = queue_limits, value_name = "N:QUEUE:WAIT_S")]
    pub long_turns: Option<QueueLimits>,

    /// Uploads; one token has at most three quarters of them [default: 16:64:30].
    #[arg(long, env = "RIGCAST_UPLOAD_TURNS", value_parser = queue_limits, value_name = "N:QUEUE:WAIT_S")]
    pub upload_turns: Option<QueueLimits>,

    /// Requests that make jobs [default: 4:64:5].
    #[arg(long, env = "RIGCAST_JOB_TURNS", value_parser = queue_limits, value_name = "N:QUEUE:WAIT_S")]
    pub job_turns: Option<QueueLimits>,

    /// Reads and small changes of the registry [default: 16:256:5].
    #[arg(long, env = "RIGCAST_REGISTRY_TURNS", value_parser = queue_limits, value_name = "N:QUEUE:WAIT_S")]
    pub registry_turns: Option<QueueLimits>,

    /// Longest time to compute an answer once its request was read, seconds.
    #[arg(long, env = "RIGCAST_PREDICT_DEADLINE_S", default_value = "60", value_parser = seconds)]
    pub predict_deadline_s: Duration,

    /// Memory of all predictions of more than 16 MiB together, from their inputs to the last byte of their
    /// answers, bytes. One that needs more is computed alone.
    #[arg(long, env = "RIGCAST_PREDICT_MEMORY_BYTES", default_value_t = Limits::default().prediction_bytes)]
    pub predict_memory_bytes: usize,

    /// Connections at once.
    #[arg(long, env = "RIGCAST_CONNECTIONS", default_value_t = ConnectionSettings::default().most)]
    pub connections: usize,

    /// Connections at once of one address, which may belong to a proxy.
    #[arg(
        long,
        env = "RIGCAST_CONNECTIONS_PER_ADDRESS",
        default_value_t = ConnectionSettings::default().per_address
    )]
    pub connections_per_address: usize,

    /// Longest time for a client to send the head of a request, and to keep a connection idle, seconds.
    #[arg(long, env = "RIGCAST_HEAD_TIMEOUT_S", default_value = "15", value_parser = seconds)]
    pub head_timeout_s: Duration,

    /// Longest time in which a client reads nothing of its answer, seconds.
    #[arg(long, env = "RIGCAST_ANSWER_TIMEOUT_S", default_value = "30", value_parser = seconds)]
    pub answer_timeout_s: Duration,

    /// Slowest body, bytes a second.
    #[arg(long, env = "RIGCAST_BODY_BYTES_PER_S", default_value_t = Pace::default().bytes_per_s)]
    pub body_bytes_per_s: u64,

    /// Time over which a body's bytes are counted, seconds.
    #[arg(long, env = "RIGCAST_BODY_WINDOW_S", default_value = "30", value_parser = seconds)]
    pub body_window_s: Duration,
}

/// Limits of a class as they are written on the command line.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct QueueLimits {
    permits: usize,
    max_waiting: usize,
    max_wait: Duration,
}

fn queue_limits(text: &str) -> Result<QueueLimits, String> {
    let read = || {
        let mut parts = text.split(':');
        let permits = parts.next()?.parse().ok().filter(|n| (1..=4096).contains(n))?;
        let max_waiting = parts.next()?.parse().ok().filter(|n| (0..=1 << 20).contains(n))?;
        let max_wait = seconds(parts.next()?).ok()?;
        parts.next().is_none().then_some(QueueLimits { permits, max_waiting, max_wait })
    };
    read().ok_or_else(|| {
        "number at once (1 to 4096), number waiting (0 to 1048576), longest wait in s: 16:64:30".into()
    })
}

/// The default settings with the given limits.
fn changed(default: QueueSettings, given: Option<QueueLimits>) -> QueueSettings {
    let Some(QueueLimits { permits, max_waiting, max_wait }) = given else { return default };
    let per_token = (permits * default.per_token).div_ceil(default.permits);
    QueueSettings { permits, per_token, max_waiting, max_wait, patience: default.patience }
}

impl LoadArgs {
    pub(super) fn compute(&self) -> ComputeSettings {
        let default = ComputeSettings::default();
        ComputeSettings {
            predict: changed(default.predict, self.predict_turns),
            long: changed(default.long, self.long_turns),
            ..default
        }
    }

    pub(super) fn admission(&self) -> AdmissionSettings {
        let default = AdmissionSettings::default();
        AdmissionSettings {
            control: default.control,
            registry: changed(default.registry, self.registry_turns),
            upload: changed(default.upload, self.upload_turns),
            jobs: changed(default.jobs, self.job_turns),
        }
    }

    pub(super) fn connections(&self) -> ConnectionSettings {
        ConnectionSettings {
            most: self.connections,
            per_address: self.connections_per_address,
            head_timeout: self.head_timeout_s,
            answer_timeout: self.answer_timeout_s,
        }
    }

    pub(super) fn pace(&self) -> Pace {
        Pace { bytes_per_s: self.body_bytes_per_s, window: self.body_window_s }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn turns_are_three_numbers() {
        let max_wait = Duration::from_millis(500);
        assert_eq!(queue_limits("2:0:0.5"), Ok(QueueLimits { permits: 2, max_waiting: 0, max_wait }));
        for text in ["", "2", "2:3", "0:3:1", "2:-1:1", "2:3:0", "2:3:nan", "2:3:1:1", "a:3:1"] {
            assert!(queue_limits(text).is_err(), "{text}");
        }
    }

    #[test]
    fn a_token_keeps_its_part_of_more_or_fewer_turns() {
        let upload = AdmissionSettings::default().upload;
        assert_eq!(changed(upload.clone(), None), upload);
        for (given, per_token) in [("1:1:1", 1), ("2:1:1", 2), ("4:1:1", 3), ("32:1:1", 24)] {
            assert_eq!(changed(upload.clone(), queue_limits(given).ok()).per_token, per_token);
        }
    }
}
