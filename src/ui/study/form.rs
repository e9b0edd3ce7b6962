//! The form that starts a study.

use maud::{Markup, html};

use super::title;
use crate::domain::study::StudyKind;
use crate::domain::{Model, Rig};
use crate::ui::frame::{Frame, Section, Visitor, csrf};
use crate::ui::iteration::model_options;

const KINDS: [StudyKind; 3] = [StudyKind::Search, StudyKind::LearningCurve, StudyKind::LinearStudy];

/// Kinds of fits that are worth a study.
const FITS: [(&str, &str); 4] =
    [("hybrid2", "hybrid 2"), ("hybrid1", "hybrid 1"), ("lstm", "LSTM alone"), ("frf", "FRF alone")];

/// The form.
pub fn form(visitor: &Visitor, rig: &Rig, models: &[Model]) -> String {
    let main = html! {
        h1 { "Start a study" }
        p { "Which settings and how much noise are worth your time? A study does many fits, gives way to other work, and can be watched and cancelled. It never looks at the split test." }
        form.fields data-api={ "POST /v1/rigs/" (rig.id) "/studies" } data-then="follow" {
            (csrf(visitor))
            label { "Kind" select name="kind" data-toggles {
                @for kind in KINDS { option value=(kind.as_str()) { (title(kind)) } }
            } }
            div data-for="kind" data-of="search learning_curve" { (fit()) }
            div data-for="kind" data-of="search" { (search()) }
            div data-for="kind" data-of="learning_curve" { (learning_curve()) }
            div data-for="kind" data-of="linear_study" { (linear(models)) }
            label { "Seed" input type="number" name="seed" data-as="number" min="0" step="1" placeholder="1"; span.soft { "of everything that is drawn" } }
            div { button.main type="submit" { "Start the study" } }
        }
    };
    let way = [("/".to_owned(), "Rigs"), (format!("/rigs/{}", rig.id), rig.name.as_str())];
    let mut frame = Frame::new("Start a study", Section::Rigs, visitor).below(&way);
    frame.scripts = &["forms.js"];
    frame.page(&main)
}

fn whole(label: &str, name: &str, placeholder: &str, note: &str) -> Markup {
    html! { label { (label) input type="number" name=(name) data-as="number" min="1" step="1" placeholder=(placeholder); span.soft { (note) } } }
}

fn number(label: &str, name: &str, placeholder: &str, note: &str) -> Markup {
    html! { label { (label) input type="number" name=(name) data-as="number" min="0" step="any" placeholder=(placeholder); span.soft { (note) } } }
}

fn fit() -> Markup {
    html! {
        div.row {
            label { "Fit" select name="fit.kind" { @for (kind, words) in FITS { option value=(kind) { (words) } } } span.soft { "on the noise runs of the split training" } }
            label { "Activate the best" select name="fit.activate" {
                option value="never" { "never: I look at it first" }
                option value="if_better" { "if it is better than the active one" }
            } span.soft { "a search makes one model version" } }
        }
    }
}

fn search() -> Markup {
    html! {
        div.row {
            (whole("Trials", "trials", "20", "each is a fit"))
            label { "Method" select name="method" {
                option value="random" { "random: all trials to their end" }
                option value="successive_halving" { "successive halving: the best go on" }
            } }
        }
        details {
            summary { "What varies: cells, learning rate, windows and mini-batch unless you choose" }
            div.row {
                (whole("Cells from", "space.cells.min", "", ""))
                (whole("to", "space.cells.max", "", ""))
                (number("Learning rate from", "space.learning_rate.min", "", ""))
                (number("to", "space.learning_rate.max", "", ""))
            }
            p.soft { "What is left empty does not vary, once one range is given." }
        }
    }
}

fn learning_curve() -> Markup {
    html! {
        div.row {
            (whole("Sizes", "sizes", "5", "from an eighth of the data to all"))
            (whole("Repeats", "repeats", "3", "subsets of each size"))
            (number("Continue it by", "more_min", "10", "minutes of noise"))
        }
    }
}

fn linear(models: &[Model]) -> Markup {
    html! {
        p { "Networks of several sizes learn an FRF from more and more files of noise, as in the source paper." }
        div.row {
            label { "The FRF of" select name="model" data-as="json" { (model_options(models, None)) } }
            label { "Files" input name="files" data-as="numbers" placeholder="3, 6, 12, 25"; span.soft { "numbers of training files" } }
            (whole("Epochs", "epochs", "", ""))
        }
    }
}
