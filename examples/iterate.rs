//! How good a drive is that was iterated on a model: `cargo run --release --example iterate -- [--seeds 1,2,3,4,5]`
//!
//! For each seed it draws a virtual rig, fits an FRF and a hybrid 2 to its noise with the service's default settings, takes
//! the three forces of withheld service drives as targets, iterates on either model, and replays each found drive once on
//! the rig. It prints a JSON line a search, then a table: over the seeds, how often the bars were met, the medians of the
//! worst force's error and of the damage ratio farthest from 1 on the rig, the milliseconds of an iteration, and the runs
//! that an iteration on the rig itself with the same FRF needs to come as near. It exits with 1 where a bar is missed.

mod bench_programme;

use std::collections::BTreeMap;
use std::process::ExitCode;
use std::time::Instant;

use bench_programme::{Recorded, fit_data, fitted, record};
use clap::Parser;
use comfy_table::Table;
use comfy_table::presets::UTF8_FULL_CONDENSED;
use rigcast::engine::fatigue::{DamageRatio, DamageSettings, damage};
use rigcast::engine::frf::{DEFAULT_RIDGE, Frf, FrfInverse};
use rigcast::engine::iteration::{DriveLimit, Found, IterationSettings, Problem, Start, iterate};
use rigcast::engine::metrics::rms;
use rigcast::engine::model::{LstmOptions, ModelKind, Predictor, Preset, Task};
use rigcast::engine::virtual_rig::{DRIVE_LIMIT_KN, VirtualRig};
use rigcast::engine::{EngineError, Progress, Signal, Split};
use serde_json::json;

/// Iterates drives on models of virtual rigs and replays them.
#[derive(Debug, Parser)]
struct Args {
    /// Seeds of the rigs and their runs.
    #[arg(long, value_delimiter = ',', default_value = "1,2,3,4,5")]
    seeds: Vec<u64>,
    /// Minutes of training noise.
    #[arg(long, default_value_t = 20.0)]
    minutes: f64,
    /// Iterations at most.
    #[arg(long, default_value_t = 15)]
    iterations: usize,
    /// Tag of the withheld service loads to reproduce.
    #[arg(long, default_value = "sl")]
    load: String,
}

/// Forces among the outputs.
const FORCES: [usize; 3] = [3, 4, 5];

/// Largest RMS error of a force on the rig.
const MOST_ERROR: f64 = 0.05;

/// Damage ratios of a force on the rig.
const DAMAGE: [f64; 2] = [0.9, 1.1];

/// Longest time of an iteration of 60 s and three channels, ms.
const MOST_MS: f64 = 50.0;

/// Share of the correction that an iteration on the rig applies, as labs do.
const GAIN: f64 = 0.5;

/// What a drive does on the rig.
struct Replayed {
    error: Vec<f64>,
    damage: Vec<f64>,
}

impl Replayed {
    fn worst(&self) -> f64 {
        self.error.iter().copied().fold(0.0, f64::max)
    }

    fn meets(&self) -> bool {
        self.worst() <= MOST_ERROR && self.damage.iter().all(|r| (DAMAGE[0]..=DAMAGE[1]).contains(r))
    }
}

fn main() -> Result<ExitCode, EngineError> {
    let args = Args::parse();
    let mut loads: BTreeMap<String, Load> = BTreeMap::new();
    for &seed in &args.seeds {
        let rig = VirtualRig::draw(seed);
        let runs = record(args.minutes, seed)?;
        let data = fit_data(&runs);
        let mut predictors = Vec::new();
        for kind in [ModelKind::Frf, ModelKind::Hybrid2] {
            let lstm = LstmOptions::default();
            let fitted = fitted(Task::Forward, kind, Preset::Default, lstm, &data, &unwatched)?;
            predictors.push((kind, Predictor::new(fitted.model)?));
        }
        let withheld = |r: &&Recorded| r.run.split == Split::Test && r.run.tags.contains(&args.load.as_str());
        for recorded in runs.iter().filter(withheld) {
            let target = recorded.pair.y.select(&FORCES);
            let on_rig = rig_iteration(&rig, &predictors[0].1, &target, args.iterations, seed)?;
            for (kind, predictor) in &predictors {
                let (found, ms) = search(predictor, &target, args.iterations)?;
                let replayed = replay(&rig, &found.drive, &target, seed)?;
                let runs_on_rig = on_rig.iter().position(|error| *error <= replayed.worst());
                let best = &found.steps[found.best];
                println!(
                    "{}",
                    json!({"seed": seed, "target": recorded.run.name, "model": kind,
                           "iterations": found.steps.len() - 1, "stopped": found.stopped, "band_hz": found.band_hz,
                           "error_by_model": best.error, "error_on_rig": replayed.error,
                           "damage_ratio_on_rig": replayed.damage, "inside": best.inside,
                           "errors": found.steps.iter().map(|s| s.total_error).collect::<Vec<_>>(),
                           "ms_per_iteration": ms, "runs_on_the_rig_to_come_as_near": runs_on_rig,
                           "errors_on_the_rig": on_rig})
                );
                let load = loads.entry(recorded.run.name.clone()).or_default();
                if *kind == ModelKind::Hybrid2 { &mut load.hybrid2 } else { &mut load.frf }.add(
                    &replayed,
                    ms,
                    runs_on_rig,
                );
            }
        }
    }
    let mut table = Table::new();
    table.load_style(UTF8_FULL_CONDENSED);
    table.set_header([
        "target",
        "model",
        "seeds met",
        "worst force's error",
        "damage ratio",
        "ms",
        "runs on the rig",
    ]);
    let needed = (0.8 * args.seeds.len() as f64).ceil() as usize;
    let mut holds = true;
    for (name, load) in &mut loads {
        holds &= load.hybrid2.met >= needed && load.hybrid2.holds();
        table.add_row(load.frf.row(name, "frf"));
        table.add_row(load.hybrid2.row(name, "hybrid2"));
    }
    println!("{table}");
    println!(
        "bars, of hybrid 2 on every target: error <= 5 %, damage ratio of every force 0.9 to 1.1, in the median and in \
         {needed} of {} seeds; an iteration <= {MOST_MS} ms: {}",
        args.seeds.len(),
        if holds { "met" } else { "MISSED" }
    );
    Ok(if holds { ExitCode::SUCCESS } else { ExitCode::FAILURE })
}

/// Figures of one target over the seeds.
#[derive(Default)]
struct Load {
    frf: Figures,
    hybrid2: Figures,
}

/// Figures of one target and kind of model over the seeds.
#[derive(Default)]
struct Figures {
    met: usize,
    error: Vec<f64>,
    /// The damage ratio of the force that is farthest from 1.
    damage: Vec<f64>,
    ms: Vec<f64>,
    /// Runs that an iteration on the rig needs to come as near; none where it never does.
    runs: Vec<Option<usize>>,
}

impl Figures {
    fn add(&mut self, replayed: &Replayed, ms: f64, runs: Option<usize>) {
        self.met += usize::from(replayed.meets());
        self.error.push(replayed.worst());
        let far = |ratio: &f64| ratio.ln().abs();
        self.damage.extend(replayed.damage.iter().copied().max_by(|a, b| far(a).total_cmp(&far(b))));
        self.ms.push(ms);
        self.runs.push(runs);
    }

    fn holds(&mut self) -> bool {
        median(&mut self.error) <= MOST_ERROR
            && (DAMAGE[0]..=DAMAGE[1]).contains(&median(&mut self.damage))
            && median(&mut self.ms) <= MOST_MS
    }

    fn row(&mut self, name: &str, model: &str) -> [String; 7] {
        let runs = self.runs.iter().map(|runs| runs.map_or("never".to_owned(), |runs| runs.to_string()));
        [
            name.to_owned(),
            model.to_owned(),
            format!("{} of {}", self.met, self.error.len()),
            format!("{:.2} %", 100.0 * median(&mut self.error)),
            format!("{:.3}", median(&mut self.damage)),
            format!("{:.1}", median(&mut self.ms)),
            runs.collect::<Vec<_>>().join(", "),
        ]
    }
}

fn unwatched(_: Progress<'_>) -> std::ops::ControlFlow<()> {
    std::ops::ControlFlow::Continue(())
}

/// The found drive, and the milliseconds of an iteration.
fn search(predictor: &Predictor, target: &Signal, iterations: usize) -> Result<(Found, f64), EngineError> {
    let limit = DriveLimit { peak: Some(DRIVE_LIMIT_KN), ..DriveLimit::default() };
    let problem = Problem {
        predictor,
        outputs: &FORCES,
        target,
        weights: &[1.0; 3],
        gains: &[1.0; 3],
        limits: &[limit; 3],
    };
    let settings = IterationSettings { iterations, ..IterationSettings::default() };
    let began = Instant::now();
    let found = iterate(&problem, &Start::Inverse, &settings, &unwatched)?;
    let ms = 1e3 * began.elapsed().as_secs_f64() / found.steps.len() as f64;
    Ok((found, ms))
}

fn replay(rig: &VirtualRig, drive: &Signal, target: &Signal, seed: u64) -> Result<Replayed, EngineError> {
    let response = rig.simulate(drive, seed.wrapping_add(77))?.select(&FORCES);
    let settings = DamageSettings::default();
    let pairs = || target.channels().iter().zip(response.channels());
    let ratio = |(t, y): (&Vec<f64>, &Vec<f64>)| {
        let ratio = DamageRatio::of(damage(y, &settings)?, damage(t, &settings)?);
        Ok(ratio.ratio.unwrap_or(f64::NAN))
    };
    Ok(Replayed {
        error: pairs().map(|(t, y)| rms(t, y).unwrap_or(f64::NAN)).collect(),
        damage: pairs().map(ratio).collect::<Result<_, EngineError>>()?,
    })
}

/// The worst force's error after each run of an iteration on the rig itself with the FRF.
fn rig_iteration(
    rig: &VirtualRig,
    frf: &Predictor,
    target: &Signal,
    runs: usize,
    seed: u64,
) -> Result<Vec<f64>, EngineError> {
    let inverse = inverse(frf)?.filter()?;
    let mut drive = Signal::new(target.sample_rate_hz(), vec![vec![0.0; target.n_samples()]; 3])?;
    let mut errors = Vec::new();
    for _ in 0..=runs {
        let response = rig.simulate(&drive, seed.wrapping_add(77))?.select(&FORCES);
        let pairs = || target.channels().iter().zip(response.channels());
        errors.push(pairs().map(|(t, y)| rms(t, y).unwrap_or(f64::NAN)).fold(0.0, f64::max));
        let error = pairs().map(|(t, y)| t.iter().zip(y).map(|(t, y)| GAIN * (t - y)).collect()).collect();
        let step = inverse.apply(&Signal::new(target.sample_rate_hz(), error)?)?;
        let add = |(u, du): (&f64, &f64)| (u + du).clamp(-DRIVE_LIMIT_KN, DRIVE_LIMIT_KN);
        let pairs = drive.channels().iter().zip(step.channels());
        let channels = pairs.map(|(u, du)| u.iter().zip(du).map(add).collect()).collect();
        drive = Signal::new(target.sample_rate_hz(), channels)?;
    }
    Ok(errors)
}

/// The inverse of a model's FRF from the drives to the forces, on lines of enough coherence, as the search on a model
/// chooses them.
fn inverse(model: &Predictor) -> Result<Frf, EngineError> {
    let model = model.model();
    let frf = model.frf.as_ref().expect("an FRF model has one");
    let quality = model.frf_quality.as_ref().expect("a fitted FRF has its quality");
    let h = (0..frf.n_lines())
        .flat_map(|line| FORCES.into_iter().map(move |force| (line, force)))
        .flat_map(|(line, force)| (0..3).map(move |drive| frf.at(line, force, drive)))
        .collect();
    let forces = Frf { h, n_outputs: 3, y_mean: vec![0.0; 3], x_mean: vec![0.0; 3], ..frf.clone() };
    let inverse = FrfInverse::new(&forces, Some(quality), DEFAULT_RIDGE)?;
    let share: Vec<f64> = quality
        .multiple_coherence
        .chunks(frf.n_outputs)
        .map(|line| FORCES.into_iter().map(|force| line[force]).fold(1.0, f64::min))
        .map(|coherence| if coherence < 0.5 { 0.0 } else { (4.0 * (coherence - 0.5)).min(1.0) })
        .collect();
    let smooth = |line: usize| {
        let near = &share[line.saturating_sub(4)..(line + 5).min(share.len())];
        near.iter().sum::<f64>() / near.len() as f64
    };
    let mut h = inverse.lines(&forces, 0..forces.n_lines())?;
    h.chunks_mut(9).enumerate().for_each(|(line, h)| h.iter_mut().for_each(|h| *h *= smooth(line)));
    Ok(Frf { h, ..forces })
}

fn median(values: &mut [f64]) -> f64 {
    values.sort_by(f64::total_cmp);
    values[values.len() / 2]
}
