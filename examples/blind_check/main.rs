//! Blind cases for the diagnosis, over HTTP, in three commands.
//!
//! `cargo run --release --example blind_check -- all [--seeds test] [--suite catalogue] [--cases 6]`
//!
//! - `generate` makes random rigs with an effect that a sim lacks, drawn and integrated without any code
//!   of the service, and writes their measured runs; the labels go to a file of their own.
//! - `diagnose` reads the runs, never the labels, and uses a service like any user.
//! - `score` reads reports and labels, prints the table of figures with its bars and a confusion matrix,
//!   and ends with an error where a bar is missed.
//! - `all` does the three; `real` diagnoses folders of measured data.
//! - `screen` runs the diagnosis' screen alone over measured data or over cases, and reads labels only to count.
//!
//! The results of test seeds may change the diagnosis. The results of final seeds are stated as they are:
//! each final round runs once and is entered in a log.

use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::time::Instant;

use clap::{Args, Parser, Subcommand};
use serde_json::{Value, json};

use generate::{Plan, Suite, Wish};
use seeds::Seeds;

mod diagnose;
mod generate;
mod real;
mod score;
mod screen;
mod seeds;

type AnyError = Box<dyn std::error::Error>;

/// Blind cases for the diagnosis.
#[derive(Debug, Parser)]
struct Cli {
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, Subcommand)]
enum Command {
    /// Make the cases.
    Generate(Cases),
    /// Diagnose the cases with a service.
    Diagnose(Cases),
    /// Compare with the labels.
    Score(Cases),
    /// Make, diagnose and compare.
    All(Cases),
    /// Run the rig of a case once more, as a report proposed.
    Lab(Lab),
    /// Diagnose measured data.
    Real(real::Args),
    /// Run the screen of the diagnosis alone, over measured data or over cases.
    Screen(screen::Args),
}

#[derive(Debug, Args)]
struct Cases {
    /// Seeds.
    #[arg(long, value_enum, default_value = "test")]
    seeds: Seeds,
    /// Round of such seeds; of the final ones the next that is not in the log.
    #[arg(long)]
    round: Option<u64>,
    /// Directory of cases, labels and reports; `target/blind_check/<seeds>-<round>` if left out.
    #[arg(long)]
    dir: Option<PathBuf>,
    /// Only these suites.
    #[arg(long, value_enum, value_delimiter = ',')]
    suite: Vec<Suite>,
    /// Cases a suite, instead of the whole check's.
    #[arg(long)]
    cases: Option<usize>,
    /// A running service; one is started if left out.
    #[arg(long)]
    service: Option<String>,
    /// Token for the service.
    #[arg(long, env = "RIGCAST_TOKEN", hide_env_values = true)]
    token: Option<String>,
    /// Cases at a time.
    #[arg(long, default_value_t = 2)]
    in_flight: usize,
    /// Fit an FRF to the baseline runs instead of importing the sim that comes with a case.
    #[arg(long)]
    fit_sims: bool,
    /// Ask by default requests: one run of each drive, and the FRF that the service fits to these.
    #[arg(long)]
    plain: bool,
    /// Log of the final runs.
    #[arg(long, default_value = concat!(env!("CARGO_MANIFEST_DIR"), "/examples/blind_check/final_runs.jsonl"))]
    log: PathBuf,
}

#[derive(Debug, Args)]
struct Lab {
    /// Directory of the cases.
    #[arg(long)]
    dir: PathBuf,
    /// Case.
    #[arg(long)]
    case: String,
    /// `noise`, `slow_sine`, `resonance_sine`, `sweep` or `offset_noise`.
    #[arg(long)]
    kind: String,
    /// Relative to the peaks of the runs so far.
    #[arg(long)]
    level: f64,
    /// Of a sine; what suits the rig if left out.
    #[arg(long)]
    frequency_hz: Option<f64>,
    /// Output file for the recording, NPY.
    #[arg(long)]
    out: PathBuf,
}

fn main() -> Result<ExitCode, AnyError> {
    match Cli::parse().command {
        Command::Generate(cases) => generate(&cases, &dir(&cases)?)?,
        Command::Diagnose(cases) => diagnose(&cases, &dir(&cases)?)?,
        Command::Score(cases) => return score(&dir(&cases)?),
        Command::All(cases) => {
            let dir = dir(&cases)?;
            generate(&cases, &dir)?;
            diagnose(&cases, &dir)?;
            return score(&dir);
        }
        Command::Lab(lab) => {
            let wish = Wish { kind: lab.kind, level_rel: lab.level, frequency_hz: lab.frequency_hz };
            std::fs::write(lab.out, generate::further_run(&lab.dir, &lab.case, &wish)?)?;
        }
        Command::Real(args) => {
            return Ok(if real::run(&args)? { ExitCode::SUCCESS } else { ExitCode::FAILURE });
        }
        Command::Screen(args) => screen::run(&args)?,
    }
    Ok(ExitCode::SUCCESS)
}

/// The round to run: of the final seeds one that no run has used.
fn round(cases: &Cases) -> Result<u64, AnyError> {
    if let Some(round) = cases.round {
        return if round < seeds::ROUNDS { Ok(round) } else { Err("rounds end at 999".into()) };
    }
    if cases.seeds != Seeds::Final {
        return Ok(0);
    }
    let used = seeds::logged(&cases.log)?;
    Ok(used.iter().filter_map(|line| line["round"].as_u64()).max().map_or(0, |last| last + 1))
}

fn dir(cases: &Cases) -> Result<PathBuf, AnyError> {
    let named = |round| PathBuf::from(format!("target/blind_check/{}-{round}", cases.seeds.name()));
    Ok(cases.dir.clone().unwrap_or(named(round(cases)?)))
}

fn generate(cases: &Cases, dir: &Path) -> Result<(), AnyError> {
    let suites = if cases.suite.is_empty() { Suite::ALL.to_vec() } else { cases.suite.clone() };
    let began = Instant::now();
    generate::generate(&Plan {
        dir: dir.to_owned(),
        seeds: cases.seeds,
        round: round(cases)?,
        suites,
        cases: cases.cases,
        log: cases.log.clone(),
    })?;
    took(dir, "generate_s", began)
}

fn diagnose(cases: &Cases, dir: &Path) -> Result<(), AnyError> {
    let began = Instant::now();
    diagnose::run(&diagnose::How {
        dir: dir.to_owned(),
        service: cases.service.clone(),
        token: cases.token.clone(),
        in_flight: cases.in_flight,
        fit_sims: cases.fit_sims,
        plain: cases.plain,
    })?;
    took(dir, "diagnose_s", began)
}

fn score(dir: &Path) -> Result<ExitCode, AnyError> {
    Ok(if score::run(dir)? { ExitCode::SUCCESS } else { ExitCode::FAILURE })
}

/// Records the time of a step.
fn took(dir: &Path, step: &str, began: Instant) -> Result<(), AnyError> {
    let path = dir.join("times.json");
    let mut times: Value = match std::fs::read(&path) {
        Ok(bytes) => serde_json::from_slice(&bytes)?,
        Err(_) => json!({}),
    };
    times[step] = began.elapsed().as_secs_f64().into();
    Ok(std::fs::write(path, times.to_string())?)
}
