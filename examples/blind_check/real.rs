//! Diagnoses measured data as a user asks: a model that the service fitted, a few runs, nothing else said.
//!
//! Every set is one case or more: runs to fit an FRF to, runs to explain, and runs that neither has seen. Where the
//! verdict may be adopted, the adopted version and the FRF predict those.

use std::path::{Path, PathBuf};
use std::time::Instant;

use rigcast::client::Client;
use rigcast::demo::LocalService;
use rigcast::formats::csv;
use rigcast::formats::npy::{self, Dtype, Order};
use serde_json::{Value, json};

use crate::AnyError;
use crate::diagnose::session::Session;

/// Command line.
#[derive(Debug, clap::Args)]
pub struct Args {
    /// Folder of the data sets.
    #[arg(long)]
    data: PathBuf,
    /// Only cases whose name holds this.
    #[arg(long)]
    only: Option<String>,
    /// A running service; one is started if left out.
    #[arg(long)]
    service: Option<String>,
    /// Token for the service.
    #[arg(long, env = "RIGCAST_TOKEN", hide_env_values = true)]
    token: Option<String>,
    /// Keep the reports in this folder.
    #[arg(long)]
    reports: Option<PathBuf>,
}

/// One request on a set.
struct Case {
    name: &'static str,
    set: &'static str,
    /// Files that the FRF is fitted to.
    model: &'static [&'static str],
    runs: &'static [&'static str],
    unseen: &'static [&'static str],
    /// What the verdict has to be.
    bar: Bar,
}

/// What is asked of a verdict.
enum Bar {
    /// One of these families, in a verdict that blames.
    Family(&'static [&'static str]),
    /// Never that there is no material gap, and a blamed family only if it is one of these.
    NotReassured(&'static [&'static str]),
    /// Undecided, since all runs share one drive.
    Undecided,
    /// No blame.
    Quiet,
}

const CASES: [Case; 8] = [
    Case {
        name: "silverbox",
        set: "silverbox",
        model: &["train"],
        runs: &["train"],
        unseen: &["test_multisine", "test_arrow"],
        bar: Bar::Family(&["stiffness"]),
    },
    Case {
        name: "wiener_hammerstein",
        set: "wiener_hammerstein",
        model: &["train"],
        runs: &["train"],
        unseen: &["test"],
        bar: Bar::Family(&["block_structure", "actuator", "sensor"]),
    },
    Case {
        name: "f16 from the lowest level",
        set: "f16",
        model: &["full_level1"],
        runs: &["full_level3", "full_level5", "full_level7"],
        unseen: &["full_level2", "full_level4", "full_level6"],
        bar: Bar::Family(&["stiffness", "friction_hysteresis"]),
    },
    Case {
        name: "f16 one level",
        set: "f16",
        model: &["full_level5"],
        runs: &["full_level5"],
        unseen: &[],
        bar: Bar::Undecided,
    },
    Case {
        name: "f16 odd multisines",
        set: "f16",
        model: &["odd_level1"],
        runs: &["odd_level1", "odd_level2", "odd_level3"],
        unseen: &[],
        bar: Bar::NotReassured(&["stiffness", "friction_hysteresis"]),
    },
    Case {
        name: "coupled_drives",
        set: "coupled_drives",
        model: &["prbs_05"],
        runs: &["prbs_05", "prbs_10", "prbs_15"],
        unseen: &[],
        bar: Bar::NotReassured(&["sensor", "block_structure"]),
    },
    Case {
        name: "cascaded_tanks",
        set: "cascaded_tanks",
        model: &["train"],
        runs: &["train", "test"],
        unseen: &[],
        bar: Bar::NotReassured(&["stiffness", "damping", "sensor", "actuator", "block_structure"]),
    },
    Case {
        name: "multiaxis_shaker",
        set: "multiaxis_shaker",
        model: &["run1"],
        runs: &["run1", "run2"],
        unseen: &[],
        bar: Bar::Quiet,
    },
];

/// Prints verdict, closure, the error on unseen runs and the bar of each case; whether all bars are met.
///
/// # Errors
/// No data, or a service that refuses it.
pub fn run(args: &Args) -> Result<bool, AnyError> {
    let runtime = tokio::runtime::Builder::new_multi_thread().enable_all().build()?;
    runtime.block_on(async {
        let own = match args.service {
            Some(_) => None,
            None => Some(LocalService::start(([127, 0, 0, 1], 0).into(), None).await?),
        };
        let url = own.as_ref().map(LocalService::url).or(args.service.clone()).ok_or("no service")?;
        let client = Client::new(&url, args.token.as_deref())?;
        let mut met = true;
        let wanted = |case: &&Case| args.only.as_ref().is_none_or(|only| case.name.contains(only.as_str()));
        for case in CASES.iter().filter(wanted) {
            let began = Instant::now();
            match diagnose(&client, &args.data, case).await {
                Ok((report, unseen)) => {
                    met &= print(case, &report, &unseen, began.elapsed().as_secs_f64());
                    if let Some(dir) = &args.reports {
                        std::fs::create_dir_all(dir)?;
                        let path = dir.join(format!("{}.json", case.name.replace(' ', "_")));
                        std::fs::write(path, serde_json::to_string_pretty(&report)?)?;
                    }
                }
                Err(e) => {
                    met = false;
                    println!("{}: MISSED, {e}", case.name);
                }
            }
            // A rig of an earlier case of the set would be in the way.
            let _ = client.delete(&format!("/v1/rigs/{}", case.set)).await;
        }
        if let Some(own) = own {
            own.stop().await?;
        }
        Ok(met)
    })
}

/// Channels of a set by `about.json`: drives, then responses.
fn rig(folder: &Path, set: &str) -> Result<Value, AnyError> {
    let about: Value = serde_json::from_slice(&std::fs::read(folder.join("about.json"))?)?;
    let channel = |name: &str, unit: &str, role: &str, quantity: &str| json!({"name": name, "unit": unit, "role": role, "quantity": quantity});
    let channels: Vec<Value> = match set {
        "multiaxis_shaker" => {
            let drives = (1..=9).map(|i| channel(&format!("input_{i}"), "1", "drive", "acceleration"));
            let responses = (1..=3).map(|i| channel(&format!("output_{i}"), "1", "response", "acceleration"));
            drives.chain(responses).collect()
        }
        "f16" => {
            let responses =
                (1..=3).map(|i| channel(&format!("acc_{i}"), "m/s^2", "response", "acceleration"));
            std::iter::once(channel("force", "N", "drive", "force")).chain(responses).collect()
        }
        _ => ["drive", "response"]
            .into_iter()
            .flat_map(|role| {
                let listed = about[role].as_array().cloned().unwrap_or_default();
                listed.into_iter().map(move |c| {
                    let of = |key: &str| c[key].as_str().unwrap_or("1").to_owned();
                    channel(&of("name"), &of("unit"), role, "other")
                })
            })
            .collect(),
    };
    Ok(json!({"id": set, "name": set, "sample_rate_hz": about["sample_rate_hz"], "channels": channels}))
}

/// Channels of a file of a set.
fn channels(folder: &Path, name: &str) -> Result<Vec<Vec<f64>>, AnyError> {
    let array = folder.join(format!("{name}.npy"));
    if array.exists() {
        return Ok(npy::read(&std::fs::read(array)?)?.channels);
    }
    Ok(csv::read(&std::fs::read(folder.join(format!("{name}.csv")))?)?.channels)
}

/// RMS that the FRF and the adopted version leave of the first response of an unseen file, after 50 samples.
struct Unseen {
    name: &'static str,
    frf: f64,
    adopted: f64,
}

async fn diagnose(client: &Client, data: &Path, case: &Case) -> Result<(Value, Vec<Unseen>), AnyError> {
    let folder = data.join(case.set);
    let rig = rig(&folder, case.set)?;
    let drives = rig["channels"].as_array().into_iter().flatten().filter(|c| c["role"] == "drive").count();
    let rate_hz = rig["sample_rate_hz"].as_f64().ok_or("a rig without a rate")?;
    let mut session = Session::open(client, &rig).await?;
    let mut names: Vec<&str> = case.runs.to_vec();
    names.extend(case.model.iter().filter(|m| !case.runs.contains(m)));
    for (i, name) in names.iter().enumerate() {
        let file = npy::write(&channels(&folder, name)?, Dtype::F8, Order::C)?;
        let at = format!("2026-03-02T{:02}:00:00Z", i);
        session.upload(name, "noise", &at, "application/x-npy", file).await?;
    }
    let model = session.fit(&json!({"kind": "frf"}), case.model).await?;
    let request = json!({"model": model, "runs": session.ids(case.runs)?});
    let (href, report) = session.diagnose(&request).await?;
    let mut unseen = Vec::new();
    let blames = ["identified", "partial", "family_only", "not_distinguishable"];
    if !case.unseen.is_empty() && blames.iter().any(|kind| report["verdict"]["kind"] == *kind) {
        let adopted = session.adopt(&href).await?;
        for name in case.unseen {
            let mut measured = channels(&folder, name)?;
            let responses = measured.split_off(drives);
            let drive = npy::write(&measured, Dtype::F8, Order::C)?;
            let mut left = [0.0; 2];
            for (left, version) in left.iter_mut().zip([model, adopted]) {
                let made = session.predict_file(version, rate_hz, drive.clone()).await?;
                let made = npy::read(&made)?.channels;
                *left = rms(&responses[0], &made[0]);
            }
            unseen.push(Unseen { name, frf: left[0], adopted: left[1] });
        }
    }
    Ok((report, unseen))
}

fn rms(measured: &[f64], made: &[f64]) -> f64 {
    let left = measured.iter().zip(made).skip(50).map(|(y, m)| (y - m).powi(2));
    (left.sum::<f64>() / measured.len().saturating_sub(50).max(1) as f64).sqrt()
}

/// Whether a verdict meets the bar.
fn meets(bar: &Bar, verdict: &Value) -> bool {
    let kind = verdict["kind"].as_str().unwrap_or_default();
    let blames = ["identified", "partial", "family_only", "not_distinguishable"].contains(&kind);
    let family = |families: &[&str]| families.iter().any(|f| verdict["family"] == *f);
    match bar {
        Bar::Family(families) => blames && (family(families) || kind == "not_distinguishable"),
        Bar::NotReassured(families) => {
            kind != "no_material_gap" && (!blames || family(families) || kind == "not_distinguishable")
        }
        Bar::Undecided => kind == "undecided",
        Bar::Quiet => !blames,
    }
}

/// Prints a case; whether its bar is met.
fn print(case: &Case, report: &Value, unseen: &[Unseen], seconds: f64) -> bool {
    let verdict = &report["verdict"];
    let met = meets(&case.bar, verdict);
    println!(
        "{}: {}, {} {} {} {} with {:.2}, {seconds:.1} s",
        case.name,
        if met { "met" } else { "MISSED" },
        verdict["kind"].as_str().unwrap_or_default(),
        verdict["effect"],
        verdict["at"],
        verdict["between"],
        verdict["probability"].as_f64().unwrap_or(f64::NAN),
    );
    println!("  {}", verdict["in_words"].as_str().unwrap_or_default());
    println!(
        "  set {}; gap {}; noise by {}",
        verdict["equivalence_set"], report["gap"], report["noise_floor_source"]
    );
    for hypothesis in report["hypotheses"].as_array().into_iter().flatten().take(3) {
        println!(
            "  {} {} {}: closure {:.4} {} at {}",
            hypothesis["effect"],
            hypothesis["at"],
            hypothesis["between"],
            hypothesis["held_out"]["closure"].as_f64().unwrap_or(f64::NAN),
            hypothesis["held_out"]["closure_ci90"],
            hypothesis["channel"],
        );
    }
    for Unseen { name, frf, adopted } in unseen {
        println!("  {name}: RMS {frf:.6} by the FRF, {adopted:.6} with the effect");
    }
    met
}
