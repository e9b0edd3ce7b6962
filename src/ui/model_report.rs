//! The report of a model version: how its fit went, on which data, and what the model leaves of data that it has not
//! seen.

use maud::{Markup, html};

use super::figures::{Drawing, address, saves};
use super::frame::{self, Frame, Section, Visitor};
use super::model::loss;
use super::plot::{Axis, Figure, Key, Mark, Scale, Style};
use super::spectrum::{Density, densities};
use super::text::{cut, number, percent};
use super::words::{clamped, duration, minute, sentence, term, word};
use crate::domain::model_report::{ChosenBy, NoPart};
use crate::domain::{Model, ModelReport, Rig};
use crate::engine::model::{Autocorrelation, Residual, ResidualOf};

/// Width of the plot of the loss curves, pixels.
const WIDTH: f64 = 840.0;

/// Most outputs whose residual is drawn; all are in the report as JSON.
const MOST_DRAWN: usize = 24;

/// Most rows of the table of data; all are in the report as JSON.
const MOST_ROWS: usize = 200;

/// What the report is of.
#[derive(Debug, Clone, Copy)]
pub struct Reported<'a> {
    /// The rig.
    pub rig: &'a Rig,
    /// The version.
    pub model: &'a Model,
    /// Its report.
    pub report: &'a ModelReport<'a>,
}

/// The report as a document that is complete in itself: no scripts, no other files.
pub fn page(of: Reported<'_>) -> String {
    frame::alone(&title(of), &content(of, None))
}

/// The report as a page of the service.
pub fn framed(visitor: &Visitor, of: Reported<'_>) -> String {
    let title = title(of);
    let rig = format!("/rigs/{}", of.rig.id);
    let version = format!("Version {}", of.model.version);
    let model_path = format!("{rig}/models/{}", of.model.version);
    let way = [("/".into(), "Rigs"), (rig, of.rig.name.as_str()), (model_path.clone(), version.as_str())];
    let mut frame = Frame::new(&title, Section::Rigs, visitor).below(&way);
    frame.class = "report";
    frame.scripts = &[];
    let at = format!("{model_path}/report");
    frame.page(&content(of, Some(&at)))
}

/// The plot of this name.
///
/// # Errors
/// The names of all plots, where there is no such one.
pub fn drawing(of: Reported<'_>, name: &str) -> Result<Drawing, String> {
    let trained = of.report.training.is_some();
    let mut all: Vec<(String, Drawing)> = Vec::new();
    if let Some(fit) = of.model.report.as_ref().filter(|_| trained) {
        all.push(("loss".into(), loss(fit, WIDTH)));
    }
    if let Some(residual) = of.report.residual {
        for (place, output) in of.model.outputs.iter().enumerate() {
            let figures =
                [spectrum(of.rig, residual, place, output), lags(&residual.autocorrelation, place, output)];
            all.extend(figures.into_iter().flatten().map(|figure| (figure.id.clone(), figure.into())));
        }
    }
    match all.iter().position(|(id, _)| id == name) {
        Some(place) => Ok(all.swap_remove(place).1),
        None => Err(all.into_iter().map(|(id, _)| id).collect::<Vec<_>>().join(", ")),
    }
}

fn title(of: Reported<'_>) -> String {
    format!("Report of version {} of {}", of.model.version, of.rig.name)
}

/// `at` is the address of the page, if it is one of the service, which has each plot as a file.
fn content(of: Reported<'_>, at: Option<&str>) -> Markup {
    let Reported { rig, model, report } = of;
    html! {
        header {
            p.over { "Fit report" }
            h1 { "Version " (model.version) " of " (clamped(&rig.name)) }
            p.soft {
                (model.kind_in_words()) " · by " (model.origin.as_str()) " · " (minute(&model.created_at)) " UTC · "
                (clamped(&model.inputs.join(", "))) " → " (clamped(&model.outputs.join(", ")))
            }
        }
        @if !report.warnings.is_empty() { ul { @for warning in report.warnings { li { (sentence(warning)) } } } }
        h2 #errors { "Errors" }
        (errors(report))
        h2 #loss { "Loss curves" }
        (training(of, at))
        h2 #frf { "FRF" }
        (frf(report))
        h2 #residual { "Residual" }
        @match report.residual {
            Some(residual) => (residual_part(rig, model, residual, at)),
            None => (absent(report, "residual")),
        }
        h2 #coverage { "Coverage of the training data" }
        (coverage(report))
        h2 #data { "Data" }
        (data(report))
    }
}

/// Why a part is not there.
fn absent(report: &ModelReport<'_>, part: &str) -> Markup {
    let why = report.reasons.get(part).map_or("It is not known.", |reason| match reason {
        NoPart::Imported => "The version was imported: the service knows no fit of it.",
        NoPart::Adopted => "The version is another one with effects on top: the fit is that of its base.",
        NoPart::NoNetwork => "A model of this kind has no network, so nothing was trained epoch by epoch.",
        NoPart::NoFrf => "A model of this kind has no FRF.",
        NoPart::EarlierProgram => "An earlier program fitted the version and did not keep it.",
        NoPart::NotFinite => "A figure exceeds the range of numbers.",
    });
    html! { p.soft { (why) } }
}

fn errors(report: &ModelReport<'_>) -> Markup {
    let Some(errors) = &report.errors else { return absent(report, "errors") };
    html! {
        div.scroll { table.figures {
            thead { tr { th.text { "Output" } th { "RMS error" } } }
            tbody { @for error in errors { tr {
                td.text { (clamped(error.channel)) }
                td { @match error.rms { Some(rms) => (percent(rms)), None => "measured zero" } }
            } } }
        } }
        p.soft { "RMS of predicted minus measured over the RMS measured, on the data that compare models or, where there are none, on those that stopped the training." }
    }
}

fn training(of: Reported<'_>, at: Option<&str>) -> Markup {
    let (Some(training), Some(fit)) = (&of.report.training, &of.model.report) else {
        return absent(of.report, "training");
    };
    html! {
        figure {
            (loss(fit, WIDTH).part())
            figcaption {
                "Mean squared error, standardised, at each epoch: on the training data, and on the data that stop the training. "
                @if let Some(seed) = training.best_seed {
                    "The network of seed " (seed) " was kept: "
                    @match training.chosen_by {
                        ChosenBy::LowestStoppingMse => "it has the lowest error on the data that stop the training.",
                        ChosenBy::OnlySeed => "there was no other seed.",
                    }
                }
                @if training.refitted { " Afterwards it was trained once more, on all training runs, up to the same share of its epochs." }
            }
            (files(at, "loss"))
        }
        div.scroll { table.figures {
            thead { tr { th.text { "Seed" } th { "Best epoch" } th { "Stopping error" } th.text { "" } } }
            tbody { @for seed in &training.seeds { tr {
                td.text { (seed.seed) }
                td { (seed.best_epoch) }
                td { (number(seed.stopping_mse)) }
                td.text { @if seed.chosen { "kept" } }
            } } }
        } }
    }
}

fn frf(report: &ModelReport<'_>) -> Markup {
    let Some(frf) = report.frf else { return absent(report, "frf") };
    let summary = frf.summary.as_ref();
    html! {
        @if let Some(summary) = summary {
            p { "Usable from " (number(summary.usable_hz[0])) " to " (number(summary.usable_hz[1])) " Hz, " (summary.lines) " lines, "
                (number(summary.df_hz)) " Hz apart." }
            @if let Some(measured) = &summary.measured {
                p { (measured.averages) " averages, worth " (number(measured.effective_averages)) " independent ones; condition number up to " (number(measured.condition_max)) "." }
                div.scroll { table.figures {
                    thead { tr { th.text { "Output" } th { "Coherence, median" } th { "Coherence, smallest" } th { "at Hz" } th { "Random error" } } }
                    tbody { @for output in &measured.outputs { tr {
                        td.text { (clamped(&output.channel)) }
                        td { (number(output.coherence_median)) }
                        td { (number(output.coherence_min)) }
                        td { (number(output.coherence_min_hz)) }
                        td { @match output.random_error { Some(error) => (percent(error)), None => "not known" } }
                    } } }
                } }
                p.soft { (term("coherence")) }
            }
        }
        @if let Some(reason) = frf.reason { p.soft { (reason) "." } }
        p { a href=(frf.href) { "All lines, with coherence and confidence" } }
    }
}

fn residual_part(rig: &Rig, model: &Model, residual: &Residual, at: Option<&str>) -> Markup {
    let whose = match residual.of {
        ResidualOf::Comparison => "data that compare models, which the model has not seen",
        ResidualOf::Stopping => "the data that stopped the training",
    };
    html! {
        p { "Measured minus predicted, on " (duration(residual.duration_s)) " of " (whose) "." }
        @for (place, output) in model.outputs.iter().take(MOST_DRAWN).enumerate() {
            @if let Some(figure) = spectrum(rig, residual, place, output) {
                figure { div.plot { (figure.svg()) } figcaption { (figure.title) "." } (files(at, &figure.id)) }
            }
            @if let Some(figure) = lags(&residual.autocorrelation, place, output) {
                figure { div.plot { (figure.svg()) } figcaption {
                    (figure.title) ". White noise stays between the rules at 95 % of the lags; beyond them the residual has a pattern that the model lacks."
                } (files(at, &figure.id)) }
            }
        }
        @if model.outputs.len() > MOST_DRAWN { p.soft { "The residuals of further outputs are in the report as JSON." } }
    }
}

/// Links that save a plot, on a page of the service.
fn files(at: Option<&str>, name: &str) -> Markup {
    html! { @if let Some(at) = at { (saves(&address(at, name))) } }
}

fn spectrum(rig: &Rig, residual: &Residual, place: usize, output: &str) -> Option<Figure> {
    let spectra = residual.spectra.as_ref()?;
    let (found, freq_hz) = (spectra.channels.get(output)?, &spectra.freq_hz[..]);
    let unit = rig.channel(output).map_or("", |channel| channel.unit.as_str());
    let measured =
        Density { freq_hz, values: &found.measured, style: Style::Measured, name: "measured".into() };
    let left = Density { freq_hz, values: &found.residual, style: Style::After, name: "residual".into() };
    Some(densities(
        format!("residual-{place}"),
        format!("Spectrum of {output} and of its residual"),
        "Power spectral densities over frequency.",
        unit,
        vec![measured, left],
    ))
}

fn lags(autocorrelation: &Autocorrelation, place: usize, output: &str) -> Option<Figure> {
    let values = autocorrelation.channels.get(output)?.as_ref()?;
    let (lag_s, bound) = (autocorrelation.lag_s, autocorrelation.bound);
    let at = |lag: usize| (lag + 1) as f64 * lag_s;
    let rule = |at: f64, name: &str| Mark::Rule { at, upright: false, name: name.into() };
    let line = Mark::Line {
        x: (0..values.len()).map(at).collect(),
        y: values.clone(),
        style: Style::After,
        name: String::new(),
    };
    Some(Figure {
        id: format!("autocorrelation-{place}"),
        title: format!("Autocorrelation of the residual of {output}"),
        description: "Autocorrelation over the lag, with the bounds of white noise.".into(),
        size: (720.0, 220.0),
        x: (Axis::exact(Scale::Linear, 0.0, at(values.len().saturating_sub(1))), "Lag in s".into()),
        y: (Axis::exact(Scale::Linear, -1.0, 1.0), "Autocorrelation".into()),
        key: Key::None,
        marks: vec![rule(bound, "95 %"), rule(-bound, ""), line],
    })
}

fn coverage(report: &ModelReport<'_>) -> Markup {
    let Some(coverage) = &report.coverage else { return absent(report, "coverage") };
    html! {
        div.scroll { table.figures {
            thead { tr {
                th.text { "Input" } th { "From" } th { "To" } th { "RMS" } th { "Slowest and fastest rate per s" } th { "Band in Hz" }
                th.text { "Share of the training in each tenth of the range" }
            } }
            tbody { @for input in coverage {
                @let of = input.coverage;
                tr {
                    td.text { (clamped(input.channel)) }
                    td { (number(of.min)) } td { (number(of.max)) } td { (number(of.rms)) }
                    td { (number(of.rate[0])) " to " (number(of.rate[1])) }
                    td { @match of.band_hz { Some([from, to]) => { (number(from)) " to " (number(to)) }, None => "does not move" } }
                    td.text { (of.shares.iter().map(|share| percent(*share)).collect::<Vec<_>>().join(" · ")) }
                }
            } }
        } }
    }
}

fn data(report: &ModelReport<'_>) -> Markup {
    if report.data.is_empty() {
        return html! { p.soft { "The service does not know the data that made the version." } };
    }
    let more = report.data.len().saturating_sub(MOST_ROWS);
    html! {
        div.scroll { table.figures {
            thead { tr { th.text { "Use" } th.text { "Run" } th.text { "Kind" } th { "Length" } th { "Share of the use" } th { "RMS error" } } }
            tbody { @for used in report.data.iter().take(MOST_ROWS) { tr {
                td.text { (word(used.used_for)) }
                td.text {
                    a href={ "/rigs/" (report.rig) "/runs/" (used.span.run) } {
                        @match used.name { Some(name) if !name.is_empty() => (clamped(name)), _ => code { (&used.span.run.to_string()[24..]) } }
                    }
                    @if used.kind.is_none() { " (gone)" }
                }
                td.text { @if let Some(kind) = used.kind { (kind.as_str()) } }
                td { (duration(used.duration_s)) }
                td { (percent(used.share)) }
                td { @if let Some(rms) = &used.rms {
                    (rms.iter().map(|(name, rms)| format!("{} {}", cut(name), rms.map_or_else(|| "–".into(), percent))).collect::<Vec<_>>().join(", "))
                } }
            } } }
        } }
        @if more > 0 { p.soft { (more) " more rows are in the report as JSON." } }
    }
}
