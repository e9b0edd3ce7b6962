//! Blind cases for the diagnosis, in one process: random rigs with one effect that the sim lacks, drawn
//! and integrated without any code of the diagnosis, diagnosed without their label, and scored.
//!
//! `cargo run --release --example blind_check -- [--suite catalogue] [--cases 28] [--first-seed 70000]`
//!
//! Prints a JSON line a case and one for the suite. A seed that has been looked at is spent: whoever
//! changes the diagnosis by what a run shows takes new seeds for the next figure.

use std::time::Instant;

use clap::{Parser, ValueEnum};
use rigcast::engine::diagnosis::{
    Channel, Diagnosis, Effect, Family, Input, Mode, Run, VerdictKind, diagnose,
};
use rigcast::engine::{EngineError, Quantity, Signal, progress};
use serde_json::json;

mod cases;
mod rig;

#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
enum SuiteName {
    /// Effects of the catalogue.
    Catalogue,
    /// Nothing, noise, hum, quantisation.
    Nothing,
    /// Effects outside the catalogue.
    Outside,
    /// The same physics in another equation.
    OtherEquation,
}

/// Diagnoses blind cases.
#[derive(Debug, Parser)]
struct Args {
    /// Suite.
    #[arg(long, value_enum, default_value = "catalogue")]
    suite: SuiteName,
    /// Cases.
    #[arg(long, default_value_t = 28)]
    cases: usize,
    /// Seed of the first case.
    #[arg(long, default_value_t = 70_000)]
    first_seed: u64,
    /// The sim was fitted on the rig with the effect.
    #[arg(long)]
    in_situ: bool,
    /// Strike the true effect and its family from the catalogue.
    #[arg(long)]
    strike: bool,
}

fn main() -> Result<(), EngineError> {
    let args = Args::parse();
    let suite = match args.suite {
        SuiteName::Catalogue => cases::Suite::Catalogue,
        SuiteName::Nothing => cases::Suite::Nothing,
        SuiteName::Outside => cases::Suite::Outside,
        SuiteName::OtherEquation => cases::Suite::OtherEquation,
    };
    let mut total = Total::default();
    for index in 0..args.cases {
        let seed = args.first_seed + index as u64;
        let case = cases::case(suite, index, seed, args.in_situ);
        let mut input = input(&case, if args.in_situ { Mode::InSitu } else { Mode::External })?;
        if args.strike {
            input.catalogue.retain(|effect| Some(effect.family()) != family(case.label));
        }
        let began = Instant::now();
        let found = diagnose(&input, &progress::unwatched)?;
        total.add(&case, seed, &found, began.elapsed().as_secs_f64());
    }
    total.print(&args);
    Ok(())
}

/// What the diagnosis sees of a case: not the label.
fn input(case: &cases::Case, mode: Mode) -> Result<Input, EngineError> {
    let channel = |name: &str, axis: &str| Channel {
        name: name.into(),
        axis: Some(axis.into()),
        unit: "mm".into(),
        quantity: Quantity::Displacement,
    };
    let run = |(name, record): (String, &cases::Record)| {
        Ok(Run {
            name,
            drive: Signal::new(rig::RATE, record.drives.clone())?,
            response: Signal::new(rig::RATE, vec![record.response.clone()])?,
            simulated: None,
            started_s: record.started_s,
        })
    };
    let named = |prefix: &'static str| move |(i, record)| (format!("{prefix}-{i}"), record);
    Ok(Input {
        drives: vec![channel("drive_x", "x"), channel("drive_z", "z")],
        responses: vec![channel("displacement_x", "x")],
        baseline: case
            .baseline
            .iter()
            .enumerate()
            .map(named("baseline"))
            .map(run)
            .collect::<Result<_, EngineError>>()?,
        runs: case.runs.iter().enumerate().map(named("run")).map(run).collect::<Result<_, EngineError>>()?,
        roles: None,
        repeats: case.repeats.clone(),
        mode,
        catalogue: Effect::ALL.to_vec(),
        material_gap: 0.01,
        drive_limit: None,
        seed: 1,
    })
}

/// Family of a label of the catalogue.
fn family(label: &str) -> Option<Family> {
    Effect::ALL.iter().find(|e| e.name() == label).map(|e| e.family())
}

#[derive(Debug, Default)]
struct Total {
    right: usize,
    identified: usize,
    right_family: usize,
    in_set: usize,
    blamed: usize,
    set_sizes: Vec<usize>,
    closures: Vec<f64>,
    seconds: Vec<f64>,
}

impl Total {
    fn add(&mut self, case: &cases::Case, seed: u64, found: &Diagnosis, seconds: f64) {
        let verdict = &found.report.verdict;
        let best = found.report.hypotheses.first();
        let named = verdict.effect.or(best.map(|h| h.effect));
        let first = named.is_some_and(|effect| effect.name() == case.label);
        let stated = matches!(verdict.kind, VerdictKind::Identified | VerdictKind::Partial);
        let right = match case.label {
            "nothing" => verdict.kind == VerdictKind::NoMaterialGap,
            "raised_noise" | "periodic_disturbance" => {
                verdict.kind == VerdictKind::NoiseOrUnmeasuredDisturbance && first
            }
            _ => first && stated,
        };
        let wrong_family = verdict.family != family(case.label);
        let blamed = stated || (verdict.kind == VerdictKind::FamilyOnly && wrong_family);
        self.right += usize::from(right);
        self.identified += usize::from(verdict.kind == VerdictKind::Identified);
        self.right_family += usize::from(named.map(|effect| effect.family()) == family(case.label));
        self.in_set += usize::from(verdict.equivalence_set.iter().any(|e| e.name() == case.label));
        self.blamed += usize::from(blamed);
        self.set_sizes.push(verdict.equivalence_set.len());
        self.closures.extend(best.filter(|_| right).map(|h| h.held_out.closure));
        self.seconds.push(seconds);
        let line = json!({
            "seed": seed, "label": case.label, "gap": case.gap, "noise": case.noise, "right": right,
            "blamed": blamed, "verdict": verdict, "seconds": seconds,
        });
        println!("{line}");
    }

    fn print(mut self, args: &Args) {
        self.set_sizes.sort_unstable();
        self.closures.sort_by(f64::total_cmp);
        self.seconds.sort_by(f64::total_cmp);
        let line = json!({
            "suite": format!("{:?}", args.suite), "in_situ": args.in_situ, "struck": args.strike,
            "first_seed": args.first_seed, "cases": args.cases, "right": self.right,
            "identified": self.identified, "right_family": self.right_family, "in_set": self.in_set,
            "blamed": self.blamed, "set_median": self.set_sizes.get(args.cases / 2),
            "set_p90": self.set_sizes.get(9 * args.cases / 10),
            "closure_median": self.closures.get(self.closures.len() / 2),
            "seconds_median": self.seconds.get(args.cases / 2), "seconds_max": self.seconds.last(),
        });
        println!("{line}");
    }
}
