//! The whole work of a lab, timed: `cargo run --release --example whole_work -- [--minutes 60] [--rig both] [--stages ...]`
//!
//! It starts the service in a process of its own and is its client: it uploads an hour of noise, fits every kind of model
//! (three seeds each) with the default settings, activates the last, predicts an hour of service load by each, evaluates
//! them, iterates a drive for a target of 60 s, and diagnoses a change. It does so for the virtual bench (3 drives, 6
//! responses) and for a large synthetic rig (32 and 32, `rigs/large.rs`), both at 1 kHz.
//!
//! A JSON line a stage: seconds as the client sees them (its own making of signals left out), the largest resident memory
//! and the processor time of the service and its workers, and for networks the share of `peak_fma`, which is measured
//! before and after. A stage that fails prints its problem document, and the program ends with 1.

mod lab;
mod progress;
mod rigs;
mod service;
mod table;

use std::path::PathBuf;
use std::process::ExitCode;

use clap::{Parser, ValueEnum};
use rigcast::config::Cli;

use lab::Lab;
use rigs::{Demo, Large, Rig};
use service::Service;

type AnyError = Box<dyn std::error::Error>;

#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
enum WhichRig {
    Demo,
    Large,
    Both,
}

/// A stage that can be left out. Uploads come with the stages that need them.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
#[expect(missing_docs, reason = "named as in the contract")]
pub enum Stage {
    Frf,
    Lstm,
    Hybrid1,
    Hybrid2,
    Drift,
    Predict,
    Evaluate,
    Iterate,
    Diagnose,
}

/// Times the whole work of a lab.
#[derive(Debug, Parser)]
pub struct Args {
    /// Minutes of noise, and of service load.
    #[arg(long, default_value_t = 60.0)]
    minutes: f64,
    /// The rig.
    #[arg(long, value_enum, default_value = "both")]
    rig: WhichRig,
    /// Stages.
    #[arg(long, value_enum, value_delimiter = ',',
          default_values = ["frf", "lstm", "hybrid1", "hybrid2", "drift", "predict", "evaluate", "iterate", "diagnose"])]
    stages: Vec<Stage>,
    /// Epochs of a network; left out: those of the default settings.
    #[arg(long)]
    epochs: Option<usize>,
    /// Estimate the FRF of the hybrids from all noise, not from the small, centred noise alone.
    #[arg(long)]
    frf_of_all_noise: bool,
    /// Folder that gets the noise, the load and the hybrid 2 that was fitted, for `scripts/peers.py --works lab`.
    #[arg(long)]
    kept: Option<PathBuf>,
    /// Seed of the rigs and their drives.
    #[arg(long, default_value_t = 1)]
    seed: u64,
}

fn main() -> ExitCode {
    // The service is this program, and so are its workers.
    if matches!(std::env::args().nth(1).as_deref(), Some("serve" | "job")) {
        return rigcast::program::run(Cli::parse().command);
    }
    match run(&Args::parse()) {
        Ok(true) => ExitCode::SUCCESS,
        Ok(false) => ExitCode::FAILURE,
        Err(error) => {
            eprintln!("whole_work: {error}");
            ExitCode::FAILURE
        }
    }
}

/// Whether every stage came to its end.
fn run(args: &Args) -> Result<bool, AnyError> {
    let runtime = tokio::runtime::Builder::new_multi_thread().enable_all().build()?;
    let mut rigs: Vec<Box<dyn Rig>> = Vec::new();
    if args.rig != WhichRig::Large {
        rigs.push(Box::new(Demo::new(args.seed)));
    }
    if args.rig != WhichRig::Demo {
        rigs.push(Box::new(Large::new(args.seed)));
    }
    let (mut done, mut whole) = (Vec::new(), true);
    for rig in &rigs {
        // A service of its own: its memory is that of one rig's work.
        let service = Service::start()?;
        runtime.block_on(async {
            let mut lab = Lab::open(&service, rig.as_ref(), args).await?;
            lab.work().await?;
            whole &= !lab.failed;
            done.append(&mut lab.done);
            Ok::<(), AnyError>(())
        })?;
    }
    table::print(&done);
    Ok(whole)
}
