//! Fits and scores models on a folder of measured data, speaking only HTTP.
//!
//! `cargo run --release --example real_data -- ../shared/data/silverbox`
//! `cargo run --release --example real_data -- ../shared/data/multiaxis_shaker --train halves --lstm '{}'`
//!
//! The folder's `about.json` names sample rate, channels, training and test files and the
//! published figures. A service is started on a free port and a temporary directory unless
//! `--url` names one. One JSON line is printed per model and test file, then a table: RMSE is the root of
//! the mean squared error in the unit of the data, NRMSE that relative to the measured standard deviation;
//! both count an error of the mean, as the published figures do. The result for a data set is that of the
//! model with the lowest error on validation data; test files are opened only after the choice.

mod support;

use std::path::PathBuf;

use clap::Parser;
use rigcast::client::{self, Client};
use rigcast::demo::LocalService;
use serde_json::{Value, json};

use support::dataset::{Dataset, TestFile};
use support::table;

/// Command line.
#[derive(Parser)]
struct Args {
    /// Folder with an `about.json`.
    folder: PathBuf,
    /// Of the shaker's data: the run to train on (`run1` or `run2`), or `halves` for the first half of each.
    #[arg(long)]
    train: Option<String>,
    /// A running service; left out: one is started for the occasion.
    #[arg(long)]
    url: Option<String>,
    /// Token for the service.
    #[arg(long, env = "RIGCAST_TOKEN", hide_env_values = true)]
    token: Option<String>,
    /// Only these kinds of model.
    #[arg(long, value_delimiter = ',', default_value = "frf,lstm,hybrid1,hybrid2")]
    kinds: Vec<String>,
    /// Settings of the LSTM part as JSON, over the service's defaults: windows of 512 samples are two
    /// to three ring-downs of a lightly damped system.
    #[arg(long, default_value = r#"{"window_len": 512, "blocks": [40], "batch_size": 16}"#)]
    lstm: String,
}

/// A fitted model, its error and its fit time.
struct FittedModel {
    kind: String,
    version: u64,
    /// Mean over outputs of the RMS error on validation data.
    validation: f64,
    fit_s: f64,
    settings: Value,
}

type AnyError = Box<dyn std::error::Error>;

fn main() -> Result<(), AnyError> {
    let args = Args::parse();
    tokio::runtime::Builder::new_multi_thread().enable_all().build()?.block_on(run(args))
}

async fn run(args: Args) -> Result<(), AnyError> {
    let own = if args.url.is_none() {
        Some(LocalService::start(([127, 0, 0, 1], 0).into(), None).await?)
    } else {
        None
    };
    let url = own.as_ref().map(|o| o.url()).or(args.url);
    let client = Client::new(&url.ok_or("no service")?, args.token.as_deref())?;
    let data = Dataset::open(&args.folder, args.train.as_deref())?;

    client.post("/v1/rigs", &data.rig()).await?;
    for (name, content_type, bytes) in data.training()? {
        let query = [("name", name.as_str()), ("kind", "noise"), ("split", "training")];
        client.upload(data.id(), &query, content_type, bytes).await?;
    }

    let lstm: Value = serde_json::from_str(&args.lstm)?;
    let mut models = Vec::new();
    for kind in &args.kinds {
        let model = fit(&client, &data, kind, &lstm).await?;
        eprintln!("{kind}: validation RMS error {:.5}, fitted in {:.1} s", model.validation, model.fit_s);
        models.push(model);
    }
    let chosen = models.iter().min_by(|a, b| a.validation.total_cmp(&b.validation)).expect("a model").version;
    let active = client.get(&format!("/v1/rigs/{}/active-model", data.id())).await?["version"].as_u64();

    // The test files are read only now.
    let tests = data.tests()?;
    let mut rows = Vec::new();
    for model in &models {
        for test in &tests {
            let score = score(&client, &data, model, test).await?;
            println!("{}", score.line(model, test));
            rows.push((model.kind.clone(), model.version == chosen, test.name.clone(), score));
        }
    }
    let of = |kind: &str, test: &TestFile| {
        rows.iter().find(|(k, _, name, _)| k == kind && *name == test.name).map(|(.., score)| score)
    };
    let active_kind = kind_of(&models, active);
    let worst = tests.iter().filter_map(|test| of(active_kind, test)?.worst_against(of("frf", test)?));
    let worst = worst.fold(f64::NAN, f64::max);
    println!("\n{}", table::compare(&data, &rows));
    println!("RMSE: root of the mean squared error, an error of the mean counts; NRMSE: over the deviation.");
    println!("chosen on validation data: {}", kind_of(&models, Some(chosen)));
    println!(
        "active in the service (if_better): {active_kind}, at most {worst:.3} times the FRF's error on any output"
    );
    if let Some(own) = own {
        own.stop().await?;
    }
    Ok(())
}

fn kind_of(models: &[FittedModel], version: Option<u64>) -> &str {
    models.iter().find(|m| Some(m.version) == version).map_or("none", |m| m.kind.as_str())
}

async fn fit(client: &Client, data: &Dataset, kind: &str, lstm: &Value) -> Result<FittedModel, AnyError> {
    let mut request = json!({"kind": kind});
    if kind != "frf" && lstm.as_object().is_some_and(|o| !o.is_empty()) {
        request["lstm"] = lstm.clone();
    }
    let job = client.fit(data.id(), &request).await?;
    let bar = support::progress::bar(kind);
    let job = client.wait(&job, |job| support::progress::show(&bar, job)).await?;
    bar.finish_and_clear();
    let model = client.fitted_model(&job).await?;
    let report = &model["report"];
    let rms: Vec<f64> =
        report["validation_rms"].as_array().into_iter().flatten().filter_map(Value::as_f64).collect();
    Ok(FittedModel {
        kind: kind.into(),
        version: model["version"].as_u64().ok_or("the model has no version")?,
        validation: rms.iter().sum::<f64>() / rms.len().max(1) as f64,
        fit_s: client::elapsed_s(&job).ok_or("the job has no times")?,
        settings: json!({"frf": report["frf"], "lstm": report["lstm"], "recombine": report["recombine"], "seed": report["best_seed"]}),
    })
}

/// Errors of one model on one test file, per output.
pub struct Score {
    rmse: Vec<f64>,
    nrmse: Vec<f64>,
    unit: String,
}

impl Score {
    /// Largest ratio of the errors of one output.
    fn worst_against(&self, other: &Self) -> Option<f64> {
        self.nrmse.iter().zip(&other.nrmse).map(|(own, other)| own / other).reduce(f64::max)
    }

    fn line(&self, model: &FittedModel, test: &TestFile) -> Value {
        let one_or_all = |v: &[f64]| if v.len() == 1 { json!(v[0]) } else { json!(v) };
        json!({"model": model.kind, "file": test.name, "rmse": one_or_all(&self.rmse), "unit": self.unit,
               "nrmse": one_or_all(&self.nrmse), "fit_s": model.fit_s, "settings": model.settings})
    }
}

/// Predicts a test file and compares after the samples that the data set's users skip.
async fn score(
    client: &Client,
    data: &Dataset,
    model: &FittedModel,
    test: &TestFile,
) -> Result<Score, AnyError> {
    let answer = client
        .predict_npy(data.id(), &model.version.to_string(), data.sample_rate_hz(), test.drive_npy()?)
        .await?;
    let predicted = rigcast::formats::npy::read(&answer.npy)?.channels;
    let skip = data.skip();
    let (factor, unit) = data.display_unit();
    let mut score = Score { rmse: Vec::new(), nrmse: Vec::new(), unit };
    for (p, m) in predicted.iter().zip(&test.response) {
        if p.len() != m.len() {
            return Err(format!("{} samples predicted for {}", p.len(), m.len()).into());
        }
        let (p, m) = (&p[skip..], &m[skip..]);
        let n = m.len() as f64;
        let mean = m.iter().sum::<f64>() / n;
        let std = (m.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / n).sqrt();
        let rmse = (p.iter().zip(m).map(|(p, m)| (p - m).powi(2)).sum::<f64>() / n).sqrt();
        score.rmse.push(rmse * factor);
        score.nrmse.push(rmse / std);
    }
    Ok(score)
}
