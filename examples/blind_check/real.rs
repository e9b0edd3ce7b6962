//! Diagnoses folders of measured data, over HTTP.
//!
//! `silverbox`: the FRF of the first fifth of `test_arrow`, where the level is low, is the sim from before the
//! change; the rest is diagnosed. The others have no low level: the FRF of the training run is the sim, and
//! has taken in what a linear model can (`in_situ`); the test run is diagnosed.

use std::ops::Range;
use std::path::{Path, PathBuf};
use std::time::Instant;

use rigcast::client::Client;
use rigcast::demo::LocalService;
use rigcast::formats::npy::{self, Dtype, Order};
use serde_json::{Value, json};

use crate::AnyError;
use crate::diagnose::session::Session;
use dataset::{Dataset, TestFile};

#[path = "../support/dataset.rs"]
#[expect(dead_code, reason = "other programs compare with published figures")]
mod dataset;

/// Command line.
#[derive(Debug, clap::Args)]
pub struct Args {
    /// Folder of data sets, or one data set with its `about.json`.
    #[arg(long)]
    data: PathBuf,
    /// A running service; one is started if left out.
    #[arg(long)]
    service: Option<String>,
    /// Token for the service.
    #[arg(long, env = "RIGCAST_TOKEN", hide_env_values = true)]
    token: Option<String>,
    /// Runs that the diagnosed part is cut into: from eight on whole runs are fitted to, chosen on or
    /// tested on.
    #[arg(long, default_value_t = 12)]
    pieces: usize,
    /// Keep the reports in this folder.
    #[arg(long)]
    reports: Option<PathBuf>,
}

/// Data sets of a folder that holds several.
const SETS: [&str; 3] = ["silverbox", "wiener_hammerstein", "multiaxis_shaker"];

/// Prints verdict, closure and remaining error of each data set.
///
/// # Errors
/// No data, or a service that refuses it.
pub fn run(args: &Args) -> Result<(), AnyError> {
    let folders: Vec<PathBuf> = if args.data.join("about.json").exists() {
        vec![args.data.clone()]
    } else {
        SETS.iter().map(|set| args.data.join(set)).collect()
    };
    let runtime = tokio::runtime::Builder::new_multi_thread().enable_all().build()?;
    runtime.block_on(async {
        let own = match args.service {
            Some(_) => None,
            None => Some(LocalService::start(([127, 0, 0, 1], 0).into(), None).await?),
        };
        let url = own.as_ref().map(LocalService::url).or(args.service.clone()).ok_or("no service")?;
        let client = Client::new(&url, args.token.as_deref())?;
        for folder in folders {
            let began = Instant::now();
            let (data, report) = diagnose(&client, &folder, args.pieces).await?;
            print(&data, &report, began.elapsed().as_secs_f64());
            if let Some(dir) = &args.reports {
                std::fs::create_dir_all(dir)?;
                std::fs::write(
                    dir.join(format!("{}.json", data.id())),
                    serde_json::to_string_pretty(&report)?,
                )?;
            }
        }
        if let Some(own) = own {
            own.stop().await?;
        }
        Ok(())
    })
}

async fn diagnose(client: &Client, folder: &Path, pieces: usize) -> Result<(Dataset, Value), AnyError> {
    let data = Dataset::open(folder, None)?;
    let mut session = Session::open(client, &data.rig()).await?;
    let mut tests = data.tests()?;
    let (mode, test, from) = if data.id() == "silverbox" {
        let at = tests.iter().position(|t| t.name == "test_arrow").ok_or("no test_arrow")?;
        let arrow = tests.swap_remove(at);
        let low = arrow.drive[0].len() / 5;
        let file = npy(&arrow, 0..low)?;
        session.upload("baseline", "noise", &started_at(0), "application/x-npy", file).await?;
        ("external", arrow, low)
    } else {
        for (_, content_type, file) in data.training()? {
            session.upload("baseline", "noise", &started_at(0), content_type, file).await?;
        }
        ("in_situ", tests.swap_remove(0), 0)
    };
    let runs = upload(&mut session, &test, from, pieces).await?;
    let runs: Vec<&str> = runs.iter().map(String::as_str).collect();
    let model = session.fit(&json!({"kind": "frf"}), &["baseline"]).await?;
    let request = json!({"model": model, "mode": mode, "baseline_runs": session.ids(&["baseline"])?,
                         "runs": session.ids(&runs)?});
    let (_, report) = session.diagnose(&request).await?;
    client.delete(&format!("/v1/rigs/{}", data.id())).await?;
    Ok((data, report))
}

/// Uploads the samples after `from` as runs of equal length and returns their names.
async fn upload(
    session: &mut Session<'_>,
    test: &TestFile,
    from: usize,
    pieces: usize,
) -> Result<Vec<String>, AnyError> {
    let length = (test.drive[0].len() - from) / pieces.max(1);
    let mut names = Vec::new();
    for piece in 0..pieces.max(1) {
        let start = from + piece * length;
        let name = format!("{}-{piece}", test.name);
        let file = npy(test, start..start + length)?;
        session.upload(&name, "other", &started_at(piece + 1), "application/x-npy", file).await?;
        names.push(name);
    }
    Ok(names)
}

/// Drives and responses of some samples as an NPY file.
fn npy(test: &TestFile, samples: Range<usize>) -> Result<Vec<u8>, AnyError> {
    let channels = test.drive.iter().chain(&test.response);
    let part: Vec<Vec<f64>> = channels.map(|c| c[samples.clone()].to_vec()).collect();
    Ok(npy::write(&part, Dtype::F8, Order::C)?)
}

/// A time of day that gives the pieces their order.
fn started_at(minute: usize) -> String {
    format!("2026-03-02T{:02}:{:02}:00Z", minute / 60, minute % 60)
}

fn print(data: &Dataset, report: &Value, seconds: f64) {
    let verdict = &report["verdict"];
    let (factor, unit) = data.display_unit();
    println!(
        "{}: {} {} (family {}, channel {}, probability {}), {seconds:.1} s",
        data.id(),
        verdict["kind"],
        verdict["effect"],
        verdict["family"],
        verdict["channel"],
        verdict["probability"],
    );
    println!("  cannot be told apart: {}; warnings: {}", verdict["equivalence_set"], report["warnings"]);
    for hypothesis in report["hypotheses"].as_array().into_iter().flatten().take(3) {
        let held = &hypothesis["held_out"];
        let rms = |key: &str| held[key].as_f64().unwrap_or(f64::NAN) * factor;
        println!(
            "  {} on {}: closure {:.4} {}, RMS {:.4} -> {:.4} {unit} (noise {:.4})",
            hypothesis["effect"],
            hypothesis["channel"],
            held["closure"].as_f64().unwrap_or(f64::NAN),
            held["closure_ci90"],
            rms("rms_before"),
            rms("rms_after"),
            rms("noise_rms"),
        );
    }
}
