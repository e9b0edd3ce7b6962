//! Runs the screen of the diagnosis alone, without a service: over the measured sets of a folder, or over cases
//! that `generate` made.

use std::path::{Path, PathBuf};
use std::time::Instant;

use rigcast::engine::diagnosis::screen::{Channel, Place, Record, Recording, Screening, group, screen};
use rigcast::engine::diagnosis::{Effect, Family, NAMED, Ranked, Refits, ranked, refits};
use rigcast::engine::progress::unwatched;
use rigcast::engine::{Quantity, Signal};
use rigcast::formats::{csv, npy};
use serde_json::Value;

use crate::AnyError;

/// Command line.
#[derive(Debug, clap::Args)]
pub struct Args {
    /// Folder of measured sets.
    #[arg(long)]
    data: Option<PathBuf>,
    /// Directory of cases with their labels.
    #[arg(long)]
    dir: Option<PathBuf>,
}

/// Prints the first families of every set and case, and how often the first is the true one.
///
/// # Errors
/// No data.
pub fn run(args: &Args) -> Result<(), AnyError> {
    println!("set; linear error; families in their order: ratio, effect, place; seconds");
    if let Some(data) = &args.data {
        for (name, recording) in measured(data)? {
            print(&name, &recording);
        }
    }
    if let Some(dir) = &args.dir {
        cases(dir)?;
    }
    Ok(())
}

/// The measured sets by default requests; of those with levels also each way of using them.
fn measured(data: &Path) -> Result<Vec<(String, Recording)>, AnyError> {
    let text = |set: &str, files: &[&str], rate_hz: f64| -> Result<(String, Recording), AnyError> {
        let read = |file: &&str| -> Result<Vec<Vec<f64>>, AnyError> {
            Ok(csv::read(&std::fs::read(data.join(set).join(format!("{file}.csv")))?)?.channels)
        };
        let runs = files.iter().map(read).collect::<Result<_, _>>()?;
        Ok((format!("{set} {}", files.join(" ")), recording(&[Quantity::Other; 2], 1, rate_hz, runs)?))
    };
    let arrays = |set: &str, files: &[&str], rate_hz: f64, quantities: &[Quantity], drives: usize| {
        let read = |file: &&str| -> Result<Vec<Vec<f64>>, AnyError> {
            Ok(npy::read(&std::fs::read(data.join(set).join(format!("{file}.npy")))?)?.channels)
        };
        let runs = files.iter().map(read).collect::<Result<_, AnyError>>()?;
        let recording = recording(quantities, drives, rate_hz, runs)?;
        Ok::<_, AnyError>((format!("{set} {}", files.join(" ")), recording))
    };
    let [force, acceleration] = [Quantity::Force, Quantity::Acceleration];
    let aircraft =
        |files: &[&str]| arrays("f16", files, 400.0, &[force, acceleration, acceleration, acceleration], 1);
    Ok(vec![
        text("silverbox", &["train"], 610.351_562_5)?,
        text("silverbox", &["test_arrow"], 610.351_562_5)?,
        text("wiener_hammerstein", &["train"], 51_200.0)?,
        text("cascaded_tanks", &["train", "test"], 0.25)?,
        text("coupled_drives", &["prbs_05", "prbs_10", "prbs_15"], 50.0)?,
        aircraft(&["full_level3", "full_level5", "full_level7"])?,
        aircraft(&["full_level1", "full_level3", "full_level5", "full_level7"])?,
        aircraft(&["full_level5"])?,
        aircraft(&["odd_level1", "odd_level2", "odd_level3"])?,
        arrays("multiaxis_shaker", &["run1", "run2"], 50_000.0, &[acceleration; 12], 9)?,
    ])
}

/// Runs of channels of which the first `drives` are drives.
fn recording(
    quantities: &[Quantity],
    drives: usize,
    rate_hz: f64,
    runs: Vec<Vec<Vec<f64>>>,
) -> Result<Recording, AnyError> {
    let channel = |(i, quantity): (usize, &Quantity)| Channel {
        name: format!("channel_{i}"),
        quantity: *quantity,
        size: None,
    };
    let mut channels: Vec<Channel> = quantities.iter().enumerate().map(channel).collect();
    let responses = channels.split_off(drives);
    let record = |(i, mut run): (usize, Vec<Vec<f64>>)| -> Result<Record, AnyError> {
        let response = Signal::new(rate_hz, run.split_off(drives))?;
        Ok(Record { drive: Signal::new(rate_hz, run)?, response, added: None, started_s: 1e3 * i as f64 })
    };
    let records = runs.into_iter().enumerate().map(record).collect::<Result<_, _>>()?;
    Ok(Recording { drives: channels, responses, records })
}

/// What the cases of a suite came to.
#[derive(Default)]
struct Counts {
    cases: usize,
    /// The true family leaves least; it has the largest probability; it is named, and another is.
    first: usize,
    likeliest: usize,
    right: usize,
    wrong: usize,
    /// Of those that are named right: the label has a place, and it is that.
    placed: usize,
    at_place: usize,
    /// Another is named with 0.9 or more.
    sure_and_wrong: usize,
}

/// Screens the cases of a directory and counts by suite how often the first family is that of the label.
fn cases(dir: &Path) -> Result<(), AnyError> {
    let labels: Value = serde_json::from_slice(&std::fs::read(dir.join("labels.json"))?)?;
    let mut counts: std::collections::BTreeMap<String, Counts> = std::collections::BTreeMap::new();
    for label in labels["cases"].as_array().into_iter().flatten() {
        let id = label["id"].as_str().ok_or("a label without id")?;
        let effects = || label["effects"].as_array().into_iter().flatten();
        let truth: Vec<String> =
            effects().map(|e| format!("{} on {} {}", e["effect"], e["axis"], e["place"])).collect();
        let suite = label["suite"].as_str().unwrap_or_default();
        let recording = case(&dir.join("cases").join(id))?;
        let count = counts.entry(suite.to_owned()).or_default();
        count.cases += 1;
        let Some((found, refits)) = print(&format!("{suite} {id} ({})", truth.join(", ")), &recording) else {
            continue;
        };
        let is_true = |family: Family| effects().any(|e| e["family"] == serde_json::json!(family));
        count.first += usize::from(found.foremost().first().is_some_and(|f| is_true(f.family)));
        let Some((best, any)) = decided(&found, &refits) else { continue };
        let right = is_true(best.standing.family);
        count.likeliest += usize::from(right);
        if any < NAMED {
            continue;
        }
        count.right += usize::from(right);
        count.wrong += usize::from(!right);
        count.sure_and_wrong += usize::from(!right && best.probability >= 0.9);
        let mut places = effects().map(|e| &e["place"]).filter(|p| right && !p.is_null()).peekable();
        count.placed += usize::from(places.peek().is_some());
        count.at_place += usize::from(places.any(|p| *p == place(&recording, best.standing.place)));
    }
    println!(
        "suite: the true family is first, likeliest, named; another is named, surely; at the true place"
    );
    for (suite, c) in counts {
        println!(
            "{suite}: {} {} {} of {}; {} {}; {} of {}",
            c.first, c.likeliest, c.right, c.cases, c.wrong, c.sure_and_wrong, c.at_place, c.placed
        );
    }
    Ok(())
}

/// The likeliest law, and the probability of any.
fn decided<'a>(found: &'a Screening, refits: &Refits) -> Option<(Ranked<'a>, f64)> {
    let ranked = ranked(found, refits, None);
    let any = ranked.iter().map(|r| r.probability).sum();
    Some((ranked.into_iter().next()?, any))
}

/// A place as labels have it.
fn place(recording: &Recording, place: Place) -> Value {
    let response = |r: usize| &recording.responses[r].name;
    match place {
        Place::Drive(d) | Place::Error(d, _) => serde_json::json!({"at": recording.drives[d].name}),
        Place::Response(r) | Place::Output(r) => serde_json::json!({"at": response(r)}),
        Place::Between(a, b) => serde_json::json!({"between": [response(a.min(b)), response(a.max(b))]}),
        Place::OnTable(d, r) => serde_json::json!({"between": [recording.drives[d].name, response(r)]}),
    }
}

/// The runs of a case; the baseline is one of them where the rig had the effect then.
fn case(folder: &Path) -> Result<Recording, AnyError> {
    let about: Value = serde_json::from_slice(&std::fs::read(folder.join("case.json"))?)?;
    let rate_hz = about["rig"]["sample_rate_hz"].as_f64().ok_or("a rig without a rate")?;
    let listed = about["rig"]["channels"].as_array().ok_or("a rig without channels")?;
    let of = |role: &str| -> Result<Vec<Channel>, AnyError> {
        let channels = listed.iter().filter(|c| c["role"] == role);
        let channel = |c: &Value| {
            let name = c["name"].as_str().unwrap_or_default().to_owned();
            Ok(Channel { name, quantity: serde_json::from_value(c["quantity"].clone())?, size: None })
        };
        channels.map(channel).collect()
    };
    let (drives, responses) = (of("drive")?, of("response")?);
    let in_situ = about["diagnosis"]["mode"] == "in_situ";
    let mut records = Vec::new();
    for run in about["runs"].as_array().into_iter().flatten().filter(|r| in_situ || r["baseline"] == false) {
        let file = run["file"].as_str().ok_or("a run without file")?;
        let mut channels = npy::read(&std::fs::read(folder.join(file))?)?.channels;
        let response = Signal::new(rate_hz, channels.split_off(drives.len()))?;
        let started: jiff::Timestamp = run["started_at"].as_str().ok_or("a run without a time")?.parse()?;
        let drive = Signal::new(rate_hz, channels)?;
        records.push(Record { drive, response, added: None, started_s: started.as_second() as f64 });
    }
    Ok(Recording { drives, responses, records })
}

/// Screens a recording and prints a line.
fn print(name: &str, recording: &Recording) -> Option<(Screening, Refits)> {
    let began = Instant::now();
    let grouping = group(recording, &[]);
    let found = screen(recording, &grouping, &unwatched).and_then(|found| {
        let refits = refits(recording, &grouping, &found, &Effect::ALL, &unwatched)?;
        Ok((found, refits))
    });
    let (found, refits) = match found {
        Ok(found) => found,
        Err(e) => {
            println!("{name}: {e}");
            return None;
        }
    };
    let means: Vec<String> = found
        .linear
        .errors
        .iter()
        .map(|e| format!("{:.3}", e.iter().sum::<f64>() / e.len().max(1) as f64))
        .collect();
    let families: Vec<String> = found
        .foremost()
        .iter()
        .take(3)
        .map(|s| {
            let free = s.free.as_ref().map_or(String::new(), |f| format!(" free x{:.3}", f.ratio));
            let refit = refits.left(s.family, s.place);
            let refit = refit.map_or(String::new(), |left| format!(" refit x{left:.3}"));
            format!("x{:.3}{free}{refit} {} {:?}", s.ratio, s.effect.name(), s.place)
        })
        .collect();
    let decision = decided(&found, &refits).map_or(String::new(), |(best, any)| {
        format!("{} {:.2} of {any:.2}", best.standing.effect.name(), best.probability)
    });
    println!(
        "{name}; {}; {}; {decision}; {:.1} s",
        means.join(" "),
        families.join(", "),
        began.elapsed().as_secs_f64()
    );
    Some((found, refits))
}
