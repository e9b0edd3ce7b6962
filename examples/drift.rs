//! Whether drift is flagged, and nothing else: `cargo run --release --example drift -- [--seed 1] [--minutes 10]`
//!
//! Fits a model to noise of the virtual rig, with the programme's validation runs (noise and service loads) held out,
//! and predicts further runs: of the unchanged rig, and of the rig with Coulomb friction at the actuators. Prints for each kind of run the
//! largest error over its control limit, and how many runs are flagged, by the rule of docs/drift.md.

mod bench_programme;

use std::collections::BTreeMap;

use bench_programme::{fit_data, fitted, record};
use clap::Parser;
use rayon::prelude::*;
use rigcast::domain::drift::Basis;
use rigcast::engine::model::{
    FitData, FitSplit, LstmOptions, ModelKind, Pair, Preset, RigModel, Squares, Task,
};
use rigcast::engine::virtual_rig::VirtualRig;
use rigcast::engine::virtual_rig::drives::{
    MixedNoise, NoiseRegion, ServiceLoad, ServiceShape, mixed_noise, service_load,
};
use rigcast::engine::{EngineError, RunKind, Signal, Split, progress::unwatched};
use serde_json::json;

/// Judges runs of an unchanged and of a changed rig.
#[derive(Debug, Parser)]
struct Args {
    /// Seed of the rig, its runs and the network.
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Minutes of training noise.
    #[arg(long, default_value_t = 10.0)]
    minutes: f64,
    /// Runs of the unchanged rig, half of them noise and half service loads.
    #[arg(long, default_value_t = 100)]
    runs: u64,
    /// Friction over the RMS of the drive.
    #[arg(long, default_value_t = 0.1)]
    friction: f64,
    /// Holds noise runs out, as a fit without validation runs does, in place of the validation runs.
    #[arg(long)]
    noise_only: bool,
    /// Kind of model.
    #[arg(long, default_value = "hybrid2", value_parser = kind)]
    kind: ModelKind,
    /// Epochs; left out: those of the default preset.
    #[arg(long)]
    epochs: Option<usize>,
}

fn kind(name: &str) -> Result<ModelKind, String> {
    serde_json::from_value(json!(name)).map_err(|_| "frf, lstm, hybrid1 or hybrid2".to_owned())
}

/// Length of a run, s.
const RUN_S: f64 = 60.0;

/// Speed at which the friction is about to be full, as a share of the RMS speed.
const SMOOTH: f64 = 0.05;

/// Number of held-out stretches, and the largest error of each output on them, by kind of run.
type Largest = BTreeMap<&'static str, (usize, Vec<f64>)>;

fn main() -> Result<(), EngineError> {
    let args = Args::parse();
    let rig = VirtualRig::draw(args.seed);
    let runs = record(args.minutes, args.seed)?;
    let lstm = LstmOptions { seeds: Some(vec![args.seed]), epochs: args.epochs, ..LstmOptions::default() };
    let mut data = fit_data(&runs);
    let names = |split: Split, tag: &'static str| {
        let of = runs
            .iter()
            .filter(move |r| r.run.split == split && (tag.is_empty() || r.run.tags.contains(&tag)));
        of.map(|r| if r.run.kind == RunKind::Noise { "noise" } else { "service" })
    };
    let held_out: Vec<&str> = if args.noise_only {
        // As the service does: the newest runs, until they hold a fifth of all.
        let count = data.training.len().div_ceil(5);
        let comparison = (data.training.len() - count..data.training.len()).collect();
        data = FitData::with_validation(
            data.training,
            Vec::new(),
            FitSplit::LeftOut { comparison, stopping: Vec::new() },
        )
        .with_frf_runs(data.frf_only);
        names(Split::Training, "mixed").take(count).collect()
    } else {
        data.split = FitSplit::ValidationHalves;
        names(Split::Validation, "").collect()
    };
    let fitted = fitted(Task::Forward, args.kind, Preset::Default, lstm, &data, &unwatched)?;
    let mut usual = Largest::new();
    let scores = fitted.report.comparison.map(|comparison| comparison.scores).unwrap_or_default();
    for (kind, score) in held_out.into_iter().zip(&scores) {
        let (count, found) = usual.entry(kind).or_insert_with(|| (0, vec![0.0; score.outputs.len()]));
        *count += 1;
        for (most, squares) in found.iter_mut().zip(&score.outputs) {
            *most = most.max(squares.rms().unwrap_or_default());
        }
    }
    println!("{}", json!({"held out": usual}));
    for (what, seed, count, friction) in [
        ("unchanged", args.seed + 1, args.runs, None),
        ("with friction", args.seed + 2, 20, Some(args.friction)),
    ] {
        let runs = recorded(&rig, drives(seed, count)?, seed, friction)?;
        judge(what, &fitted.model, &runs, &usual)?;
    }
    Ok(())
}

/// Prints the ratios of the runs to the limits that rest on held-out runs of the same kind, and of noise alone.
fn judge(
    what: &str,
    model: &RigModel,
    runs: &[(&'static str, Pair)],
    usual: &Largest,
) -> Result<(), EngineError> {
    for kind in ["noise", "service"] {
        for (basis, of) in [(Basis::SameKind, kind), (Basis::OtherKinds, "noise")] {
            let Some((count, usual)) = usual.get(of).filter(|_| basis == Basis::SameKind || kind != of)
            else {
                continue;
            };
            let Some(factor) = basis.factor(*count) else { continue };
            let of_kind: Vec<&Pair> = runs.iter().filter(|(k, _)| *k == kind).map(|(_, pair)| pair).collect();
            let ratios: Vec<f64> = of_kind
                .par_iter()
                .map(|pair| {
                    let predicted = model.predict(&pair.x)?;
                    let ratio = |(c, usual): (usize, &f64)| {
                        let squares = Squares::of(predicted.channel(c), pair.y.channel(c));
                        squares.rms().unwrap_or_default() / (factor * usual)
                    };
                    Ok(usual.iter().enumerate().map(ratio).fold(0.0, f64::max))
                })
                .collect::<Result<_, EngineError>>()?;
            let mut sorted = ratios.clone();
            sorted.sort_by(f64::total_cmp);
            let flagged = ratios.iter().filter(|ratio| **ratio > 1.0).count();
            println!(
                "{}",
                json!({"rig": what, "kind": kind, "basis": basis, "runs": ratios.len(), "flagged": flagged,
                       "first": ratios[0], "smallest": sorted[0], "median": sorted[sorted.len() / 2],
                       "largest": sorted[sorted.len() - 1]})
            );
        }
    }
    Ok(())
}

/// Drives, noise and service loads in turn.
fn drives(seed: u64, count: u64) -> Result<Vec<(&'static str, Signal)>, EngineError> {
    let one = |k: u64| {
        let kind = if k.is_multiple_of(2) { "noise" } else { "service" };
        Ok((kind, drive(kind, seed, k)?))
    };
    (0..count).map(one).collect()
}

/// The drive of a run: the seeds of the noise differ, the service loads go through all shapes and scales.
fn drive(kind: &str, seed: u64, k: u64) -> Result<Signal, EngineError> {
    let seed = seed.wrapping_mul(1_000_003).wrapping_add(k);
    if kind == "noise" {
        let noise = MixedNoise { duration_s: RUN_S, stretch_s: 15.0, region: NoiseRegion::Interior };
        return mixed_noise(&noise, seed);
    }
    let shape = ServiceShape::ALL[(k / 2) as usize % ServiceShape::ALL.len()];
    let scale = [0.4, 0.7, 1.0][(k / 6) as usize % 3];
    service_load(&ServiceLoad { shape, duration_s: RUN_S, scale, offset_kn: 0.0 }, seed)
}

/// Records drives on the rig; the friction is in shares of each drive's RMS.
fn recorded(
    rig: &VirtualRig,
    drives: Vec<(&'static str, Signal)>,
    seed: u64,
    friction: Option<f64>,
) -> Result<Vec<(&'static str, Pair)>, EngineError> {
    let one = |(k, (kind, x)): (usize, (&'static str, Signal))| {
        let sensors = seed.wrapping_mul(7919).wrapping_add(k as u64);
        let mut y = rig.simulate(&x, sensors)?;
        if let Some(share) = friction {
            y = rig.simulate(&rubbed(&x, &y, share)?, sensors)?;
        }
        Ok((kind, Pair { x, y }))
    };
    drives.into_par_iter().enumerate().map(one).collect()
}

/// The drives less the friction that opposes the motion of each axis, which is taken from the rig without friction.
fn rubbed(x: &Signal, y: &Signal, share: f64) -> Result<Signal, EngineError> {
    let rms = |samples: &[f64]| (samples.iter().map(|v| v * v).sum::<f64>() / samples.len() as f64).sqrt();
    let one = |axis: usize| {
        // A tenth of the sample rate: below it sensor noise is no motion.
        let smooth: Vec<f64> = y.channel(axis).windows(10).map(|w| w.iter().sum::<f64>() / 10.0).collect();
        let speed: Vec<f64> = smooth.windows(2).map(|w| w[1] - w[0]).collect();
        let (drive, slow) = (x.channel(axis), SMOOTH * rms(&speed));
        let force = share * rms(drive);
        let at = |t: usize| speed[t.saturating_sub(5).min(speed.len() - 1)];
        drive.iter().enumerate().map(|(t, u)| u - force * (at(t) / slow).tanh()).collect()
    };
    Signal::new(x.sample_rate_hz(), (0..3).map(one).collect())
}
