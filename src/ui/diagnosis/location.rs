//! The gap by frequency, response, amplitude, velocity and time.

use maud::{Markup, html};

use super::{figure, heading, quiet};
use crate::engine::diagnosis::views::ResponseSpectra;
use crate::engine::diagnosis::{RangeShare, Report, SegmentChi2, VerdictKind, Views};
use crate::ui::plot::{Axis, BarRow, Figure, Key, Mark, Scale, Style, bars};
use crate::ui::text::{density_unit, number, percent, with_unit};

/// Most spans of time in the plot.
const STRETCHES: usize = 500;
/// Responses whose spectrum is drawn.
const DRAWN: usize = 8;

/// The section.
pub fn section(report: &Report, views: &Views) -> Markup {
    let order = by_share(report);
    let main = main_channel(report, &order);
    html! {
        (heading("where", if quiet(report.verdict.kind) { "The error of the model" } else { "Where is the gap?" }))
        (spectra(report, views, &order))
        @if report.location.channels.len() > 1 && !quiet(report.verdict.kind) { (shares(report, views)) }
        @if let Some(channel) = &main {
            @if !quiet(report.verdict.kind) {
                div.pair {
                    @for by in &QUANTITIES { (by_range(channel, report, by)) }
                }
            }
            @if let Some((plot, worst)) = over_time(channel, &report.location.segments) {
                (figure(&plot.svg(), &html! {
                    b { "Over time. " } "Largest in " (worst.run) " at " (number(worst.from_s)) " s: "
                    (number(worst.chi2.max(0.0).sqrt())) " times the noise floor."
                }))
            }
        }
    }
}

/// The response that the verdict is about, or the one with the largest share of the gap.
fn main_channel(report: &Report, order: &[(String, f64)]) -> Option<String> {
    report.verdict.channel.clone().or_else(|| order.first().map(|c| c.0.clone()))
}

/// The plots of the section.
pub fn figures(report: &Report, views: &Views) -> Vec<Figure> {
    let order = by_share(report);
    let (drawn, _) = drawn(views, &order);
    let mut found: Vec<Figure> =
        drawn.iter().enumerate().map(|(k, spectrum)| spectrum_figure(k, report, views, spectrum)).collect();
    if let Some(channel) = main_channel(report, &order) {
        if !quiet(report.verdict.kind) {
            found.extend(QUANTITIES.iter().filter_map(|by| Some(ranges(&channel, report, by)?.0)));
        }
        found.extend(over_time(&channel, &report.location.segments).map(|(plot, _)| plot));
    }
    found
}

/// The spectra that are drawn, and how many are not.
fn drawn<'a>(views: &'a Views, order: &[(String, f64)]) -> (Vec<&'a ResponseSpectra>, usize) {
    let mut drawn: Vec<&ResponseSpectra> = order
        .iter()
        .filter_map(|(channel, _)| views.spectra.iter().find(|s| s.channel == *channel))
        .collect();
    let left_out = drawn.len().saturating_sub(DRAWN);
    drawn.truncate(DRAWN);
    (drawn, left_out)
}

/// Responses with their share of the gap, the largest first.
fn by_share(report: &Report) -> Vec<(String, f64)> {
    let mut order: Vec<(String, f64)> =
        report.location.channels.iter().map(|c| (c.channel.clone(), c.share_of_gap)).collect();
    order.sort_by(|a, b| b.1.total_cmp(&a.1));
    order
}

fn spectra(report: &Report, views: &Views, order: &[(String, f64)]) -> Markup {
    let (drawn, left_out) = drawn(views, order);
    html! {
        @for (k, spectrum) in drawn.iter().enumerate() {
            @let bands: Vec<_> = report.location.bands.iter().filter(|b| b.channel == spectrum.channel).collect();
            @let worst = bands.iter().max_by(|a, b| a.share_of_gap.total_cmp(&b.share_of_gap));
            (figure(&spectrum_figure(k, report, views, spectrum).svg(), &html! {
                b { (spectrum.channel) ". " }
                @if is_noise(report) {
                    "The error of the model, the noise floor and the response itself."
                } @else if let Some(band) = worst.filter(|_| !quiet(report.verdict.kind)) {
                    (percent(band.share_of_gap)) " of the gap lies between " (number(band.from_hz)) " and " (number(band.to_hz))
                    " Hz; there it is " (above(band.systematic_db)) " the response and " (above(band.systematic_db - band.noise_db)) " the noise floor."
                } @else {
                    "The error of the model that all runs share, the noise floor and the response itself."
                }
            }))
        }
        @if left_out > 0 { p.soft { (left_out) " more responses, with smaller shares of the gap, are in the report as JSON." } }
    }
}

fn above(db: f64) -> String {
    format!("{:.0}\u{a0}dB {}", db.abs(), if db >= 0.0 { "above" } else { "below" })
}

fn is_noise(report: &Report) -> bool {
    report.verdict.kind == VerdictKind::NoiseOrUnmeasuredDisturbance
}

fn spectrum_figure(k: usize, report: &Report, views: &Views, s: &ResponseSpectra) -> Figure {
    let (gap, name) = if is_noise(report) { (&s.error, "error of the model") } else { (&s.gap, "gap") };
    let line = report.fingerprints.line_hz.filter(|_| is_noise(report));
    let marks = vec![
        (s.measured.clone(), Style::Measured, "measured"),
        (s.noise.clone(), Style::Noise, "noise floor"),
        (gap.clone(), Style::Before, name),
    ];
    Figure {
        id: format!("spectrum-{k}"),
        title: format!("Spectrum of {}: response, gap and noise floor", s.channel),
        description: format!(
            "Power spectral densities of the measured response, of {name} and of the noise floor over frequency. The grey range outside the band is not scored."
        ),
        size: (720.0, 280.0),
        ..spectral(views.band_hz, &s.frequency_hz, &s.unit, marks, line)
    }
}

/// A plot of densities over frequency with the band in which errors count.
pub fn spectral(
    band: [f64; 2],
    frequency: &[f64],
    unit: &str,
    lines: Vec<(Vec<f64>, Style, &str)>,
    line_hz: Option<f64>,
) -> Figure {
    let first = frequency.first().copied().unwrap_or(1.0);
    let last = frequency.last().copied().unwrap_or(2.0);
    let low = first.max(band[0]).max(band[1] / 200.0);
    let high = (1.5 * band[1]).max(line_hz.map_or(0.0, |f| 1.3 * f)).min(last);
    let x = Axis::exact(Scale::Log, low, high);
    let shown = |y: &[f64]| -> Vec<f64> {
        frequency.iter().zip(y).filter(|(f, _)| x.holds(**f)).map(|(_, y)| *y).collect()
    };
    // A gap far below the noise has no meaning: the axis ends a little below the floor.
    let floor = lines
        .iter()
        .filter(|l| l.1 == Style::Noise)
        .flat_map(|l| shown(&l.0))
        .filter(|y| *y > 0.0)
        .fold(f64::INFINITY, f64::min);
    let largest = lines.iter().flat_map(|l| shown(&l.0)).fold(0.0, f64::max);
    let lowest = if floor.is_finite() { 0.1 * floor } else { 1e-6 * largest };
    let mut marks = vec![Mark::Span { from: band[1], to: high, upright: true, name: String::new() }];
    if band[0] > low {
        marks.push(Mark::Span { from: low, to: band[0], upright: true, name: String::new() });
    }
    marks.extend(lines.into_iter().map(|(y, style, name)| Mark::Line {
        x: frequency.to_vec(),
        y,
        style,
        name: name.into(),
    }));
    if let Some(f) = line_hz {
        marks.push(Mark::Rule { at: f, upright: true, name: format!("{} Hz", number(f)) });
    } else if band[1] < 0.93 * high {
        marks.push(Mark::Rule { at: band[1], upright: true, name: "end of the band".into() });
    }
    Figure {
        id: String::new(),
        title: String::new(),
        description: String::new(),
        size: (720.0, 280.0),
        x: (x, "Frequency in Hz".into()),
        y: (
            // Room above the lines for the name of a rule.
            Axis::around(Scale::Log, [lowest, 3.0 * largest]),
            format!("Power spectral density in {}", density_unit(unit)),
        ),
        key: Key::Ends,
        marks,
    }
}

fn shares(report: &Report, views: &Views) -> Markup {
    let mut channels: Vec<_> = report.location.channels.iter().collect();
    channels.sort_by(|a, b| b.share_of_gap.total_cmp(&a.share_of_gap));
    let unit =
        |channel: &str| views.spectra.iter().find(|s| s.channel == channel).map_or("", |s| s.unit.as_str());
    let rows: Vec<BarRow> = channels
        .iter()
        .map(|c| BarRow {
            name: c.channel.clone(),
            share: c.share_of_gap,
            note: format!("RMS error {}", with_unit(c.rms_error, unit(&c.channel))),
        })
        .collect();
    let description = "One bar per response; each response counts in units of its own level.";
    figure(
        &bars("shares", "Share of the gap by response", description, &rows),
        &html! { b { "By response. " } "Share of the gap, each response counted in units of its own level." },
    )
}

/// A quantity that the gap is divided by.
struct Quantity {
    name: &'static str,
    axis: &'static str,
    of: fn(&Report) -> &[RangeShare],
}

const QUANTITIES: [Quantity; 2] = [
    Quantity {
        name: "amplitude",
        axis: "Size of the response, % of the largest",
        of: |report| &report.location.amplitude,
    },
    Quantity {
        name: "velocity",
        axis: "Size of its velocity, % of the largest",
        of: |report| &report.location.velocity,
    },
];

/// The share of a channel's gap by a quantity, and the range with the largest.
fn ranges<'a>(channel: &str, report: &'a Report, by: &Quantity) -> Option<(Figure, &'a RangeShare)> {
    let own: Vec<&RangeShare> = (by.of)(report).iter().filter(|r| r.channel == channel).collect();
    let worst = *own.iter().max_by(|a, b| a.share_of_gap.total_cmp(&b.share_of_gap))?;
    let what = by.name;
    let marks = own
        .iter()
        .map(|r| Mark::Bar {
            from: 100.0 * r.from,
            to: 100.0 * r.to,
            height: 100.0 * r.share_of_gap,
            style: Style::Before,
        })
        .collect();
    let plot = Figure {
        id: format!("by-{what}"),
        title: format!("Share of the gap of {channel} by {what}"),
        description: format!(
            "Bars over five ranges; the largest share, {}, lies between {} and {} of the largest {what}.",
            percent(worst.share_of_gap),
            percent(worst.from),
            percent(worst.to)
        ),
        size: (350.0, 210.0),
        x: (Axis::exact(Scale::Linear, 0.0, 100.0), by.axis.into()),
        y: (
            Axis::around(Scale::Linear, own.iter().map(|r| 100.0 * r.share_of_gap).chain([0.0])),
            "Share of the gap in %".into(),
        ),
        key: Key::Above,
        marks,
    };
    Some((plot, worst))
}

fn by_range(channel: &str, report: &Report, by: &Quantity) -> Markup {
    let what = by.name;
    html! { @if let Some((plot, worst)) = ranges(channel, report, by) {
        (figure(&plot.svg(), &html! {
            b { "By " (what) ". " } (percent(worst.share_of_gap)) " of it lies at " (number(100.0 * worst.from)) "–" (percent(worst.to)) " of the largest " (what) "."
        }))
    } }
}

/// Means of neighbouring spans of one run, where there are too many spans to draw.
fn thinned(all: Vec<&SegmentChi2>) -> Vec<SegmentChi2> {
    let together = all.len().div_ceil(STRETCHES).max(1);
    all.chunk_by(|a, b| a.run == b.run)
        .flat_map(|run| run.chunks(together))
        .map(|part| SegmentChi2 {
            to_s: part[part.len() - 1].to_s,
            chi2: part.iter().map(|s| s.chi2).sum::<f64>() / part.len() as f64,
            ..part[0].clone()
        })
        .collect()
}

/// The error of a channel over time, and the span with the largest.
fn over_time(channel: &str, all: &[SegmentChi2]) -> Option<(Figure, SegmentChi2)> {
    let own = thinned(all.iter().filter(|s| s.channel == channel).collect());
    let worst = own.iter().max_by(|a, b| a.chi2.total_cmp(&b.chi2))?.clone();
    let (mut x, mut y, mut starts) = (Vec::new(), Vec::new(), Vec::new());
    let mut clock = 0.0;
    let mut run = "";
    for segment in &own {
        if segment.run != run {
            // A gap in the line between runs.
            x.push(clock);
            y.push(f64::NAN);
            starts.push((clock, segment.run.clone()));
            run = &segment.run;
        }
        let length = segment.to_s - segment.from_s;
        let size = segment.chi2.max(0.0).sqrt();
        x.extend([clock, clock + length]);
        y.extend([size, size]);
        clock += length;
    }
    let named = starts.len() <= 6;
    // Many noise floors: only a logarithmic axis shows the floor too.
    let (scale, foot, room) =
        if worst.chi2 > 400.0 { (Scale::Log, 0.8, 3.0) } else { (Scale::Linear, 0.0, 1.15) };
    // Above the line is room for the names of runs.
    let ends = [foot, room * worst.chi2.max(0.0).sqrt()];
    let mut marks: Vec<Mark> = starts
        .into_iter()
        .map(|(at, name)| Mark::Rule { at, upright: true, name: if named { name } else { String::new() } })
        .collect();
    marks.push(Mark::Rule { at: 1.0, upright: false, name: "noise floor".into() });
    let plot = Figure {
        id: "over-time".into(),
        title: format!("Error of {channel} over time"),
        description: "Error of each second in noise floors, run after run.".into(),
        size: (720.0, 200.0),
        x: (Axis::exact(Scale::Linear, 0.0, clock), "Time in s, one run after the other".into()),
        y: (Axis::around(scale, y.iter().copied().chain(ends)), "RMS error in noise floors".into()),
        key: Key::Above,
        marks: marks
            .into_iter()
            .chain([Mark::Line { x, y, style: Style::Before, name: String::new() }])
            .collect(),
    };
    Some((plot, worst))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn hours_are_thinned_to_means_that_stay_within_their_run() {
        let second = |run: &str, k: usize| SegmentChi2 {
            run: run.into(),
            channel: "x".into(),
            from_s: k as f64,
            to_s: (k + 1) as f64,
            chi2: (k % 2) as f64,
        };
        let all: Vec<SegmentChi2> =
            (0..3001).map(|k| second("a", k)).chain((0..1999).map(|k| second("b", k))).collect();
        let thin = thinned(all.iter().collect());
        assert!(thin.len() <= STRETCHES + 2, "{}", thin.len());
        assert_eq!(thin.iter().map(|s| s.to_s - s.from_s).sum::<f64>(), 5000.0);
        assert!(thin[0].chi2 == 0.5 && thin.iter().filter(|s| s.run == "b").all(|s| s.to_s <= 1999.0));
        assert_eq!(thinned(all[..400].iter().collect()), all[..400]);
    }

    #[test]
    fn units_of_densities_are_squared_as_a_whole() {
        assert_eq!(density_unit("mm"), "mm²/Hz");
        assert_eq!(density_unit("m/s^2"), "(m/s²)²/Hz");
    }
}
