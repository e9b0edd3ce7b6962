//! The worker's side: one piece of work, then the end of the process.

use std::sync::Arc;
use std::time::Duration;

use tokio::io::{Stdin, Stdout};
use tokio::signal::unix::{SignalKind, signal};

use crate::compute::{Compute, ComputeSettings};
use crate::storage::Store;

use super::frames::{self, Begin, Say, Tell};
use crate::jobs::control::{Control, Stop};
use crate::jobs::problem::{JobError, panicked};
use crate::jobs::spec::JobOutput;
use crate::jobs::work_context::WorkContext;

/// How often a worker reports its progress.
const SAY_EVERY: Duration = Duration::from_millis(250);

/// Why a worker process could not work.
#[derive(Debug, thiserror::Error)]
pub enum WorkError {
    /// Its standard input and output do not belong to a server.
    #[error("`rigcast job` is started by `rigcast serve`, which talks to it: {0}")]
    Server(#[from] std::io::Error),
    /// The server sent no work.
    #[error("`rigcast job` is started by `rigcast serve`, which sends it its work; nothing was sent")]
    Nothing,
}

/// Does the one piece of work that the server sends over standard input, and reports the outcome on
/// standard output.
///
/// # Errors
/// See [`WorkError`]; errors of the work itself are reported to the server.
pub async fn work() -> Result<(), WorkError> {
    die_with_the_server();
    // A terminal or a service manager signals all processes. A worker ignores that and stops when its
    // server says so.
    let _not_ours = (signal(SignalKind::terminate())?, signal(SignalKind::interrupt())?);
    let (mut ears, mut mouth) = (tokio::io::stdin(), tokio::io::stdout());
    let Some((Tell::Begin(begin), _)) = frames::read(&mut ears).await? else {
        return Err(WorkError::Nothing);
    };
    let control = Arc::new(Control::default());
    tokio::spawn(obey(ears, Arc::clone(&control)));
    let mut work = tokio::spawn(make(*begin, Arc::clone(&control)));
    let mut ticks = tokio::time::interval(SAY_EVERY);
    let end = loop {
        tokio::select! {
            end = &mut work => break end.unwrap_or_else(|error| Err(panicked(&error.to_string()))),
            _ = ticks.tick() => say_progress(&mut mouth, &control).await?,
            () = control.kept() => say_kept(&mut mouth, &control).await?,
        }
    };
    say_progress(&mut mouth, &control).await?;
    match end {
        Ok(mut made) => {
            let bytes = std::mem::take(made.bytes());
            frames::write(&mut mouth, &Say::Output(made), &bytes).await?;
        }
        Err(error) => frames::write(&mut mouth, &Say::Ended(error), &[]).await?,
    }
    Ok(())
}

/// Does the job with the store of the running service.
async fn make(begin: Begin, control: Arc<Control>) -> Result<JobOutput, JobError> {
    #[cfg(debug_assertions)]
    super::fault::inject(&begin.spec);
    let store = Store::open_to_read(&begin.data_dir, &begin.store).await?;
    let settings = ComputeSettings { predict_threads: 1, long_threads: 1, ..ComputeSettings::default() };
    let compute = Compute::new(&settings)?;
    let context = WorkContext {
        store,
        compute,
        fit: crate::engine::model::fit_resumable,
        checkpoint_every: begin.checkpoint_every,
        memory_bytes: begin.memory_bytes,
    };
    context.make(&begin.spec, &control).await
}

async fn say_progress(mouth: &mut Stdout, control: &Control) -> std::io::Result<()> {
    say_kept(mouth, control).await?;
    let losses = control.take_losses();
    if !losses.is_empty() {
        frames::write(mouth, &Say::Losses(losses), &[]).await?;
    }
    let (stage, fraction) = control.progress();
    frames::write(mouth, &Say::Progress { stage, fraction }, &[]).await
}

/// Sends the checkpoints since the last call.
async fn say_kept(mouth: &mut Stdout, control: &Control) -> std::io::Result<()> {
    for mut checkpoint in control.take_kept() {
        let state = std::mem::take(&mut checkpoint.state);
        frames::write(mouth, &Say::Keep(checkpoint), &state).await?;
    }
    Ok(())
}

/// Stops the work when the server says so, and the process when the server is gone.
async fn obey(mut ears: Stdin, control: Arc<Control>) {
    // The server knows the reason.
    while let Ok(Some((Tell::Stop, _))) = frames::read(&mut ears).await {
        control.stop(Stop::Shutdown);
    }
    std::process::exit(1);
}

/// Makes the system kill this process with its server, even if it is frozen, and kill a worker rather
/// than the server when memory runs out.
fn die_with_the_server() {
    #[cfg(target_os = "linux")]
    {
        let signal = rustix::process::Signal::KILL;
        if let Err(error) = rustix::process::set_parent_process_death_signal(Some(signal)) {
            tracing::warn!(%error, "a frozen worker may outlive its server");
        }
        if let Err(error) = std::fs::write("/proc/self/oom_score_adj", "1000") {
            tracing::debug!(%error, "the system chooses by itself what to end when memory is short");
        }
    }
}
