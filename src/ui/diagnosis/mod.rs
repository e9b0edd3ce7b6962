//! The page of a diagnosis: the verdict in one sentence, and the evidence below it.

mod candidates;
mod closure;
mod force;
mod labels;
mod location;
mod names;
mod remaining;
#[cfg(test)]
#[expect(dead_code, reason = "the engine's tests use more of the rig")]
#[path = "../../engine/diagnosis/tests/rig.rs"]
mod rig;
mod sentence;
#[cfg(test)]
mod tests;
mod transfer;

use maud::{Markup, html};

use super::figures::{Drawing, address, saves};
use super::frame::{self, Frame, Section, Visitor};
use super::iteration::model_options;
use super::plot::Figure;
use super::rig::name_of;
use super::words::{clamped, duration};
use crate::domain::{Model, Rig, Run, TokenRole};
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

/// The report as a document that is complete in itself: no scripts, no other files.
pub fn page(of: &Heading, report: &Report, views: &Views) -> String {
    let title = format!("Diagnosis of {}", of.rig_name);
    let call = html! {
        @if let Some(call) = of.adopt.as_ref().filter(|_| may_adopt(report)) {
            (heading("adopt", "Take the effect into the model"))
            p { "This call makes a new model version that predicts with the effect; the version in use stays until you change it." }
            pre { code { (call) } }
        }
    };
    frame::alone(&title, &content(of, report, views, &call))
}

/// The report as a page of the service, with the form that adopts the effect.
pub fn framed(visitor: &Visitor, of: &Heading, report: &Report, views: &Views) -> String {
    let title = format!("Diagnosis of {}", of.rig_name);
    let form = html! {
        @if of.adopt.is_some() && may_adopt(report) && visitor.may(TokenRole::Operator) {
            (heading("adopt", "Take the effect into the model"))
            p { "A new model version predicts with the effect; the version in use stays until you change it." }
            form data-api={ "POST /v1/rigs/" (of.rig) "/diagnoses/" (of.diagnosis) "/adopt" } data-then="follow" {
                (frame::csrf(visitor))
                div.row {
                    label { "Activate it" select name="activate" {
                        option value="never" { "not yet: I look at it first" }
                        option value="if_better" { "if it closes at least 1 % of the gap" }
                        option value="always" { "in any case" }
                    } }
                    button.main type="submit" { "Adopt the effect" }
                }
            }
        }
    };
    let rig = format!("/rigs/{}", of.rig);
    let mut frame =
        Frame::new(&title, Section::Rigs, visitor).below(&[("/".into(), "Rigs"), (rig, &of.rig_name)]);
    frame.class = "report";
    frame.scripts = &["forms.js"];
    let at = format!("/rigs/{}/diagnoses/{}", of.rig, of.diagnosis);
    let files = html! {
        (heading("files", "Plots as files"))
        ul { @for figure in figures(report, views) {
            li { (figure.title) (saves(&address(&at, &figure.id))) }
        } }
    };
    frame.page(&html! { (content(of, report, views, &form)) (files) })
}

/// The plots of the report.
fn figures(report: &Report, views: &Views) -> Vec<Figure> {
    let sections =
        [location::figures(report, views), closure::figures(report, views), force::figures(report, views)];
    sections.into_iter().flatten().chain(remaining::figures(report)).collect()
}

/// A plot of the report by its name.
///
/// # Errors
/// The names of all plots, where there is no such one.
pub fn drawing(report: &Report, views: &Views, name: &str) -> Result<Drawing, String> {
    let mut all = figures(report, views);
    match all.iter().position(|figure| figure.id == name) {
        Some(place) => Ok(all.swap_remove(place).into()),
        None => Err(all.iter().map(|figure| figure.id.as_str()).collect::<Vec<_>>().join(", ")),
    }
}

/// The form that starts a diagnosis.
pub fn form(
    visitor: &Visitor,
    rig: &Rig,
    runs: &[Run],
    models: &[Model],
    chosen: (Option<&str>, Option<u32>),
) -> String {
    let main = html! {
        h1 { "Diagnose" }
        p { "Where do model and rig disagree, which physical effect does the model lack, and how much closer does it get with that effect? Choose runs that the model misses: some for the parameters, the rest to check them." }
        form.fields data-api={ "POST /v1/rigs/" (rig.id) "/diagnoses" } data-then="follow" {
            (frame::csrf(visitor))
            fieldset { legend { "Runs to explain" }
                @for run in runs { @let id = run.id.to_string();
                    label.check {
                        input type="checkbox" name="runs" value=(id) data-as="each" checked[chosen.0 == Some(id.as_str())];
                        (clamped(&name_of(run))) " " span.soft { (run.kind.as_str()) ", " (run.split.as_str()) ", " (duration(run.duration_s)) }
                    }
                }
                @if runs.is_empty() { p { "There is no run yet." } }
            }
            div.row {
                label { "Model" select name="model" data-as="json" { (model_options(models, chosen.1)) } }
                label { "A gap matters from" input type="number" name="material_gap" data-as="number" min="0" step="any" placeholder="0.02"; span.soft { "of the response's RMS" } }
            }
            div { button.main type="submit" { "Start the diagnosis" } }
        }
    };
    let way = [("/".to_owned(), "Rigs"), (format!("/rigs/{}", rig.id), rig.name.as_str())];
    let mut frame = Frame::new("Diagnose", Section::Rigs, visitor).below(&way);
    frame.scripts = &["forms.js"];
    frame.page(&main)
}

fn content(of: &Heading, report: &Report, views: &Views, adopt: &Markup) -> Markup {
    html! {
        (header(of, report))
        (location::section(report, views))
        (candidates::section(report))
        (transfer::section(report, unit_of(report, views)))
        (closure::section(report, views))
        (force::section(report, views))
        (remaining::remaining(report))
        (remaining::next(report))
        (adopt)
        (remaining::method(of, report, views))
    }
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
            h1 { (clamped(&of.rig_name)) }
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

pub(super) fn kind_in_words(kind: VerdictKind) -> &'static str {
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

/// Whether there is an effect to adopt: one that diverges within the allowed drives cannot be.
fn may_adopt(report: &Report) -> bool {
    report.verdict.kind.blames() && sentence::best(report).is_some_and(|best| best.stable_over_envelope)
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
