//! The search of settings: its trials.

use maud::{Markup, html};

use crate::domain::study::{SearchReport, Trial};
use crate::ui::figures::Drawing;
use crate::ui::plot::{Axis, Figure, Key, Mark, Scale, Style};
use crate::ui::text::{number, percent};

/// The best so far, in a sentence.
pub(super) fn best(report: &SearchReport) -> Markup {
    html! {
        @if let Some(best) = &report.best && let Some(error) = best.error {
            p.figure-of { (percent(error)) }
            p.soft { "RMS error of trial " (best.trial) ", the best: " (settings(best)) }
        }
    }
}

/// Every trial, in the order in which they were done.
pub(super) fn table(report: &SearchReport) -> Markup {
    html! {
        div.wide { table.full {
            thead { tr { th.number { "Trial" } th.number { "Rung" } th.number { "Epochs" } th { "Settings" } th.number { "Error" } th { "" } } }
            tbody { @for trial in &report.trials { tr {
                td.number { (trial.trial) }
                td.number { (trial.rung) }
                td.number { (trial.epochs.map_or_else(|| "–".into(), |epochs| epochs.to_string())) }
                td { (settings(trial)) }
                td.number { (trial.error.map_or_else(|| "–".into(), percent)) }
                td.soft { (trial.reason.as_deref().unwrap_or_default()) }
            } } }
        } }
    }
}

/// What a trial varies, in words.
fn settings(trial: &Trial) -> String {
    let lstm = &trial.settings.lstm;
    let cells = lstm.blocks.as_ref().map(|blocks| {
        format!("cells {}", blocks.iter().map(usize::to_string).collect::<Vec<_>>().join(", "))
    });
    let rate = lstm.learning_rate.map(|rate| format!("learning rate {}", number(rate)));
    let window = lstm.window_len.map(|window| format!("window {window}"));
    let hop = lstm.hop.map(|hop| format!("hop {hop}"));
    let batch = lstm.batch_size.map(|batch| format!("batch {batch}"));
    let kind = Some(trial.settings.kind.as_str().to_owned());
    [kind, cells, rate, window, hop, batch].into_iter().flatten().collect::<Vec<_>>().join(" · ")
}

/// Errors by trial, a colour for each rung.
pub(super) fn figure(report: &SearchReport, size: (f64, f64)) -> Drawing {
    let known = || report.trials.iter().filter_map(|trial| Some((trial, trial.error.filter(|e| *e > 0.0)?)));
    if known().next().is_none() {
        return Drawing::Nothing("No trial has an error yet.".into());
    }
    let last = report.trials.iter().map(|trial| trial.rung).max().unwrap_or_default();
    let dots = |rung: usize| {
        let of_rung = || known().filter(move |(trial, _)| trial.rung == rung);
        Mark::Dots {
            x: of_rung().map(|(trial, _)| trial.trial as f64).collect(),
            y: of_rung().map(|(_, error)| 100.0 * error).collect(),
            style: Style::Series(rung),
            radius: 4.0,
            name: format!("rung {rung}"),
        }
    };
    Figure {
        id: "errors".into(),
        title: "Errors of the trials".into(),
        description: "RMS error of each trial, by the share of the epochs that it had".into(),
        size,
        x: (Axis::around(Scale::Linear, known().map(|(trial, _)| trial.trial as f64)), "Trial".into()),
        y: (Axis::around(Scale::Log, known().map(|(_, error)| 100.0 * error)), "RMS error in %".into()),
        key: Key::Above,
        marks: (0..=last).map(dots).collect(),
    }
    .into()
}
