//! The page of a run: its signals over time, their spectra and counts, and its quality report.

use maud::{Markup, html};

use super::figures::{Drawing, Zoom, address, late, thinned};
use super::frame::{Frame, Section, Visitor, csrf};
use super::plot::{Axis, Figure, Key, Mark, Matrix, Scale, Style};
use super::rig::name_of;
use super::text::{cut, exponents, number, percent};
use super::words::{clamped, duration, minute, sentence, term};
use crate::domain::{Rig, Run, RunKind, Split, TokenRole};
use crate::engine::envelope::Envelope;
use crate::engine::fatigue::Counts;
use crate::engine::spectral::Psd;

/// Height of a channel's row, pixels, and of a plot that stands alone.
const ROW: f64 = 136.0;
const TALL: f64 = 320.0;

/// Points of a line of a spectrum.
const LINES: usize = 500;

/// A view of a run's signals.
#[derive(Debug, Clone, PartialEq)]
pub struct TimeView {
    /// Names and units of the channels.
    pub channels: Vec<(String, String)>,
    /// Their envelopes.
    pub envelopes: Vec<Envelope>,
    /// Range of time, s.
    pub range: [f64; 2],
    /// Whether a column is one sample.
    pub single: bool,
    /// Width of the picture, pixels.
    pub width: f64,
    /// Whether channels of one unit share a plot.
    pub overlay: bool,
}

/// The axis over some values and the name of its unit.
fn axis(envelopes: &[&Envelope]) -> Axis {
    Axis::around(Scale::Linear, envelopes.iter().flat_map(|e| e.low.iter().chain(&e.high)).copied())
}

/// A name with its unit.
pub fn with_unit(name: &str, unit: &str) -> String {
    if unit.is_empty() || unit == "1" { name.to_owned() } else { format!("{name} in {}", exponents(unit)) }
}

impl TimeView {
    fn mark(&self, channel: usize, style: Style) -> Mark {
        let (name, envelope) = (self.channels[channel].0.clone(), &self.envelopes[channel]);
        let [from, to] = self.range;
        if self.single {
            let step = (to - from) / envelope.low.len().max(1) as f64;
            let x = (0..envelope.low.len()).map(|k| from + step * k as f64).collect();
            return Mark::Line { x, y: envelope.low.clone(), style, name };
        }
        Mark::Envelope { from, to, low: envelope.low.clone(), high: envelope.high.clone(), style, name }
    }

    /// The plots.
    pub fn drawing(&self) -> Drawing {
        let x = || Axis::exact(Scale::Linear, self.range[0], self.range[1]);
        let plot = |id: String, height: f64, y: Axis, y_name: String, key: Key, marks: Vec<Mark>| Figure {
            id,
            title: format!("{y_name} over time"),
            description: format!("From {} to {} s.", number(self.range[0]), number(self.range[1])),
            size: (self.width, height),
            x: (x(), "Time in s".into()),
            y: (y, y_name),
            key,
            marks,
        };
        if !self.overlay {
            let rows = self.channels.iter().enumerate().map(|(at, (name, unit))| {
                let y = axis(&[&self.envelopes[at]]);
                plot(
                    format!("time-{at}"),
                    ROW,
                    y,
                    with_unit(name, unit),
                    Key::None,
                    vec![self.mark(at, Style::Series(0))],
                )
            });
            return Drawing::Plots(rows.collect());
        }
        let mut units: Vec<&str> = Vec::new();
        for (_, unit) in &self.channels {
            if !units.contains(&unit.as_str()) {
                units.push(unit);
            }
        }
        let plots = units.iter().enumerate().map(|(at, unit)| {
            let members: Vec<usize> =
                (0..self.channels.len()).filter(|&c| self.channels[c].1 == **unit).collect();
            let y = axis(&members.iter().map(|&c| &self.envelopes[c]).collect::<Vec<_>>());
            let marks = members.iter().enumerate().map(|(k, &c)| self.mark(c, Style::Series(k))).collect();
            plot(format!("time-{at}"), TALL, y, with_unit("Value", unit), Key::Above, marks)
        });
        Drawing::Plots(plots.collect())
    }
}

/// Power spectral densities of channels, those of one unit in one plot.
pub fn spectra(channels: &[(String, String)], psd: &Psd, width: f64) -> Drawing {
    let mut units: Vec<&str> = Vec::new();
    for (_, unit) in channels {
        if !units.contains(&unit.as_str()) {
            units.push(unit);
        }
    }
    let freq: Vec<f64> = (1..psd.density[0].len()).map(|line| line as f64 * psd.df_hz).collect();
    if freq.len() < 2 {
        return Drawing::Nothing("The run is too short for a spectrum.".into());
    }
    let plots = units.iter().enumerate().map(|(at, unit)| {
        let members: Vec<usize> = (0..channels.len()).filter(|&c| channels[c].1 == **unit).collect();
        let marks: Vec<Mark> = members
            .iter()
            .enumerate()
            .map(|(k, &c)| {
                let (x, y) = thinned(&freq, &psd.density[c][1..], LINES);
                Mark::Line { x, y, style: Style::Series(k), name: channels[c].0.clone() }
            })
            .collect();
        let values = members.iter().flat_map(|&c| psd.density[c][1..].iter().copied());
        let unit = if unit.is_empty() { "1".to_owned() } else { format!("({unit})^2") };
        Figure {
            id: format!("psd-{at}"),
            title: "Power spectral density".into(),
            description: format!("{} averages, lines {} Hz apart.", psd.n_averages, number(psd.df_hz)),
            size: (width, TALL),
            x: (Axis::exact(Scale::Log, freq[0], *freq.last().unwrap_or(&1.0)), "Frequency in Hz".into()),
            y: (Axis::around(Scale::Log, values), format!("PSD in {}/Hz", exponents(&unit))),
            key: Key::Above,
            marks,
        }
    });
    Drawing::Plots(plots.collect())
}

/// The three tables of counts of one or two signals of a channel; the names of the signals are those of the lines.
pub fn counted(name: &str, channel: &str, unit: &str, tables: &[(&str, &Counts)], width: f64) -> Drawing {
    let Some((_, first)) = tables.first() else { return Drawing::Nothing("Nothing was counted.".into()) };
    match name {
        "from_to" => {
            let edges = first.from_to.edges.clone();
            let axis = Axis::exact(Scale::Linear, edges[0], edges[edges.len() - 1]);
            Drawing::Matrix(Box::new(Matrix {
                id: "from-to".into(),
                title: format!("Rainflow from-to matrix of {channel}"),
                description: "Cycles by the classes in which they begin and turn.".into(),
                edges,
                axis,
                names: [with_unit("From", unit), with_unit("To", unit)],
                cells: first.from_to.cycles.clone(),
            }))
        }
        "range_pair" => {
            let lines = tables.iter().map(|(signal, counts)| {
                let found = &counts.range_pair;
                // At the lower edge of each class: cycles of this range and more.
                (*signal, found.cumulative.clone(), found.range_edges[..found.cumulative.len()].to_vec())
            });
            counts_plot(
                "range-pair",
                "Cycles of at least this range",
                with_unit("Range", unit),
                lines.collect(),
                width,
            )
        }
        _ => {
            let lines = tables.iter().map(|(signal, counts)| {
                let found = &counts.level_crossing;
                (*signal, found.rising.iter().map(|n| *n as f64).collect(), found.levels.clone())
            });
            counts_plot(
                "level-crossing",
                "Crossings from below",
                with_unit("Level", unit),
                lines.collect(),
                width,
            )
        }
    }
}

fn counts_plot(
    id: &str,
    x_name: &str,
    y_name: String,
    lines: Vec<(&str, Vec<f64>, Vec<f64>)>,
    width: f64,
) -> Drawing {
    let most = lines.iter().flat_map(|(_, x, _)| x.iter().copied()).fold(1.0, f64::max);
    // One signal has the first style; of two the measured one comes first, in the style that it has in every plot.
    let styles =
        if lines.len() > 1 { vec![Style::Series(1), Style::Series(0)] } else { vec![Style::Series(0)] };
    let y = Axis::around(Scale::Linear, lines.iter().flat_map(|(_, _, y)| y.iter().copied()));
    let marks = lines.into_iter().zip(styles).map(|((name, x, y), style)| {
        let x = x.into_iter().map(|n| if n > 0.0 { n } else { f64::NAN }).collect();
        Mark::Line { x, y, style, name: name.into() }
    });
    Figure {
        id: id.into(),
        title: format!("{y_name} over {}", x_name.to_lowercase()),
        description: "Counts on a logarithmic axis.".into(),
        size: (width.min(700.0), TALL),
        x: (Axis::around(Scale::Log, [0.5, most]), x_name.into()),
        y: (y, y_name),
        key: Key::Above,
        marks: marks.collect(),
    }
    .into()
}

/// What the page shows of its run.
#[derive(Debug, Clone)]
pub struct RunView<'a> {
    /// The rig.
    pub rig: &'a Rig,
    /// The run.
    pub run: &'a Run,
    /// Channel whose counts are shown.
    pub channel: usize,
    /// Whether channels of one unit share a plot.
    pub overlay: bool,
    /// The signals over time.
    pub time: Drawing,
    /// Whether the rig has an active model.
    pub can_predict: bool,
}

/// The page.
pub fn page(visitor: &Visitor, of: &RunView<'_>) -> String {
    let (rig, run) = (of.rig, of.run);
    let at = format!("/rigs/{}/runs/{}", rig.id, run.id);
    let name = name_of(run);
    let shown = format!("{at}?channel={}{}", of.channel, if of.overlay { "&overlay=true" } else { "" });
    let time = address(&shown, "time");
    let zoom = Zoom {
        address: &time,
        name: "Signals over time",
        range: [0.0, run.duration_s],
        least: 8.0 / run.sample_rate_hz,
    };
    let main = html! {
        (head(visitor, of, &at, &name))
        h2 #time { "Over time" }
        form.tools method="get" action=(at) {
            input type="hidden" name="channel" value=(of.channel);
            label.check { input type="checkbox" name="overlay" value="true" checked[of.overlay] data-go; "Channels of one unit in one plot" }
            noscript { button type="submit" { "Show" } }
        }
        (zoom.figure(Some(&of.time), &html! { "Each column of the picture spans its smallest and its largest sample; close enough, the samples themselves are drawn." }))
        h2 #spectra { "Spectra" }
        (late(&address(&shown, "psd"), &html! { (term("psd")) }))
        (counts(of, &at, &shown))
        (quality(run))
        (changes(visitor, of, &at))
    };
    let way = [("/".to_owned(), "Rigs"), (format!("/rigs/{}", rig.id), rig.name.as_str())];
    Frame::new(&name, Section::Rigs, visitor).below(&way).page(&main)
}

fn head(visitor: &Visitor, of: &RunView<'_>, at: &str, name: &str) -> Markup {
    let run = of.run;
    let operator = visitor.may(TokenRole::Operator);
    html! {
        div.head {
            div {
                h1 { (clamped(name)) }
                p.soft {
                    (run.kind.as_str()) " · " (run.split.as_str()) " · " (duration(run.duration_s)) " at " (number(run.sample_rate_hz)) " Hz · "
                    (run.samples) " samples of " (run.channels.len()) " channels · accepted " (minute(&run.created_at)) " UTC"
                }
                @for tag in &run.tags { span.tag { (clamped(tag)) } " " }
            }
            div.actions {
                @if of.can_predict { a.button.main href={ "/rigs/" (of.rig.id) "/predict?drive=" (run.id) "&target=" (run.id) } { "Predict this run" } }
                @if operator && of.can_predict { a.button href={ "/rigs/" (of.rig.id) "/diagnose?run=" (run.id) } { "Diagnose" } }
                @if operator && of.can_predict { a.button href={ "/rigs/" (of.rig.id) "/iterate?run=" (run.id) } { "Find its drive" } }
                form method="get" action={ (at) "/file" } {
                    label.check { span.soft { "Download as" }
                        select name="format" { @for format in ["csv", "npy", "rpc3", "mat", "json"] { option value=(format) { (format) } } }
                    }
                    " " button type="submit" { "Download" }
                }
            }
        }
        @if let Some(first) = &run.duplicate_of {
            p.notes { "The same bytes were uploaded before: " a href={ "/rigs/" (of.rig.id) "/runs/" (first) } { "the first of them" } "." }
        }
    }
}

fn counts(of: &RunView<'_>, at: &str, shown: &str) -> Markup {
    html! {
        h2 #counts { "Rainflow" }
        form.tools method="get" action={ (at) "#counts" } {
            @if of.overlay { input type="hidden" name="overlay" value="true"; }
            label.check { "Channel" select name="channel" data-go {
                @for (place, name) in of.run.channels.iter().enumerate() {
                    option value=(place) selected[place == of.channel] { (cut(name)) }
                }
            } }
            noscript { button type="submit" { "Show" } }
        }
        div.pair {
            (late(&address(shown, "from_to"), &html! { (term("from_to")) " " (term("residue")) }))
            (late(&address(shown, "range_pair"), &html! { (term("range_pair")) }))
            (late(&address(shown, "level_crossing"), &html! { (term("level_crossing")) }))
        }
    }
}

fn quality(run: &Run) -> Markup {
    html! {
        h2 #quality { "Quality" }
        @if run.quality.warnings.is_empty() { p { "No warning: no spikes, drop-outs, clipping, hum or constant channels were found." } }
        @else { ul.notes { @for warning in &run.quality.warnings { li { (sentence(warning)) } } } }
        @if let Some(repeats) = &run.quality.repeats {
            p { "The drives repeat " (repeats.count) " times, each " (duration(repeats.period_s)) ". "
                @for noise in &repeats.responses { (clamped(&noise.channel)) ": noise " (percent(noise.noise_share)) " of the signal. " } }
        }
        div.wide { table.full {
            thead { tr { th { "Channel" } th.number { "Smallest" } th.number { "Largest" } th.number { "Mean" } th.number { "Std" } th.number { "RMS" } th.number { "Peak / RMS" } th.number { "Clipped" } } }
            tbody { @for (channel, unit) in run.quality.channels.iter().zip(&run.units) { tr {
                td { (clamped(&with_unit(&channel.channel, unit))) @if channel.dead { " " span.tag.bad { "constant" } } }
                @for value in [channel.min, channel.max, channel.mean, channel.std, channel.rms] { td.number { (number(value)) } }
                td.number { @match channel.peak_to_rms { Some(peak) => (number(peak)), None => "–" } }
                td.number { (percent(channel.clipped_share)) }
            } } }
        } }
    }
}

fn changes(visitor: &Visitor, of: &RunView<'_>, at: &str) -> Markup {
    let run = of.run;
    let api = format!("/v1{at}");
    html! {
        @if visitor.may(TokenRole::Operator) {
            details {
                summary { "Change its description" }
                form.fields data-api={ "PATCH " (api) } data-type="application/merge-patch+json" {
                    (csrf(visitor))
                    div.row {
                        label { "Name" input name="name" value=(run.name); }
                        label { "Kind" select name="kind" { @for kind in RunKind::ALL { option value=(kind.as_str()) selected[kind == run.kind] { (kind.as_str()) } } } }
                        label { "Split" select name="split" { @for split in [Split::Training, Split::Validation, Split::Test] {
                            option value=(split.as_str()) selected[split == run.split] { (split.as_str()) }
                        } } }
                        label { "Tags" input name="tags" data-as="list" value=(run.tags.join(", ")); }
                    }
                    div { button type="submit" { "Change" } }
                }
            }
        }
        @if visitor.may(TokenRole::Admin) {
            details {
                summary { "Delete this run" }
                form data-api={ "DELETE " (api) } data-then={ "/rigs/" (of.rig.id) } data-confirm="Delete this run? There is no way back." {
                    (csrf(visitor))
                    p { "Models that were fitted on it stay." }
                    button.grave type="submit" { "Delete the run" }
                }
            }
        }
        p.soft { "SHA-256 of the file: " code { (run.sha256) } }
    }
}
