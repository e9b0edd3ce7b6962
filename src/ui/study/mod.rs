//! The page of a study: what it has found so far, as a figure and as a table.

mod curve;
mod form;
mod linear;
mod search;

use maud::{Markup, html};

use super::figures::{Drawing, address, late};
use super::frame::{Frame, Section, Visitor};
use super::words;
use crate::domain::study::{StoredStudy, StudyKind, StudyReport};
use crate::domain::{Rig, TokenRole};

pub use form::form;
pub use linear::linear_study_svg;

/// A kind of study as a title.
pub(super) fn title(kind: StudyKind) -> &'static str {
    match kind {
        StudyKind::Search => "Search of settings",
        StudyKind::LearningCurve => "Error against minutes of data",
        StudyKind::LinearStudy => "Linear study",
    }
}

/// The page.
pub fn page(visitor: &Visitor, rig: &Rig, of: &StoredStudy) -> String {
    let summary = &of.summary;
    let at = format!("/rigs/{}/studies/{}", rig.id, summary.id);
    let title = title(summary.kind);
    let main = html! {
        div.head {
            div {
                h1 { (title) }
                p { (words::state(summary.state)) " " span.soft { "asked for " (words::minute(&summary.created_at)) " UTC" } }
            }
            div.actions {
                a.button href={ "/jobs/" (summary.id) } { (if summary.state.is_terminal() { "Its job" } else { "Progress" }) }
                @if let Some(version) = summary.model { a.button.main href={ "/rigs/" (rig.id) "/models/" (version) } { "Version " (version) } }
            }
        }
        (fit(of))
        @match &of.report {
            None => div.empty { p { "Nothing is found yet." } @if visitor.may(TokenRole::Operator) { p.soft { "Its job says how far it is." } } },
            Some(report) => (found(report, &at)),
        }
    };
    let way = [("/".to_owned(), "Rigs"), (format!("/rigs/{}", rig.id), rig.name.as_str())];
    Frame::new(title, Section::Rigs, visitor).below(&way).page(&main)
}

/// The fit that is studied, in a line.
fn fit(of: &StoredStudy) -> Markup {
    html! { @if let Some(fit) = &of.request.fit { p.soft { "Of fits of the kind " (fit.kind.as_str()) ", seed " (of.request.seed) "." } } }
}

fn found(report: &StudyReport, at: &str) -> Markup {
    let figure = |caption: &str| late(&address(at, "errors"), &html! { (caption) });
    html! {
        @match report {
            StudyReport::Search(report) => {
                p.soft { (report.trials.len()) " of " (report.planned) " trials are done." }
                (search::best(report))
                (figure("RMS error of each trial on the data that choose, mean over the outputs. A rung is a share of the epochs."))
                (search::table(report))
            }
            StudyReport::LearningCurve(report) => {
                p.soft { (report.fits.len()) " of " (report.planned) " fits are done." }
                ul { @for output in &report.outputs { li { (output.sentence) } } }
                (figure("RMS error of each output: fits as dots, the curve with its 90 % interval, continued to more data."))
                (curve::table(report))
            }
            StudyReport::LinearStudy(report) => {
                p.soft { (report.fits.len()) " of " (report.planned) " fits are done." }
                (figure("RMS error on the files that score, one line for the cells of each network."))
                (linear::table(report))
            }
        }
    }
}

/// Its figure.
pub fn errors(of: &StoredStudy, width: f64) -> Drawing {
    let size = (width.min(900.0), 360.0);
    match &of.report {
        None => Drawing::Nothing("Nothing is found yet.".into()),
        Some(StudyReport::Search(report)) => search::figure(report, size),
        Some(StudyReport::LearningCurve(report)) => curve::figure(report, outputs(of), size),
        Some(StudyReport::LinearStudy(report)) => {
            super::plot::Figure { size, ..linear::figure(&report.fits) }.into()
        }
    }
}

/// Outputs of the fit, in the order of its errors.
fn outputs(of: &StoredStudy) -> &[String] {
    of.request.fit.as_ref().and_then(|fit| fit.outputs.as_deref()).unwrap_or_default()
}
