//! The service in a process of its own, and what a stage takes of it.

use std::io::{BufRead, BufReader};
use std::process::{Child, Command, Stdio};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use serde_json::Value;
use tempfile::TempDir;

use crate::AnyError;

/// Time between two looks at the memory of the service's processes.
const LOOK_EVERY: Duration = Duration::from_millis(20);

/// Limits above the defaults, so that an hour of 32 drives is one request: 460 MB of NPY.
const LIMITS: [&str; 4] = ["--drive-limit-bytes", "2147483648", "--predict-deadline-s", "1800"];

/// A running service: this program as `rigcast serve`, with worker processes of its own.
pub struct Service {
    child: Child,
    address: String,
    peak: Arc<AtomicU64>,
    ended: Arc<AtomicBool>,
    threads: Vec<JoinHandle<()>>,
    _data_dir: TempDir,
}

/// What a stage took.
#[derive(Debug, Clone, Copy)]
pub struct Cost {
    pub seconds: f64,
    /// Largest resident memory of all of the service's processes together.
    pub resident_mib: f64,
    /// Processor time of the same.
    pub cpu_s: f64,
}

impl Service {
    /// Starts it and waits until it listens.
    pub fn start() -> Result<Self, AnyError> {
        let data_dir = TempDir::with_prefix("rigcast-whole-work-")?;
        let mut child = Command::new(std::env::current_exe()?)
            .args([
                "serve",
                "--listen",
                "127.0.0.1:0",
                "--log",
                "warn,rigcast::program=info",
                "--log-format",
                "json",
            ])
            .args(LIMITS)
            .arg("--data-dir")
            .arg(data_dir.path())
            .stderr(Stdio::piped())
            .spawn()?;
        let mut lines = BufReader::new(child.stderr.take().ok_or("no log")?).lines();
        let address = loop {
            let line = lines.next().ok_or("the service has ended before it listened")??;
            let event: Value = serde_json::from_str(&line).unwrap_or_default();
            if let Some(address) = event["http.address"].as_str() {
                break address.to_owned();
            }
            eprintln!("{line}");
        };
        let log =
            std::thread::spawn(move || lines.map_while(Result::ok).for_each(|line| eprintln!("{line}")));
        let (peak, ended) = (Arc::new(AtomicU64::new(0)), Arc::new(AtomicBool::new(false)));
        let (seen, over, pid) = (Arc::clone(&peak), Arc::clone(&ended), child.id());
        let watch = std::thread::spawn(move || {
            while !over.load(Ordering::Relaxed) {
                seen.fetch_max(family(pid).into_iter().map(resident_kib).sum(), Ordering::Relaxed);
                std::thread::sleep(LOOK_EVERY);
            }
        });
        Ok(Self { child, address, peak, ended, threads: vec![log, watch], _data_dir: data_dir })
    }

    /// Its URL.
    pub fn url(&self) -> String {
        format!("http://{}", self.address)
    }

    /// Begins to count.
    pub fn meter(&self) -> Meter<'_> {
        self.peak.store(0, Ordering::Relaxed);
        Meter { service: self, began: Instant::now(), cpu_s: self.cpu_s() }
    }

    /// Processor time of the server, of the workers that it has waited for, and of those that run.
    fn cpu_s(&self) -> f64 {
        family(self.child.id()).into_iter().map(cpu_s).sum()
    }
}

/// Counts from the beginning of a stage.
pub struct Meter<'a> {
    service: &'a Service,
    began: Instant,
    cpu_s: f64,
}

impl Meter<'_> {
    /// What it took until now.
    pub fn read(&self) -> Cost {
        let seconds = self.began.elapsed().as_secs_f64();
        // One more look: a stage may be shorter than the time between two.
        std::thread::sleep(LOOK_EVERY);
        Cost {
            seconds,
            resident_mib: self.service.peak.load(Ordering::Relaxed) as f64 / 1024.0,
            cpu_s: self.service.cpu_s() - self.cpu_s,
        }
    }
}

impl Drop for Service {
    fn drop(&mut self) {
        // Errors are ignored here: the directory is temporary, and the figures are printed.
        let _ = self.child.kill();
        let _ = self.child.wait();
        self.ended.store(true, Ordering::Relaxed);
        self.threads.drain(..).for_each(|thread| _ = thread.join());
    }
}

/// A process and its children.
fn family(pid: u32) -> Vec<u32> {
    let mut all = vec![pid];
    for task in std::fs::read_dir(format!("/proc/{pid}/task")).into_iter().flatten().flatten() {
        let children = std::fs::read_to_string(task.path().join("children")).unwrap_or_default();
        all.extend(children.split_whitespace().filter_map(|child| child.parse::<u32>().ok()));
    }
    all
}

fn resident_kib(pid: u32) -> u64 {
    let status = std::fs::read_to_string(format!("/proc/{pid}/status")).unwrap_or_default();
    let line = status.lines().find_map(|line| line.strip_prefix("VmRSS:"));
    line.and_then(|line| line.trim().trim_end_matches(" kB").parse().ok()).unwrap_or(0)
}

/// Times of a process and of its children that it has waited for.
fn cpu_s(pid: u32) -> f64 {
    let stat = std::fs::read_to_string(format!("/proc/{pid}/stat")).unwrap_or_default();
    // The name before it, in brackets, may hold spaces. Fields 14 to 17 of the line, in hundredths of a second.
    let after = stat.rsplit_once(')').map_or("", |(_, after)| after);
    after.split_whitespace().skip(11).take(4).filter_map(|ticks| ticks.parse::<f64>().ok()).sum::<f64>()
        / 100.0
}
