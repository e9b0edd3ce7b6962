//! The page of a diagnosis: the verdict in one sentence, and the evidence below it.

mod candidates;
mod closure;
mod force;
mod labels;
mod location;
mod names;
mod remaining;
mod sentence;
#[cfg(test)]
mod tests;
mod transfer;

use maud::{Markup, html};

use super::document::document;
use crate::engine::diagnosis::{Report, VerdictKind, Views};

pub use names::name_runs;

/// The heading of a diagnosis.
#[derive(Debug, Clone, PartialEq)]
pub struct Heading {
    /// Id of the rig.
    pub rig: String,
    /// Its name.
    pub rig_name: String,
    /// Id of the diagnosis.
    pub diagnosis: String,
    /// When it was asked for, as people read it.
    pub when: String,
    /// The sim that was compared with the rig.
    pub model: Simulation,
    /// Time that it took.
    pub elapsed_s: f64,
    /// The call that adopts the effect into a model version, if there is one.
    pub adopt: Option<String>,
}

/// The sim that was compared with the rig.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Simulation {
    /// A model version of the service.
    Version {
        /// Its number.
        version: u64,
        /// `frf`, `lstm`, `hybrid1`, `hybrid2`, `adopted on frf`, ...
        kind: String,
    },
    /// A simulation that the client uploaded.
    Outside,
}

/// The page as self-contained HTML: no scripts, no other files.
pub fn page(of: &Heading, report: &Report, views: &Views) -> String {
    let title = format!("Diagnosis of {}", of.rig_name);
    let main = html! {
        (header(of, report))
        (location::section(report, views))
        (candidates::section(report))
        (transfer::section(report, unit_of(report, views)))
        (closure::section(report, views))
        (force::section(report, views))
        (remaining::remaining(report))
        (remaining::next(report))
        (adopt(of, report))
        (remaining::method(of, report, views))
    };
    document(&title, include_str!("style.css"), &main)
}

/// Unit of the response that the best hypothesis helps most.
fn unit_of<'a>(report: &Report, views: &'a Views) -> &'a str {
    let channel = report.hypotheses.first().map(|h| h.channel.as_str());
    views.spectra.iter().find(|s| Some(s.channel.as_str()) == channel).map_or("", |s| s.unit.as_str())
}

fn header(of: &Heading, report: &Report) -> Markup {
    let kind = report.verdict.kind;
    let tone = match kind {
        VerdictKind::Identified | VerdictKind::NoiseOrUnmeasuredDisturbance => "found",
        VerdictKind::NoMaterialGap => "quiet",
        _ => "open",
    };
    html! {
        header {
            p.over { "Model against rig" }
            h1 { (of.rig_name) }
            p.soft {
                (of.rig) " · "
                (match &of.model {
                    Simulation::Version { version, kind } => format!("model version {version} ({kind})"),
                    Simulation::Outside => "outside simulation".into(),
                })
                " · " (of.when)
            }
        }
        section class=(format!("verdict {tone}")) {
            p.label { (kind_in_words(kind)) }
            p.answer { (sentence::verdict(report)) }
            @if matches!(kind, VerdictKind::FamilyOnly | VerdictKind::NotDistinguishable | VerdictKind::Undecided) {
                @if let Some(next) = sentence::next(report) { p { (next) } }
            }
        }
    }
}

fn kind_in_words(kind: VerdictKind) -> &'static str {
    match kind {
        VerdictKind::Identified => "Effect identified",
        VerdictKind::Partial => "Effect identified in part",
        VerdictKind::FamilyOnly => "Kind of effect known",
        VerdictKind::NotDistinguishable => "Several effects possible",
        VerdictKind::NoneOfCatalogue => "Cause not known",
        VerdictKind::Undecided => "Cause or noise: not decided",
        VerdictKind::NoiseOrUnmeasuredDisturbance => "Noise or disturbance",
        VerdictKind::NoMaterialGap => "No gap that matters",
    }
}

fn adopt(of: &Heading, report: &Report) -> Markup {
    // An effect that diverges within the allowed drives cannot be adopted.
    let steady = sentence::best(report).is_some_and(|b| b.stable_over_envelope);
    let may = report.verdict.kind.blames() && steady;
    let Some(call) = of.adopt.as_ref().filter(|_| may) else {
        return html! {};
    };
    html! {
        (heading("adopt", "Take the effect into the model"))
        p { "This call makes a new model version that predicts with the effect; the version in use stays until you change it." }
        pre { code { (call) } }
    }
}

/// Whether the verdict is that there is no gap.
fn quiet(kind: VerdictKind) -> bool {
    matches!(kind, VerdictKind::NoMaterialGap | VerdictKind::NoiseOrUnmeasuredDisturbance)
}

fn heading(id: &str, text: &str) -> Markup {
    html! { h2 id=(id) { (text) } }
}

fn figure(plot: &Markup, caption: &Markup) -> Markup {
    html! { figure { div.plot { (plot) } figcaption { (caption) } } }
}
