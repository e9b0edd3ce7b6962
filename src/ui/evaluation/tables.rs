//! The tables of a class.

use maud::{Markup, html};

use super::named;
use crate::domain::evaluation::{ClassRow, EvaluationReport};
use crate::engine::evaluation::GroupAverage;
use crate::ui::text::{number, percent};
use crate::ui::words::clamped;

/// One row a group and model, the groups one after the other.
pub fn groups(report: &EvaluationReport, rows: &[&ClassRow]) -> Markup {
    let against = rows.iter().any(|row| row.difference.is_some());
    html! {
        div.scroll { table.figures {
            thead { tr {
                th.text { "Group" } th.text { "Model" } th { "RMS" } th { "PSD RMS" } th { "Damage ratio" } th { "Multi-Rain" }
                th { "Inside" }
                @if against { th { "RMS to baseline" } }
            } }
            tbody {
                @for group in &report.groups {
                    @let lowest = lowest(rows, &group.name);
                    @for row in rows {
                        @if let Some(average) = row.average.groups.get(&group.name) {
                            tr {
                                td.text { (clamped(&group.name)) }
                                td.text { (named(report, row.model)) }
                                (figures(average, average.rms.is_some() && average.rms == lowest))
                                td { (row.inside.map_or(none(), percent)) }
                                @if against { td { (to_baseline(row, &group.name)) } }
                            }
                        }
                    }
                }
            }
        } }
    }
}

fn lowest(rows: &[&ClassRow], group: &str) -> Option<f64> {
    let errors = rows.iter().filter_map(|row| row.average.groups.get(group)?.rms);
    errors.reduce(f64::min).filter(|_| rows.len() > 1)
}

fn figures(average: &GroupAverage, best: bool) -> Markup {
    html! {
        td.best[best] { (average.rms.map_or(none(), percent)) }
        td { (average.psd_rms.map_or(none(), percent)) }
        td { (average.damage_ratio.map_or(none(), number)) }
        td { (average.multi_rain.map_or(none(), number)) }
    }
}

/// The difference in points of percent.
fn to_baseline(row: &ClassRow, group: &str) -> String {
    let difference = row.difference.as_ref().and_then(|d| d.figures.groups.get(group)?.errors.rms);
    difference.map_or(String::new(), |rms| {
        let sign = if rms > 0.0 { "+" } else { "" };
        format!("{sign}{}", number(100.0 * rms))
    })
}

/// One row a channel and model.
pub fn channels(report: &EvaluationReport, rows: &[&ClassRow]) -> Markup {
    html! {
        div.scroll { table.figures {
            thead { tr {
                th.text { "Channel" } th.text { "Model" } th { "RMS" } th { "RMS about the mean" } th { "PSD RMS" } th { "Damage ratio" }
            } }
            tbody {
                @for channel in &report.channels {
                    @for row in rows {
                        @if let Some(average) = row.average.channels.get(&channel.name) {
                            tr {
                                td.text { (clamped(&channel.name)) }
                                td.text { (named(report, row.model)) }
                                td { (average.rms.map_or(none(), percent)) }
                                td { (average.rms_ac.map_or(none(), percent)) }
                                td { (average.psd_rms.map_or(none(), percent)) }
                                td { (average.damage_ratio.map_or(none(), number)) }
                            }
                        }
                    }
                }
            }
        } }
    }
}

/// In place of a figure that is absent.
fn none() -> String {
    "–".to_owned()
}
