//! A further run where a report could not tell effects apart: the one that it asks for, and beside it one
//! drawn at random.

use std::path::Path;

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use serde_json::{Map, Value, json};

use super::session::Session;
use crate::AnyError;

/// What a report may ask for: kind and level.
const MENU: [(&str, f64); 9] = [
    ("noise", 0.3),
    ("noise", 1.0),
    ("noise", 2.0),
    ("slow_sine", 0.3),
    ("slow_sine", 1.0),
    ("resonance_sine", 0.3),
    ("resonance_sine", 1.0),
    ("sweep", 1.0),
    ("offset_noise", 1.0),
];
/// When further runs begin, after all others.
const STARTED_AT: &str = "2026-03-02T12:10:00Z";

/// Reports with the run asked for (`proposed`), if one is, and with one of the menu (`random`), each with
/// its drive; nothing where one effect stands alone.
pub async fn further(
    dir: &Path,
    folder: &Path,
    about: &Value,
    session: &mut Session<'_>,
    request: &Value,
    report: &Value,
) -> Result<Value, AnyError> {
    if report["verdict"]["equivalence_set"].as_array().is_none_or(|set| set.len() < 2) {
        return Ok(Value::Null);
    }
    let id = about["id"].as_str().ok_or("a case without id")?;
    let mut rng = ChaCha8Rng::seed_from_u64(id.parse()?);
    let (kind, level) = MENU[rng.random_range(0..MENU.len())];
    let asked = &report["next_experiment"]["drive"];
    let drawn = json!({"kind": kind, "level_rel": level});
    let mut found = Map::new();
    for (name, drive) in [("proposed", asked), ("random", &drawn)] {
        if drive.is_null() {
            continue;
        }
        let run = format!("further-{name}");
        let file = record(dir, folder, id, &run, drive).await?;
        session.upload(&run, "other", STARTED_AT, "application/x-npy", file).await?;
        let mut request = request.clone();
        let ids = session.ids(&[&run])?;
        if let (Some(runs), Some(more)) = (request["runs"].as_array_mut(), ids.as_array()) {
            runs.extend(more.iter().cloned());
        }
        let (_, report) = session.diagnose(&request).await?;
        found.insert(name.into(), json!({"drive": drive, "report": report}));
    }
    Ok(found.into())
}

/// Has the lab run the rig; the lab knows which one it is.
async fn record(dir: &Path, folder: &Path, id: &str, run: &str, drive: &Value) -> Result<Vec<u8>, AnyError> {
    let out = folder.join(format!("{run}.npy"));
    let mut lab = tokio::process::Command::new(std::env::current_exe()?);
    lab.arg("lab").arg("--dir").arg(dir).args(["--case", id]);
    lab.args(["--kind", drive["kind"].as_str().ok_or("a drive without kind")?]);
    lab.args(["--level", &drive["level_rel"].to_string()]);
    if let Some(hz) = drive["frequency_hz"].as_f64() {
        lab.args(["--frequency-hz", &hz.to_string()]);
    }
    let status = lab.arg("--out").arg(&out).status().await?;
    if !status.success() {
        return Err(format!("the lab did not run {drive}").into());
    }
    Ok(std::fs::read(out)?)
}
