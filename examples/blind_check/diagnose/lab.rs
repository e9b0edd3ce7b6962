//! A further run for reports that could not tell effects apart: the run that the report proposes and, for
//! comparison, random ones.

use std::path::Path;

use rand::SeedableRng;
use rand::seq::SliceRandom;
use rand_chacha::ChaCha8Rng;
use serde_json::{Value, json};

use super::session::Session;
use crate::AnyError;

/// The runs that a report may propose: kind and level.
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
/// Start of further runs, after all others.
const STARTED_AT: &str = "2026-03-02T12:10:00Z";

/// Reports with the run asked for (`proposed`), if one is, and with runs of the menu in random order
/// (`random`), each with its drive: one at least, and more until some run leaves one effect alone. Nothing where
/// one stands alone from the start.
pub async fn further(
    dir: &Path,
    folder: &Path,
    about: &Value,
    session: &mut Session<'_>,
    request: &Value,
    report: &Value,
) -> Result<Value, AnyError> {
    if standing(report) < 2 {
        return Ok(Value::Null);
    }
    let id = about["id"].as_str().ok_or("a case without id")?;
    let mut lab = Lab { dir, folder, id, session, request };
    let proposed = match &report["next_experiment"]["drive"] {
        Value::Null => Value::Null,
        asked => lab.with("proposed", asked).await?,
    };
    let mut settled = standing(&proposed["report"]) == 1;
    let mut menu = MENU;
    menu.shuffle(&mut ChaCha8Rng::seed_from_u64(id.parse()?));
    let mut random = Vec::new();
    for (kind, level) in menu {
        if settled && !random.is_empty() {
            break;
        }
        let drive = json!({"kind": kind, "level_rel": level});
        let found = lab.with(&format!("random-{}", random.len()), &drive).await?;
        settled |= standing(&found["report"]) == 1;
        random.push(found);
    }
    Ok(json!({"proposed": proposed, "random": random}))
}

/// Number of effects that a report cannot tell apart; `None` where it names none.
fn standing(report: &Value) -> usize {
    report["verdict"]["equivalence_set"].as_array().map_or(0, Vec::len)
}

/// The rig of a case, with the session that holds its runs.
struct Lab<'a, 'b> {
    dir: &'a Path,
    folder: &'a Path,
    id: &'a str,
    session: &'a mut Session<'b>,
    request: &'a Value,
}

impl Lab<'_, '_> {
    /// The drive, and the report on the runs so far with this one.
    async fn with(&mut self, name: &str, drive: &Value) -> Result<Value, AnyError> {
        let run = format!("further-{name}");
        let file = record(self.dir, self.folder, self.id, &run, drive).await?;
        self.session.upload(&run, "other", STARTED_AT, "application/x-npy", file).await?;
        let mut request = self.request.clone();
        let ids = self.session.ids(&[&run])?;
        if let (Some(runs), Some(more)) = (request["runs"].as_array_mut(), ids.as_array()) {
            runs.extend(more.iter().cloned());
        }
        let (_, report) = self.session.diagnose(&request).await?;
        Ok(json!({"drive": drive, "report": report}))
    }
}

/// Calls the lab to run the rig, which only the lab knows.
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
