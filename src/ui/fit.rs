//! The form of a fit: the kinds of models with what they take, and everything else with its default.

use maud::{Markup, html};

use super::frame::{Frame, Section, Visitor, csrf};
use super::rig::name_of;
use super::words::{clamped, count, duration};
use crate::domain::{Rig, Run, RunKind, Split};
use crate::engine::model::{LstmOptions, ModelKind, Preset, Task};

/// Windows of 256 samples that two cores train in a second with a network of 6,828 parameters (docs/performance.md).
const WINDOWS_PER_S: f64 = 10_000.0;
const WINDOW: f64 = 256.0;
const PARAMETERS: f64 = 6828.0;

/// Seconds that an FRF takes for a million samples, and what every fit takes to start.
const FRF_S: f64 = 0.2;
const START_S: f64 = 1.0;

/// The kinds with what speaks for each.
const KINDS: [(ModelKind, &str); 4] = [
    (ModelKind::Frf, "linear, in seconds: where to begin"),
    (ModelKind::Hybrid2, "FRF inside an LSTM: the most accurate as a rule"),
    (ModelKind::Hybrid1, "FRF plus an LSTM for its error"),
    (ModelKind::Lstm, "LSTM alone"),
];

/// About how long a fit of this kind takes on these runs with its defaults, s.
pub fn estimate(rig: &Rig, runs: &[Run], kind: ModelKind, preset: Preset) -> f64 {
    let lens: Vec<usize> = runs
        .iter()
        .filter(|run| run.kind == RunKind::Noise && run.split == Split::Training)
        .map(|run| usize::try_from(run.samples).unwrap_or(usize::MAX))
        .collect();
    let samples: f64 = lens.iter().map(|n| *n as f64).sum();
    let (inputs, outputs) = (rig.drives().count() as f64, rig.responses().count() as f64);
    let linear = START_S + FRF_S * samples * inputs.max(1.0) * outputs.max(1.0) / 9e6;
    if kind == ModelKind::Frf {
        return linear;
    }
    let Ok(settings) = LstmOptions::default().resolve(preset, kind, Task::Forward, &lens) else {
        return linear;
    };
    let windows = samples / settings.hop as f64 * settings.epochs as f64 * settings.seeds.len() as f64;
    let mut wide = if kind == ModelKind::Hybrid2 { inputs + outputs } else { inputs };
    let mut parameters = 0.0;
    for cells in &settings.blocks {
        let cells = *cells as f64;
        parameters += 4.0 * cells * (wide + cells + 1.0);
        wide = cells;
    }
    parameters += outputs * (wide + 1.0);
    let cost = settings.window_len as f64 / WINDOW * parameters / PARAMETERS;
    // With several training runs the winner is fitted once more on all of them, with one seed.
    let again = if lens.len() > 1 { 1.0 + 1.0 / settings.seeds.len() as f64 } else { 1.0 };
    linear + again * windows * cost / WINDOWS_PER_S
}

/// The page.
pub fn page(visitor: &Visitor, rig: &Rig, runs: &[Run]) -> String {
    let noise: Vec<&Run> =
        runs.iter().filter(|run| run.kind == RunKind::Noise && run.split == Split::Training).collect();
    let length: f64 = noise.iter().map(|run| run.duration_s).sum();
    let main = html! {
        h1 { "Fit a model" }
        @if noise.is_empty() {
            div.empty {
                p { b { "There is no noise run of the split training." } }
                p { "A fit takes those unless you choose others below. " a href={ "/rigs/" (rig.id) "/upload" } { "Upload a run" } "." }
            }
        } @else {
            p { "On " (count(noise.len(), "noise run", "noise runs")) " of the split training, " (duration(length)) " together, unless you choose others." }
        }
        form.fields data-api={ "POST /v1/rigs/" (rig.id) "/fits" } data-then="follow" {
            (csrf(visitor))
            (kinds(rig, runs))
            label { "Activate it" select name="activate" {
                option value="if_better" { "if it is better than the active one" }
                option value="never" { "never: I look at it first" }
                option value="always" { "in any case" }
            } span.soft { "Better: at least 1 % on data that neither has seen, and no response more than 5 % worse." } }
            label { "Preset" select name="preset" {
                option value="default" { "default: accurate in minutes" }
                option value="paper" { "paper: the settings of the source paper" }
            } }
            (channels(rig))
            (selection(runs))
            (expert())
            div { button.main type="submit" { "Start the fit" } }
        }
    };
    let way = [("/".to_owned(), "Rigs"), (format!("/rigs/{}", rig.id), rig.name.as_str())];
    let mut frame = Frame::new("Fit a model", Section::Rigs, visitor).below(&way);
    frame.scripts = &["forms.js"];
    frame.page(&main)
}

fn kinds(rig: &Rig, runs: &[Run]) -> Markup {
    html! {
        fieldset {
            legend { "Kind" }
            table {
                thead { tr { th { "Model" } th { "" } th.number { "About" } th.number { "Paper's preset" } } }
                tbody { @for (place, (kind, why)) in KINDS.iter().enumerate() {
                    tr {
                        td { label.check { input type="radio" name="kind" value=(kind.as_str()) checked[place == 0]; (kind.as_str()) } }
                        td.soft { (why) }
                        td.number { (duration(rounded(estimate(rig, runs, *kind, Preset::Default)))) }
                        td.number { (duration(rounded(estimate(rig, runs, *kind, Preset::Paper)))) }
                    }
                } }
            }
            p.soft { "The times are estimates for two free cores and the settings that are left open." }
        }
    }
}

/// One digit is all that an estimate has.
fn rounded(s: f64) -> f64 {
    let decade = 10.0_f64.powf(s.max(1e-3).log10().floor());
    (s / decade).ceil() * decade
}

fn channels(rig: &Rig) -> Markup {
    html! {
        details {
            summary { "Channels: all drives to all responses unless you choose" }
            div.row {
                label { "Inputs" input name="inputs" data-as="list" placeholder=(rig.drives().collect::<Vec<_>>().join(", ")); span.soft { "separated by commas" } }
                label { "Outputs" input name="outputs" data-as="list" placeholder=(rig.responses().collect::<Vec<_>>().join(", ")); span.soft { "measured inputs make a virtual sensor" } }
            }
        }
    }
}

fn selection(runs: &[Run]) -> Markup {
    let boxes = |name: &str, split: Split| {
        html! {
            @for run in runs.iter().filter(|run| run.split == split) {
                label.check { input type="checkbox" name=(name) value=(run.id) data-as="each"; (clamped(&name_of(run))) " " span.soft { (run.kind.as_str()) ", " (duration(run.duration_s)) } }
            }
        }
    };
    html! {
        details {
            summary { "Runs: all noise of the split training unless you choose" }
            fieldset { legend { "Training" } (boxes("runs", Split::Training)) }
            fieldset { legend { "Validation" } (boxes("validation_runs", Split::Validation)) }
            p.soft { "Test runs are not here: they never enter a fit." }
        }
    }
}

fn expert() -> Markup {
    let field = |name: &str, label: &str, hint: &str| {
        html! { label { (label) input name=(name) type="number" step="any" min="0" data-as="number" placeholder=(hint); } }
    };
    html! {
        details {
            summary { "Settings" }
            div.row {
                (field("preprocess.low_pass_hz", "Low-pass in Hz", "none"))
                (field("frf.segment_len", "FRF segment, samples", "chosen"))
            }
            div.row {
                label { "LSTM blocks" input name="lstm.blocks" data-as="numbers" placeholder="39"; }
                (field("lstm.epochs", "Epochs", "by the data"))
                (field("lstm.learning_rate", "Learning rate", "0.005"))
                (field("lstm.window_len", "Window, samples", "256"))
                label { "Seeds" input name="lstm.seeds" data-as="numbers" placeholder="1"; }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ui::testing::hostile_rig;

    #[test]
    fn an_estimate_grows_with_the_work_and_is_finite_without_runs() {
        let rig = hostile_rig();
        for (kind, _) in KINDS {
            for preset in [Preset::Default, Preset::Paper] {
                assert!(estimate(&rig, &[], kind, preset).is_finite());
            }
        }
        assert_eq!((rounded(0.0), rounded(1.2), rounded(31.0)), (0.0, 2.0, 40.0));
    }
}
