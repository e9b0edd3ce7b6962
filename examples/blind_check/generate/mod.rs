//! Makes the cases: rigs that share no code with the diagnosis, and their labels in a file of their own.

use std::fs;
use std::path::{Path, PathBuf};

use indicatif::{ProgressBar, ProgressStyle};
use rand::SeedableRng;
use rand::seq::SliceRandom;
use rand_chacha::ChaCha8Rng;
use rayon::prelude::*;
use serde_json::{Value, json};

pub use case::Case;
pub use drives::Wish;
pub use suites::Suite;

use crate::AnyError;
use crate::seeds::{self, Seeds};

mod axis;
mod case;
mod drives;
mod effects;
mod files;
mod flaw;
mod force;
mod frame;
mod retune;
mod rig;
mod runge_kutta;
mod sim;
mod source;
mod suites;

/// The cases to make.
pub struct Plan {
    pub dir: PathBuf,
    pub seeds: Seeds,
    pub round: u64,
    pub suites: Vec<Suite>,
    /// Cases a suite instead of the whole check's.
    pub cases: Option<usize>,
    /// Log of final runs.
    pub log: PathBuf,
}

/// Writes `cases/<id>/`, `labels.json` and `truth/`; ids say nothing of a case.
///
/// # Errors
/// A directory that has cases, a final round that was used before, files that cannot be written.
pub fn generate(plan: &Plan) -> Result<(), AnyError> {
    let labels = plan.dir.join("labels.json");
    if labels.exists() {
        return Err(format!("{} has cases already", plan.dir.display()).into());
    }
    let truth = plan.dir.join("truth");
    fs::create_dir_all(&truth)?;
    if plan.seeds == Seeds::Final {
        enter(plan)?;
    }
    let mut cases: Vec<(Suite, usize)> = Vec::new();
    for &suite in &plan.suites {
        // The clocked cases are two, whatever is asked of the others.
        let wanted = plan.cases.filter(|_| suite != Suite::Time).unwrap_or(suite.cases());
        cases.extend((0..wanted).map(|i| (suite, i)));
    }
    // Ids in order would reveal the suite of a case.
    cases.shuffle(&mut ChaCha8Rng::seed_from_u64(plan.seeds.of(plan.round, 99, 0)));
    let style = ProgressStyle::with_template("{prefix:>9} {bar:32} {pos}/{len}, {eta} left")?;
    let bar = ProgressBar::new(cases.len() as u64).with_style(style).with_prefix("generate");
    let labelled: Vec<Value> = cases
        .par_iter()
        .enumerate()
        .map(|(number, &(suite, index))| {
            let id = format!("{number:04}");
            let seed = plan.seeds.of(plan.round, suite.number(), index as u64);
            let folder = plan.dir.join("cases").join(&id);
            let label = if suite.is_of_frames() {
                frame::write(suite, index, seed, &id, &folder).map_err(|e| e.to_string())?
            } else {
                let mut case = Case::draw(suite, index, seed)?;
                files::write(&mut case, &id, &folder, &truth).map_err(|e| e.to_string())?;
                label(&case, &id, index, seed)
            };
            bar.inc(1);
            Ok(label)
        })
        .collect::<Result<_, String>>()?;
    bar.finish_and_clear();
    let all = json!({"seeds": plan.seeds.name(), "round": plan.round, "log": plan.log, "cases": labelled});
    Ok(fs::write(labels, serde_json::to_string_pretty(&all)?)?)
}

/// Enters a final run into the log before any of its results exist.
fn enter(plan: &Plan) -> Result<(), AnyError> {
    let used = seeds::logged(&plan.log)?;
    if used.iter().any(|line| line["round"] == plan.round) {
        return Err(format!("round {} of the final seeds was used before", plan.round).into());
    }
    let suites: Vec<String> = plan.suites.iter().map(|s| s.name()).collect();
    let line = json!({"event": "generated", "round": plan.round, "at": jiff::Timestamp::now().to_string(),
                      "suites": suites, "cases_a_suite": plan.cases,
                      "diagnosis": source::hash(source::DIAGNOSIS)?, "generator": source::hash(source::GENERATOR)?});
    Ok(seeds::append(&plan.log, &line)?)
}

fn label(case: &Case, id: &str, index: usize, seed: u64) -> Value {
    let effects: Vec<Value> = case
        .named
        .iter()
        .zip(&case.placed)
        .map(|(n, p)| {
            json!({"effect": n.effect, "family": n.family, "axis": files::axis_name(p.axis),
                   "strength": p.strength})
        })
        .collect();
    json!({"id": id, "suite": case.suite.name(), "index": index, "seed": seed, "effects": effects,
           "gap": case.gap, "noise": case.noise, "axes": case.axes})
}

/// Runs the rig of a case once more and answers the recording as an NPY file: the lab's part in a next
/// experiment. Only the lab knows which rig a case has.
///
/// # Errors
/// No such case, or a kind of run that is not on the menu.
pub fn further_run(dir: &Path, id: &str, wish: &Wish) -> Result<Vec<u8>, AnyError> {
    let labels: Value = serde_json::from_slice(&fs::read(dir.join("labels.json"))?)?;
    let cases = labels["cases"].as_array().ok_or("labels without cases")?;
    let label = cases.iter().find(|c| c["id"] == id).ok_or("no such case")?;
    let number = |key: &str| label[key].as_u64().ok_or_else(|| format!("a label without {key}"));
    let suite = *Suite::ALL.iter().find(|s| label["suite"] == s.name()).ok_or("no such suite")?;
    let mut case = Case::draw(suite, number("index")? as usize, number("seed")?)?;
    Ok(files::npy(&case.further(wish)?)?)
}
