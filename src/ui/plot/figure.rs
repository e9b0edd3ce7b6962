//! A plot over two axes.

use std::fmt::Write;

use maud::{Markup, html};

use super::{Axis, Style, px, text_width};
use crate::ui::text::{cut, cut_to};

/// Space left of the axis for tick labels.
const LEFT: f64 = 58.0;
/// Space below it for tick labels and the name of the axis.
const BELOW: f64 = 42.0;
/// Space above it for the name of the vertical axis.
const ABOVE: f64 = 26.0;
/// Height of a row of keys.
const KEY: f64 = 20.0;
/// Length of the piece of line before the label at its end.
const SAMPLE: f64 = 18.0;
/// Least distance of labels at line ends.
const LABEL: f64 = 15.0;

/// Longest name of an axis.
const AXIS: usize = 80;

/// Position of the names of marks.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Key {
    /// In a row above the plot.
    Above,
    /// Beside the right end of each line.
    Ends,
    /// Nowhere: the axis has the name.
    None,
}

/// Something drawn over the axes.
#[derive(Debug, Clone)]
pub enum Mark {
    /// A line through points; points that are not finite are left out.
    Line { x: Vec<f64>, y: Vec<f64>, style: Style, name: String },
    /// The smallest and the largest value in each of the equal stretches of `from..to`, as a filled line.
    Envelope { from: f64, to: f64, low: Vec<f64>, high: Vec<f64>, style: Style, name: String },
    /// The area from the smallest to the largest value in each of the equal stretches of `from..to`.
    Corridor { from: f64, to: f64, low: Vec<f64>, high: Vec<f64>, style: Style, name: String },
    /// The area between two lines over the same points.
    Band { x: Vec<f64>, low: Vec<f64>, high: Vec<f64>, style: Style, name: String },
    /// Points of a cloud.
    Dots { x: Vec<f64>, y: Vec<f64>, style: Style, radius: f64, name: String },
    /// A bar from the lower end of the axis to `height`.
    Bar { from: f64, to: f64, height: f64, style: Style },
    /// A range of the horizontal axis, or of the vertical one, that is shaded.
    Span { from: f64, to: f64, upright: bool, name: String },
    /// A thin rule across the plot, upright or level, with its name at its end.
    Rule { at: f64, upright: bool, name: String },
}

/// A plot with its title, description and axes.
#[derive(Debug, Clone)]
pub struct Figure {
    /// Identifies the plot on its page.
    pub id: String,
    /// Title.
    pub title: String,
    /// Description of its content in words.
    pub description: String,
    /// Width and height in pixels.
    pub size: (f64, f64),
    /// Horizontal axis and its name.
    pub x: (Axis, String),
    /// Vertical axis and its name.
    pub y: (Axis, String),
    /// Position of the names.
    pub key: Key,
    /// Marks from back to front.
    pub marks: Vec<Mark>,
}

/// The rectangle between the axes.
#[derive(Clone, Copy)]
struct Frame {
    left: f64,
    right: f64,
    top: f64,
    bottom: f64,
}

impl Figure {
    /// The plot as an `svg` element.
    pub fn svg(&self) -> Markup {
        let (width, height) = self.size;
        let frame = self.frame();
        let (title, description) = (format!("{}-title", self.id), format!("{}-desc", self.id));
        html! {
            svg xmlns="http://www.w3.org/2000/svg" role="img" aria-labelledby=(format!("{title} {description}"))
                viewBox=(format!("0 0 {} {}", px(width), px(height))) width=(px(width)) height=(px(height))
                data-left=(px(frame.left)) data-right=(px(frame.right)) {
                title id=(title) { (self.title) }
                desc id=(description) { (self.description) }
                @for mark in &self.marks { (self.behind(mark, frame)) }
                (self.grid(frame))
                @for mark in &self.marks { (self.mark(mark, frame)) }
                @match self.key {
                    Key::Above => { (self.row_of_keys(frame)) }
                    Key::Ends => { (self.end_labels(frame)) }
                    Key::None => {}
                }
            }
        }
    }

    fn frame(&self) -> Frame {
        // Names at line ends may be bold.
        let ends = self.named().map(|(name, _)| 1.15 * text_width(&name)).fold(0.0, f64::max);
        let beside = if self.key == Key::Ends && ends > 0.0 { ends + SAMPLE + 14.0 } else { 12.0 };
        let keys = if self.key == Key::Above && self.named().next().is_some() { KEY } else { 0.0 };
        Frame { left: LEFT, right: self.size.0 - beside, top: ABOVE + keys, bottom: self.size.1 - BELOW }
    }

    fn at_x(&self, frame: Frame, x: f64) -> f64 {
        frame.left + (frame.right - frame.left) * self.x.0.place(x)
    }

    fn at_y(&self, frame: Frame, y: f64) -> f64 {
        frame.bottom - (frame.bottom - frame.top) * self.y.0.place(y)
    }

    fn named(&self) -> impl Iterator<Item = (String, &Mark)> {
        self.marks.iter().filter_map(|mark| match mark {
            Mark::Line { name, .. }
            | Mark::Dots { name, .. }
            | Mark::Envelope { name, .. }
            | Mark::Corridor { name, .. }
            | Mark::Band { name, .. }
                if !name.is_empty() =>
            {
                Some((cut(name), mark))
            }
            Mark::Span { name, .. } if !name.is_empty() && self.key == Key::Above => Some((cut(name), mark)),
            _ => None,
        })
    }

    fn grid(&self, frame: Frame) -> Markup {
        let wide = frame.right - frame.left;
        let across = self.x.0.ticks((wide / 52.0) as usize);
        let up = self.y.0.ticks(((frame.bottom - frame.top) / 34.0) as usize);
        html! {
            g class="grid" {
                @for tick in &up {
                    @let y = px(self.at_y(frame, tick.value));
                    line x1=(px(frame.left)) x2=(px(frame.right)) y1=(y) y2=(y) {}
                    text x=(px(frame.left - 6.0)) y=(y) dy="0.35em" text-anchor="end" { (tick.label) }
                }
                @for tick in &across {
                    @let x = px(self.at_x(frame, tick.value));
                    line x1=(x) x2=(x) y1=(px(frame.bottom)) y2=(px(frame.bottom + 4.0)) {}
                    text x=(x) y=(px(frame.bottom + 17.0)) text-anchor="middle" { (tick.label) }
                }
                line.axis x1=(px(frame.left)) x2=(px(frame.right)) y1=(px(frame.bottom)) y2=(px(frame.bottom)) {}
            }
            text.name x=(px(frame.left + 0.5 * wide)) y=(px(frame.bottom + 35.0)) text-anchor="middle" { (cut_to(&self.x.1, AXIS)) }
            text.name x="2" y="14" { (cut_to(&self.y.1, AXIS)) }
        }
    }

    /// Marks behind the grid.
    fn behind(&self, mark: &Mark, frame: Frame) -> Markup {
        let Mark::Span { from, to, upright, .. } = mark else { return html! {} };
        let (x, y, width, height) = if *upright {
            let (a, b) = (self.at_x(frame, *from), self.at_x(frame, *to));
            (a, frame.top, b - a, frame.bottom - frame.top)
        } else {
            let (a, b) = (self.at_y(frame, *to), self.at_y(frame, *from));
            (frame.left, a, frame.right - frame.left, b - a)
        };
        html! {
            rect.span x=(px(x)) y=(px(y)) width=(px(width.max(0.0))) height=(px(height.max(0.0))) {}
        }
    }

    fn mark(&self, mark: &Mark, frame: Frame) -> Markup {
        match mark {
            Mark::Line { x, y, style, .. } => html! {
                path class=(format!("line {}", style.class())) d=(self.path(x, y, frame)) {}
            },
            Mark::Envelope { from, to, low, high, style, .. } => {
                let ends = (self.at_x(frame, *from), self.at_x(frame, *to));
                let columns =
                    low.iter().zip(high).map(|(low, high)| (self.at_y(frame, *high), self.at_y(frame, *low)));
                html! { path class=(format!("line {}", style.class())) d=(envelope(ends, low.len(), columns)) {} }
            }
            Mark::Corridor { from, to, low, high, style, .. } => {
                let step = (to - from) / low.len().max(1) as f64;
                let x: Vec<f64> = (0..low.len()).map(|k| from + step * (k as f64 + 0.5)).collect();
                html! { path class=(format!("band {}", style.class())) d=(self.band(&x, low, high, frame)) {} }
            }
            Mark::Band { x, low, high, style, .. } => html! {
                path class=(format!("band {}", style.class())) d=(self.band(x, low, high, frame)) {}
            },
            Mark::Dots { x, y, style, radius, .. } => html! {
                path class=(format!("dots {}", style.class())) d=(self.dots(x, y, frame))
                    stroke-width=(px(2.0 * radius)) {}
            },
            Mark::Bar { from, to, height, style } => {
                let (a, b) = (self.at_x(frame, *from) + 1.5, self.at_x(frame, *to) - 1.5);
                let top = self.at_y(frame, *height);
                html! {
                    rect class=(format!("bar {}", style.class())) x=(px(a)) width=(px((b - a).max(0.5)))
                        y=(px(top)) height=(px((frame.bottom - top).max(0.0))) {}
                }
            }
            Mark::Rule { at, upright, name } => self.rule(*at, *upright, name, frame),
            Mark::Span { .. } => html! {},
        }
    }

    fn rule(&self, at: f64, upright: bool, name: &str, frame: Frame) -> Markup {
        let axis = if upright { &self.x.0 } else { &self.y.0 };
        if !axis.holds(at) {
            return html! {};
        }
        let (x, y) = (self.at_x(frame, at), self.at_y(frame, at));
        let (x1, x2) = if upright { (x, x) } else { (frame.left, frame.right) };
        let (y1, y2) = if upright { (frame.top, frame.bottom) } else { (y, y) };
        // The name keeps inside the plot.
        let late = upright && x + text_width(name) > frame.right;
        let (tx, ty, anchor) = match (upright, late) {
            (true, false) => (x + 5.0, frame.top + 11.0, "start"),
            (true, true) => (x - 5.0, frame.top + 11.0, "end"),
            (false, _) => (frame.right - 4.0, y - 5.0, "end"),
        };
        html! {
            g class="rule" {
                line x1=(px(x1)) x2=(px(x2)) y1=(px(y1)) y2=(px(y2)) {}
                text x=(px(tx)) y=(px(ty)) text-anchor=(anchor) { (name) }
            }
        }
    }

    fn path(&self, x: &[f64], y: &[f64], frame: Frame) -> String {
        let mut d = String::new();
        let mut pen = 'M';
        for (x, y) in x.iter().zip(y) {
            if !(x.is_finite() && y.is_finite() && self.x.0.holds(*x)) {
                pen = 'M';
                continue;
            }
            let _ = write!(d, "{pen}{} {}", px(self.at_x(frame, *x)), px(self.at_y(frame, *y)));
            pen = 'L';
        }
        d
    }

    /// Forth along the upper line and back along the lower one.
    fn band(&self, x: &[f64], low: &[f64], high: &[f64], frame: Frame) -> String {
        let points: Vec<(f64, f64, f64)> = x
            .iter()
            .zip(low.iter().zip(high))
            .map(|(x, (low, high))| (*x, *low, *high))
            .filter(|(x, low, high)| self.x.0.holds(*x) && low.is_finite() && high.is_finite())
            .collect();
        let mut d = String::new();
        let forth = points.iter().map(|(x, _, high)| (x, high));
        let back = points.iter().rev().map(|(x, low, _)| (x, low));
        for (at, (x, y)) in forth.chain(back).enumerate() {
            let pen = if at == 0 { 'M' } else { 'L' };
            let _ = write!(d, "{pen}{} {}", px(self.at_x(frame, *x)), px(self.at_y(frame, *y)));
        }
        if !d.is_empty() {
            d.push('Z');
        }
        d
    }

    /// Strokes of no length with round caps: a dot takes fewer characters than a circle.
    fn dots(&self, x: &[f64], y: &[f64], frame: Frame) -> String {
        let mut d = String::new();
        for (x, y) in x.iter().zip(y) {
            if self.x.0.holds(*x) && self.y.0.holds(*y) {
                let _ = write!(d, "M{} {}h0", px(self.at_x(frame, *x)), px(self.at_y(frame, *y)));
            }
        }
        d
    }

    fn row_of_keys(&self, frame: Frame) -> Markup {
        let mut x = frame.left;
        let y = frame.top - 12.0;
        let keys: Vec<(f64, String, &Mark)> = self
            .named()
            .map(|(name, mark)| {
                let here = x;
                x += 28.0 + text_width(&name) + 14.0;
                (here, name, mark)
            })
            .collect();
        html! {
            @for (x, name, mark) in keys {
                @match mark {
                    Mark::Line { style, .. } | Mark::Envelope { style, .. } => {
                        line class=(format!("line {}", style.class()))
                            x1=(px(x)) x2=(px(x + 22.0)) y1=(px(y)) y2=(px(y)) {}
                    }
                    Mark::Dots { style, .. } => {
                        path class=(format!("dots {}", style.class())) stroke-width="5"
                            d=(format!("M{} {}h0m8 0h0m7 -3h0", px(x + 4.0), px(y))) {}
                    }
                    Mark::Band { style, .. } | Mark::Corridor { style, .. } => {
                        rect class=(format!("band {}", style.class())) x=(px(x)) y=(px(y - 6.0)) width="22" height="12" {}
                    }
                    _ => { rect.span x=(px(x)) y=(px(y - 6.0)) width="22" height="12" {} }
                }
                text x=(px(x + 28.0)) y=(px(y)) dy="0.35em" { (name) }
            }
        }
    }

    fn end_labels(&self, frame: Frame) -> Markup {
        let mut labels: Vec<(f64, String, Style)> = self
            .marks
            .iter()
            .filter_map(|mark| match mark {
                Mark::Line { x, y, style, name } if !name.is_empty() => {
                    let last = x.iter().zip(y).rev().find(|(x, y)| self.x.0.holds(**x) && y.is_finite())?;
                    Some((self.at_y(frame, *last.1), cut(name), *style))
                }
                _ => None,
            })
            .collect();
        labels.sort_by(|a, b| a.0.total_cmp(&b.0));
        let mut places: Vec<f64> = labels.iter().map(|l| l.0).collect();
        spread(&mut places, frame.top + 6.0, frame.bottom - 4.0);
        html! {
            @for (place, (_, name, style)) in places.iter().zip(&labels) {
                line class=(format!("line {}", style.class())) x1=(px(frame.right + 5.0)) x2=(px(frame.right + 5.0 + SAMPLE)) y1=(px(*place)) y2=(px(*place)) {}
                text class=(format!("end {}", style.class())) x=(px(frame.right + 9.0 + SAMPLE)) y=(px(*place)) dy="0.35em" { (name) }
            }
        }
    }
}

/// A line that runs up and down in each of `n` columns between these ends, from the upper to the lower place of the
/// column. Whole pixels, each relative to the one before, keep an hour of a channel within some kilobytes.
fn envelope(ends: (f64, f64), n: usize, columns: impl Iterator<Item = (f64, f64)>) -> String {
    let mut d = String::new();
    let mut pen: Option<(i64, i64)> = None;
    for (column, (top, bottom)) in columns.enumerate() {
        if !(top.is_finite() && bottom.is_finite()) {
            pen = None;
            continue;
        }
        let x = (ends.0 + (ends.1 - ends.0) * (column as f64 + 0.5) / n as f64).round() as i64;
        let (top, bottom) = (top.round() as i64, bottom.round() as i64);
        let first = match pen {
            Some((before, y)) => {
                let nearest = if (y - top).abs() <= (y - bottom).abs() { top } else { bottom };
                let _ = write!(d, "l{} {}", x - before, nearest - y);
                nearest
            }
            None => {
                let _ = write!(d, "M{x} {top}");
                top
            }
        };
        let last = if first == top { bottom } else { top };
        if last != first {
            let _ = write!(d, "v{}", last - first);
        }
        pen = Some((x, last));
    }
    d
}

/// Moves sorted positions apart until neighbours are at least a line of text apart.
fn spread(places: &mut [f64], top: f64, bottom: f64) {
    for k in 1..places.len() {
        places[k] = places[k].max(places[k - 1] + LABEL);
    }
    let mut below = bottom;
    for place in places.iter_mut().rev() {
        *place = place.min(below);
        below = *place - LABEL;
    }
    let mut above = top;
    for place in places.iter_mut() {
        *place = place.max(above);
        above = *place + LABEL;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ui::plot::Scale;

    fn figure(marks: Vec<Mark>, key: Key) -> String {
        Figure {
            id: "f".into(),
            title: "a < b".into(),
            description: "rising".into(),
            size: (400.0, 200.0),
            x: (Axis::exact(Scale::Linear, 0.0, 1.0), "t in s".into()),
            y: (Axis::exact(Scale::Log, 0.1, 10.0), "y in \"mm\"".into()),
            key,
            marks,
        }
        .svg()
        .into_string()
    }

    #[test]
    fn names_are_escaped_and_what_is_not_a_number_is_left_out() {
        let line = Mark::Line {
            x: vec![0.0, 0.5, 1.0, f64::NAN],
            y: vec![1.0, f64::NAN, 0.0, f64::INFINITY],
            style: Style::Before,
            name: "<script>".into(),
        };
        let svg = figure(vec![line], Key::Ends);
        assert!(svg.contains("a &lt; b") && svg.contains("&lt;script&gt;") && !svg.contains("<script>"));
        assert!(!svg.contains("NaN") && !svg.contains("inf"), "{svg}");
        // Two points that do not join; nothing positive lies at the foot of a logarithmic axis.
        let d = svg.split(" d=\"").nth(1).unwrap().split('"').next().unwrap();
        assert_eq!(d.matches('M').count(), 2);
        assert!(!d.contains('L') && d.ends_with(" 158"), "{d}");
    }

    #[test]
    fn an_envelope_runs_through_all_extremes_in_few_characters() {
        // Two columns of 10 pixels: from 20 to 40, then from 90 to 60, the nearer end first.
        assert_eq!(envelope((0.0, 20.0), 2, [(20.0, 40.0), (60.0, 90.0)].into_iter()), "M5 20v20l10 20v30");
        assert_eq!(
            envelope((0.0, 30.0), 3, [(1.0, 1.0), (f64::NAN, 2.0), (3.0, 3.0)].into_iter()),
            "M5 1M25 3"
        );
        assert_eq!(envelope((0.0, 20.0), 0, [].into_iter()), "");
    }

    #[test]
    fn labels_at_line_ends_do_not_lie_on_each_other() {
        let mut places = [50.0, 51.0, 52.0, 199.0, 199.0];
        spread(&mut places, 10.0, 190.0);
        assert!(places.windows(2).all(|w| w[1] - w[0] >= LABEL - 1e-9), "{places:?}");
        assert!(places[0] >= 10.0 && places[4] <= 190.0, "{places:?}");
    }
}
