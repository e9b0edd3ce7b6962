//! Predicts the withheld loads with each model and tabulates the errors.

use comfy_table::presets::UTF8_FULL_CONDENSED;
use comfy_table::{CellAlignment, Table};
use serde_json::{Value, json};

use super::{DemoError, KINDS, bars};
use crate::client::Client;
use crate::engine::metrics::geometric_mean;

/// An uploaded test run and the column of the table that it belongs to.
pub struct TestRun {
    /// Run id.
    pub id: String,
    /// `N1`, `N2`, `SL`, `SL-` or `SL+`.
    pub column: &'static str,
}

/// Columns of the table.
pub const COLUMNS: [&str; 5] = ["N1", "N2", "SL", "SL-", "SL+"];

/// Says how to read the table.
pub const LEGEND: &str = "\
Errors are relative to the withheld response, mean over three channels and over a column's runs.
RMS: root of squared error over squared response, the preload counts. AC: the same about the means, over the
response's standard deviation. PSD: RMS of the spectra, each segment's mean removed. Damage: predicted / measured
Multi-Rain damage of the forces (500 directions, k = 5, residue repeated), geometric mean over a column's runs.";

/// The errors of a prediction that are shown: field of the contract and name.
const ERRORS: [(&str, &str); 3] = [("rms", "RMS"), ("rms_ac", "AC"), ("psd_rms", "PSD")];

/// The groups of channels: what their names begin with, and what they are.
const GROUPS: [(&str, &str); 2] = [("disp_", "displacement"), ("force_", "force")];

/// Figures of one model on one run.
struct Score {
    /// Of each group, by [`GROUPS`] and [`ERRORS`].
    errors: [[f64; ERRORS.len()]; GROUPS.len()],
    damage_ratio: f64,
}

/// Predicts every run with every model, and tabulates the means per column ([`LEGEND`]).
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
    for (g, (_, group)) in GROUPS.iter().enumerate() {
        for (e, (_, error)) in ERRORS.iter().enumerate() {
            let cell = |scores: &[&Score]| {
                let sum: f64 = scores.iter().map(|score| score.errors[g][e]).sum();
                format!("{:.2} %", 100.0 * sum / scores.len() as f64)
            };
            add_rows(&mut table, &format!("{group} {error}"), &rows, cell);
        }
    }
    add_rows(&mut table, "damage ratio", &rows, |scores| {
        let ratios: Vec<f64> = scores.iter().map(|score| score.damage_ratio).collect();
        geometric_mean(&ratios).map_or("-".into(), |ratio| format!("{ratio:.3}"))
    });
    for column in table.column_iter_mut().skip(2) {
        column.set_cell_alignment(CellAlignment::Right);
    }
    Ok(table)
}

/// A line a model of one figure, which is `cell` of a column's runs.
fn add_rows(
    table: &mut Table,
    name: &str,
    rows: &[(&str, Vec<(&str, Score)>)],
    cell: impl Fn(&[&Score]) -> String,
) {
    for (i, (label, scores)) in rows.iter().enumerate() {
        let head = if i == 0 { name } else { "" };
        let cells = COLUMNS.iter().map(|column| {
            let of: Vec<&Score> = scores.iter().filter(|(c, _)| c == column).map(|(_, s)| s).collect();
            if of.is_empty() { "-".into() } else { cell(&of) }
        });
        table.add_row([head.to_owned(), (*label).to_owned()].into_iter().chain(cells));
    }
}

async fn score_all(
    client: &Client,
    rig: &str,
    version: u64,
    runs: &[TestRun],
    bar: &bars::Bar,
) -> Result<Vec<(&'static str, Score)>, DemoError> {
    let mut scores = Vec::new();
    for run in runs {
        let request = json!({"model": version, "drive": {"run": run.id}, "target": {"run": run.id},
                             "include": ["damage", "errors"]});
        let answer = client.post(&format!("/v1/rigs/{rig}/predict"), &request).await?;
        scores.push((
            run.column,
            Score {
                errors: GROUPS.map(|(prefix, _)| ERRORS.map(|(field, _)| mean(&answer, prefix, field))),
                damage_ratio: answer["damage"]["groups"]["force"]["ratio"].as_f64().unwrap_or(f64::NAN),
            },
        ));
        bar.inc(1);
    }
    Ok(scores)
}

/// Mean of an error over the channels whose name starts with `prefix`.
fn mean(answer: &Value, prefix: &str, field: &str) -> f64 {
    let channels = answer["errors"]["channels"].as_object().into_iter().flatten();
    let found: Vec<f64> = channels
        .filter(|(name, _)| name.starts_with(prefix))
        .filter_map(|(_, errors)| errors[field].as_f64())
        .collect();
    found.iter().sum::<f64>() / found.len() as f64
}
