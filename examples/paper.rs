//! The source paper's comparison on the virtual rig: `cargo run --release --example paper -- [--minutes 4] [--out .]`
//!
//! Fits the four kinds of model to the programme's noise with the presets `paper` and `default`, three seeds each, the best by
//! validation: forward (drives to displacements and forces) and as virtual sensors (displacements to forces). Compares
//! them on test runs that nothing was fitted on: N1, N2, SL, SL- and SL+. Prints a CSV row for each preset, task, kind, class
//! and group of channels, writes all rows to `paper.csv` in the folder `--out`, with a plot of the RMS errors and one of the
//! damage ratios for each preset and task, and then holds what the paper found (Heindel et al., sections 4.1 and 4.2)
//! against them: a finding that differs is printed as one.

mod bench_programme;

use std::error::Error;
use std::fmt::Write as _;
use std::path::PathBuf;
use std::time::Instant;

use bench_programme::{Recorded, fit_data, fitted, record};
use clap::Parser;
use rigcast::engine::evaluation::{
    ChannelGroup, ClassAverage, CompareSettings, GroupAverage, RunFigures, average, compare,
};
use rigcast::engine::fatigue::{DamageGroup, DamageSettings};
use rigcast::engine::model::{LstmOptions, ModelKind, Pair, Preset, RigModel, Task};
use rigcast::engine::progress::unwatched;
use rigcast::engine::virtual_rig::SAMPLE_RATE_HZ;
use rigcast::engine::{EngineError, Signal, Split};
use rigcast::ui::figures::ratios_svg;

/// Compares kinds of models as the source paper did.
#[derive(Debug, Parser)]
struct Args {
    /// Minutes of training noise.
    #[arg(long, default_value_t = 4.0)]
    minutes: f64,
    /// Share of the epochs of the preset `paper`; with all of them two cores need half a day.
    #[arg(long, default_value_t = 0.3)]
    epochs: f64,
    /// Presets.
    #[arg(long, value_delimiter = ',', default_value = "paper,default", value_parser = preset)]
    presets: Vec<Preset>,
    /// Seeds of the networks.
    #[arg(long, value_delimiter = ',', default_value = "1,2,3")]
    seeds: Vec<u64>,
    /// Seed of the rig and its runs.
    #[arg(long, default_value_t = 1)]
    rig: u64,
    /// Folder of the table and the plots.
    #[arg(long, default_value = ".")]
    out: PathBuf,
}

fn preset(name: &str) -> Result<Preset, String> {
    serde_json::from_value(serde_json::json!(name)).map_err(|_| "paper or default".to_owned())
}

const KINDS: [ModelKind; 4] = [ModelKind::Frf, ModelKind::Lstm, ModelKind::Hybrid1, ModelKind::Hybrid2];

/// Classes of test runs: the paper's name, and the programme's tag.
const CLASSES: [(&str, &str); 5] =
    [("N1", "n1"), ("N2", "n2"), ("SL", "sl"), ("SL-", "sl-minus"), ("SL+", "sl-plus")];

const SERVICE: [&str; 3] = ["SL", "SL-", "SL+"];

/// The figures of one kind on one class of runs.
struct Row {
    kind: ModelKind,
    class: &'static str,
    average: ClassAverage,
}

fn main() -> Result<(), Box<dyn Error>> {
    let args = Args::parse();
    let runs = record(args.minutes, args.rig)?;
    let mut csv = String::from("preset,task,kind,class,group,rms,psd_rms,damage_ratio,multi_rain\n");
    print!("{csv}");
    for &preset in &args.presets {
        for task in [Task::Forward, Task::VirtualSensing] {
            let rows = table(&args, preset, task, &runs)?;
            let lines = lines(preset, task, &rows)?;
            print!("{lines}");
            csv.push_str(&lines);
            plot(&args, preset, task, &rows)?;
            findings(preset, task, &rows);
        }
    }
    std::fs::write(args.out.join("paper.csv"), csv)?;
    Ok(())
}

/// Fits the four kinds and compares them.
fn table(args: &Args, preset: Preset, task: Task, runs: &[Recorded]) -> Result<Vec<Row>, Box<dyn Error>> {
    let runs: Vec<Recorded> =
        runs.iter().map(|r| Recorded { run: r.run.clone(), pair: pair(task, &r.pair) }).collect();
    let data = fit_data(&runs);
    let mut rows = Vec::new();
    for kind in KINDS {
        let started = Instant::now();
        let lstm = lstm(args, preset, task, kind)?;
        let fitted = fitted(task, kind, preset, lstm, &data, &unwatched)?;
        eprintln!(
            "{} {} {}: fitted in {:.0} s, seed {:?}",
            name_of(&preset)?,
            name_of(&task)?,
            kind.as_str(),
            started.elapsed().as_secs_f64(),
            fitted.report.best_seed
        );
        for (class, tag) in CLASSES {
            let of_class = runs.iter().filter(|r| r.run.split == Split::Test && r.run.tags.contains(&tag));
            let figures: Vec<RunFigures> =
                of_class.map(|r| figures(&fitted.model, &r.pair)).collect::<Result<_, EngineError>>()?;
            let average = average(&figures.iter().collect::<Vec<_>>(), &groups(&fitted.model));
            rows.push(Row { kind, class, average });
        }
    }
    Ok(rows)
}

/// The preset's network; of the preset `paper` with the share of its epochs that was asked for.
fn lstm(args: &Args, preset: Preset, task: Task, kind: ModelKind) -> Result<LstmOptions, EngineError> {
    let mut lstm = LstmOptions { seeds: Some(args.seeds.clone()), ..LstmOptions::default() };
    if preset == Preset::Paper && kind != ModelKind::Frf {
        let samples = (args.minutes * 60.0 * SAMPLE_RATE_HZ) as usize;
        let epochs = lstm.resolve(preset, kind, task, &[samples])?.epochs as f64;
        lstm.epochs = Some(((epochs * args.epochs).ceil() as usize).max(1));
    }
    Ok(lstm)
}

/// The names of a model's groups of outputs.
fn group_names(model: &RigModel) -> &'static [&'static str] {
    if model.outputs.len() == 3 { &["force"] } else { &["displacement", "force"] }
}

fn groups(model: &RigModel) -> Vec<ChannelGroup> {
    let group = |(name, channels): (&&str, &[String])| ChannelGroup {
        name: (*name).to_owned(),
        channels: channels.to_vec(),
    };
    group_names(model).iter().zip(model.outputs.chunks(3)).map(group).collect()
}

/// Inputs and outputs of a recording of three drives and six responses.
fn pair(task: Task, recorded: &Pair) -> Pair {
    let part = |of: std::ops::Range<usize>| {
        let y = &recorded.y;
        Signal::new(y.sample_rate_hz(), y.channels()[of].to_vec()).expect("channels of a signal are a signal")
    };
    match task {
        Task::Forward => recorded.clone(),
        Task::VirtualSensing => Pair { x: part(0..3), y: part(3..6) },
    }
}

fn figures(model: &RigModel, measured: &Pair) -> Result<RunFigures, EngineError> {
    let group =
        |(k, name): (usize, &&'static str)| DamageGroup { name, channels: [3 * k, 3 * k + 1, 3 * k + 2] };
    let groups: Vec<DamageGroup<'_>> = group_names(model).iter().enumerate().map(group).collect();
    let predicted = model.predict(&measured.x)?;
    let settings = CompareSettings { damage: DamageSettings::default(), span_s: 1.0 };
    Ok(compare(&model.outputs, &groups, &measured.y, &predicted, &settings)?.figures)
}

fn lines(preset: Preset, task: Task, rows: &[Row]) -> Result<String, Box<dyn Error>> {
    let mut text = String::new();
    let number = |value: Option<f64>| value.map_or_else(String::new, |v| format!("{v:.4}"));
    for row in rows {
        for (group, found) in &row.average.groups {
            writeln!(
                text,
                "{},{},{},{},{group},{},{},{},{}",
                name_of(&preset)?,
                name_of(&task)?,
                row.kind.as_str(),
                row.class,
                number(found.rms),
                number(found.psd_rms),
                number(found.damage_ratio),
                number(found.multi_rain)
            )?;
        }
    }
    Ok(text)
}

/// The groups of channels that the rows have averages of.
fn group_keys(rows: &[Row]) -> impl Iterator<Item = &String> {
    rows.first().into_iter().flat_map(|row| row.average.groups.keys())
}

/// Writes the RMS errors, over those of the FRF, and the damage ratios, one row a group, class and kind.
fn plot(args: &Args, preset: Preset, task: Task, rows: &[Row]) -> Result<(), Box<dyn Error>> {
    let all = |of: &dyn Fn(&Row, &str) -> Option<f64>| -> Vec<(String, Option<f64>)> {
        let of_group = |group: &String| {
            let name = |row: &Row| format!("{group}, {}, {}", row.class, row.kind.as_str());
            let mut in_order: Vec<&Row> = rows.iter().collect();
            in_order.sort_by_key(|row| CLASSES.iter().position(|(class, _)| *class == row.class));
            in_order.iter().map(|row| (name(row), of(row, group))).collect::<Vec<_>>()
        };
        group_keys(rows).flat_map(of_group).collect()
    };
    let over_frf = |row: &Row, group: &str| {
        let frf = rows.iter().find(|r| r.class == row.class && r.kind == ModelKind::Frf)?;
        Some(row.average.groups.get(group)?.rms? / frf.average.groups.get(group)?.rms?)
    };
    let damage = |row: &Row, group: &str| row.average.groups.get(group)?.damage_ratio;
    let named = format!("{}-{}", name_of(&preset)?, name_of(&task)?);
    let rms = ratios_svg("RMS errors", "RMS error over that of the FRF", all(&over_frf));
    std::fs::write(args.out.join(format!("paper-{named}-rms.svg")), rms)?;
    let damage = ratios_svg("Damage ratios", "Predicted over measured damage", all(&damage));
    std::fs::write(args.out.join(format!("paper-{named}-damage.svg")), damage)?;
    Ok(())
}

/// Name of a preset or task, as a fit's request has it.
fn name_of(of: &impl serde::Serialize) -> Result<String, serde_json::Error> {
    Ok(serde_json::to_value(of)?.as_str().unwrap_or_default().to_owned())
}

/// Holds the paper's findings against the rows.
fn findings(preset: Preset, task: Task, rows: &[Row]) {
    let tell = |what: &str, class: &str, group: &str, holds: bool, detail: String| {
        let verdict = if holds { "as in the paper" } else { "FINDING, differs from the paper" };
        println!("# {preset:?} {task:?} {class} {group}: {what}: {verdict} ({detail})");
    };
    for group in group_keys(rows) {
        let of = |class: &str, figure: fn(&GroupAverage) -> Option<f64>| -> Vec<(ModelKind, f64)> {
            let in_class = rows.iter().filter(|row| row.class == class);
            in_class.filter_map(|row| Some((row.kind, figure(&row.average.groups[group])?))).collect()
        };
        let from_one: fn(f64) -> f64 = |ratio| ratio.max(f64::MIN_POSITIVE).ln().abs();
        match task {
            Task::Forward => {
                for class in SERVICE {
                    let rms = of(class, |g| g.rms);
                    let best = least(&rms, |v| v);
                    tell(
                        "hybrid 2 has the least RMS",
                        class,
                        group,
                        best == Some(ModelKind::Hybrid2),
                        text(&rms),
                    );
                    let damage = of(class, |g| g.damage_ratio);
                    let best = least(&damage, from_one);
                    let holds = best == Some(ModelKind::Hybrid2);
                    tell("hybrid 2 has the damage nearest to 1", class, group, holds, text(&damage));
                }
                let rms = of("N2", |g| g.rms);
                let holds = least(&rms, |v| v) == Some(ModelKind::Frf);
                tell("networks have a larger RMS than the FRF", "N2", group, holds, text(&rms));
            }
            Task::VirtualSensing => {
                for class in SERVICE {
                    let rms = of(class, |g| g.rms);
                    let frf = rms.iter().find(|(kind, _)| *kind == ModelKind::Frf).map_or(0.0, |(_, v)| *v);
                    let others = rms.iter().filter(|(kind, _)| *kind != ModelKind::Frf);
                    let holds = others.map(|(_, v)| *v).fold(0.0, f64::max) < 0.5 * frf;
                    tell("networks have less than half the FRF's RMS", class, group, holds, text(&rms));
                    let multi_rain = of(class, |g| g.multi_rain);
                    let holds = least(&multi_rain, from_one) == Some(ModelKind::Hybrid2);
                    tell("hybrid 2 has the Multi-Rain nearest to 1", class, group, holds, text(&multi_rain));
                    let psd = of(class, |g| g.psd_rms);
                    let best = least(&psd, |v| v);
                    let holds = matches!(best, Some(ModelKind::Lstm | ModelKind::Hybrid1));
                    tell("LSTM or hybrid 1 has the least PSD RMS", class, group, holds, text(&psd));
                }
            }
        }
    }
}

/// The kind with the least of a figure.
fn least(found: &[(ModelKind, f64)], of: impl Fn(f64) -> f64) -> Option<ModelKind> {
    found.iter().min_by(|a, b| of(a.1).total_cmp(&of(b.1))).map(|(kind, _)| *kind)
}

fn text(found: &[(ModelKind, f64)]) -> String {
    let one = |(kind, value): &(ModelKind, f64)| format!("{} {value:.4}", kind.as_str());
    found.iter().map(one).collect::<Vec<_>>().join(", ")
}
