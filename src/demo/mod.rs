//! `rigcast demo`: an example on a virtual rig, over HTTP as a lab's software would do it.
//!
//! Starts the service on an empty data directory, uploads noise runs, lets the fit policy fit the
//! four kinds of model, predicts withheld loads and prints the errors of each kind (in the form of
//! Heindel et al., figure 7). Then it uploads runs from after a change of the rig, for a diagnosis. It
//! calls the service as any client does; the service does not know that the rig is virtual.

mod bars;
mod later;
mod scores;
mod service;
mod upload;

use std::path::PathBuf;

use serde_json::{Value, json};
use tokio::signal::unix::{SignalKind, signal};

use crate::app::AppError;
use crate::client::{self, Client, ClientError};
use crate::config::DemoArgs;
use crate::engine::EngineError;
use crate::engine::virtual_rig::VirtualRig;

pub use service::LocalService;

/// The reason why the demo ended early.
#[derive(Debug, thiserror::Error)]
pub enum DemoError {
    /// The service did not start or stop.
    #[error(transparent)]
    App(#[from] AppError),
    /// A call failed.
    #[error(transparent)]
    Client(#[from] ClientError),
    /// The rig could not be simulated.
    #[error("virtual rig: {0}")]
    Rig(#[from] EngineError),
    /// The directory holds something already.
    #[error("the data directory {0} is not empty; the demo wants an empty one")]
    NotEmpty(PathBuf),
    /// The file system.
    #[error(transparent)]
    Io(#[from] std::io::Error),
}

/// Kinds of model in the order of the table.
const KINDS: [(&str, &str); 4] =
    [("frf", "FRF"), ("lstm", "LSTM"), ("hybrid1", "hybrid 1"), ("hybrid2", "hybrid 2")];

/// Id of the demo's rig.
const RIG: &str = "hydromount-3x";

/// Runs the demo.
///
/// # Errors
/// The error of the step that failed, in the words of the service.
pub async fn run(args: DemoArgs) -> Result<(), DemoError> {
    if let Some(dir) = &args.data_dir
        && dir.is_dir()
        && std::fs::read_dir(dir)?.next().is_some()
    {
        return Err(DemoError::NotEmpty(dir.clone()));
    }
    let service = LocalService::start(args.listen, args.data_dir.clone()).await?;
    let client = Client::new(&service.url(), args.token.as_deref())?;
    println!("Service on {}; data in {}", service.url(), service.data_dir().display());
    println!("Virtual rig, seed {}: {:.0} min of training noise, loads withheld\n", args.seed, args.minutes);

    let runs = simulate(&args).await?;
    let training_s: f64 = runs.iter().map(upload::DemoRun::training_s).sum();
    client.post("/v1/rigs", &rig(&args, training_s)).await?;
    let uploaded = upload::all(&client, RIG, &runs).await?;
    let models = wait_for_fits(&client, &uploaded.jobs).await?;
    let table = scores::table(&client, RIG, &models, &uploaded.tests).await?;
    println!("\n{table}\n{}", scores::LEGEND);
    let (draw, seed) = (VirtualRig::draw(args.seed), args.seed);
    let changed = computed(move || later::record(&draw, seed)).await??;
    upload::all(&client, RIG, &changed).await?;
    println!(
        "\nMonths later, z's servo-valve has play: {} more runs, tagged `{}`. docs/diagnosis.md, \"Where model and rig\n\
         differ\", has the service find it and mend the model.",
        changed.len(),
        later::TAG
    );
    if args.exit {
        return service.stop().await;
    }
    println!("\nThe service stays up: {}/docs shows its contract. Ctrl-C ends it.", service.url());
    until_signal().await?;
    service.stop().await
}

/// Waits for Ctrl-C or SIGTERM.
async fn until_signal() -> std::io::Result<()> {
    let mut terminate = signal(SignalKind::terminate())?;
    tokio::select! {
        _ = terminate.recv() => Ok(()),
        interrupted = tokio::signal::ctrl_c() => interrupted,
    }
}

/// Simulates the whole test programme, all cores at work.
async fn simulate(args: &DemoArgs) -> Result<Vec<upload::DemoRun>, DemoError> {
    let (seed, minutes) = (args.seed, args.minutes);
    let bar = bars::steps("simulating the rig");
    let shown = bar.clone();
    let runs = computed(move || upload::record(&VirtualRig::draw(seed), seed, minutes, &shown)).await??;
    bar.finish_and_clear();
    println!("{} runs recorded in {:.0} s", runs.len(), bar.elapsed().as_secs_f64());
    Ok(runs)
}

/// Runs long work on a thread apart from the service.
async fn computed<T: Send + 'static>(work: impl FnOnce() -> T + Send + 'static) -> std::io::Result<T> {
    tokio::task::spawn_blocking(work).await.map_err(|e| std::io::Error::other(e.to_string()))
}

/// The rig with a policy that fits all four kinds once all training noise is there.
fn rig(args: &DemoArgs, training_s: f64) -> Value {
    let channels = VirtualRig::draw(args.seed).channels();
    // As in the paper, service loads help to choose among networks, never to train them.
    let validation = json!({"kinds": ["noise", "service"], "split": "validation"});
    // The FRF is fitted where the rig is nearly linear.
    let linear = json!({"runs": {"tags": ["linear"]}});
    // One network each, so that the whole demo takes minutes; the default is the best of three.
    let network = json!({"seeds": [args.seed], "epochs": args.epochs});
    let fits: Vec<Value> = KINDS
        .iter()
        .map(|(kind, _)| match *kind {
            "frf" => json!({"kind": kind, "validation_runs": validation, "frf": linear}),
            "lstm" => json!({"kind": kind, "validation_runs": validation, "lstm": network}),
            _ => json!({"kind": kind, "validation_runs": validation, "frf": linear, "lstm": network}),
        })
        .collect();
    json!({"id": RIG, "name": "Hydro-mount, three axes (virtual)", "sample_rate_hz": 1000.0, "channels": channels,
           "fit_policy": {"kinds": ["noise"], "min_total_s": training_s - 0.5, "fits": fits}})
}

/// Waits for the jobs that the policy queued. Returns the model version of each kind.
async fn wait_for_fits(client: &Client, jobs: &[String]) -> Result<Vec<(String, u64)>, DemoError> {
    let mut models = Vec::new();
    for job in jobs {
        let bar = bars::job();
        let done = client.wait(job, |state| bars::show(&bar, state)).await?;
        bar.finish_and_clear();
        let model = client.fitted_model(&done).await?;
        let kind = model["kind"].as_str().ok_or(ClientError::Missing("kind"))?.to_owned();
        let version = model["version"].as_u64().ok_or(ClientError::Missing("version"))?;
        let label = KINDS.iter().find(|(k, _)| *k == kind).map_or(kind.as_str(), |(_, label)| label);
        let took = client::elapsed_s(&done).map(|s| format!(" in {s:.1} s")).unwrap_or_default();
        println!("{label} fitted{took} (model {version})");
        models.push((kind, version));
    }
    Ok(models)
}
