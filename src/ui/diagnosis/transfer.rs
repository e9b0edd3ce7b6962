//! What the best law leaves of runs that it was not fitted to, and the law as a curve.

use maud::{Markup, html};

use super::heading;
use crate::engine::diagnosis::{Hypothesis, Report, TransferRow};
use crate::ui::text::{listed, number, percent, with_unit};

/// The section; empty where repeats decided, or where nothing ran freely.
pub fn section(report: &Report, unit: &str) -> Markup {
    let Some(best) = report.hypotheses.first().filter(|h| !h.transfer.is_empty()) else { return html! {} };
    html! {
        (heading("transfer", "Does it hold elsewhere?"))
        p {
            "Each group of runs was predicted by a linear part, and by the law, that were fitted to all other groups. \
             A cause holds in all of them with the same numbers."
        }
        (table(best, unit))
        @if let Some(strength) = &best.strength {
            p {
                "In terms of " (strength.as_drive) " it does as much as " (with_unit(strength.rms, &strength.unit))
                " RMS, at most " (with_unit(strength.peak, &strength.unit)) ", in the loudest run."
            }
        }
    }
}

fn table(best: &Hypothesis, unit: &str) -> Markup {
    let row = |row: &TransferRow| {
        let alone =
            row.parameters_alone.first().map_or_else(|| "not known".to_owned(), |alone| number(*alone));
        let left = if row.rms_before > 0.0 { percent(row.rms_after / row.rms_before) } else { "0".into() };
        html! {
            tr {
                td { (listed(&row.runs, "and")) }
                td.number { (with_unit(row.rms_before, unit)) }
                td.number { (with_unit(row.rms_after, unit)) }
                td.number { (left) }
                td.number { (alone) }
            }
        }
    };
    html! {
        table {
            thead {
                tr {
                    th { "Runs" } th { "Linear part" } th { "With the law" } th { "Left" } th { "Law asked for here alone" }
                }
            }
            tbody { @for group in &best.transfer { (row(group)) } }
        }
    }
}
