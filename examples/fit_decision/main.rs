//! Fits the weights of the diagnosis' decision to a population of simulated rigs.
//!
//! `cargo run --release --example fit_decision -- --cases 1200 --out src/engine/diagnosis/transfer/weights.json`
//!
//! Each rig is drawn from its seed, screened as a diagnosis screens it, and its families of laws with their features
//! become one row. A tenth of the rigs after another is held out: what is printed of probabilities and of the families
//! named is of rigs that the weights were not fitted to. The check of the diagnosis, `blind_check`, draws its rigs from
//! other equations; none of them is used here.

use std::collections::BTreeMap;
use std::path::PathBuf;

use clap::Parser;
use indicatif::{ProgressBar, ProgressStyle};
use rayon::prelude::*;
use rigcast::engine::diagnosis::screen::{group, screen};
use rigcast::engine::diagnosis::{Family, Weights, alternatives};
use rigcast::engine::progress::unwatched;
use serde_json::{Value, json};

use logit::Row;

mod drives;
mod law;
mod logit;
mod rig;

type AnyError = Box<dyn std::error::Error>;

/// Parts of which each is held out once.
const FOLDS: usize = 10;

/// Fits the weights of the diagnosis' decision.
#[derive(Debug, Parser)]
struct Args {
    /// Rigs.
    #[arg(long, default_value_t = 1200)]
    cases: usize,
    /// Seed of the population.
    #[arg(long, default_value_t = 2026)]
    seed: u64,
    /// File of rows: read if it is there, else written.
    #[arg(long)]
    rows: Option<PathBuf>,
    /// Output file for the weights.
    #[arg(long)]
    out: Option<PathBuf>,
}

/// One rig's row with what it is.
struct Rig {
    row: Row,
    families: Vec<Family>,
    truth: Vec<Family>,
}

fn main() -> Result<(), AnyError> {
    let args = Args::parse();
    let rigs = match &args.rows {
        Some(path) if path.exists() => read(&serde_json::from_slice(&std::fs::read(path)?)?)?,
        _ => made(&args),
    };
    if let Some(path) = args.rows.as_ref().filter(|path| !path.exists()) {
        std::fs::write(path, written(&rigs).to_string())?;
    }
    let rows: Vec<Row> = rigs.iter().map(|rig| rig.row.clone()).collect();
    let without: Vec<Weights> = (0..FOLDS)
        .into_par_iter()
        .map(|fold| {
            let others = rows.iter().enumerate().filter(|(i, _)| i % FOLDS != fold);
            logit::fit(&others.map(|(_, row)| row.clone()).collect::<Vec<Row>>())
        })
        .collect();
    let probabilities = |(i, row): (usize, &Row)| without[i % FOLDS].probabilities(&row.features, 1.0);
    let held_out: Vec<Vec<f64>> = rows.iter().enumerate().map(probabilities).collect();
    print(&rigs, &held_out);
    let weights = logit::fit(&rows);
    for (feature, weight) in weights.features.iter().zip(&weights.weights) {
        println!("{feature:32} {weight:7.3}");
    }
    if let Some(out) = &args.out {
        std::fs::write(out, serde_json::to_string_pretty(&weights)? + "\n")?;
    }
    Ok(())
}

/// Draws and screens the population; what cannot be screened is left out and counted.
fn made(args: &Args) -> Vec<Rig> {
    let style =
        ProgressStyle::with_template("{prefix:>9} {bar:32} {pos}/{len}, {eta} left").expect("a template");
    let bar = ProgressBar::new(args.cases as u64).with_style(style).with_prefix("screen");
    let found: Vec<Option<Rig>> = (0..args.cases as u64)
        .into_par_iter()
        .map(|i| {
            bar.inc(1);
            let case = rig::draw(args.seed.wrapping_mul(0x9e37_79b9_7f4a_7c15) ^ i).ok()?;
            let grouping = group(&case.recording, &[]);
            let screening = screen(&case.recording, &grouping, &unwatched).ok()?;
            let alternatives = alternatives(&screening);
            let families: Vec<Family> = alternatives.iter().map(|a| a.standing.family).collect();
            let right = families.iter().map(|f| case.truth.contains(f)).collect();
            let features = alternatives.iter().map(|a| a.features).collect();
            Some(Rig { row: Row { features, right }, families, truth: case.truth })
        })
        .collect();
    let missing = found.iter().filter(|rig| rig.is_none()).count();
    if missing > 0 {
        println!("{missing} of {} rigs could not be screened", args.cases);
    }
    found.into_iter().flatten().collect()
}

fn written(rigs: &[Rig]) -> Value {
    rigs.iter()
        .map(|rig| {
            json!({"features": rig.row.features.iter().map(|f| f.to_vec()).collect::<Vec<_>>(),
                          "families": rig.families, "truth": rig.truth})
        })
        .collect()
}

fn read(value: &Value) -> Result<Vec<Rig>, AnyError> {
    let mut rigs = Vec::new();
    for rig in value.as_array().ok_or("rows: an array")? {
        let families: Vec<Family> = serde_json::from_value(rig["families"].clone())?;
        let truth: Vec<Family> = serde_json::from_value(rig["truth"].clone())?;
        let features: Vec<Vec<f64>> = serde_json::from_value(rig["features"].clone())?;
        let features = features
            .into_iter()
            .map(|f| <[f64; logit::N]>::try_from(f).map_err(|_| "rows of other features"));
        let row = Row {
            features: features.collect::<Result<_, _>>()?,
            right: families.iter().map(|f| truth.contains(f)).collect(),
        };
        rigs.push(Rig { row, families, truth });
    }
    Ok(rigs)
}

/// What the probabilities of rigs that were held out are worth.
fn print(rigs: &[Rig], probabilities: &[Vec<f64>]) {
    let mut bins = [(0.0, 0.0, 0usize); 10];
    let (mut loss, mut named, mut right, mut blamed, mut none, mut sure_wrong) =
        (0.0, 0usize, 0usize, 0usize, 0usize, 0usize);
    let mut by_family: BTreeMap<String, [usize; 4]> = BTreeMap::new();
    let mut taken: BTreeMap<(String, String), usize> = BTreeMap::new();
    for (rig, p) in rigs.iter().zip(probabilities) {
        loss -= rig.row.of_truth(p).max(1e-12).ln();
        let best = (0..p.len()).max_by(|&a, &b| p[a].total_cmp(&p[b]));
        let any: f64 = p.iter().sum();
        let name = rig.truth.first().map_or("none".into(), |f| format!("{f:?}"));
        if let Some(best) = best.filter(|&best| any >= 0.5 && !rig.row.right[best]) {
            *taken.entry((name.clone(), format!("{:?}", rig.families[best]))).or_default() += 1;
        }
        let counts = by_family.entry(name).or_default();
        counts[0] += 1;
        counts[3] += usize::from(rig.row.right.contains(&true));
        if rig.truth.is_empty() {
            none += 1;
        }
        let (stated, is_right) = match best {
            Some(best) if any >= 0.5 => {
                named += 1;
                counts[1] += 1;
                blamed += usize::from(rig.truth.is_empty());
                right += usize::from(rig.row.right[best]);
                counts[2] += usize::from(rig.row.right[best]);
                sure_wrong += usize::from(p[best] >= 0.9 && !rig.row.right[best]);
                (p[best], rig.row.right[best])
            }
            _ => (1.0 - any, !rig.row.right.contains(&true)),
        };
        let bin = &mut bins[((stated * 10.0) as usize).min(9)];
        bin.0 += stated;
        bin.1 += f64::from(u8::from(is_right));
        bin.2 += 1;
    }
    let n = rigs.len().max(1) as f64;
    println!("held out, {} rigs: mean log loss {:.3}", rigs.len(), loss / n);
    println!(
        "named {named}, right {right}; {blamed} of {none} without an effect blamed; stated with 0.9 or more and wrong {sure_wrong}"
    );
    let error: f64 = bins.iter().map(|(p, r, _)| (p - r).abs()).sum::<f64>() / n;
    println!("expected calibration error {error:.3}");
    for (p, r, count) in bins.iter().filter(|b| b.2 > 0) {
        println!("  stated {:.2}: right {:.2} of {count}", p / *count as f64, r / *count as f64);
    }
    for (family, [all, named, right, present]) in by_family {
        println!(
            "  {family:20} {all:4} rigs, {present:4} among the alternatives, {named:4} named, {right:4} right"
        );
    }
    println!("taken for another:");
    let mut wrong: Vec<((String, String), usize)> = taken.into_iter().collect();
    wrong.sort_by_key(|(_, count)| std::cmp::Reverse(*count));
    for ((truth, stated), count) in wrong {
        println!("  {truth:20} as {stated:20} {count:4}");
    }
}
