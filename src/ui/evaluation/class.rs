//! The section of one class of runs.

use maud::{Markup, html};

use super::{named, tables};
use crate::domain::evaluation::{ClassRow, EvaluatedChannel, EvaluationReport};
use crate::ui::figures::{address, saves};
use crate::ui::plot::{Figure, RatioRow, Ratios, Style};
use crate::ui::spectrum::{Density, densities};
use crate::ui::text::{number, percent};

/// Most rows of the plot of damage ratios; the tables have them all.
const MOST_RATIOS: usize = 40;

/// Its tables and plots. `spectra_left` counts the plots of spectra that the page may still have; `at` is the address of
/// the page, if it is one of the service, which has each of them as a file.
pub fn section(
    k: usize,
    report: &EvaluationReport,
    rows: &[&ClassRow],
    spectra_left: &mut usize,
    at: Option<&str>,
) -> Markup {
    let class = &rows[0].class;
    let drawn: Vec<Figure> = spectra(k, report, rows).take(*spectra_left).collect();
    *spectra_left -= drawn.len();
    html! {
        h2 id=(format!("class-{k}")) { "Runs: " (class) }
        (facts(report, rows))
        (tables::groups(report, rows))
        @if rows.iter().any(|row| row.runs > 0) {
            (damage(k, report, rows, at))
            @for figure in &drawn {
                figure {
                    div.plot { (figure.svg()) }
                    figcaption { (figure.title) }
                    @if let Some(at) = at { (saves(&address(at, &figure.id))) }
                }
            }
            (tables::channels(report, rows))
        }
    }
}

/// Runs that count, and where each model is worst.
fn facts(report: &EvaluationReport, rows: &[&ClassRow]) -> Markup {
    html! {
        ul {
            @for row in rows {
                li {
                    (named(report, row.model)) ": " (count(row.runs)) ", " (number(row.duration_s)) " s"
                    @if row.left_out > 0 { ", " (count(row.left_out)) " left out that it was fitted on" }
                    @if let Some(worst) = &row.worst_channel {
                        ". Worst channel: " (worst.channel) " (" (percent(worst.rms)) ")"
                    }
                    @if let Some(worst) = &row.worst_span {
                        ". Worst span: " (worst.span.channel) " from " (number(worst.span.from_s)) " to "
                        (number(worst.span.to_s)) " s of " (run_name(report, row)) " (" (percent(worst.span.rms))
                        " of the channel's RMS)"
                    }
                    "."
                }
            }
        }
    }
}

fn run_name(report: &EvaluationReport, row: &ClassRow) -> String {
    let run = row.worst_span.as_ref().map(|worst| worst.run);
    let found = report.runs.iter().find(|r| Some(r.id) == run);
    found.map_or_else(String::new, super::runs::name)
}

fn count(runs: usize) -> String {
    if runs == 1 { "1 run".into() } else { format!("{runs} runs") }
}

/// The baseline among the models, if there is one.
fn baseline(report: &EvaluationReport) -> Option<u32> {
    report.models.iter().find(|model| model.baseline).map(|model| model.version)
}

/// Damage ratios of channels and groups: every model's, with the baseline's beside.
pub fn ratios(k: usize, report: &EvaluationReport, rows: &[&ClassRow]) -> Ratios {
    let baseline = baseline(report);
    let of_baseline = rows.iter().find(|row| Some(row.model) == baseline);
    let others = || rows.iter().filter(|row| rows.len() == 1 || Some(row.model) != baseline);
    let mut drawn = Vec::new();
    for channel in &report.channels {
        for row in others() {
            let Some(average) = row.average.channels.get(&channel.name) else { continue };
            let other = of_baseline.filter(|_| rows.len() > 1);
            drawn.push(RatioRow {
                name: format!("{}, version {}", channel.name, row.model),
                value: average.damage_ratio,
                other: other.and_then(|row| row.average.channels.get(&channel.name)?.damage_ratio),
                interval: None,
            });
        }
    }
    for group in &report.groups {
        for row in others() {
            let Some(value) = row.average.groups.get(&group.name).and_then(|g| g.multi_rain) else {
                continue;
            };
            let other = of_baseline.filter(|_| rows.len() > 1);
            drawn.push(RatioRow {
                name: format!("{}, Multi-Rain, version {}", group.name, row.model),
                value: Some(value),
                other: other.and_then(|row| row.average.groups.get(&group.name)?.multi_rain),
                interval: None,
            });
        }
    }
    drawn.truncate(MOST_RATIOS);
    Ratios {
        id: format!("damage-{k}"),
        title: format!("Damage ratios on {}", rows[0].class),
        description:
            "One row a channel and model: predicted over measured damage on a logarithmic axis about 1."
                .into(),
        label: "Predicted over measured damage".into(),
        rows: drawn,
    }
}

fn damage(k: usize, report: &EvaluationReport, rows: &[&ClassRow], at: Option<&str>) -> Markup {
    let plot = ratios(k, report, rows);
    html! {
        figure {
            div.plot { (plot.svg()) }
            figcaption {
                b { (plot.title) ". " } "1 is right."
                @if baseline(report).is_some() && rows.len() > 1 { " The grey dots are those of the baseline." }
            }
            @if let Some(at) = at { (saves(&address(at, &plot.id))) }
        }
    }
}

/// The spectra of a class, one for each group of channels.
pub fn spectra(k: usize, report: &EvaluationReport, rows: &[&ClassRow]) -> impl Iterator<Item = Figure> {
    worst_channels(report, rows).into_iter().filter_map(move |channel| spectrum(k, report, rows, channel))
}

/// Of each group the channel on which the first model is worst.
fn worst_channels<'a>(report: &'a EvaluationReport, rows: &[&ClassRow]) -> Vec<&'a EvaluatedChannel> {
    let worst = |group: &crate::engine::evaluation::ChannelGroup| {
        let first = rows.iter().find(|row| row.runs > 0 && row.average.groups.contains_key(&group.name))?;
        let errors =
            group.channels.iter().filter_map(|name| Some((name, first.average.channels.get(name)?.rms?)));
        let (name, _) = errors.reduce(|a, b| if b.1 > a.1 { b } else { a })?;
        report.channels.iter().find(|channel| channel.name == *name)
    };
    report.groups.iter().filter_map(worst).collect()
}

/// The measured spectrum of a channel, and those that the first model and the baseline predict.
fn spectrum(
    k: usize,
    report: &EvaluationReport,
    rows: &[&ClassRow],
    channel: &EvaluatedChannel,
) -> Option<Figure> {
    let baseline = baseline(report);
    let has = |row: &&&ClassRow| {
        row.spectra.as_ref().is_some_and(|spectra| spectra.channels.contains_key(&channel.name))
    };
    let first = rows.iter().filter(has).find(|row| rows.len() == 1 || Some(row.model) != baseline);
    let first = first.or_else(|| rows.iter().find(has))?;
    let other = rows.iter().filter(has).find(|row| Some(row.model) == baseline && row.model != first.model);
    let spectra = first.spectra.as_ref()?;
    let found = &spectra.channels[&channel.name];
    let freq_hz = &spectra.freq_hz[..];
    let mut drawn =
        vec![Density { freq_hz, values: &found.target, style: Style::Measured, name: "measured".into() }];
    if let Some(other) = other {
        let of_other = other.spectra.as_ref()?;
        drawn.push(Density {
            freq_hz: &of_other.freq_hz,
            values: &of_other.channels[&channel.name].predicted,
            style: Style::Before,
            name: format!("version {}", other.model),
        });
    }
    let name = format!("version {}", first.model);
    drawn.push(Density { freq_hz, values: &found.predicted, style: Style::After, name });
    let place = report.channels.iter().position(|c| c.name == channel.name)?;
    Some(densities(
        format!("spectrum-{k}-{place}"),
        format!("Spectrum of {} on {}: measured and predicted", channel.name, first.class),
        "Power spectral densities over frequency, means over the runs that count.",
        &channel.unit,
        drawn,
    ))
}
