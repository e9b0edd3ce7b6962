//! What a fit by the source paper's settings and one by ours cost, and how accurate they are:
//! `cargo run --release --example time_to_accuracy -- [--minutes 20] [--seed 1] [--kinds hybrid2]`
//!
//! Fits each kind of model to noise of the virtual rig twice, with the preset `paper` and with the
//! default, one network each. It prints a JSON line a fit, with the settings used and its seconds, and
//! at the end a table: the seconds, the RMS errors (the preload counts) and the PSD RMS errors (each
//! segment's mean removed), both means over the displacements and over the forces, and the Multi-Rain
//! damage ratio of the forces (geometric mean over the runs) on withheld noise (N1) and on a withheld
//! service load as it is (SL) and with an offset (SL-, SL+).
//! `--epochs`, `--batch-size` and `--learning-rate` take the place of both presets' values: three epochs
//! show in a minute that all works.

mod bench_programme;

use std::time::Instant;

use bench_programme::{Recorded, fit_data, fitted, record};
use clap::Parser;
use comfy_table::presets::UTF8_FULL_CONDENSED;
use comfy_table::{CellAlignment, Table};
use indicatif::{ProgressBar, ProgressStyle};
use rigcast::engine::fatigue::{DamageChannel, DamageGroup, DamageSettings, damage_report};
use rigcast::engine::metrics;
use rigcast::engine::model::{FitData, Fitted, LstmOptions, ModelKind, Preset, RigModel, Task};
use rigcast::engine::{EngineError, Progress, Signal, Split};
use serde_json::json;

/// Compares the paper's preset with the default.
#[derive(Debug, Parser)]
struct Args {
    /// Minutes of training noise.
    #[arg(long, default_value_t = 20.0)]
    minutes: f64,
    /// Seed of the rig, of its runs and of the networks.
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Kinds of model to fit.
    #[arg(long, value_delimiter = ',', default_value = "frf,lstm,hybrid1,hybrid2", value_parser = kind)]
    kinds: Vec<ModelKind>,
    /// Fits with the default preset only.
    #[arg(long)]
    skip_paper: bool,
    /// Epochs of every fit.
    #[arg(long)]
    epochs: Option<usize>,
    /// Mini-batch of every fit.
    #[arg(long)]
    batch_size: Option<usize>,
    /// Learning rate of every fit.
    #[arg(long)]
    learning_rate: Option<f64>,
}

fn kind(name: &str) -> Result<ModelKind, String> {
    serde_json::from_value(json!(name)).map_err(|_| "frf, lstm, hybrid1 or hybrid2".to_owned())
}

/// Withheld loads: the column's name and the runs' tag.
const LOADS: [(&str, &str); 4] = [("N1", "n1"), ("SL", "sl"), ("SL-", "sl-minus"), ("SL+", "sl-plus")];

fn main() -> Result<(), EngineError> {
    let args = Args::parse();
    let runs = record(args.minutes, args.seed)?;
    let data = fit_data(&runs);
    let mut table = Table::new();
    table.load_style(UTF8_FULL_CONDENSED);
    let errors = ["RMS disp.", "RMS force", "PSD RMS disp.", "PSD RMS force", "damage ratio"];
    table.set_header([&["model", "preset", "fit, s", "best epoch", "load"][..], &errors].concat());
    for kind in &args.kinds {
        for (name, preset) in [("paper", Preset::Paper), ("default", Preset::Default)] {
            if preset == Preset::Paper && args.skip_paper {
                continue;
            }
            let (fitted, seconds) = timed_fit(&args, *kind, (name, preset), &data)?;
            let report = &fitted.report;
            let best_epoch = report.seeds.first().map(|seed| seed.best_epoch);
            println!(
                "{}",
                json!({"kind": kind, "preset": name, "seconds": seconds, "best_epoch": best_epoch,
                       "frf": report.frf, "lstm": report.lstm, "recombine": report.recombine,
                       "warnings": report.warnings})
            );
            for (load, tag) in LOADS {
                let first = load == LOADS[0].0;
                let head = [
                    kind.as_str().to_owned(),
                    name.to_owned(),
                    format!("{seconds:.1}"),
                    best_epoch.map_or("-".to_owned(), |epoch| epoch.to_string()),
                ];
                let head = head.map(|cell| if first { cell } else { String::new() });
                let Score { rms, psd_rms, damage } = score(&fitted.model, &runs, tag)?;
                let percent = [rms[0], rms[1], psd_rms[0], psd_rms[1]].map(|v| format!("{:.2} %", 100.0 * v));
                let cells = head.into_iter().chain([load.to_owned()]).chain(percent);
                table.add_row(cells.chain([format!("{damage:.3}")]));
            }
        }
    }
    for column in table.column_iter_mut().skip(2) {
        column.set_cell_alignment(CellAlignment::Right);
    }
    println!("{table}");
    Ok(())
}

/// One fit and its seconds.
fn timed_fit(
    args: &Args,
    kind: ModelKind,
    (name, preset): (&str, Preset),
    data: &FitData,
) -> Result<(Fitted, f64), EngineError> {
    let lstm = LstmOptions {
        seeds: Some(vec![args.seed]),
        epochs: args.epochs,
        batch_size: args.batch_size,
        learning_rate: args.learning_rate,
        ..LstmOptions::default()
    };
    let style = ProgressStyle::with_template("{msg:16} {wide_bar} {percent:>3} % {elapsed} of {duration}")
        .expect("a valid template");
    let message = format!("{} {name}", kind.as_str());
    let bar = ProgressBar::new(1000).with_style(style).with_message(message);
    let watch = |progress: Progress<'_>| {
        bar.set_position((1000.0 * progress.fraction) as u64);
        std::ops::ControlFlow::Continue(())
    };
    let began = Instant::now();
    let fitted = fitted(Task::Forward, kind, preset, lstm, data, &watch)?;
    bar.finish_and_clear();
    Ok((fitted, began.elapsed().as_secs_f64()))
}

/// Errors over the runs of one load, of displacements and forces.
struct Score {
    rms: [f64; 2],
    psd_rms: [f64; 2],
    damage: f64,
}

fn score(model: &RigModel, runs: &[Recorded], tag: &str) -> Result<Score, EngineError> {
    let test: Vec<&Recorded> =
        runs.iter().filter(|r| r.run.split == Split::Test && r.run.tags.contains(&tag)).collect();
    let mut score = Score { rms: [0.0; 2], psd_rms: [0.0; 2], damage: 0.0 };
    for recorded in &test {
        let predicted = model.predict(&recorded.pair.x)?;
        let errors = metrics::errors(&recorded.pair.y, &predicted)?;
        for (channel, errors) in errors.channels.iter().enumerate() {
            let share = 1.0 / (3 * test.len()) as f64;
            score.rms[channel / 3] += share * errors.rms.unwrap_or(f64::NAN);
            score.psd_rms[channel / 3] += share * errors.psd_rms.unwrap_or(f64::NAN);
        }
        score.damage += damage_ratio(&predicted, &recorded.pair.y)?.ln() / test.len() as f64;
    }
    score.damage = score.damage.exp();
    Ok(score)
}

/// Multi-Rain damage of the predicted forces over that of the measured ones.
fn damage_ratio(predicted: &Signal, measured: &Signal) -> Result<f64, EngineError> {
    let names = ["force_x", "force_y", "force_z"];
    let channels: Vec<DamageChannel<'_>> = (3..6)
        .map(|c| DamageChannel {
            name: names[c - 3],
            predicted: predicted.channel(c),
            target: Some(measured.channel(c)),
        })
        .collect();
    let groups = [DamageGroup { name: "force", channels: [0, 1, 2] }];
    let report = damage_report(&channels, &groups, &DamageSettings::default())?;
    let target = report.groups[0].1.target.expect("every channel has a target");
    Ok(target.ratio.ratio.unwrap_or(f64::NAN))
}
