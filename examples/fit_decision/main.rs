//! Fits the weights of the diagnosis' decision to a population of simulated rigs.
//!
//! `cargo run --release --example fit_decision -- --cases 1200 --out src/engine/diagnosis/transfer/weights.json`
//!
//! Each rig is drawn from its seed, screened as a diagnosis screens it, and its families of laws with their features
//! become one row. A tenth of the rigs after another is held out: what is printed of probabilities and of the families
//! named is of rigs that the weights were not fitted to. The check of the diagnosis, `blind_check`, draws its rigs from
//! other equations; none of them is used here.

use std::collections::BTreeMap;
use std::fs::OpenOptions;
use std::io::{BufRead, BufReader, Write};
use std::path::PathBuf;
use std::sync::Mutex;

use clap::Parser;
use indicatif::{ProgressBar, ProgressStyle};
use rayon::prelude::*;
use rigcast::engine::diagnosis::screen::{group, screen};
use rigcast::engine::diagnosis::{Effect, Family, Weights, alternatives, refits};
use rigcast::engine::progress::unwatched;
use serde::{Deserialize, Serialize};

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
    cases: u64,
    /// Seed of the population.
    #[arg(long, default_value_t = 2026)]
    seed: u64,
    /// File of rows, a line a rig of this seed: each is added when it was screened, and those that are there are not
    /// screened again. Remove it when the screen or the population has changed.
    #[arg(long)]
    rows: Option<PathBuf>,
    /// Output file for the weights.
    #[arg(long)]
    out: Option<PathBuf>,
}

/// A line of the file of rows.
#[derive(Serialize, Deserialize)]
struct Line {
    case: u64,
    /// None where the rig could not be screened.
    rig: Option<Rig>,
}

/// One rig: its alternatives, and what it is.
#[derive(Serialize, Deserialize)]
struct Rig {
    features: Vec<Vec<f64>>,
    families: Vec<Family>,
    truth: Vec<Family>,
}

impl Rig {
    fn row(&self) -> Result<Row, AnyError> {
        let features = self.features.iter().map(|f| <[f64; logit::N]>::try_from(f.as_slice()));
        Ok(Row {
            features: features.collect::<Result<_, _>>().map_err(|_| "rows of other features")?,
            right: self.families.iter().map(|f| self.truth.contains(f)).collect(),
        })
    }
}

fn main() -> Result<(), AnyError> {
    let args = Args::parse();
    let rigs = population(&args)?;
    let rows: Vec<Row> = rigs.iter().map(Rig::row).collect::<Result<_, _>>()?;
    let without: Vec<Weights> = (0..FOLDS)
        .into_par_iter()
        .map(|fold| {
            let others = rows.iter().enumerate().filter(|(i, _)| i % FOLDS != fold);
            logit::fit(&others.map(|(_, row)| row.clone()).collect::<Vec<Row>>())
        })
        .collect();
    let probabilities = |(i, row): (usize, &Row)| without[i % FOLDS].probabilities(&row.features, 1.0);
    let held_out: Vec<Vec<f64>> = rows.iter().enumerate().map(probabilities).collect();
    print(&rigs, &rows, &held_out);
    let weights = logit::fit(&rows);
    for (feature, weight) in weights.features.iter().zip(&weights.weights) {
        println!("{feature:32} {weight:7.3}");
    }
    if let Some(out) = &args.out {
        std::fs::write(out, serde_json::to_string_pretty(&weights)? + "\n")?;
    }
    Ok(())
}

/// The population: rigs of the file of rows, and those that it lacks, drawn, screened and added to it one by one.
fn population(args: &Args) -> Result<Vec<Rig>, AnyError> {
    let mut found = BTreeMap::new();
    let mut file = None;
    if let Some(path) = &args.rows {
        let kept = OpenOptions::new().read(true).append(true).create(true).open(path)?;
        for line in BufReader::new(&kept).lines() {
            let Line { case, rig } = serde_json::from_str(&line?)?;
            found.insert(case, rig);
        }
        file = Some(Mutex::new(kept));
    }
    let missing: Vec<u64> = (0..args.cases).filter(|case| !found.contains_key(case)).collect();
    let style =
        ProgressStyle::with_template("{prefix:>9} {bar:32} {pos}/{len}, {eta} left").expect("a template");
    let bar = ProgressBar::new(missing.len() as u64).with_style(style).with_prefix("screen");
    let made = missing.into_par_iter().map(|case| {
        let line = Line { case, rig: screened(args.seed, case) };
        if let Some(file) = &file {
            let text = serde_json::to_string(&line)? + "\n";
            file.lock()
                .map_err(|_| std::io::Error::other("another rig failed"))?
                .write_all(text.as_bytes())?;
        }
        bar.inc(1);
        Ok((line.case, line.rig))
    });
    found.extend(made.collect::<std::io::Result<Vec<_>>>()?);
    let rigs: Vec<Rig> = found.into_values().take(args.cases as usize).flatten().collect();
    if rigs.len() < args.cases as usize {
        println!("{} of {} rigs could not be screened", args.cases as usize - rigs.len(), args.cases);
    }
    Ok(rigs)
}

/// Draws a rig and screens it; `None` where it cannot be screened.
fn screened(seed: u64, case: u64) -> Option<Rig> {
    let drawn = rig::draw(seed.wrapping_mul(0x9e37_79b9_7f4a_7c15) ^ case).ok()?;
    let grouping = group(&drawn.recording, &[]);
    let screening = screen(&drawn.recording, &grouping, &unwatched).ok()?;
    let refits = refits(&drawn.recording, &grouping, &screening, &Effect::ALL, &unwatched).ok()?;
    let alternatives = alternatives(&screening, &refits);
    Some(Rig {
        features: alternatives.iter().map(|a| a.features.to_vec()).collect(),
        families: alternatives.iter().map(|a| a.standing.family).collect(),
        truth: drawn.truth,
    })
}

/// What the probabilities of rigs that were held out are worth.
fn print(rigs: &[Rig], rows: &[Row], probabilities: &[Vec<f64>]) {
    let mut bins = [(0.0, 0.0, 0usize); 10];
    let (mut loss, mut named, mut right, mut blamed, mut none, mut sure_wrong) =
        (0.0, 0usize, 0usize, 0usize, 0usize, 0usize);
    let mut by_family: BTreeMap<String, [usize; 4]> = BTreeMap::new();
    let mut taken: BTreeMap<(String, String), usize> = BTreeMap::new();
    for ((rig, row), p) in rigs.iter().zip(rows).zip(probabilities) {
        loss -= row.of_truth(p).max(1e-12).ln();
        let best = (0..p.len()).max_by(|&a, &b| p[a].total_cmp(&p[b]));
        let any: f64 = p.iter().sum();
        let name = rig.truth.first().map_or("none".into(), |f| format!("{f:?}"));
        if let Some(best) = best.filter(|&best| any >= 0.5 && !row.right[best]) {
            *taken.entry((name.clone(), format!("{:?}", rig.families[best]))).or_default() += 1;
        }
        let counts = by_family.entry(name).or_default();
        counts[0] += 1;
        counts[3] += usize::from(row.right.contains(&true));
        if rig.truth.is_empty() {
            none += 1;
        }
        let (stated, is_right) = match best {
            Some(best) if any >= 0.5 => {
                named += 1;
                counts[1] += 1;
                blamed += usize::from(rig.truth.is_empty());
                right += usize::from(row.right[best]);
                counts[2] += usize::from(row.right[best]);
                sure_wrong += usize::from(p[best] >= 0.9 && !row.right[best]);
                (p[best], row.right[best])
            }
            _ => (1.0 - any, !row.right.contains(&true)),
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
