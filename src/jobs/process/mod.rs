//! Work in a process of its own, so that its failure costs one attempt of one job and nothing else.
//!
//! The worker reads the store, computes and sends its output. Lease, heartbeat, progress and publishing
//! stay with the server. Each side notices when the other is gone: the server by the end of the worker's
//! output, the worker by the end of its input.

mod child;
#[cfg(debug_assertions)]
mod fault;
mod frames;
mod limits;

use std::ffi::OsString;
use std::os::unix::process::ExitStatusExt;
use std::path::PathBuf;
use std::process::{ExitStatus, Stdio};
use std::time::{Duration, Instant};

use bytes::Bytes;
use tokio::process::{Child, ChildStdin, ChildStdout, Command};
use tokio::sync::{mpsc, oneshot};
use tokio::task::JoinSet;
use tokio::time::MissedTickBehavior;

use crate::domain::Problem;
use crate::storage::Checkpoint;

use super::control::Control;
use super::problem::{JobError, codes};
use super::spec::JobOutput;
use frames::{Say, Tell};
use limits::{Cut, Watch, out_of_memory_kills};

pub use child::{WorkError, work};
pub(super) use frames::Begin;
pub(super) use limits::{available_memory_bytes, default_memory_bytes};

/// How often a worker is checked.
const LOOK_EVERY: Duration = Duration::from_millis(100);

/// How long a worker may take to stop; the engine checks several times a second.
const OBEY: Duration = Duration::from_secs(5);

/// How long a worker may take to end after its last message.
const LEAVE: Duration = Duration::from_secs(2);

/// How worker processes are started, and their limits.
#[derive(Debug, Clone)]
pub struct WorkerProgram {
    /// The program to start.
    pub program: PathBuf,
    /// Its arguments.
    pub arguments: Vec<OsString>,
    /// Memory that a worker may hold, bytes; above that it is killed.
    pub memory_bytes: u64,
    /// How long one attempt of a job may take.
    pub time_limit: Duration,
}

impl WorkerProgram {
    /// Three quarters of the machine's memory (or of the control group's), shared by `workers`.
    pub fn default_memory_bytes(workers: u16) -> u64 {
        limits::default_memory_bytes(workers.into())
    }

    fn start(&self) -> std::io::Result<Child> {
        Command::new(&self.program)
            .arg0("rigcast")
            .args(&self.arguments)
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .kill_on_drop(true)
            .spawn()
    }

    /// Starts a process for the work of a job and waits for its output. A process that is silent for
    /// longer than `silence` is killed.
    pub(super) async fn make(
        &self,
        begin: Begin,
        silence: Duration,
        control: &Control,
    ) -> Result<JobOutput, JobError> {
        let killed_before = out_of_memory_kills();
        let mut child = self.start().map_err(|error| not_started(&error))?;
        let (Some(ears), Some(mouth)) = (child.stdin.take(), child.stdout.take()) else {
            unreachable!("both were asked for as pipes")
        };
        let (said, mut heard) = mpsc::channel(8);
        tokio::spawn(listen(mouth, said));
        let (stop, told_to_stop) = oneshot::channel();
        let mut stop = Some(stop);
        // A task of its own, which ends with this work: a frozen worker does not even read its input.
        let mut telling = JoinSet::new();
        telling.spawn(tell(ears, begin, told_to_stop));
        let now = Instant::now();
        let mut watch = Watch {
            pid: child.id(),
            memory_bytes: self.memory_bytes,
            time_limit: self.time_limit,
            silence,
            started: now,
            looked: now,
            silent_for: Duration::ZERO,
            stop_by: None,
        };
        let mut looks = tokio::time::interval(LOOK_EVERY);
        looks.set_missed_tick_behavior(MissedTickBehavior::Delay);
        let mut cut: Option<Cut> = None;
        loop {
            tokio::select! {
                biased;
                message = heard.recv() => match message {
                    Some((Say::Progress { stage, fraction }, _)) => {
                        watch.silent_for = Duration::ZERO;
                        control.report(&stage, fraction);
                    }
                    Some((Say::Losses(losses), _)) => control.add_losses(losses),
                    Some((Say::Keep(checkpoint), state)) => control.keep(Checkpoint { state, ..checkpoint }),
                    Some((Say::Output(mut made), bytes)) => {
                        *made.bytes() = bytes;
                        let _ = leave(&mut child).await;
                        return Ok(made);
                    }
                    Some((Say::Ended(error), _)) => {
                        let _ = leave(&mut child).await;
                        return Err(error);
                    }
                    None => break,
                },
                _ = looks.tick() => {
                    if watch.stop_by.is_none() && control.stopped().is_some() {
                        watch.stop_by = Some(Instant::now() + OBEY);
                        // An error means that the worker has ended.
                        let _ = stop.take().map(|stop| stop.send(()));
                    }
                    if cut.is_none() {
                        cut = watch.look();
                        // An error means that the worker is gone; its output ends either way.
                        if cut.is_some() {
                            let _ = child.start_kill();
                        }
                    }
                }
            }
        }
        let status = leave(&mut child).await;
        tracing::warn!(worker.pid = watch.pid, ?status, ?cut, "a worker process ended without a last word");
        if let Some(cut) = cut {
            return Err(cut.ends());
        }
        let killed_for_memory = status.as_ref().is_ok_and(|status| status.signal() == Some(9))
            && out_of_memory_kills() > killed_before;
        Err(died(status.ok(), killed_for_memory))
    }
}

/// Sends a worker its work and later, if needed, the message to stop. The input stays open, because its
/// end would mean that the server is gone. A worker that is gone is noticed by its silence.
async fn tell(mut ears: ChildStdin, begin: Begin, stop: oneshot::Receiver<()>) {
    if frames::write(&mut ears, &Tell::Begin(Box::new(begin)), &[]).await.is_ok() && stop.await.is_ok() {
        let _ = frames::write(&mut ears, &Tell::Stop, &[]).await;
    }
    std::future::pending().await
}

/// Passes on a worker's messages until its output ends.
async fn listen(mut mouth: ChildStdout, said: mpsc::Sender<(Say, Bytes)>) {
    loop {
        match frames::read(&mut mouth).await {
            Ok(Some(message)) => {
                if said.send(message).await.is_err() {
                    return;
                }
            }
            Ok(None) => return,
            Err(error) => {
                tracing::warn!(%error, "a worker process was cut off while it spoke");
                return;
            }
        }
    }
}

/// Waits for the end of a worker whose output has ended, and kills it if it stays.
async fn leave(child: &mut Child) -> std::io::Result<ExitStatus> {
    if let Ok(ended) = tokio::time::timeout(LEAVE, child.wait()).await {
        return ended;
    }
    tracing::warn!("a worker process did not end by itself");
    child.start_kill()?;
    child.wait().await
}

fn not_started(error: &std::io::Error) -> JobError {
    tracing::error!(%error, "a worker process could not be started");
    let detail = "No worker process could be started; the service's log says why.";
    JobError::retry(Problem::new(503, codes::BUSY, "Busy", detail))
}

/// The end of a worker that the server has not killed.
fn died(status: Option<ExitStatus>, for_memory: bool) -> JobError {
    if for_memory {
        let detail = "The system killed the worker process because the machine had no memory left.";
        return JobError::retry(Problem::new(500, codes::JOB_MEMORY, "The job took too much memory", detail));
    }
    let how = match status.map(|status| (status.code(), status.signal())) {
        Some((_, Some(signal))) => format!("by signal {signal}"),
        Some((Some(code), None)) => format!("with exit code {code}"),
        _ => "in an unknown way".into(),
    };
    let detail = format!("The worker process ended {how} while it had the job.");
    JobError::retry(Problem::new(500, codes::JOB_CRASHED, "The worker process died", detail))
}
