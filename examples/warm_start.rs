//! How many epochs a fit for the next specimen saves that begins at the last one's weights:
//! `cargo run --release --example warm_start -- [--seed 1] [--minutes 20] [--next-minutes 5] [--kinds lstm,hybrid2]`
//!
//! Fits each kind to noise of the virtual rig, exchanges the specimen (every parameter of the mount is drawn anew
//! within a share of its value), records less noise, and fits the new specimen twice: from the start, and from the
//! weights of the first. Prints a line for each number of epochs: the error on the withheld noise and on the service
//! loads of the new specimen, mean over the outputs.

mod bench_programme;

use bench_programme::{Recorded, fit_data, fitted, record, record_on, settings};
use clap::Parser;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rigcast::engine::model::{FitSettings, LstmOptions, LstmPart, ModelKind, Preset, RigModel, Task, fit};
use rigcast::engine::virtual_rig::VirtualRig;
use rigcast::engine::{EngineError, metrics, progress::unwatched};
use serde_json::json;

/// Compares a fit from the start with one from the weights of a model.
#[derive(Debug, Parser)]
struct Args {
    /// Seed of the rig, its runs and the networks.
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Minutes of noise of the first specimen.
    #[arg(long, default_value_t = 20.0)]
    minutes: f64,
    /// Minutes of noise of the next one.
    #[arg(long, default_value_t = 5.0)]
    next_minutes: f64,
    /// Largest change of a parameter of the mount, as a share.
    #[arg(long, default_value_t = 0.1)]
    change: f64,
    /// Kinds of model.
    #[arg(long, value_delimiter = ',', default_value = "lstm,hybrid2", value_parser = kind)]
    kinds: Vec<ModelKind>,
    /// Epochs of the first fit and of the one from the start; left out: those of the default preset.
    #[arg(long)]
    epochs: Option<usize>,
}

fn kind(name: &str) -> Result<ModelKind, String> {
    serde_json::from_value(json!(name)).map_err(|_| "lstm, hybrid1 or hybrid2".to_owned())
}

/// Shares of the epochs of the fit from the start.
const SHARES: [f64; 6] = [0.02, 0.05, 0.1, 0.2, 0.5, 1.0];

fn main() -> Result<(), EngineError> {
    let args = Args::parse();
    let rig = VirtualRig::draw(args.seed);
    let first = record(args.minutes, args.seed)?;
    let next = record_on(&another(&rig, args.change, args.seed), args.next_minutes, args.seed + 1)?;
    for &kind in &args.kinds {
        let base = trained(&args, kind, args.epochs, None, &first)?;
        let untouched = errors(&base.0, &next)?;
        println!(
            "{}",
            json!({"kind": kind, "fit": "of the first specimen", "epochs": 0, "errors": untouched})
        );
        let full = trained(&args, kind, args.epochs, None, &next)?.1;
        for share in SHARES {
            let epochs = ((share * full as f64).round() as usize).max(1);
            for (fit, start) in [("from the start", None), ("from its weights", base.0.lstm.clone())] {
                let (model, _) = trained(&args, kind, Some(epochs), start, &next)?;
                let errors = errors(&model, &next)?;
                println!("{}", json!({"kind": kind, "fit": fit, "epochs": epochs, "errors": errors}));
            }
        }
    }
    Ok(())
}

/// The bench with another specimen: the parameters of the mount changed by up to `share` either way.
fn another(rig: &VirtualRig, share: f64, seed: u64) -> VirtualRig {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let mut axes = *rig.axes();
    for axis in &mut axes {
        for parameter in [
            &mut axis.stiffness_n_per_mm,
            &mut axis.stop_load_plus_kn,
            &mut axis.stop_load_minus_kn,
            &mut axis.stop_stiffness_ratio,
            &mut axis.stop_travel_mm,
            &mut axis.rubber_damping_n_s_per_m,
            &mut axis.friction_force_n,
            &mut axis.pumping_area_cm2,
            &mut axis.chamber_compliance_cm3_per_mpa,
            &mut axis.track_loss,
        ] {
            *parameter *= 1.0 + rng.random_range(-share..=share);
        }
    }
    rig.with_axes(axes)
}

/// A forward model, and the epochs of its schedule.
fn trained(
    args: &Args,
    kind: ModelKind,
    epochs: Option<usize>,
    start: Option<LstmPart>,
    runs: &[Recorded],
) -> Result<(RigModel, usize), EngineError> {
    let lstm = LstmOptions { seeds: Some(vec![args.seed]), epochs, ..LstmOptions::default() };
    let data = fit_data(runs);
    let fitted = match start {
        None => fitted(Task::Forward, kind, Preset::Default, lstm, &data, &unwatched)?,
        start => {
            let settings = FitSettings { start, ..settings(Task::Forward, kind, Preset::Default, lstm) };
            fit(&data, &settings, &unwatched)?
        }
    };
    let epochs = fitted.report.lstm.as_ref().map_or(0, |lstm| lstm.epochs);
    Ok((fitted.model, epochs))
}

/// Mean over the outputs of the RMS error, as a share, on withheld noise and on the withheld service loads.
fn errors(model: &RigModel, runs: &[Recorded]) -> Result<serde_json::Value, EngineError> {
    let of = |tag: &str| -> Result<f64, EngineError> {
        let (mut sum, mut n) = (0.0, 0.0);
        for recorded in runs.iter().filter(|recorded| recorded.run.name.starts_with(tag)) {
            let predicted = model.predict(&recorded.pair.x)?;
            let errors = metrics::errors(&recorded.pair.y, &predicted)?;
            for rms in errors.channels.iter().filter_map(|channel| channel.rms) {
                (sum, n) = (sum + rms, n + 1.0);
            }
        }
        Ok(sum / n)
    };
    Ok(json!({"N1": of("test-n1")?, "SL": of("test-sl")?}))
}
