//! The averages of an evaluation as a table: one row a class, model and group, and one a channel below its group.

use std::io;

use crate::domain::evaluation::{ClassRow, EvaluationReport};

/// Columns.
const HEAD: [&str; 17] = [
    "class",
    "model",
    "kind",
    "runs",
    "duration_s",
    "inside",
    "group",
    "channel",
    "rms",
    "rms_ac",
    "psd_rms",
    "damage_ratio",
    "multi_rain",
    "rms_difference",
    "psd_rms_difference",
    "damage_ratio_to_baseline",
    "multi_rain_to_baseline",
];

/// Writes the table; a figure that is absent is an empty cell.
///
/// # Errors
/// None: memory takes what is written.
pub fn write(report: &EvaluationReport) -> io::Result<Vec<u8>> {
    let mut table = csv::Writer::from_writer(Vec::new());
    table.write_record(HEAD)?;
    for row in &report.table {
        for group in &report.groups {
            let Some(average) = row.average.groups.get(&group.name) else { continue };
            let difference = row.difference.as_ref().and_then(|d| d.figures.groups.get(&group.name));
            let errors = difference.map(|d| d.errors);
            let figures = [
                average.rms,
                average.rms_ac,
                average.psd_rms,
                average.damage_ratio,
                average.multi_rain,
                errors.and_then(|d| d.rms),
                errors.and_then(|d| d.psd_rms),
                errors.and_then(|d| d.damage_ratio),
                difference.and_then(|d| d.multi_rain),
            ];
            table.write_record(record(report, row, [&group.name, ""], figures))?;
            for name in &group.channels {
                let Some(average) = row.average.channels.get(name) else { continue };
                let difference = row.difference.as_ref().and_then(|d| d.figures.channels.get(name));
                let figures = [
                    average.rms,
                    average.rms_ac,
                    average.psd_rms,
                    average.damage_ratio,
                    None,
                    difference.and_then(|d| d.rms),
                    difference.and_then(|d| d.psd_rms),
                    difference.and_then(|d| d.damage_ratio),
                    None,
                ];
                table.write_record(record(report, row, [&group.name, name], figures))?;
            }
        }
    }
    table.into_inner().map_err(|error| io::Error::other(error.to_string()))
}

fn record(
    report: &EvaluationReport,
    row: &ClassRow,
    [group, channel]: [&str; 2],
    figures: [Option<f64>; 9],
) -> Vec<String> {
    let number = |value: Option<f64>| value.map_or_else(String::new, |value| value.to_string());
    let kind = report.models.iter().find(|model| model.version == row.model).map_or("", |m| m.kind.as_str());
    let head = [
        row.class.clone(),
        row.model.to_string(),
        kind.to_owned(),
        row.runs.to_string(),
        row.duration_s.to_string(),
        number(row.inside),
        group.to_owned(),
        channel.to_owned(),
    ];
    head.into_iter().chain(figures.map(number)).collect()
}
