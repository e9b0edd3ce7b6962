//! The page that predicts a run and compares it with another: overlay, error, spectra, damage and loops.

use std::collections::BTreeMap;

use maud::{Markup, html};

use super::figures::{Drawing, Zoom, address, late, thinned};
use super::frame::{Frame, Section, Visitor};
use super::plot::{Axis, Figure, Hemisphere, Key, Mark, Ratios, Scale, Style};
use super::rig::name_of;
use super::run::with_unit;
use super::text::{cut, exponents, number, percent};
use super::words::{clamped, duration, term};
use crate::domain::{Model, Rig, Run};
use crate::engine::envelope::Envelope;
use crate::engine::fatigue::{DamageReport, direction as spread};
use crate::engine::metrics::ChannelErrors;
use crate::engine::model::TrustSpan;
use crate::engine::spectral::Psd;

pub use super::plot::RatioRow;

/// Height of a plot, pixels.
const TALL: f64 = 280.0;

/// Spans that a plot shades and a table lists.
const SPANS: usize = 200;
const LISTED: usize = 8;

/// Points of a cloud or a loop.
const POINTS: usize = 4000;

/// What was chosen, and what there is to choose from.
#[derive(Debug, Clone)]
pub struct Choice<'a> {
    /// The rig.
    pub rig: &'a Rig,
    /// Its models.
    pub models: &'a [Model],
    /// Its runs.
    pub runs: &'a [Run],
    /// `active` or a version.
    pub model: String,
    /// Run whose drives are predicted.
    pub drive: Option<String>,
    /// Run that it is compared with.
    pub target: Option<String>,
    /// Address of the page with these choices.
    pub at: String,
}

/// A comparison in figures.
#[derive(Debug, Clone)]
pub struct Result<'a> {
    /// Version and kind of the model.
    pub model: String,
    /// Names of the outputs and of the inputs.
    pub channels: [&'a [String]; 2],
    /// Output that is shown.
    pub output: usize,
    /// Channels of the loop: places among outputs, then inputs.
    pub axes: [usize; 2],
    /// Errors by output.
    pub errors: &'a BTreeMap<String, ChannelErrors>,
    /// Damage.
    pub damage: &'a DamageReport,
    /// Share of samples inside what the model was fitted on, where that is known.
    pub inside: Option<f64>,
    /// Spans outside.
    pub spans: &'a [TrustSpan],
    /// Length, s, and samples per second.
    pub length: [f64; 2],
    /// Whether there is a target.
    pub has_target: bool,
    /// Why there is no band, if there is none.
    pub no_band: Option<&'static str>,
}

/// The page; without a result, only the choices.
pub fn page(visitor: &Visitor, choice: &Choice<'_>, result: Option<&Result<'_>>) -> String {
    let main = html! {
        h1 { "Predict and compare" }
        (choices(choice))
        @match result {
            Some(result) => (shown(choice, result)),
            None => div.empty { p {
                @if choice.runs.is_empty() { "There is no run yet: upload one whose drives are to be predicted." }
                @else { "Choose the run whose drives the model gets, and the run whose responses it is compared with: as a rule the same." }
            } },
        }
    };
    let way = [("/".to_owned(), "Rigs"), (format!("/rigs/{}", choice.rig.id), choice.rig.name.as_str())];
    Frame::new("Predict and compare", Section::Rigs, visitor).below(&way).page(&main)
}

fn choices(choice: &Choice<'_>) -> Markup {
    let runs = |name: &str, chosen: Option<&str>, none: &str| {
        html! {
            select name=(name) {
                option value="" { (none) }
                @for run in choice.runs {
                    @let id = run.id.to_string();
                    option value=(id) selected[chosen == Some(id.as_str())] { (cut(&name_of(run))) " (" (run.kind.as_str()) ", " (duration(run.duration_s)) ")" }
                }
            }
        }
    };
    html! {
        form.row method="get" action={ "/rigs/" (choice.rig.id) "/predict" } {
            label { "Model" select name="model" {
                option value="active" selected[choice.model == "active"] { "active" }
                @for model in choice.models {
                    @let version = model.version.to_string();
                    option value=(version) selected[choice.model == version] { "version " (version) " (" (model.kind_in_words()) ")" }
                }
            } }
            label { "Drives of" (runs("drive", choice.drive.as_deref(), "choose a run")) }
            label { "Compared with" (runs("target", choice.target.as_deref(), "nothing")) }
            button.main type="submit" { "Predict" }
        }
    }
}

fn shown(choice: &Choice<'_>, of: &Result<'_>) -> Markup {
    let at = format!("{}&output={}", choice.at, of.output);
    let loops = format!("{at}&x={}&y={}", of.axes[0], of.axes[1]);
    let zoom = |page: &str, name: &str, what: &'static str, caption: Markup| {
        let address = address(page, name);
        Zoom { address: &address, name: what, range: [0.0, of.length[0]], least: 8.0 / of.length[1] }
            .figure(None, &caption)
    };
    html! {
        p.soft { (of.model) " · " (duration(of.length[0])) " · slope " (number(of.damage.settings.slope)) ", residue repeated" }
        (figures_in_words(choice.rig, of))
        (damage(&at, of))
        (trust(of))
        h2 #overlay { "Over time" }
        form.tools method="get" action={ "/rigs/" (choice.rig.id) "/predict#overlay" } {
            (hidden(choice))
            label.check { "Response" select name="output" data-go {
                @for (place, name) in of.channels[0].iter().enumerate() { option value=(place) selected[place == of.output] { (cut(name)) } }
            } }
            noscript { button type="submit" { "Show" } }
        }
        (zoom(&at, "overlay", "Predicted and measured over time", html! { (term("trust")) " " @match of.no_band {
            None => (term("band")),
            Some(why) => { "There is no band: " (why) "." }
        } }))
        @if of.has_target { (zoom(&at, "error", "Error over time", html! { "Predicted minus measured." @if of.no_band.is_none() { " The band lies about zero: an error within it is as large as the model leaves to be expected." } })) }
        div.pair {
            (late(&address(&at, "psd"), &html! { (term("psd")) }))
            (late(&address(&at, "range_pair"), &html! { (term("range_pair")) " " (term("residue")) }))
        }
        h2 #loops { "One channel over another" }
        form.tools method="get" action={ "/rigs/" (choice.rig.id) "/predict#loops" } {
            (hidden(choice))
            input type="hidden" name="output" value=(of.output);
            (axis_of("x", "Across", of, of.axes[0])) (axis_of("y", "Up", of, of.axes[1]))
            noscript { button type="submit" { "Show" } }
        }
        (zoom(&loops, "loop", "One channel over another", html! { "Force over displacement shows hysteresis as a loop, whose area is the work lost; a shorter range of time shows single loops." }))
    }
}

/// Damage as pictures: ratios by channel, and each group over the directions.
fn damage(at: &str, of: &Result<'_>) -> Markup {
    html! {
        @if of.has_target || !of.damage.groups.is_empty() {
            h2 #damage { "Damage" }
            div.pair {
                @if of.has_target {
                    (late(&address(at, "damage_ratio"), &html! {
                        "Predicted over measured damage, on a logarithmic axis: 1 is perfect."
                        @if of.no_band.is_none() { " A bar reaches from the least to the largest damage within the 90 % band of the response." }
                    }))
                }
                @for (place, (name, _)) in of.damage.groups.iter().enumerate() {
                    (late(&address(&format!("{at}&group={place}"), "multi_rain"), &html! {
                        "Damage of " (clamped(name)) " in each of " (of.damage.settings.directions) " directions in space, on a map of the half sphere that keeps areas. "
                        @if of.has_target { "Squares are directions whose damage is predicted too small, round dots those where it is too large." }
                    }))
                }
            }
        }
    }
}

fn axis_of(name: &str, label: &str, of: &Result<'_>, chosen: usize) -> Markup {
    html! {
        label.check { (label) select name=(name) data-go {
            @for (place, channel) in of.channels[0].iter().chain(of.channels[1]).enumerate() {
                option value=(place) selected[place == chosen] { (cut(channel)) }
            }
        } }
    }
}

fn hidden(choice: &Choice<'_>) -> Markup {
    html! {
        input type="hidden" name="model" value=(choice.model);
        @if let Some(drive) = &choice.drive { input type="hidden" name="drive" value=(drive); }
        @if let Some(target) = &choice.target { input type="hidden" name="target" value=(target); }
    }
}

fn figures_in_words(rig: &Rig, of: &Result<'_>) -> Markup {
    let share = |x: Option<f64>| x.map_or_else(|| "–".to_owned(), percent);
    html! {
        div.wide { table {
            thead { tr {
                th { "Response" } th.number { "RMS error" } th.number { "RMS error of PSD" } th.number { "Damage predicted" }
                @if of.has_target { th.number { "Damage measured" } th.number { "Damage ratio" } }
            } }
            tbody {
                @for (name, damage) in &of.damage.channels {
                    @let error = of.errors.get(name);
                    tr {
                        td { (clamped(&with_unit(name, rig.channel(name).map_or("", |channel| &channel.unit)))) }
                        td.number { (share(error.and_then(|e| e.rms))) }
                        td.number { (share(error.and_then(|e| e.psd_rms))) }
                        td.number { (number(damage.predicted)) }
                        @if of.has_target {
                            td.number { (damage.target.map_or_else(|| "–".to_owned(), |t| number(t.target))) }
                            td.number data-ratio { (damage.target.and_then(|t| t.ratio.ratio).map_or_else(|| "–".to_owned(), number)) }
                        }
                    }
                }
                @for (name, damage) in &of.damage.groups {
                    tr {
                        td { "Multi-Rain of " (clamped(name)) br; span.soft { "largest along " (direction(damage.direction_predicted)) } }
                        td.number { "–" } td.number { "–" }
                        td.number { (number(damage.predicted)) }
                        @if of.has_target {
                            td.number { (damage.target.map_or_else(|| "–".to_owned(), |t| number(t.target))) @if let Some(t) = damage.target { br; span.soft { "along " (direction(t.direction_target)) } } }
                            td.number { (damage.target.and_then(|t| t.ratio.ratio).map_or_else(|| "–".to_owned(), number)) }
                        }
                    }
                }
            }
        } }
        p.soft { (term("damage")) " A ratio of 1 is perfect." @if !of.damage.groups.is_empty() { " " (term("multi_rain")) } }
    }
}

fn direction(of: [f64; 3]) -> String {
    format!("({:.2}, {:.2}, {:.2})", of[0], of[1], of[2]).replace('-', "−")
}

/// The spans in which one channel is outside in one way.
struct WayOutside<'a> {
    first: &'a TrustSpan,
    spans: usize,
    total_s: f64,
}

/// The ways in which channels are outside, those that last longest first.
fn ways_outside(spans: &[TrustSpan]) -> Vec<WayOutside<'_>> {
    let mut ways: Vec<WayOutside<'_>> = Vec::new();
    for span in spans {
        let lasts = span.to_s - span.from_s;
        let same = |way: &&mut WayOutside<'_>| {
            (&way.first.channel, &way.first.reason) == (&span.channel, &span.reason)
        };
        match ways.iter_mut().find(same) {
            Some(way) => (way.spans, way.total_s) = (way.spans + 1, way.total_s + lasts),
            None => ways.push(WayOutside { first: span, spans: 1, total_s: lasts }),
        }
    }
    ways.sort_by(|a, b| b.total_s.total_cmp(&a.total_s));
    ways
}

fn trust(of: &Result<'_>) -> Markup {
    html! {
        @match of.inside {
            Some(inside) if of.spans.is_empty() => p { span.tag.good { "inside" } " All drives stay inside what the model was fitted on (" (percent(inside)) ")." },
            Some(inside) => div.notes {
                p { (percent(inside)) " of the samples are inside what the model was fitted on. Outside:" }
                @let ways = ways_outside(of.spans);
                ul {
                    @for way in ways.iter().take(LISTED) {
                        li {
                            (clamped(&way.first.channel)) ": " (way.first.reason) ", "
                            @if way.spans == 1 { "from " (number(way.first.from_s)) " to " (number(way.first.to_s)) " s" }
                            @else { (number(way.total_s)) " s in all, first at " (number(way.first.from_s)) " s" }
                        }
                    }
                    @if ways.len() > LISTED { li { "and in " (ways.len() - LISTED) " more ways, for less time each" } }
                }
            },
            None => p.soft { "The weights do not say what they were fitted on." },
        }
    }
}

/// Signals of one output over a range of time.
#[derive(Debug, Clone)]
pub struct Overlay<'a> {
    /// Name of the figure.
    pub id: &'static str,
    /// Name and unit of the output.
    pub channel: (&'a str, &'a str),
    /// Names and envelopes of the lines.
    pub lines: Vec<(&'static str, Envelope)>,
    /// The smallest and the largest value of the band in each column, if there is one.
    pub band: Option<Envelope>,
    /// Spans outside.
    pub spans: &'a [TrustSpan],
    /// Range of time, s.
    pub range: [f64; 2],
    /// Width, pixels.
    pub width: f64,
}

impl Overlay<'_> {
    /// The plot.
    pub fn drawing(self) -> Drawing {
        let [from, to] = self.range;
        let all = self.lines.iter().map(|(_, line)| line).chain(&self.band);
        let values = all.flat_map(|e| e.low.iter().chain(&e.high)).copied();
        let y = Axis::around(Scale::Linear, values);
        let seen = |span: &&TrustSpan| span.to_s > from && span.from_s < to;
        let mut marks: Vec<Mark> = self
            .spans
            .iter()
            .filter(seen)
            .take(SPANS)
            .enumerate()
            .map(|(k, span)| Mark::Span {
                from: span.from_s.max(from),
                to: span.to_s.min(to),
                upright: true,
                name: if k == 0 { "outside the training range".into() } else { String::new() },
            })
            .collect();
        if let Some(Envelope { low, high }) = self.band {
            let (style, name) = (Style::Series(0), "90 % band".into());
            marks.push(Mark::Corridor { from, to, low, high, style, name });
        }
        let styles = [Style::Series(1), Style::Series(0)];
        for ((name, envelope), style) in self.lines.into_iter().zip(styles) {
            marks.push(Mark::Envelope {
                from,
                to,
                low: envelope.low,
                high: envelope.high,
                style,
                name: name.into(),
            });
        }
        Figure {
            id: self.id.into(),
            title: format!("{} over time", self.channel.0),
            description: format!("From {} to {} s.", number(from), number(to)),
            size: (self.width, TALL),
            x: (Axis::exact(Scale::Linear, from, to), "Time in s".into()),
            y: (y, with_unit(self.channel.0, self.channel.1)),
            key: Key::Above,
            marks,
        }
        .into()
    }
}

/// Damage ratios of channels and groups.
pub fn damage_ratios(rows: Vec<RatioRow>) -> Drawing {
    if rows.is_empty() {
        return Drawing::Nothing("The run it is compared with has none of the predicted channels.".into());
    }
    Ratios {
        id: "damage-ratio".into(),
        title: "Damage ratios".into(),
        description: "One row a channel or group: predicted over measured damage on a logarithmic axis about 1.".into(),
        label: "Predicted over measured damage".into(),
        rows,
    }
    .into()
}

/// Damage of a group by direction: of its channels x, y and z, predicted and perhaps measured.
pub fn multi_rain(
    (place, group): (usize, &str),
    axes: [String; 3],
    damages: (Vec<f64>, Option<Vec<f64>>),
) -> Drawing {
    let (predicted, measured) = damages;
    let n = predicted.len();
    let what = if measured.is_some() { "Predicted over measured damage" } else { "Damage" };
    Drawing::Hemisphere(Box::new(Hemisphere {
        id: format!("multi-rain-{place}"),
        title: format!("{what} of {group} by direction"),
        description: format!("{n} directions of the upper half sphere, z in the middle."),
        axes,
        directions: (0..n).map(|i| spread(i, n)).collect(),
        predicted,
        measured,
    }))
}

/// Spectra of an output, predicted and measured.
pub fn spectra(channel: (&str, &str), lines: &[(&'static str, &Psd)], width: f64) -> Drawing {
    let Some((_, first)) = lines.first().filter(|(_, psd)| psd.density[0].len() > 2) else {
        return Drawing::Nothing("The run is too short for a spectrum.".into());
    };
    let freq: Vec<f64> = (1..first.density[0].len()).map(|line| line as f64 * first.df_hz).collect();
    let values = lines.iter().flat_map(|(_, psd)| psd.density[0][1..].iter().copied());
    let y = Axis::around(Scale::Log, values);
    let styles = [Style::Series(1), Style::Series(0)];
    let marks = lines.iter().zip(styles).map(|((name, psd), style)| {
        let (x, y) = thinned(&freq, &psd.density[0][1..], 400);
        Mark::Line { x, y, style, name: (*name).into() }
    });
    Figure {
        id: "psd".into(),
        title: format!("Power spectral density of {}", channel.0),
        description: "Predicted and measured.".into(),
        size: (width.min(760.0), 320.0),
        x: (Axis::exact(Scale::Log, freq[0], freq[freq.len() - 1]), "Frequency in Hz".into()),
        y: (y, format!("PSD in ({})²/Hz", exponents(channel.1))),
        key: Key::Above,
        marks: marks.collect(),
    }
    .into()
}

/// A channel over another: names with units, and the pairs of lines.
pub fn loops(names: [String; 2], lines: Vec<(&'static str, Vec<f64>, Vec<f64>)>, width: f64) -> Drawing {
    let side = |place: usize| lines.iter().flat_map(move |(_, x, y)| if place == 0 { x } else { y }).copied();
    let [x_name, y_name] = names;
    let (x, y) = (Axis::around(Scale::Linear, side(0)), Axis::around(Scale::Linear, side(1)));
    let styles = [Style::Series(1), Style::Series(0)];
    let marks = lines.into_iter().zip(styles).map(|((name, x, y), style)| {
        let step = x.len().div_ceil(POINTS).max(1);
        if step > 4 {
            let thin = |values: Vec<f64>| values.into_iter().step_by(step).collect();
            return Mark::Dots { x: thin(x), y: thin(y), style, radius: 1.2, name: name.into() };
        }
        Mark::Line { x, y, style, name: name.into() }
    });
    Figure {
        id: "loop".into(),
        title: format!("{y_name} over {x_name}"),
        description: "Predicted and measured.".into(),
        size: (width.min(620.0), 440.0),
        x: (x, x_name),
        y: (y, y_name),
        key: Key::Above,
        marks: marks.collect(),
    }
    .into()
}
