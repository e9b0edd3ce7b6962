//! What a fit costs until it is as accurate as the paper's:
//! `cargo run --release --example time_to_accuracy -- [--minutes 20] [--seed 1] [--skip-paper]`
//!
//! Fits hybrid 2 to noise of the virtual rig twice, with the preset `paper` and with the default, one
//! network each, and prints a JSON line a fit: its seconds, its best epoch, and its RMS errors on
//! withheld noise (N1) and service loads (SL, SL-, SL+), mean over the displacements and the forces.
//! `--epochs`, `--batch-size` and `--learning-rate` change the default's for a comparison.

use std::time::Instant;

use clap::Parser;
use indicatif::{ProgressBar, ProgressStyle};
use rayon::prelude::*;
use rigcast::engine::frf::FrfSettings;
use rigcast::engine::metrics::rms;
use rigcast::engine::model::{
    FitData, FitSettings, LstmOptions, ModelKind, Pair, Preprocess, Preset, RigModel, Validation, fit,
};
use rigcast::engine::virtual_rig::{ProgrammeRun, ProgrammeSettings, RunSplit, VirtualRig, programme};
use rigcast::engine::{EngineError, Progress};
use serde_json::{Value, json};

/// Compares the default preset with the paper's.
#[derive(Debug, Parser)]
struct Args {
    /// Minutes of training noise.
    #[arg(long, default_value_t = 20.0)]
    minutes: f64,
    /// Seed of the rig, of its runs and of the networks.
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Fits with the default preset only.
    #[arg(long)]
    skip_paper: bool,
    /// Epochs of the default preset's fit.
    #[arg(long)]
    epochs: Option<usize>,
    /// Mini-batch of the default preset's fit.
    #[arg(long)]
    batch_size: Option<usize>,
    /// Learning rate of the default preset's fit.
    #[arg(long)]
    learning_rate: Option<f64>,
}

/// A recorded run.
struct Recorded {
    run: ProgrammeRun,
    pair: Pair,
}

fn main() -> Result<(), EngineError> {
    let args = Args::parse();
    let runs = record(&args)?;
    let data = fit_data(&runs);
    let options = LstmOptions { seeds: Some(vec![args.seed]), ..LstmOptions::default() };
    if !args.skip_paper {
        println!("{}", compare("paper", Preset::Paper, options.clone(), &data, &runs)?);
    }
    let changed = LstmOptions {
        epochs: args.epochs,
        batch_size: args.batch_size,
        learning_rate: args.learning_rate,
        ..options
    };
    println!("{}", compare("default", Preset::Default, changed, &data, &runs)?);
    Ok(())
}

fn record(args: &Args) -> Result<Vec<Recorded>, EngineError> {
    let rig = VirtualRig::draw(args.seed);
    programme(&ProgrammeSettings::of_minutes(args.minutes), args.seed)?
        .into_par_iter()
        .enumerate()
        .map(|(index, run)| {
            let y = rig.simulate(&run.drive, args.seed.wrapping_mul(1_000_003).wrapping_add(index as u64))?;
            let pair = Pair { x: run.drive.clone(), y };
            Ok(Recorded { run, pair })
        })
        .collect()
}

/// The networks learn from the mixed noise, the FRF from the small centred noise.
fn fit_data(runs: &[Recorded]) -> FitData {
    let of = |split: RunSplit, tag: &str| -> Vec<Pair> {
        runs.iter()
            .filter(|r| r.run.split == split && r.run.tags.contains(&tag))
            .map(|r| r.pair.clone())
            .collect()
    };
    let validation = runs
        .iter()
        .filter(|r| r.run.split == RunSplit::Validation)
        .map(|r| Validation { pair: r.pair.clone(), score_from: 0 })
        .collect();
    FitData {
        training: of(RunSplit::Training, "mixed"),
        frf: Some(of(RunSplit::Training, "linear")),
        validation,
    }
}

fn compare(
    name: &str,
    preset: Preset,
    lstm: LstmOptions,
    data: &FitData,
    runs: &[Recorded],
) -> Result<Value, EngineError> {
    let names = |channels: std::ops::Range<usize>| channels.map(|c| format!("channel_{c}")).collect();
    let settings = FitSettings {
        kind: ModelKind::Hybrid2,
        inputs: names(0..3),
        outputs: names(3..9),
        preprocess: Preprocess::default(),
        frf: FrfSettings::default(),
        lstm,
        preset,
    };
    let style = ProgressStyle::with_template("{msg:8} {wide_bar} {percent:>3} % {elapsed} of {duration}")
        .expect("a valid template");
    let bar = ProgressBar::new(1000).with_style(style).with_message(name.to_owned());
    let watch = |progress: Progress<'_>| {
        bar.set_position((1000.0 * progress.fraction) as u64);
        std::ops::ControlFlow::Continue(())
    };
    let began = Instant::now();
    let fitted = fit(data, &settings, &watch)?;
    let seconds = began.elapsed().as_secs_f64();
    bar.finish_and_clear();
    let lstm = fitted.report.lstm.as_ref();
    let mut line = json!({
        "fit": name, "seconds": seconds, "epochs": lstm.map(|l| l.epochs),
        "best_epoch": fitted.report.seeds.first().map(|s| s.best_epoch), "recombine": fitted.report.recombine,
    });
    for tag in ["n1", "sl", "sl-minus", "sl-plus"] {
        line[tag] = errors(&fitted.model, runs, tag)?;
    }
    Ok(line)
}

/// Mean RMS errors over the runs with `tag`.
fn errors(model: &RigModel, runs: &[Recorded], tag: &str) -> Result<Value, EngineError> {
    let test: Vec<_> =
        runs.iter().filter(|r| r.run.split == RunSplit::Test && r.run.tags.contains(&tag)).collect();
    let mut sums = [0.0; 2];
    for recorded in &test {
        let predicted = model.predict(&recorded.pair.x)?;
        for channel in 0..6 {
            let error = rms(recorded.pair.y.channel(channel), predicted.channel(channel));
            sums[channel / 3] += error.unwrap_or(f64::NAN) / (3 * test.len()) as f64;
        }
    }
    Ok(json!({"displacement": sums[0], "force": sums[1]}))
}
