//! The form that starts an evaluation.

use maud::html;

use crate::domain::{Model, Rig, Run};
use crate::ui::frame::{Frame, Section, Visitor, csrf};
use crate::ui::rig::name_of;
use crate::ui::words::{clamped, duration};

/// The form; `chosen` is a model that is marked at first, else the active one is.
pub fn form(visitor: &Visitor, rig: &Rig, runs: &[Run], models: &[Model], chosen: Option<u32>) -> String {
    let marked = |model: &Model| chosen.map_or(model.active, |version| version == model.version);
    let main = html! {
        h1 { "Evaluate models" }
        p { "How good is each model on each kind of load? Each model predicts each run; the report compares errors, damage and spectra, by kind of run." }
        form.fields data-api={ "POST /v1/rigs/" (rig.id) "/evaluations" } data-then="follow" {
            (csrf(visitor))
            fieldset { legend { "Models" }
                @for model in models {
                    label.check {
                        input type="checkbox" name="models" value=(model.version) data-as="each" data-number checked[marked(model)];
                        "Version " (model.version) " " span.soft { (model.kind_in_words()) @if model.active { ", active" } }
                    }
                }
            }
            fieldset { legend { "Runs" }
                @for run in runs { @let id = run.id.to_string();
                    label.check {
                        input type="checkbox" name="runs" value=(id) data-as="each";
                        (clamped(&name_of(run))) " " span.soft { (run.kind.as_str()) ", " (run.split.as_str()) ", " (duration(run.duration_s)) }
                    }
                }
                p.soft { "None chosen: all runs of the split test." }
            }
            div.row {
                label { "Compare with"
                    select name="baseline" data-as="number" {
                        option value="" { "no baseline" }
                        @for model in models { option value=(model.version) { "version " (model.version) } }
                    }
                }
                label { "Classes" input name="classes" data-as="list" placeholder="SL, N1"; span.soft { "kinds and tags; left out: by kind" } }
            }
            label.check { input type="checkbox" name="include_fitted" data-as="bool"; "Count runs that a model was fitted on" }
            div { button.main type="submit" { "Start the evaluation" } }
        }
    };
    let way = [("/".to_owned(), "Rigs"), (format!("/rigs/{}", rig.id), rig.name.as_str())];
    let mut frame = Frame::new("Evaluate models", Section::Rigs, visitor).below(&way);
    frame.scripts = &["forms.js"];
    frame.page(&main)
}
