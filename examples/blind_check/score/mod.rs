//! Compares reports with labels: the table of figures with its bars, and a confusion matrix. Reads JSON
//! and nothing else.

use std::fs;
use std::path::Path;
use std::sync::Arc;

use comfy_table::Table;
use comfy_table::presets::UTF8_FULL_CONDENSED;
use serde_json::{Value, json};

use crate::AnyError;
use crate::seeds;
use case::Case;
use row::Row;

mod calibration;
mod case;
mod closure;
mod confusion;
mod leaks;
mod next;
mod pooled;
mod row;
mod statistics;
mod suites;
mod times;

/// Prints the table, writes `score.json`, and returns whether every bar is reached.
///
/// # Errors
/// Labels or reports that are missing or not JSON.
pub fn run(dir: &Path) -> Result<bool, AnyError> {
    let read = |path: &Path| -> Result<Value, AnyError> {
        let bytes = fs::read(path).map_err(|e| format!("{}: {e}", path.display()))?;
        Ok(serde_json::from_slice(&bytes)?)
    };
    let labels = read(&dir.join("labels.json"))?;
    let mut cases = Vec::new();
    for label in labels["cases"].as_array().into_iter().flatten() {
        let word = |key: &str| label[key].as_str().unwrap_or_default().to_owned();
        let answer = Arc::new(read(&dir.join("reports").join(format!("{}.json", word("id"))))?);
        cases.push(Case { id: word("id"), suite: word("suite"), label: label.clone(), answer });
    }
    let truth = |case: &Case| read(&dir.join("truth").join(format!("{}.json", case.id))).ok();
    let is_whole = ["catalogue", "nothing", "next-experiment"]
        .iter()
        .all(|suite| cases.iter().filter(|c| c.suite == *suite).count() >= 200);
    let mut rows = suites::rows(&cases);
    rows.extend(closure::rows(&cases, truth));
    rows.extend(calibration::rows(&cases));
    rows.extend(next::rows(&cases));
    rows.extend(leaks::rows(&cases));
    rows.extend(times::rows(&cases, dir, is_whole));

    println!("{}", confusion::table(&cases));
    let verdicts = calibration::verdicts(&cases);
    for (i, bin) in calibration::bins(&verdicts).iter().enumerate().filter(|(_, bin)| bin.count > 0) {
        let from = i as f64 / 10.0;
        println!(
            "probability from {from:.1}: {} verdicts, stated {:.2}, true {:.2}",
            bin.count, bin.stated, bin.found
        );
    }
    for case in cases.iter().filter(|c| !c.answer["error"].is_null()) {
        println!("case {} ({}): {}", case.id, case.suite, case.answer["error"]);
    }
    println!("{}", table(&rows));
    let reached = rows.iter().all(|row| row.passes() != Some(false));
    let summary = json!({
        "seeds": labels["seeds"], "round": labels["round"], "reached": reached,
        "rows": rows.iter().map(Row::json).collect::<Vec<_>>(),
        "cases": cases.iter().map(line).collect::<Vec<_>>(),
    });
    fs::write(dir.join("score.json"), serde_json::to_string_pretty(&summary)?)?;
    if labels["seeds"] == "final" {
        // What is stated of final rounds is what all of them found together.
        return Ok(final_runs(&labels, &rows)? && reached);
    }
    Ok(reached)
}

fn table(rows: &[Row]) -> Table {
    let mut table = Table::new();
    table.load_style(UTF8_FULL_CONDENSED);
    table.set_header(["figure", "found", "95 % interval", "bar", ""]);
    table.add_rows(rows.iter().map(Row::cells));
    table
}

/// One line per case, to find the cases that went wrong.
fn line(case: &Case) -> Value {
    json!({"id": case.id, "suite": case.suite, "label": case.label, "kind": case.kind(), "stated": case.stated(),
           "probability": case.verdict()["probability"], "right": case.is_right(),
           "verdict_is_true": case.verdict_is_true(), "elapsed_s": case.report()["elapsed_s"]})
}

/// Enters the figures of a final round once, prints every final run that there was and what they found together, and
/// returns whether the bars are reached by all of them pooled.
fn final_runs(labels: &Value, rows: &[Row]) -> Result<bool, AnyError> {
    let log = Path::new(labels["log"].as_str().ok_or("labels without a log")?);
    let is_this = |line: &Value| line["event"] == "scored" && line["round"] == labels["round"];
    if !seeds::logged(log)?.iter().any(is_this) {
        let figures: serde_json::Map<String, Value> = rows
            .iter()
            .map(|row| {
                let [name, value, ..] = row.cells();
                (name, Value::from(value))
            })
            .collect();
        let missed = rows.iter().filter(|row| row.passes() == Some(false)).count();
        let line = json!({"event": "scored", "round": labels["round"], "missed": missed, "figures": figures,
                          "shares": pooled::shares(rows)});
        seeds::append(log, &line)?;
    }
    let lines = seeds::logged(log)?;
    println!("final runs so far:");
    for line in &lines {
        match line["event"].as_str() {
            Some("generated") => println!("  round {} made at {}", line["round"], line["at"]),
            Some("lost") => println!("  round {} lost: {}", line["round"], line["why"]),
            _ => println!("  round {} scored, {} bars missed", line["round"], line["missed"]),
        }
    }
    let pooled = pooled::rows(&lines, rows);
    println!("rounds {:?} pooled:", pooled::rounds(&lines));
    println!("{}", table(&pooled));
    Ok(pooled.iter().all(|row| row.passes() != Some(false)))
}
