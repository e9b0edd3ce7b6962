//! What the subcommands of `rigcast` do.

mod allocator;

use std::process::ExitCode;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Instant;

use rustix::process::{Resource, Rlimit, getrlimit, setrlimit};
use tokio::runtime::{Builder, Runtime};
use tokio::signal::unix::{SignalKind, signal};

use crate::app::{self, Address, App};
use crate::config::{
    BackupArgs, Command, Config, ConfigError, CopyArgs, CreateArgs, DemoArgs, HealthArgs, LogArgs, MoveArgs,
    RecoverArgs, ServeArgs, TokenCommand, WorkArgs,
};
use crate::engine::simd::Isa;
use crate::storage;
use crate::storage::StoreSettings;
use crate::storage::backup::Source;
use crate::telemetry::{self, LogFormat};
use crate::token;

type Failure = Box<dyn std::error::Error>;

/// Does what a subcommand says. A failure is told on standard error.
pub fn run(command: Command) -> ExitCode {
    let outcome = match command {
        Command::Serve(args) => serve(&args),
        Command::Demo(args) => demo(args),
        Command::Token(TokenCommand::Create(args)) => create_token(&args),
        Command::Health(args) => health(&args),
        Command::Backup(args) => backup(&args),
        Command::Restore(args) => restore(&args),
        Command::Recover(args) => recover(&args),
        Command::Move(args) => move_registry(&args),
        Command::Work(args) => work(&args),
        Command::Job(log) => job(&log),
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
    begin(&args.log)?;
    run_service(args.check()?)
}

fn work(args: &WorkArgs) -> Result<(), Failure> {
    begin(&args.log)?;
    run_service(args.check()?)
}

/// What comes before everything else in a process that stays.
fn begin(log: &LogArgs) -> Result<(), Failure> {
    let allocator = allocator::fix_settings();
    telemetry::init_logging(&log.log, log.log_format)?;
    if let Err(error) = allocator {
        tracing::warn!(%error, "the allocator's settings stay as they are: freed memory may be kept");
    }
    Ok(())
}

/// Runs a part of the service until it is told to stop.
fn run_service(mut config: Config) -> Result<(), Failure> {
    // A core dump would hold secrets from requests.
    setrlimit(Resource::Core, Rlimit { current: Some(0), maximum: Some(0) })?;
    let connections = &mut config.connections;
    connections.most = connections.most.min(handles()?);
    // A wrong instruction set is refused now and not at the first prediction.
    let isa = Isa::of_process()?;
    runtime()?.block_on(async {
        // Signals are caught before anything is opened, so that a stop during the start is clean.
        let mut terminate = signal(SignalKind::terminate())?;
        let mut interrupt = signal(SignalKind::interrupt())?;
        let address = Address::take(config.listen)?;
        let app = App::build(&config).await?;
        let listener = address.listen()?;
        let address = listener.local_addr()?;
        tracing::info!(
            http.address = %address,
            data.dir = %config.data_dir.display(),
            cpu.isa = isa.name(),
            version = crate::VERSION,
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

/// File handles for connections: the system's limit, less those of the store and of jobs.
fn handles() -> Result<usize, Failure> {
    /// An upper bound on the files that are open without connections, with some for jobs and uploads.
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
    Ok(runtime()?.block_on(crate::demo::run(args))?)
}

/// Prints only the secret on standard output, for scripts, and its description on standard error.
fn create_token(args: &CreateArgs) -> Result<(), Failure> {
    let (token, secret) = runtime()?.block_on(token::create(args, app::now()))?;
    eprintln!("token {}, role {}. Its secret is shown this once:", token.id, token.role.as_str());
    println!("{}", secret.reveal());
    Ok(())
}

fn health(args: &HealthArgs) -> Result<(), Failure> {
    crate::health::check(args.listen, args.timeout_s)?;
    println!("alive");
    Ok(())
}

fn backup(args: &BackupArgs) -> Result<(), Failure> {
    let BackupArgs { copy: CopyArgs { backup, data_dir }, previous, store } = args;
    let StoreSettings { bucket, database } = store.settings();
    let (previous, now) = (previous.as_deref(), jiff::Timestamp::now());
    let source = database.as_ref().map_or(Source::DataDir(data_dir), Source::Postgres);
    let work = storage::backup::backup(source, bucket.as_ref(), backup, previous, now, told_each_second());
    let made = runtime()?.block_on(work)?;
    println!("backed up {} objects of {} bytes into {}", made.objects, made.bytes, backup.display());
    Ok(())
}

fn restore(args: &CopyArgs) -> Result<(), Failure> {
    let CopyArgs { backup, data_dir } = args;
    let made = runtime()?.block_on(storage::backup::restore(backup, data_dir, told_each_second()))?;
    let (n, path) = (made.objects, data_dir.display());
    println!("restored {n} objects of {} bytes, as of {}, into {path}", made.bytes, made.created_at);
    Ok(())
}

fn move_registry(args: &MoveArgs) -> Result<(), Failure> {
    let MoveArgs { data_dir, back, store } = args;
    let StoreSettings { bucket: Some(bucket), database: Some(database) } = store.settings() else {
        return Err(ConfigError::Nowhere.into());
    };
    telemetry::init_logging("warn", LogFormat::Text)?;
    let (path, name) = (data_dir.display(), database.name()?);
    if *back {
        let work = storage::backup::move_back(&database, &bucket, data_dir, told_each_second());
        let n = runtime()?.block_on(work)?;
        println!("{path} has the registry of {name} and its {n} objects; both stay where they were");
        return Ok(());
    }
    let moved = runtime()?.block_on(storage::move_into(data_dir, &bucket, &database, told_each_second()))?;
    println!("{name} has the registry of {path}, and {} its {} objects", bucket.url, moved.objects);
    Ok(())
}

/// Says on standard error how far a copy is and how long it still takes, each second.
fn told_each_second() -> storage::backup::Progress {
    let (begin, told) = (Instant::now(), AtomicU64::new(0));
    Arc::new(move |done, all| {
        let elapsed = begin.elapsed().as_secs();
        if told.fetch_max(elapsed, Ordering::Relaxed) < elapsed && done < all {
            let left = begin.elapsed().as_secs_f64() * (all - done) as f64 / done.max(1) as f64;
            eprintln!("{done} of {all} objects, {left:.0} s to go");
        }
    })
}

fn recover(args: &RecoverArgs) -> Result<(), Failure> {
    /// Longer lists are cut; the whole of them is seldom read.
    const LISTED: usize = 50;
    telemetry::init_logging("warn", LogFormat::Text)?;
    let done =
        runtime()?.block_on(storage::recover(&args.data_dir, args.objects.bucket().as_ref(), app::now()))?;
    let list = |title: &str, items: Vec<String>| {
        if items.is_empty() {
            return;
        }
        println!("{title} ({}):", items.len());
        items.iter().take(LISTED).for_each(|item| println!("  {item}"));
        if items.len() > LISTED {
            println!("  and {} more", items.len() - LISTED);
        }
    };
    let rows: Vec<String> = done.rows.iter().map(|(table, n)| format!("{n} {table}")).collect();
    println!("the database of {} was made anew: {}", args.data_dir.display(), rows.join(", "));
    list("sources that were not whole", done.sources);
    list("rows brought back from the journal", done.restored);
    let (unknown, lost): (Vec<_>, Vec<_>) =
        done.lost.into_iter().partition(|lost| matches!(lost, storage::Lost::Unknown(_)));
    list("what could not be brought back", lost.iter().map(ToString::to_string).collect());
    list("objects that no row names, which are kept", unknown.iter().map(ToString::to_string).collect());
    println!("the files from before are in {}", done.kept_in.display());
    Ok(())
}

fn job(log: &LogArgs) -> Result<(), Failure> {
    telemetry::init_logging(&log.log, log.log_format)?;
    let runtime = runtime()?;
    let ended = runtime.block_on(crate::jobs::work());
    // A thread still waits for the server's next word.
    runtime.shutdown_background();
    Ok(ended?)
}

/// At least two threads, so that one handler that takes long never stops the health check.
fn runtime() -> std::io::Result<Runtime> {
    let cores = std::thread::available_parallelism().map_or(2, usize::from);
    Builder::new_multi_thread().worker_threads(cores.max(2)).thread_name("rigcast-http").enable_all().build()
}
