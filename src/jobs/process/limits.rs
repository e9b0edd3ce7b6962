//! Limits of a worker process, and how they are checked.

use std::time::{Duration, Instant};

use super::LOOK_EVERY;
use crate::domain::Problem;
use crate::jobs::problem::{JobError, codes};

/// Why a worker is killed.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Cut {
    /// It holds more memory than it may.
    Memory { limit_bytes: u64 },
    /// It has run for longer than it may.
    Time { limit: Duration },
    /// It was silent for this long, so it is frozen.
    Silent { limit: Duration },
    /// It did not stop when told to.
    Disobedient,
}

impl Cut {
    /// As the end of an attempt.
    pub(super) fn ends(self) -> JobError {
        let retry =
            |code, title: &str, detail: String| JobError::retry(Problem::new(500, code, title, detail));
        match self {
            Self::Memory { limit_bytes } => {
                let detail = format!(
                    "The job took more than {} MiB of memory, the limit (--job-memory-mib).",
                    limit_bytes >> 20
                );
                retry(codes::JOB_MEMORY, "The job took too much memory", detail)
            }
            Self::Time { limit } => {
                let detail = format!(
                    "An attempt took longer than {} s, the limit (--job-time-limit-s).",
                    limit.as_secs_f64()
                );
                retry(codes::JOB_TIME_LIMIT, "The job took too long", detail)
            }
            Self::Silent { limit } => {
                let detail = format!(
                    "The worker process was silent for {} s, the time of a lease.",
                    limit.as_secs_f64()
                );
                retry(codes::JOB_CRASHED, "The worker process died", detail)
            }
            Self::Disobedient => JobError::Stopped,
        }
    }
}

/// The state of a running worker.
pub(super) struct Watch {
    pub pid: Option<u32>,
    pub memory_bytes: u64,
    pub time_limit: Duration,
    pub silence: Duration,
    pub started: Instant,
    /// Time of the last check.
    pub looked: Instant,
    /// How long the worker was silent while the server listened; the time in which the server was frozen
    /// itself does not count.
    pub silent_for: Duration,
    /// Time by which it must end, once it was told to stop.
    pub stop_by: Option<Instant>,
}

impl Watch {
    /// Checks the worker; returns why it must be killed, if it must.
    pub(super) fn look(&mut self) -> Option<Cut> {
        self.silent_for += self.looked.elapsed().min(2 * LOOK_EVERY);
        self.looked = Instant::now();
        if self.stop_by.is_some_and(|by| Instant::now() >= by) {
            return Some(Cut::Disobedient);
        }
        if self.started.elapsed() > self.time_limit {
            return Some(Cut::Time { limit: self.time_limit });
        }
        if self.silent_for > self.silence {
            return Some(Cut::Silent { limit: self.silence });
        }
        let resident = self.pid.and_then(resident_bytes);
        resident
            .is_some_and(|bytes| bytes > self.memory_bytes)
            .then_some(Cut::Memory { limit_bytes: self.memory_bytes })
    }
}

/// Memory that a process holds; unknown where there is no `/proc`.
fn resident_bytes(pid: u32) -> Option<u64> {
    kib_of(&std::fs::read_to_string(format!("/proc/{pid}/status")).ok()?, "VmRSS:")
}

/// A line like `VmRSS:   123 kB`, in bytes.
fn kib_of(text: &str, name: &str) -> Option<u64> {
    let line = text.lines().find_map(|line| line.strip_prefix(name))?;
    line.split_whitespace().next()?.parse::<u64>().ok()?.checked_mul(1024)
}

/// How often the system has killed a process for lack of memory since it started.
pub(super) fn out_of_memory_kills() -> Option<u64> {
    let text = std::fs::read_to_string("/proc/vmstat").ok()?;
    text.lines().find_map(|line| line.strip_prefix("oom_kill "))?.trim().parse().ok()
}

/// Memory that a further process can take: what the machine has left, and what the control group has, of which caches of files
/// give way. Unknown where there is no `/proc`.
pub(in crate::jobs) fn available_memory_bytes() -> Option<u64> {
    let machine =
        std::fs::read_to_string("/proc/meminfo").ok().and_then(|text| kib_of(&text, "MemAvailable:"));
    let read = |name: &str| std::fs::read_to_string(format!("/sys/fs/cgroup/{name}")).ok();
    let group = group_left(
        &read("memory.max").unwrap_or_default(),
        &read("memory.current").unwrap_or_default(),
        &read("memory.stat").unwrap_or_default(),
    );
    machine.into_iter().chain(group).min()
}

/// What a control group has left; none without a limit.
fn group_left(max: &str, current: &str, stat: &str) -> Option<u64> {
    let max: u64 = max.trim().parse().ok()?;
    let current: u64 = current.trim().parse().ok()?;
    let files = stat.lines().find_map(|line| line.strip_prefix("inactive_file ")?.trim().parse().ok());
    Some(max.saturating_sub(current.saturating_sub(files.unwrap_or(0))))
}

/// Three quarters of the memory of this machine or control group, shared by `workers`.
pub(in crate::jobs) fn default_memory_bytes(workers: usize) -> u64 {
    let machine = std::fs::read_to_string("/proc/meminfo").ok().and_then(|text| kib_of(&text, "MemTotal:"));
    let group = std::fs::read_to_string("/sys/fs/cgroup/memory.max").ok();
    let group = group.and_then(|text| text.trim().parse::<u64>().ok());
    let all = machine.into_iter().chain(group).min().unwrap_or(u64::MAX);
    all / 4 * 3 / workers.max(1) as u64
}

#[cfg(test)]
mod tests {
    use super::*;

    fn watch() -> Watch {
        let (limit, now) = (Duration::from_secs(60), Instant::now());
        Watch {
            pid: Some(std::process::id()),
            memory_bytes: u64::MAX,
            time_limit: limit,
            silence: limit,
            started: now,
            looked: now,
            silent_for: Duration::ZERO,
            stop_by: None,
        }
    }

    #[test]
    fn each_limit_is_seen_and_named() {
        assert_eq!(watch().look(), None);
        let zero = Duration::ZERO;
        let code = |mut watch: Watch| match watch.look().expect("a limit is passed").ends() {
            JobError::Retry(problem) => problem.code,
            JobError::Stopped => "stopped".into(),
            other => panic!("{other:?}"),
        };
        assert_eq!(code(Watch { time_limit: zero, ..watch() }), codes::JOB_TIME_LIMIT);
        let silent = || Watch { silent_for: Duration::from_secs(61), ..watch() };
        assert_eq!(code(silent()), codes::JOB_CRASHED);
        // Frozen together with its server.
        let looked = Instant::now().checked_sub(Duration::from_secs(61)).unwrap();
        assert_eq!(Watch { looked, ..watch() }.look(), None);
        assert_eq!(code(Watch { stop_by: Some(Instant::now()), ..watch() }), "stopped");
        if cfg!(target_os = "linux") {
            assert_eq!(code(Watch { memory_bytes: 1 << 16, ..watch() }), codes::JOB_MEMORY);
        }
    }

    #[test]
    fn memory_is_read_from_the_systems_words() {
        assert_eq!(kib_of("Name:\tx\nVmRSS:\t  12 kB\n", "VmRSS:"), Some(12 << 10));
        assert_eq!(kib_of("Name:\tx\n", "VmRSS:"), None);
        assert!(default_memory_bytes(1) >= 2 * default_memory_bytes(2));
        assert_eq!(group_left("max\n", "5\n", "inactive_file 3\n"), None);
        assert_eq!(group_left("100\n", "50\n", "anon 40\ninactive_file 10\n"), Some(60));
        assert_eq!(group_left("100\n", "150\n", ""), Some(0));
        if cfg!(target_os = "linux") {
            assert!(available_memory_bytes().unwrap() > 0);
        }
    }
}
