//! The page of an evaluation: per class of runs a table of the models' errors, their damage ratios, and the spectra.

mod class;
mod form;
mod runs;
mod tables;
#[cfg(test)]
mod tests;

use maud::{Markup, html};

use super::figures::Drawing;
use super::frame::{self, Frame, Section, Visitor};
use super::text::{listed, percent};
use super::words::{clamped, sentence};
use crate::domain::evaluation::{ClassRow, EvaluatedModel, EvaluationReport};
use crate::domain::{EvaluationRequest, StoredEvaluation};

pub use form::form;

/// Most plots of spectra on a page; the others are in the report as JSON.
const MOST_SPECTRA: usize = 24;

/// The report as a document that is complete in itself: no scripts, no other files.
pub fn page(rig_name: &str, of: &StoredEvaluation, report: &EvaluationReport) -> String {
    frame::alone(&title(rig_name), &content(rig_name, of, report, None))
}

/// The report as a page of the service.
pub fn framed(visitor: &Visitor, rig_name: &str, of: &StoredEvaluation, report: &EvaluationReport) -> String {
    let title = title(rig_name);
    let rig = format!("/rigs/{}", of.summary.rig);
    let mut frame =
        Frame::new(&title, Section::Rigs, visitor).below(&[("/".into(), "Rigs"), (rig, rig_name)]);
    frame.class = "report";
    frame.scripts = &[];
    let at = format!("/rigs/{}/evaluations/{}", of.summary.rig, of.summary.id);
    frame.page(&content(rig_name, of, report, Some(&at)))
}

/// The plot of this name.
///
/// # Errors
/// The names of all plots, where there is no such one.
pub fn drawing(report: &EvaluationReport, name: &str) -> Result<Drawing, String> {
    let mut all: Vec<(String, Drawing)> = Vec::new();
    for (k, rows) in
        classes(report).iter().enumerate().filter(|(_, rows)| rows.iter().any(|row| row.runs > 0))
    {
        let ratios = class::ratios(k, report, rows);
        all.push((ratios.id.clone(), ratios.into()));
        all.extend(class::spectra(k, report, rows).map(|figure| (figure.id.clone(), figure.into())));
    }
    match all.iter().position(|(id, _)| id == name) {
        Some(place) => Ok(all.swap_remove(place).1),
        None => Err(all.into_iter().map(|(id, _)| id).collect::<Vec<_>>().join(", ")),
    }
}

fn title(rig_name: &str) -> String {
    format!("Evaluation of models of {rig_name}")
}

fn content(rig_name: &str, of: &StoredEvaluation, report: &EvaluationReport, at: Option<&str>) -> Markup {
    let mut spectra_left = MOST_SPECTRA;
    let sections: Vec<Markup> = classes(report)
        .into_iter()
        .enumerate()
        .map(|(k, rows)| class::section(k, report, &rows, &mut spectra_left, at))
        .collect();
    html! {
        (header(rig_name, of, report))
        @for section in &sections { (section) }
        @if spectra_left == 0 { p.soft { "Further spectra are in the report as JSON." } }
        (runs::section(report))
        (method(&of.request, report))
    }
}

/// The rows of each class.
fn classes(report: &EvaluationReport) -> Vec<Vec<&ClassRow>> {
    let mut classes: Vec<Vec<&ClassRow>> = Vec::new();
    for row in &report.table {
        match classes.last_mut() {
            Some(rows) if rows[0].class == row.class => rows.push(row),
            _ => classes.push(vec![row]),
        }
    }
    classes
}

fn header(rig_name: &str, of: &StoredEvaluation, report: &EvaluationReport) -> Markup {
    let summary = &of.summary;
    let names: Vec<String> = report.models.iter().map(name).collect();
    html! {
        header {
            p.over { "Models on runs" }
            h1 { (clamped(rig_name)) }
            p.soft {
                (summary.rig.as_str()) " · " (listed(&names, "and")) " on " (report.runs.len())
                @if report.runs.len() == 1 { " run" } @else { " runs" }
                " · " (summary.created_at.strftime("%Y-%m-%d %H:%M UTC").to_string())
            }
        }
        section.verdict {
            p.label { "Lowest mean error" }
            ul {
                @for rows in classes(report) { li { (best_in_words(report, &rows)) } }
            }
        }
        @if !report.warnings.is_empty() {
            ul { @for warning in &report.warnings { li { (sentence(warning)) } } }
        }
    }
}

/// The model with the lowest RMS error, as the mean over the channels that all models of the class predict.
fn best_in_words(report: &EvaluationReport, rows: &[&ClassRow]) -> String {
    let class = &rows[0].class;
    let with_runs: Vec<&&ClassRow> = rows.iter().filter(|row| row.runs > 0).collect();
    let shared: Vec<&String> = with_runs.first().map_or(Vec::new(), |first| {
        let all = |name: &&String| {
            with_runs.iter().all(|row| row.average.channels.get(*name).is_some_and(|a| a.rms.is_some()))
        };
        first.average.channels.keys().filter(all).collect()
    });
    let mean = |row: &ClassRow| -> f64 {
        let errors = shared.iter().filter_map(|name| row.average.channels[*name].rms);
        errors.sum::<f64>() / shared.len() as f64
    };
    let best =
        with_runs.iter().map(|row| (mean(row), row.model)).reduce(|a, b| if b.0 < a.0 { b } else { a });
    match best.filter(|_| !shared.is_empty()) {
        None if with_runs.is_empty() => format!("{class}: no run counts"),
        None => format!("{class}: the models have no channel in common"),
        Some((error, version)) => {
            format!("{class}: {}, {} over {}", named(report, version), percent(error), channels(shared.len()))
        }
    }
}

fn channels(count: usize) -> String {
    if count == 1 { "one channel".into() } else { format!("{count} channels") }
}

/// A model in words.
fn name(model: &EvaluatedModel) -> String {
    format!("version {} ({})", model.version, model.kind.as_str())
}

fn named(report: &EvaluationReport, version: u32) -> String {
    let model = report.models.iter().find(|model| model.version == version);
    model.map_or_else(|| format!("version {version}"), name)
}

fn method(request: &EvaluationRequest, report: &EvaluationReport) -> Markup {
    let damage = &request.damage;
    let filtered: Vec<String> =
        report.models.iter().filter(|m| !m.preprocess.is_none()).map(|m| m.version.to_string()).collect();
    html! {
        h2 id="method" { "How the figures are made" }
        p {
            "RMS is the error relative to the measured signal, its mean included; PSD RMS the same of the power spectral densities. Both are "
            "means over runs, then over the channels of a group. The damage ratio is predicted over measured pseudo-damage for the "
            "slope " (damage.slope) ", Multi-Rain that of the largest damage over " (damage.directions) " directions; 1 is right, and "
            "averages are geometric."
        }
        p {
            @if request.include_fitted { "Runs that a model was fitted on count in its averages." }
            @else { "Runs that a model was fitted on are left out of its averages." }
            @if !filtered.is_empty() {
                " The measurements were filtered as version " (listed(&filtered, "and")) " asks for, before they were compared with it."
            }
        }
    }
}
