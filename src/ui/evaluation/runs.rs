//! The runs of an evaluation, and what was left out.

use maud::{Markup, html};

use crate::domain::evaluation::{EvaluatedRun, EvaluationReport, Omission, Seen};
use crate::ui::text::{listed, number, percent};
use crate::ui::words::clamped;

/// Most runs that the page lists; all are in the report as JSON.
const MOST_RUNS: usize = 200;

/// A run's name, or its id where it has none.
pub fn name(run: &EvaluatedRun) -> String {
    if run.name.is_empty() { run.id.to_string() } else { run.name.clone() }
}

/// The section.
pub fn section(report: &EvaluationReport) -> Markup {
    let hidden = report.runs.len().saturating_sub(MOST_RUNS);
    html! {
        h2 id="runs" { "Runs" }
        div.scroll { table.figures {
            thead { tr {
                th.text { "Run" } th.text { "Kind" } th { "Length in s" } th.text { "Fitted on" } th { "Worst RMS by model" }
            } }
            tbody {
                @for run in report.runs.iter().take(MOST_RUNS) {
                    tr {
                        td.text { (clamped(&name(run))) }
                        td.text { (run.kind.as_str()) }
                        td { (number(run.duration_s)) }
                        td.text { (fitted_on(report, run)) }
                        td { (errors(report, run)) }
                    }
                }
            }
        } }
        @if hidden > 0 { p.soft { (hidden) " more runs are in the report as JSON." } }
        (omitted(report))
    }
}

/// The models that a run shaped.
fn fitted_on(report: &EvaluationReport, run: &EvaluatedRun) -> String {
    let of = |r: &&crate::domain::evaluation::RunResult| r.run == run.id && r.seen.is_some_and(Seen::shaped);
    let versions: Vec<String> = report.results.iter().filter(of).map(|r| r.model.to_string()).collect();
    if versions.is_empty() { String::new() } else { format!("version {}", listed(&versions, "and")) }
}

/// The largest channel error of each model.
fn errors(report: &EvaluationReport, run: &EvaluatedRun) -> String {
    let of_run = report.results.iter().filter(|result| result.run == run.id);
    let errors = of_run.map(|result| {
        let channels = result.figures.channels.values().filter_map(|figures| figures.errors.rms);
        let worst = channels.fold(None, |worst: Option<f64>, rms| Some(worst.map_or(rms, |w| w.max(rms))));
        format!("{}: {}", result.model, worst.map_or("–".to_owned(), percent))
    });
    errors.collect::<Vec<_>>().join(", ")
}

fn omitted(report: &EvaluationReport) -> Markup {
    if report.omitted.is_empty() {
        return html! {};
    }
    let run = |id| report.runs.iter().find(|run| run.id == id).map_or_else(String::new, name);
    html! {
        h3 { "Not compared" }
        ul {
            @for left in report.omitted.iter().take(MOST_RUNS) {
                li {
                    "Version " (left.model) " on " (run(left.run)) ": "
                    (match left.reason {
                        Omission::MissingChannels => "the run lacks ",
                        Omission::SampleRate => "the run has another sample rate",
                        Omission::NotFinite => "the prediction or its damage is not finite ",
                    })
                    (left.channels.join(", "))
                }
            }
        }
    }
}
