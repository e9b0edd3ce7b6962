//! The files of a case: measured runs and a `case.json` without a label.

use std::fs;
use std::io;
use std::path::Path;

use npyz::WriterBuilder;
use serde_json::{Value, json};

use super::case::{Case, Record};
use super::effects::{FAMILIES, struck};
use super::rig::RATE;
use super::sim;
use super::suites::Suite;

/// When the programme began; the baseline run is from the day before.
const BEGAN: &str = "2026-03-02T08:00:00Z";
const BASELINE: &str = "2026-03-01T08:00:00Z";
/// Half of the smallest gap: what comes in bursts may be smaller on the runs that an effect is chosen on.
const MATERIAL_GAP: f64 = 0.006;

/// The sim's weights.
const SIM: &str = "sim.safetensors";

const AXES: [&str; 3] = ["x", "y", "z"];

/// Channels of the rig as the contract's `POST /v1/rigs` takes them, drives first.
fn channels(axes: usize) -> Vec<Value> {
    let channel = |quantity: &str, unit: &str, role: &str, axis: &str| {
        let name = if role == "drive" { format!("drive_{axis}") } else { format!("{quantity}_{axis}") };
        self::channel(&name, unit, role, quantity, axis)
    };
    let driven = if axes == 1 { vec!["x", "z"] } else { AXES.to_vec() };
    let mut out: Vec<Value> = driven.iter().map(|a| channel("force", "kN", "drive", a)).collect();
    out.extend(AXES[..axes].iter().map(|a| channel("displacement", "mm", "response", a)));
    if axes > 1 {
        out.extend(AXES[..axes].iter().map(|a| channel("force", "kN", "response", a)));
    }
    out
}

/// A channel as the contract's `POST /v1/rigs` takes it.
pub fn channel(name: &str, unit: &str, role: &str, quantity: &str, axis: &str) -> Value {
    json!({"name": name, "unit": unit, "role": role, "quantity": quantity, "axis": axis})
}

/// Name of an axis of a rig with `axes` of them.
pub fn axis_name(axis: usize) -> &'static str {
    AXES[axis]
}

/// Writes the case's runs, its `case.json` and, for the scorer alone, the true response of its check
/// runs to `truth`.
///
/// # Errors
/// Files that cannot be written.
pub fn write(case: &mut Case, id: &str, folder: &Path, truth: &Path) -> io::Result<()> {
    fs::create_dir_all(folder)?;
    let mut runs = vec![run(folder, "baseline-0", true, &case.baseline())?];
    let (records, repeats) = case.runs();
    for (i, record) in records.iter().enumerate() {
        runs.push(run(folder, &format!("run-{i}"), false, record)?);
    }
    let channels = channels(case.axes);
    let n_drives = case.peaks().len();
    let names = |channels: &[Value]| -> Vec<String> {
        channels.iter().filter_map(|c| c["name"].as_str()).map(String::from).collect()
    };
    if case.suite.fit(case.index).is_none() {
        let (sim, mean) = case.sim();
        let sim =
            sim::safetensors(&sim, &names(&channels[..n_drives]), &names(&channels[n_drives..]), &mean)?;
        fs::write(folder.join(SIM), sim)?;
    }
    let mut checks = Vec::new();
    if case.suite.is_checked() {
        let mut responses = Vec::new();
        for (i, record) in case.checks().iter().enumerate() {
            let file = format!("check-{i}.json");
            fs::write(folder.join(&file), named(&channels[..n_drives], &record.drives).to_string())?;
            responses.push(named(&channels[n_drives..], &record.responses));
            checks.push(file);
        }
        fs::write(truth.join(format!("{id}.json")), Value::from(responses).to_string())?;
    }
    let run_names =
        |group: &Vec<usize>| -> Vec<String> { group.iter().map(|i| format!("run-{i}")).collect() };
    let about = json!({
        "id": id,
        "rig": {"id": format!("case-{id}"), "name": format!("Case {id}"), "sample_rate_hz": RATE, "channels": channels},
        "runs": runs,
        "repeats": repeats.iter().map(run_names).collect::<Vec<_>>(),
        "sim": case.suite.fit(case.index).is_none().then_some(SIM),
        "diagnosis": request(case, &channels),
        "fit": case.suite.fit(case.index),
        "asked": case.suite.asked(case.index),
        "default_request": case.suite.is_default_request(case.index),
        "check": checks,
        "next_experiment": case.suite == Suite::NextExperiment,
        "alone": case.suite == Suite::Time,
    });
    fs::write(folder.join("case.json"), serde_json::to_string_pretty(&about)?)
}

/// Writes a run and answers what `case.json` says of it.
///
/// # Errors
/// A file that cannot be written.
pub fn run(folder: &Path, name: &str, baseline: bool, record: &Record) -> io::Result<Value> {
    let file = format!("{name}.npy");
    fs::write(folder.join(&file), npy(record)?)?;
    let began: jiff::Timestamp = BEGAN.parse().map_err(io::Error::other)?;
    let started = began + jiff::SignedDuration::from_secs_f64(record.started_s);
    let started = if baseline { BASELINE.into() } else { started.to_string() };
    Ok(json!({"name": name, "file": file, "kind": "noise", "baseline": baseline, "started_at": started}))
}

/// The fields of the diagnosis request that a user knows.
fn request(case: &Case, channels: &[Value]) -> Value {
    let named = case.named[0];
    let catalogue = match case.suite {
        Suite::Struck => struck(named.effect, named.family),
        _ => FAMILIES.iter().flat_map(|(_, effects)| *effects).copied().collect(),
    };
    let mode = if case.with_the_flaw() { "in_situ" } else { "external" };
    let mut request = json!({"mode": mode, "catalogue": catalogue, "material_gap": MATERIAL_GAP});
    if case.suite == Suite::NextExperiment {
        let limit = |(c, peak): (&Value, f64)| {
            (c["name"].as_str().unwrap_or_default().to_owned(), Value::from(2.0 * peak))
        };
        let limits: serde_json::Map<String, Value> = channels.iter().zip(case.peaks()).map(limit).collect();
        request["envelope"] = json!({"drive_peak": limits});
    }
    request
}

/// Signals as the contract's JSON has them, to seven digits.
fn named(channels: &[Value], samples: &[Vec<f64>]) -> Value {
    let short = |x: &f64| (x * 1e7).round() / 1e7;
    let channels: serde_json::Map<String, Value> = channels
        .iter()
        .zip(samples)
        .map(|(c, x)| (c["name"].as_str().unwrap_or_default().into(), x.iter().map(short).collect()))
        .collect();
    json!({"sample_rate_hz": RATE, "channels": channels})
}

/// A run as an NPY file, `[samples, channels]` in the rig's order.
///
/// # Errors
/// Only for lack of memory.
pub fn npy(record: &Record) -> io::Result<Vec<u8>> {
    let channels: Vec<&Vec<f64>> = record.drives.iter().chain(&record.responses).collect();
    let n = channels[0].len();
    let mut file = Vec::new();
    let mut writer = npyz::WriteOptions::new()
        .default_dtype()
        .shape(&[n as u64, channels.len() as u64])
        .writer(&mut file)
        .begin_nd()?;
    for k in 0..n {
        writer.extend(channels.iter().map(|c| c[k]))?;
    }
    writer.finish()?;
    Ok(file)
}
