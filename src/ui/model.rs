//! The page of a model version: how good it is, what it was made from, its FRF and its learning curves.

use maud::{Markup, html};

use super::figures::{Drawing, address, late, thinned};
use super::frame::{Frame, Section, Visitor, csrf};
use super::plot::{Axis, Figure, Key, Mark, Scale, Style};
use super::run::with_unit;
use super::text::{cut, number, percent};
use super::words::{bytes, clamped, count, duration, minute, sentence, term};
use crate::domain::{Model, Rig, Span, TokenRole};
use crate::engine::frf::{Frf, FrfQuality};
use crate::engine::model::{FitReport, RigModel};

/// Points of a line of an FRF.
const LINES: usize = 450;

/// Height of a plot, pixels.
const TALL: f64 = 300.0;

/// Probability that the true value lies in the band.
pub const CONFIDENCE: f64 = 0.95;

/// Mean over the outputs of a model's RMS error on the data that compare models.
pub(super) fn mean_error(model: &Model) -> Option<f64> {
    let report = model.report.as_ref()?;
    let found: Vec<f64> = report.validation_rms.iter().flatten().copied().collect();
    (!found.is_empty()).then(|| found.iter().sum::<f64>() / found.len() as f64)
}

/// The form that makes a version the active one.
pub(super) fn activation(model: &Model, tag: &str, visitor: &Visitor, word: &str) -> Markup {
    html! {
        form data-api={ "PUT /v1/rigs/" (model.rig) "/active-model" } data-if-match=(tag) data-body=(format!("{{\"version\": {}}}", model.version)) {
            (csrf(visitor))
            button type="submit" { (word) }
        }
    }
}

/// What the page shows.
#[derive(Debug, Clone, PartialEq)]
pub struct ModelView<'a> {
    /// The rig.
    pub rig: &'a Rig,
    /// The version.
    pub model: &'a Model,
    /// `ETag` of the active model.
    pub active_tag: &'a str,
    /// The active version, if there is one.
    pub active: Option<u32>,
    /// Output whose FRF is shown.
    pub output: usize,
}

/// The page.
pub fn page(visitor: &Visitor, of: &ModelView<'_>) -> String {
    let (rig, model) = (of.rig, of.model);
    let at = format!("/rigs/{}/models/{}", rig.id, model.version);
    let title = format!("Version {} of {}", model.version, rig.name);
    let main = html! {
        (head(visitor, of, &at))
        @if let Some(report) = &model.report {
            @if !report.warnings.is_empty() { ul.notes { @for warning in &report.warnings { li { (sentence(warning)) } } } }
            h2 #errors { "Errors on validation data" }
            (errors(model, report))
            @if !report.seeds.is_empty() {
                h2 #loss { "Learning curves" }
                (late(&address(&at, "loss"), &html! { "Mean squared error, standardised, of each seed: training, and the data that stop it. Seed " (report.best_seed.unwrap_or_default()) " was kept." }))
            }
        }
        @if model.frf.is_some() { (frf(of, &at)) }
        h2 #lineage { "Where it comes from" }
        (lineage(model))
        @if visitor.may(TokenRole::Admin) && !model.active {
            details {
                summary { "Delete this version" }
                form data-api={ "DELETE /v1" (at) } data-then={ "/rigs/" (rig.id) } data-confirm="Delete this version? There is no way back." {
                    (csrf(visitor)) button.grave type="submit" { "Delete the version" }
                }
            }
        }
    };
    let way = [("/".to_owned(), "Rigs"), (format!("/rigs/{}", rig.id), rig.name.as_str())];
    Frame::new(&title, Section::Rigs, visitor).below(&way).page(&main)
}

fn head(visitor: &Visitor, of: &ModelView<'_>, at: &str) -> Markup {
    let model = of.model;
    let forward = model.is_forward(of.rig);
    let operator = visitor.may(TokenRole::Operator);
    let back = of.active.is_some_and(|active| active > model.version);
    html! {
        div.head {
            div {
                h1 { "Version " (model.version) " " @if model.active { span.tag.good { "active" } } }
                p.soft { (model.kind_in_words()) " · by " (model.origin.as_str()) " · " (minute(&model.created_at)) " UTC · " (bytes(model.size_bytes)) }
                p { (clamped(&model.inputs.join(", "))) " → " (clamped(&model.outputs.join(", "))) }
                @if !forward { p.soft { "It does not map all drives to all responses: it predicts under its number, and cannot be the active one." } }
            }
            div.actions {
                @if operator && forward && !model.active { (activation(model, of.active_tag, visitor, if back { "Roll back to this version" } else { "Activate" })) }
                a.button href={ "/rigs/" (model.rig) "/predict?model=" (model.version) } { "Predict" }
                a.button href={ (at) "/report" } { "Report" }
                @if operator { a.button href={ "/v1" (at) "/weights" } download { "Export weights" } }
                @if operator { a.button href={ "/rigs/" (model.rig) "/diagnose?model=" (model.version) } { "Diagnose" } }
            }
        }
    }
}

fn errors(model: &Model, report: &FitReport) -> Markup {
    html! {
        div.wide { table {
            thead { tr { th { "Output" } th.number { "RMS error" } } }
            tbody {
                @for (name, rms) in model.outputs.iter().zip(&report.validation_rms) {
                    tr { td { (clamped(name)) } td.number { @match rms { Some(rms) => (percent(*rms)), None => "measured zero" } } }
                }
            }
        } }
        p.soft {
            "RMS of predicted minus measured over the RMS measured, on " (duration(report.validation_s)) " that the model has not seen; "
            "fitted on " (duration(report.training_s)) "."
            @if report.comparison.as_ref().is_some_and(|c| c.refitted) { " Afterwards it was fitted once more on all runs." }
        }
    }
}

fn frf(of: &ModelView<'_>, at: &str) -> Markup {
    let shown = format!("{at}?output={}", of.output);
    html! {
        h2 #frf { "Frequency response" }
        form.tools method="get" action={ (at) "#frf" } {
            label.check { "Response" select name="output" data-go {
                @for (place, name) in of.model.outputs.iter().enumerate() { option value=(place) selected[place == of.output] { (cut(name)) } }
            } }
            noscript { button type="submit" { "Show" } }
        }
        div.pair {
            (late(&address(&shown, "magnitude"), &html! { "Magnitude of the response to each drive; the band holds the true value with a probability of " (percent(CONFIDENCE)) "." }))
            (late(&address(&shown, "phase"), &html! { "Phase: negative where the response lags behind the drive." }))
            (late(&address(&shown, "coherence"), &html! { (term("coherence")) " The multiple coherence counts all drives together." }))
        }
        p.soft { a href={ "/v1" (at) "/frf" } { "All lines for programs" } }
    }
}

fn lineage(model: &Model) -> Markup {
    let spans = |name: &str, spans: &[Span]| {
        html! {
            @if !spans.is_empty() {
                dt { (name) }
                dd { @for span in spans {
                    a href={ "/rigs/" (model.rig) "/runs/" (span.run) } { "run " code { (&span.run.to_string()[24..]) } }
                    " samples " (span.from_sample) " to " (span.to_sample) br;
                } }
            }
        }
    };
    html! {
        dl {
            @if let Some(adoption) = &model.adoption {
                dt { "Consists of" }
                dd {
                    (adoption.base.kind.as_str()) @if let Some(version) = adoption.base.version { " of version " (version) }
                    @for effect in &adoption.effects { ", with " (effect.effect.name()) " at " (clamped(&effect.channel)) }
                }
            }
            (spans("Fitted on", &model.lineage.training))
            (spans("FRF from", &model.lineage.frf))
            @if let Some(core) = &model.lineage.core {
                dt { "Core" }
                dd {
                    "an FRF" @for effect in &core.effects { ", with " (effect.effect.name()) " at " (clamped(&effect.channel)) }
                    @if let Some(version) = core.version { " (version " (version) ")" }
                }
            }
            @if let Some(stopping) = &model.lineage.stopping { (spans("Stopped by", stopping)) }
            (spans("Compared on", &model.lineage.validation))
            @for adopted in &model.lineage.diagnoses {
                dt { "Effect from" } dd { a href={ "/rigs/" (model.rig) "/diagnoses/" (adopted.id) } { "a diagnosis of version " (adopted.version) } }
            }
            @if let Some(job) = model.job { dt { "Job" } dd { a href={ "/jobs/" (job) } { code { (job) } } } }
            dt { "Program" } dd { "version " (model.code_version) ", instruction set " (model.instruction_set) }
            dt { "Weights" } dd { "SHA-256 " code { (model.sha256) } }
        }
        @if let Some(request) = &model.request {
            details { summary { "The request of its fit" } pre { (serde_json::to_string_pretty(request).unwrap_or_default()) } }
        }
    }
}

/// The learning curves of all seeds.
pub fn loss(report: &FitReport, width: f64) -> Drawing {
    let mut marks = Vec::new();
    for (place, seed) in report.seeds.iter().enumerate() {
        let x: Vec<f64> = seed.curve.iter().map(|point| point.0 as f64).collect();
        let line = |values: Vec<f64>, name: &str, style| Mark::Line {
            x: x.clone(),
            y: values,
            style,
            name: format!("seed {} {name}", seed.seed),
        };
        marks.push(line(seed.curve.iter().map(|p| p.1).collect(), "training", Style::Series(2 * place)));
        marks.push(line(seed.curve.iter().map(|p| p.2).collect(), "stopping", Style::Series(2 * place + 1)));
    }
    let all = report.seeds.iter().flat_map(|seed| &seed.curve);
    let last = all.clone().map(|point| point.0).max().unwrap_or(1) as f64;
    if marks.is_empty() {
        return Drawing::Nothing("This version has no learning curve.".into());
    }
    Figure {
        id: "loss".into(),
        title: "Learning curves".into(),
        description: format!("{} of up to {last} epochs.", count(report.seeds.len(), "seed", "seeds")),
        size: (width, TALL),
        x: (Axis::exact(Scale::Count, 0.0, last), "Epoch".into()),
        y: (Axis::around(Scale::Log, all.flat_map(|point| [point.1, point.2])), "Mean squared error".into()),
        key: Key::Above,
        marks,
    }
    .into()
}

/// One view of an output's FRF: `magnitude`, `phase` or `coherence`.
pub fn response(name: &str, rig: &Rig, model: &RigModel, frf: &Frf, output: usize, width: f64) -> Drawing {
    let quality = model.frf_quality.as_ref();
    let [low, high] = frf.usable_hz;
    let df = frf.df_hz();
    let lines: Vec<usize> =
        (1..frf.n_lines()).filter(|line| (low - df..=high + df).contains(&(*line as f64 * df))).collect();
    if lines.len() < 2 {
        return Drawing::Nothing("The FRF has too few lines to draw.".into());
    }
    let unit = |channel: &str| rig.channel(channel).map_or("", |channel| channel.unit.as_str());
    let view = FrfView { model, frf, quality, output, lines, df };
    let out = &model.outputs[output];
    let (y, marks) = match name {
        "magnitude" => {
            let mut units: Vec<String> =
                model.inputs.iter().map(|input| format!("{}/{}", unit(out), unit(input))).collect();
            units.dedup();
            let y_name = with_unit(&format!("|H| of {out}"), &units.join(", "));
            let (axis, marks) = view.magnitude();
            ((axis, y_name), marks)
        }
        "phase" => ((Axis::exact(Scale::Linear, -180.0, 180.0), "Phase in degrees".to_owned()), view.phase()),
        _ => match quality {
            Some(quality) => {
                ((Axis::exact(Scale::Linear, 0.0, 1.0), "Coherence".to_owned()), view.coherence(quality))
            }
            None => {
                return Drawing::Nothing("The weights carry no coherence: they were made elsewhere.".into());
            }
        },
    };
    Figure {
        id: name.into(),
        title: format!("{} of {out}", y.1),
        description: format!("From {} to {} Hz.", number(low), number(high)),
        size: (width.min(760.0), TALL),
        x: (Axis::exact(Scale::Log, low.max(df), high), "Frequency in Hz".into()),
        y,
        key: Key::Above,
        marks,
    }
    .into()
}

/// Lines of the FRF of one output.
struct FrfView<'a> {
    model: &'a RigModel,
    frf: &'a Frf,
    quality: Option<&'a FrfQuality>,
    output: usize,
    lines: Vec<usize>,
    df: f64,
}

impl FrfView<'_> {
    fn freq(&self) -> Vec<f64> {
        self.lines.iter().map(|line| *line as f64 * self.df).collect()
    }

    fn index(&self, line: usize, input: usize) -> usize {
        (line * self.frf.n_outputs + self.output) * self.frf.n_inputs + input
    }

    fn line(&self, y: &[f64], input: usize, name: &str) -> Mark {
        let (x, y) = thinned(&self.freq(), y, LINES);
        Mark::Line { x, y, style: Style::Series(input), name: name.to_owned() }
    }

    fn magnitude(&self) -> (Axis, Vec<Mark>) {
        let factor = self.quality.and_then(|quality| quality.confidence_factor(CONFIDENCE).ok());
        let (mut bands, mut lines, mut all) = (Vec::new(), Vec::new(), Vec::new());
        for (input, name) in self.model.inputs.iter().enumerate() {
            let size: Vec<f64> =
                self.lines.iter().map(|&line| self.frf.at(line, self.output, input).norm()).collect();
            if let (Some(factor), Some(quality)) = (factor, self.quality) {
                let radius = |k: usize| factor * quality.std_error[self.index(self.lines[k], input)];
                let step = self.lines.len().div_ceil(LINES);
                let places: Vec<usize> = (0..self.lines.len()).step_by(step).collect();
                bands.push(Mark::Band {
                    x: places.iter().map(|&k| self.lines[k] as f64 * self.df).collect(),
                    low: places.iter().map(|&k| (size[k] - radius(k)).max(1e-3 * size[k])).collect(),
                    high: places.iter().map(|&k| size[k] + radius(k)).collect(),
                    style: Style::Series(input),
                    name: String::new(),
                });
            }
            lines.push(self.line(&size, input, name));
            all.extend(size);
        }
        bands.extend(lines);
        (Axis::around(Scale::Log, all), bands)
    }

    fn phase(&self) -> Vec<Mark> {
        let of = |input: usize| -> Vec<f64> {
            self.lines.iter().map(|&line| self.frf.at(line, self.output, input).arg().to_degrees()).collect()
        };
        self.model.inputs.iter().enumerate().map(|(input, name)| self.line(&of(input), input, name)).collect()
    }

    fn coherence(&self, quality: &FrfQuality) -> Vec<Mark> {
        let multiple: Vec<f64> = self
            .lines
            .iter()
            .map(|&line| quality.multiple_coherence[line * self.frf.n_outputs + self.output])
            .collect();
        let mut marks = vec![self.line(&multiple, 7, "all drives")];
        for (input, name) in self.model.inputs.iter().enumerate() {
            let ordinary: Vec<f64> =
                self.lines.iter().map(|&line| quality.coherence[self.index(line, input)]).collect();
            marks.push(self.line(&ordinary, input, name));
        }
        marks
    }
}
