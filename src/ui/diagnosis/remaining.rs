//! The remaining error, the next experiment, and the method.

use maud::{Markup, html};

use super::labels::{family, in_words, parameter, words};
use super::sentence;
use super::{Heading, Simulation, figure, heading};
use crate::engine::diagnosis::{
    Hypothesis, Mode, NoiseSource, Parameter, Report, RunPart, VerdictKind, Views,
};
use crate::ui::plot::{Axis, Figure, Key, Mark, Scale, Style};
use crate::ui::text::{listed, number, percent, with_unit};

/// Shares of the drive-predicted difference of repeats above which the rig has changed.
const CHANGED: f64 = 0.02;

/// The error that remains after the best hypothesis; empty where none was tried.
pub fn remaining(report: &Report) -> Markup {
    let Some(best) = report.hypotheses.first() else { return html! {} };
    let r = &report.remaining;
    let size = r.chi2.max(0.0).sqrt();
    html! {
        (heading("remains", "What remains?"))
        p {
            "With " (sentence::held(best)) " in the model the RMS error, on the runs on which it was chosen, is " (number(size)) " noise floors"
            @if size < 1.15 { ": the remaining error cannot be told from noise." }
            @else if size < 2.0 { ": a little error remains besides the noise." }
            @else { ": more error remains than noise explains." }
            @if best.effects.len() > 1 {
                " For a further effect adopt these and diagnose again."
            } @else if let Some(second) = &r.second_effect {
                " A second effect helps: " b { (words(second.effect).name) } " (" (family(second.family)) ")"
                @if let Some(axis) = &second.axis { " on axis " (axis) }
                " on top leaves " (second.channel) " at "
                (number(second.chi2.max(0.0).sqrt())) " noise floors, and both together close " (percent(second.closure)) " of the gap on unseen runs."
            } @else if size >= 1.26 { " No second effect of the catalogue reduces it by much." }
        }
        @for plot in figures(report) {
            (figure(&plot.svg(), &html! {
                b { "Remaining error by frequency. " } "Share of the error above the noise that remains with the best candidate."
            }))
        }
    }
}

/// The plots of the section.
pub fn figures(report: &Report) -> Vec<Figure> {
    let r = &report.remaining;
    let much = r.chi2.max(0.0).sqrt() >= 1.15 && !r.bands.is_empty();
    if report.hypotheses.is_empty() || !much { Vec::new() } else { vec![bands(report)] }
}

fn bands(report: &Report) -> Figure {
    let bands = &report.remaining.bands;
    let low = bands.first().map_or(1.0, |b| b.from_hz).max(bands.last().map_or(1.0, |b| b.to_hz) / 200.0);
    let high = bands.last().map_or(2.0, |b| b.to_hz);
    let marks = bands
        .iter()
        .map(|b| Mark::Bar {
            from: b.from_hz.max(low),
            to: b.to_hz,
            height: 100.0 * b.share_of_gap,
            style: Style::After,
        })
        .collect();
    Figure {
        id: "remaining".into(),
        title: "Remaining error by frequency".into(),
        description: "Share of the best candidate's remaining error, by band.".into(),
        size: (720.0, 190.0),
        x: (Axis::exact(Scale::Log, low, high), "Frequency in Hz".into()),
        y: (
            Axis::around(Scale::Linear, bands.iter().map(|b| 100.0 * b.share_of_gap).chain([0.0])),
            "Share of the remaining error in %".into(),
        ),
        key: Key::Above,
        marks,
    }
}

/// The next experiment.
pub fn next(report: &Report) -> Markup {
    let text = match (sentence::next(report), report.verdict.kind) {
        (Some(text), _) => text,
        (None, _) if report.noise_floor_source == NoiseSource::Assumed => {
            "Run one drive twice: repeats separate noise from gap.".into()
        }
        (None, VerdictKind::NoneOfCatalogue) => {
            "Measure a further signal near the place where the gap is largest: these responses do not show its cause.".into()
        }
        (None, _) => return html! {},
    };
    html! {
        (heading("next", "What to run next?"))
        p { (text) }
    }
}

/// The method and the runs.
pub fn method(of: &Heading, report: &Report, views: &Views) -> Markup {
    let v = &report.verdict;
    html! {
        (heading("method", "How was this found?"))
        p {
            @match report.mode {
                Mode::External => "The simulation is from before the change: its linear part was kept as it is, and each candidate was added to it.",
                Mode::InSitu => "The model was fitted on the rig as it is and may have taken up a part of the effect: each candidate was fitted together with a retune of the linear part.",
            }
            " " (noise(report))
            " Errors count between " (number(views.band_hz[0])) " and " (number(views.band_hz[1])) " Hz, the band that the baseline runs excite."
        }
        @if !report.warnings.is_empty() || report.location.out_of_band_excitation || changed(report) {
            h3 { "Mind" }
            ul {
                @for warning in &report.warnings { li { (sentence::warning(warning)) } }
                @if report.location.out_of_band_excitation {
                    li { "The runs drive the rig beyond the band of the baseline runs. The response there was not scored: baseline runs over a wider band would show it." }
                }
                @if changed(report) {
                    li { "The rig changed between runs with the same drive: the drive explains " (percent(report.location.time_variance.repeat_drive_coherence)) " of their difference. Wear, warmth or a re-clamped specimen are usual causes." }
                }
            }
        }
        @if !v.because.is_empty() {
            h3 { "Reasons for the verdict" }
            ul { @for reason in &v.because { li { (in_words(reason)) } } }
        }
        @if let Some(best) = report.hypotheses.first().filter(|_| v.kind.blames()) { (parameters(best)) }
        h3 { "Data" }
        dl {
            (runs("Fitted to", &report.data_split.fit))
            (runs("Chosen on", &report.data_split.select))
            (runs("Unseen until the end", &report.data_split.test))
        }
        p.soft {
            (match &of.model {
                Simulation::Version { version, kind } => format!("Model version {version} ({kind})."),
                Simulation::Outside => "Simulation from outside.".into(),
            })
            " Computed in " (number(of.elapsed_s)) " s. Report " (report.schema) ", diagnosis " (of.diagnosis) "."
        }
    }
}

fn noise(report: &Report) -> String {
    let share = percent(report.gap.noise_rms_rel);
    match report.noise_floor_source {
        NoiseSource::Repeats => format!(
            "The noise floor ({share} of the response) comes from runs with the same drive: their difference is noise, and the error that they share is the gap."
        ),
        NoiseSource::FoundRepeats => format!(
            "The noise floor ({share} of the response) comes from runs, or periods inside a run, with the same drive, which were found among the runs."
        ),
        NoiseSource::Bounded => format!(
            "There are no runs with the same drive. What the best law, or a linear part alone, predicts on runs that it was not fitted to is no noise; the rest ({share} of the response) is noise at most."
        ),
        NoiseSource::Assumed => format!(
            "The noise floor ({share} of the response) is assumed to be the error of the linear core on the baseline runs."
        ),
    }
}

fn changed(report: &Report) -> bool {
    report.location.time_variance.repeat_drive_coherence > CHANGED
}

fn parameters(best: &Hypothesis) -> Markup {
    if best.parameters.is_empty() {
        return html! {};
    }
    let row = |p: &Parameter| {
        let error = p.se.map(|se| format!(" ± {}", with_unit(se, &p.unit))).unwrap_or_default();
        html! { tr { td { (parameter(&p.name)) } td.number { (with_unit(p.value, &p.unit)) (error) } } }
    };
    html! {
        h3 { "Fitted numbers of " (sentence::held(best)) }
        table { tbody { @for p in &best.parameters { (row(p)) } } }
        p.soft { "With standard errors. They describe the simulation; they are not measurements of a part." }
    }
}

fn runs(what: &str, parts: &[RunPart]) -> Markup {
    let named: Vec<String> =
        parts.iter().map(|p| format!("{} ({}–{} s)", p.run, number(p.from_s), number(p.to_s))).collect();
    html! { dt { (what) } dd { @if named.is_empty() { "none" } @else { (listed(&named, "and")) } } }
}
