//! Drive-file iterations: the form that starts one, and the page of its result.

use maud::{Markup, html};

use super::figures::{Drawing, address, late};
use super::frame::{Frame, Section, Visitor, csrf};
use super::plot::{Axis, Figure, Key, Mark, Scale, Style};
use super::rig::name_of;
use super::text::{cut, number, percent};
use super::words::{self, clamped, duration, minute, sentence};
use crate::domain::iteration::IterationStep;
use crate::domain::{Model, Rig, Role, Run, StoredIteration};

/// Options for the models of a rig; the empty value is the active one.
pub(super) fn model_options(models: &[Model], chosen: Option<u32>) -> Markup {
    html! {
        option value="" { "the active one" }
        @for model in models {
            option value=(model.version) selected[chosen == Some(model.version)] { "version " (model.version) " (" (model.kind_in_words()) ")" }
        }
    }
}

/// The form.
pub fn form(visitor: &Visitor, rig: &Rig, runs: &[Run], models: &[Model], chosen: Option<&str>) -> String {
    let main = html! {
        h1 { "Find a drive" }
        p { "The drive that makes the rig answer with a wanted response is searched on the model: predicted, corrected by the inverse FRF or by the model's gradient, and predicted again. The rig stays still." }
        form.fields data-api={ "POST /v1/rigs/" (rig.id) "/iterations" } data-then="follow" {
            (csrf(visitor))
            label { "Wanted response, of the run"
                select name="target.run" required {
                    @for run in runs { @let id = run.id.to_string();
                        option value=(id) selected[chosen == Some(id.as_str())] { (cut(&name_of(run))) " (" (run.kind.as_str()) ", " (duration(run.duration_s)) ")" }
                    }
                }
            }
            div.row {
                label { "Model" select name="model" data-as="json" { (model_options(models, None)) } }
                label { "Corrections at most" input type="number" name="iterations" data-as="number" min="1" max="200" placeholder="10"; }
                label { "Gain" input type="number" name="gain" data-as="number" min="0" max="2" step="any" placeholder="1"; span.soft { "share of each correction" } }
                label { "Name of the drive" input name="name" maxlength="1000"; }
            }
            (limits(rig))
            div { button.main type="submit" { "Start" } }
        }
    };
    let way = [("/".to_owned(), "Rigs"), (format!("/rigs/{}", rig.id), rig.name.as_str())];
    let mut frame = Frame::new("Find a drive", Section::Rigs, visitor).below(&way);
    frame.scripts = &["forms.js"];
    frame.page(&main)
}

fn limits(rig: &Rig) -> Markup {
    const LIMITS: [(&str, &str); 3] =
        [("peak", "Peak"), ("rms", "RMS"), ("rate", "Rate of change per second")];
    html! {
        details open[rig.drives().count() <= 8] {
            summary { "Limits of the drives, each in its unit; an empty field is no limit" }
            table {
                thead { tr { th { "Drive" } @for (_, words) in LIMITS { th { (words) } } } }
                tbody { @for channel in rig.channels.iter().filter(|channel| channel.role == Role::Drive) { tr {
                    td { (clamped(&channel.name)) " " span.soft { (clamped(&channel.unit)) } }
                    @for (name, words) in LIMITS { td {
                        input type="number" name={ "limits.*." (name) } data-key=(channel.name) data-as="number" min="0" step="any" aria-label={ (words) " of " (channel.name) };
                    } }
                } } }
            }
        }
    }
}

/// The page of a result.
pub fn page(visitor: &Visitor, rig: &Rig, of: &StoredIteration) -> String {
    let (summary, report) = (&of.summary, &of.report);
    let at = format!("/rigs/{}/iterations/{}", rig.id, summary.id);
    let target = of.request.target.run;
    let main = html! {
        div.head {
            div {
                h1 { "Drive found by iteration" }
                p.soft { "Model version " (summary.model.version) " · " (minute(&summary.created_at)) " UTC · took " (duration(of.elapsed_s)) " · stopped: " (words::word(summary.stopped)) }
            }
            div.actions {
                @if let Some(drive) = summary.drive {
                    a.button.main href={ "/rigs/" (rig.id) "/runs/" (drive) "/file?format=rpc3" } download { "Download the drive (RPC III)" }
                    a.button href={ "/rigs/" (rig.id) "/runs/" (drive) "/file?format=csv" } download { "CSV" }
                    a.button href={ "/rigs/" (rig.id) "/runs/" (drive) } { "Look at the drive" }
                    a.button href={ "/rigs/" (rig.id) "/predict?model=" (summary.model.version) "&drive=" (drive) "&target=" (target) } { "Drive and response" }
                }
            }
        }
        p.figure-of { (percent(summary.total_error)) }
        p.soft { "weighted RMS error left by iteration " (report.best) ", the best of " (report.steps.len()) }
        @if !report.warnings.is_empty() { ul.notes { @for warning in &report.warnings { li { (sentence(warning)) } } } }
        @if summary.drive.is_none() { p.notes { "The run that held the drive was deleted." } }
        h2 { "Error by iteration" }
        (late(&address(&at, "steps"), &html! { "RMS error of each wanted response, relative to its RMS." }))
        (table(&report.steps))
        @if let Some([low, high]) = report.band_hz { p.soft { "Corrected from " (number(low)) " to " (number(high)) " Hz." } }
    };
    let way = [("/".to_owned(), "Rigs"), (format!("/rigs/{}", rig.id), rig.name.as_str())];
    Frame::new("Iteration", Section::Rigs, visitor).below(&way).page(&main)
}

fn table(steps: &[IterationStep]) -> Markup {
    html! {
        div.wide { table {
            thead { tr { th.number { "Iteration" } th { "Step" } th.number { "Error" } th { "Damage ratio" } th.number { "Inside the training range" } th { "Peak of the drives" } } }
            tbody { @for step in steps { tr {
                td.number { (step.iteration) @if step.better { " ●" } }
                td { (words::word(step.kind)) }
                td.number { (percent(step.total_error)) }
                td { @for (name, ratio) in &step.damage { (clamped(name)) " " (ratio.ratio.map_or_else(|| "–".to_owned(), number)) " " } }
                td.number { (percent(step.inside)) }
                td { @for (name, peak) in &step.drive_peak { (clamped(name)) " " (number(*peak)) " " } }
            } } }
        } }
        p.soft { "● better than all before. Iteration 0 is the drive that the search began with." }
    }
}

/// Errors of all channels over the iterations.
pub fn steps(of: &StoredIteration, width: f64) -> Drawing {
    let steps = &of.report.steps;
    let Some(first) = steps.first() else { return Drawing::Nothing("There is no iteration.".into()) };
    let x: Vec<f64> = steps.iter().map(|step| step.iteration as f64).collect();
    let line = |name: &str, y: Vec<f64>, style| Mark::Line { x: x.clone(), y, style, name: name.to_owned() };
    let mut marks = vec![line("all", steps.iter().map(|step| step.total_error).collect(), Style::Series(7))];
    for (place, name) in first.errors.keys().enumerate() {
        let errors = steps.iter().map(|step| step.errors.get(name).copied().flatten().unwrap_or(f64::NAN));
        marks.push(line(name, errors.collect(), Style::Series(place)));
    }
    let values =
        steps.iter().flat_map(|step| step.errors.values().flatten().copied().chain([step.total_error]));
    Figure {
        id: "steps".into(),
        title: "Error by iteration".into(),
        description: "Relative to the RMS of the wanted response.".into(),
        size: (width.min(900.0), 300.0),
        x: (Axis::exact(Scale::Count, 0.0, x.last().copied().unwrap_or(1.0).max(1.0)), "Iteration".into()),
        y: (Axis::around(Scale::Log, values), "RMS error, relative".into()),
        key: Key::Above,
        marks,
    }
    .into()
}
