//! The `rigcast` program.

use std::process::ExitCode;

use clap::Parser;
use rigcast::app::{self, App};
use rigcast::config::{Cli, Command, CopyArgs, LogArgs, ServeArgs};
use rigcast::demo::DemoArgs;
use rigcast::engine::simd::Isa;
use rigcast::storage;
use rigcast::telemetry::{self, LogFormat};
use rigcast::token::{self, CreateArgs, TokenCommand};
use rustix::process::{Resource, Rlimit, getrlimit, setrlimit};
use tokio::net::TcpListener;
use tokio::runtime::{Builder, Runtime};
use tokio::signal::unix::{SignalKind, signal};

type Failure = Box<dyn std::error::Error>;

fn main() -> ExitCode {
    let outcome = match Cli::parse().command {
        Command::Serve(args) => serve(&args),
        Command::Demo(args) => demo(args),
        Command::Token(TokenCommand::Create(args)) => create_token(&args),
        Command::Backup(args) => backup(&args),
        Command::Restore(args) => restore(&args),
        Command::Work(log) => work(&log),
    };
    match outcome {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("rigcast: {error}");
            ExitCode::FAILURE
        }
    }
}

fn serve(args: &ServeArgs) -> Result<(), Failure> {
    telemetry::init_logging(&args.log.log, args.log.log_format)?;
    let mut config = args.check()?;
    // A core would hold secrets that requests showed.
    setrlimit(Resource::Core, Rlimit { current: Some(0), maximum: Some(0) })?;
    let connections = &mut config.connections;
    connections.most = connections.most.min(handles()?);
    // A wrong instruction set is told now, not by the first prediction.
    let isa = Isa::of_process()?;
    runtime()?.block_on(async {
        // Signals are caught before anything is opened: a stop during the start is a clean one.
        let mut terminate = signal(SignalKind::terminate())?;
        let mut interrupt = signal(SignalKind::interrupt())?;
        let app = App::build(&config).await?;
        let listener = TcpListener::bind(args.listen).await?;
        let address = listener.local_addr()?;
        tracing::info!(
            http.address = %address,
            data.dir = %config.data_dir.display(),
            cpu.isa = isa.name(),
            version = env!("CARGO_PKG_VERSION"),
            "rigcast listens on http://{address}"
        );
        app.serve(listener, async move {
            tokio::select! {
                _ = terminate.recv() => {}
                _ = interrupt.recv() => {}
            }
        })
        .await;
        Ok(())
    })
}

/// File handles for connections: as many as the system allows, but for those of the store and of jobs.
fn handles() -> Result<usize, Failure> {
    /// More than are open without any connection, with some for jobs and uploads.
    const OTHERS: u64 = 256;
    let maximum = getrlimit(Resource::Nofile).maximum;
    setrlimit(Resource::Nofile, Rlimit { current: maximum, maximum })?;
    let handles = maximum.map_or(usize::MAX, |n| n.saturating_sub(OTHERS).max(1) as usize);
    if handles < 4096 {
        tracing::warn!(connections = handles, "the system allows few open files: connections are limited");
    }
    Ok(handles)
}

fn demo(args: DemoArgs) -> Result<(), Failure> {
    telemetry::init_logging(&args.log, LogFormat::Text)?;
    Ok(runtime()?.block_on(rigcast::demo::run(args))?)
}

/// The secret alone goes to standard output, for scripts; what it is, for people, to standard error.
fn create_token(args: &CreateArgs) -> Result<(), Failure> {
    let (token, secret) = runtime()?.block_on(token::create(args, app::now()))?;
    eprintln!("token {}, role {}. Its secret is shown this once:", token.id, token.role.as_str());
    println!("{}", secret.reveal());
    Ok(())
}

fn backup(args: &CopyArgs) -> Result<(), Failure> {
    let CopyArgs { backup, data_dir } = args;
    let made = runtime()?.block_on(storage::backup::backup(data_dir, backup, jiff::Timestamp::now()))?;
    println!("backed up {} objects of {} bytes into {}", made.objects, made.bytes, backup.display());
    Ok(())
}

fn restore(args: &CopyArgs) -> Result<(), Failure> {
    let CopyArgs { backup, data_dir } = args;
    let made = runtime()?.block_on(storage::backup::restore(backup, data_dir))?;
    let (n, path) = (made.objects, data_dir.display());
    println!("restored {n} objects of {} bytes, as of {}, into {path}", made.bytes, made.created_at);
    Ok(())
}

fn work(log: &LogArgs) -> Result<(), Failure> {
    telemetry::init_logging(&log.log, log.log_format)?;
    let runtime = runtime()?;
    let ended = runtime.block_on(rigcast::jobs::work());
    // A thread still waits for the server's next word.
    runtime.shutdown_background();
    Ok(ended?)
}

/// At least two threads, so that one handler that takes long never stops the health check.
fn runtime() -> std::io::Result<Runtime> {
    let cores = std::thread::available_parallelism().map_or(2, usize::from);
    Builder::new_multi_thread().worker_threads(cores.max(2)).thread_name("rigcast-http").enable_all().build()
}
