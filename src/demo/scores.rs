//! Predicts the withheld loads with each model and tabulates the errors.

use comfy_table::presets::UTF8_FULL_CONDENSED;
use comfy_table::{CellAlignment, Table};
use indicatif::ProgressBar;
use serde_json::{Value, json};

use super::{DemoError, KINDS, bars};
use crate::client::Client;

/// An uploaded test run and the column of the table that it belongs to.
pub struct TestRun {
    /// Run id.
    pub id: String,
    /// `N1`, `N2`, `SL`, `SL-` or `SL+`.
    pub column: &'static str,
}

/// Columns of the table.
pub const COLUMNS: [&str; 5] = ["N1", "N2", "SL", "SL-", "SL+"];

/// Errors of one model on one run.
struct Score {
    displacement_rms: f64,
    force_rms: f64,
    damage_ratio: f64,
}

/// Predicts every run with every model, and tabulates the means per column.
pub async fn table(
    client: &Client,
    rig: &str,
    models: &[(String, u64)],
    runs: &[TestRun],
) -> Result<Table, DemoError> {
    let bar = bars::steps("predicting the loads");
    bar.set_length((models.len() * runs.len()) as u64);
    let mut rows: Vec<(&str, Vec<(&str, Score)>)> = Vec::new();
    for (kind, label) in KINDS {
        let Some((_, version)) = models.iter().find(|(k, _)| k == kind) else { continue };
        rows.push((label, score_all(client, rig, *version, runs, &bar).await?));
    }
    bar.finish_and_clear();

    let mut table = Table::new();
    table.load_style(UTF8_FULL_CONDENSED);
    table.set_header([vec!["", "model"], COLUMNS.to_vec()].concat());
    type Figure = (&'static str, fn(&Score) -> f64, fn(f64) -> String);
    let percent: fn(f64) -> String = |v| format!("{:.2} %", 100.0 * v);
    let figures: [Figure; 3] = [
        ("displacement RMS", |s| s.displacement_rms, percent),
        ("force RMS", |s| s.force_rms, percent),
        ("damage ratio", |s| s.damage_ratio, |v| format!("{v:.3}")),
    ];
    for (name, figure, print) in figures {
        for (i, (label, scores)) in rows.iter().enumerate() {
            let cells = COLUMNS.iter().map(|column| {
                let of: Vec<f64> =
                    scores.iter().filter(|(c, _)| c == column).map(|(_, s)| figure(s)).collect();
                if of.is_empty() { "-".into() } else { print(of.iter().sum::<f64>() / of.len() as f64) }
            });
            let head = if i == 0 { name } else { "" };
            table.add_row([head.to_string(), label.to_string()].into_iter().chain(cells));
        }
    }
    for column in table.column_iter_mut().skip(2) {
        column.set_cell_alignment(CellAlignment::Right);
    }
    Ok(table)
}

async fn score_all(
    client: &Client,
    rig: &str,
    version: u64,
    runs: &[TestRun],
    bar: &ProgressBar,
) -> Result<Vec<(&'static str, Score)>, DemoError> {
    let mut scores = Vec::new();
    for run in runs {
        let request = json!({"model": version, "drive": {"run": run.id}, "target": {"run": run.id},
                             "include": ["damage", "errors"]});
        let answer = client.post(&format!("/v1/rigs/{rig}/predict"), &request).await?;
        scores.push((
            run.column,
            Score {
                displacement_rms: mean_rms(&answer, "disp_"),
                force_rms: mean_rms(&answer, "force_"),
                damage_ratio: answer["damage"]["groups"]["force"]["ratio"].as_f64().unwrap_or(f64::NAN),
            },
        ));
        bar.inc(1);
    }
    Ok(scores)
}

/// Mean RMS error over the channels whose name starts with `prefix`.
fn mean_rms(answer: &Value, prefix: &str) -> f64 {
    let channels = answer["errors"]["channels"].as_object().into_iter().flatten();
    let rms: Vec<f64> = channels
        .filter(|(name, _)| name.starts_with(prefix))
        .filter_map(|(_, e)| e["rms"].as_f64())
        .collect();
    rms.iter().sum::<f64>() / rms.len() as f64
}
