//! The effects that were tried, compared.

use maud::{Markup, html};

use super::labels::words;
use super::sentence::{closure, held};
use super::{figure, heading};
use crate::engine::diagnosis::{Effect, Report};
use crate::ui::plot::{WhiskerRow, whiskers};
use crate::ui::text::{number, percent};

/// The section; empty where no candidate was needed.
pub fn section(report: &Report) -> Markup {
    let Some(best) = report.hypotheses.first() else { return html! {} };
    let v = &report.verdict;
    let rows: Vec<WhiskerRow> = report
        .hypotheses
        .iter()
        .map(|h| WhiskerRow {
            name: held(h),
            value: h.held_out.closure,
            interval: h.held_out.closure_ci90,
            probability: Some(h.probability),
            chosen: v.kind.blames() && v.equivalence_set.contains(&h.effect),
        })
        .collect();
    let description = format!(
        "One row per candidate, the most probable first: {} closes {} of the gap.",
        held(best),
        closure(best)
    );
    html! {
        (heading("which", "Which effect is it?"))
        @if v.kind.blames() { (explained(report)) }
        (figure(
            &whiskers("candidates", "Candidates side by side", &description, &rows),
            &html! {
                "Each candidate was fitted to the same runs, and simulated without the measured responses. "
                @if v.kind.blames() && v.equivalence_set.len() > 1 {
                    "Those in colour cannot be told apart by these runs alone. "
                }
                "Of two candidates with the same closure the simpler one is preferred."
            },
        ))
        @if report.hypotheses.iter().any(|h| !h.stable_over_envelope) {
            p.soft {
                "Not stable up to the allowed drive level, and therefore not to be simulated there: "
                @for (k, h) in report.hypotheses.iter().filter(|h| !h.stable_over_envelope).enumerate() {
                    @if k > 0 { ", " } (words(h.effect).name)
                }
                "."
            }
        }
        (fingerprints(report))
    }
}

/// Description of the blamed effect, or of each of those that it may be.
fn explained(report: &Report) -> Markup {
    let v = &report.verdict;
    let line = |effect: Effect| html! { b { (capital(words(effect).name)) ". " } (words(effect).plain) };
    match v.effect {
        Some(_) if v.effects.len() > 1 => html! {
            ul {
                @for (k, e) in v.effects.iter().enumerate() {
                    li { (line(e.effect)) " It closes " (percent(e.share_of_gap)) " of the gap" @if k > 0 { " beside what is named before it" } "." }
                }
            }
        },
        Some(effect) => html! { p { (line(effect)) } },
        None => html! { ul { @for effect in &v.equivalence_set { li { (line(*effect)) } } } },
    }
}

/// Traits of the gap, each with the effects that it supports.
fn fingerprints(report: &Report) -> Markup {
    let f = &report.fingerprints;
    let mut lines: Vec<(String, &str)> = Vec::new();
    if let Some(odd) = f.odd_share {
        let means = match odd {
            o if o > 0.8 => "the gap is the same in both directions of travel",
            o if o < 0.3 => "the gap differs between the two directions of travel",
            _ => "the gap is partly the same in both directions of travel, partly not",
        };
        lines.push((format!("Odd in the response: {}", percent(odd)), means));
    }
    if let Some(e) = f.gap_level_exponent {
        let means = match e {
            e if e < 0.5 => "hardly grows with the drive, as with dry friction",
            e if e < 1.4 => "grows in proportion to the drive, as a linear change or hysteresis does",
            e if e < 2.4 => "grows with the square of the drive, as quadratic terms do",
            _ => "grows with the cube of the drive or faster, as hardening springs and stops do",
        };
        lines.push((format!("Gap against drive level: exponent {}", number(e)), means));
    }
    if let Some(c) = f.linear_refit_closure {
        let means = if c > 0.9 {
            "nearly all of it can be a linear change"
        } else if c < 0.5 {
            "most of it is not linear"
        } else {
            "a linear change could hide a part of it"
        };
        lines.push((format!("Closed by a refit of the linear part alone: {}", percent(c)), means));
    }
    if lines.is_empty() {
        return html! {};
    }
    html! {
        h3 { "Evidence" }
        ul { @for (what, means) in lines { li { (what) " – " (means) "." } } }
        p.soft { "These traits explain the verdict; the decision rests on the closure on runs that were not fitted." }
    }
}

fn capital(text: &str) -> String {
    let mut letters = text.chars();
    letters.next().map_or_else(String::new, |first| first.to_uppercase().chain(letters).collect())
}
