//! Plots with one row per item: bars, and dots with whiskers.

use maud::{Markup, html};

use super::scale::Tick;
use super::{Axis, Scale, Style, px, text_width};
use crate::ui::text::{cut, percent};

/// Width of these plots.
pub(super) const WIDTH: f64 = 720.0;
/// Height of a row.
pub(super) const ROW: f64 = 26.0;
/// Least distance of ticks.
const TICK: f64 = 42.0;

/// A name with a share.
#[derive(Debug, Clone)]
pub struct BarRow {
    pub name: String,
    /// 0..1
    pub share: f64,
    /// Text after the share.
    pub note: String,
}

/// A name with a value, its interval and a probability.
#[derive(Debug, Clone)]
pub struct WhiskerRow {
    pub name: String,
    pub value: f64,
    pub interval: [f64; 2],
    /// 0..1, if there is one to draw.
    pub probability: Option<f64>,
    /// Whether the row is among the answers.
    pub chosen: bool,
}

pub(super) fn names_width<'a>(names: impl Iterator<Item = &'a str>) -> f64 {
    // Some of them are bold.
    names.map(|n| 1.15 * text_width(&cut(n))).fold(60.0, f64::max) + 14.0
}

pub(super) fn frame(id: &str, title: &str, description: &str, height: f64, content: &Markup) -> Markup {
    let (title_id, description_id) = (format!("{id}-title"), format!("{id}-desc"));
    html! {
        svg xmlns="http://www.w3.org/2000/svg" role="img" aria-labelledby=(format!("{title_id} {description_id}"))
            viewBox=(format!("0 0 {} {}", px(WIDTH), px(height))) width=(px(WIDTH)) height=(px(height)) {
            title id=(title_id) { (title) }
            desc id=(description_id) { (description) }
            (content)
        }
    }
}

/// Horizontal bars, each followed by its share as text.
pub fn bars(id: &str, title: &str, description: &str, rows: &[BarRow]) -> Markup {
    let left = names_width(rows.iter().map(|r| r.name.as_str()));
    let notes = rows.iter().map(|r| text_width(&r.note)).fold(0.0, f64::max);
    let wide = (WIDTH - left - notes - 90.0).max(80.0);
    let content = html! {
        @for (k, row) in rows.iter().enumerate() {
            @let y = ROW * k as f64 + 0.5 * ROW;
            @let length = wide * if row.share.is_finite() { row.share.clamp(0.0, 1.0) } else { 0.0 };
            text x=(px(left - 10.0)) y=(px(y)) dy="0.35em" text-anchor="end" { (cut(&row.name)) }
            rect class=(format!("bar {}", Style::Before.class())) x=(px(left)) y=(px(y - 8.0)) width=(px(length.max(1.0))) height="16" {}
            text x=(px(left + length + 8.0)) y=(px(y)) dy="0.35em" {
                (percent(row.share)) @if !row.note.is_empty() { tspan.soft dx="10" { (row.note) } }
            }
        }
    };
    frame(id, title, description, ROW * rows.len() as f64, &content)
}

/// Ticks whose names do not overlap: first 0, 90, 99, ... %, then those that have room.
fn apart(ticks: Vec<Tick>, at: impl Fn(f64) -> f64) -> Vec<Tick> {
    let whole = |tick: &Tick| {
        let nines = (1.0 - tick.value).log10();
        (nines - nines.round()).abs() < 1e-6
    };
    let (first, rest): (Vec<Tick>, Vec<Tick>) = ticks.into_iter().partition(whole);
    let mut kept: Vec<Tick> = Vec::new();
    for tick in first.into_iter().chain(rest) {
        if kept.iter().all(|k| (at(k.value) - at(tick.value)).abs() > TICK) {
            kept.push(tick);
        }
    }
    kept
}

/// Closures as dots with their intervals, on an axis that separates 99 from 99.9 %, and probabilities as
/// bars next to them.
pub fn whiskers(id: &str, title: &str, description: &str, rows: &[WhiskerRow]) -> Markup {
    let left = names_width(rows.iter().map(|r| r.name.as_str()));
    let (right, bar) = (WIDTH - 170.0, 80.0);
    let best = rows.iter().map(|r| r.interval[1].max(r.value)).fold(0.5, f64::max);
    let axis = Axis::exact(Scale::ToOne, 0.0, 1.0 - 0.5 * (1.0 - best).max(0.002));
    let at = |x: f64| left + (right - left) * axis.place(x);
    let top = 24.0;
    let ticks = apart(axis.ticks(8), at);
    let bottom = top + ROW * rows.len() as f64;
    let content = html! {
        text.name x=(px(left)) y="14" { "Share of the gap closed, with 90 % interval" }
        @if rows.iter().any(|r| r.probability.is_some()) {
            text.name x=(px(right + 24.0)) y="14" { "Probability" }
        }
        g class="grid" {
            @for tick in &ticks {
                @let x = px(at(tick.value));
                line x1=(x) x2=(x) y1=(px(top)) y2=(px(bottom)) {}
                text x=(x) y=(px(bottom + 16.0)) text-anchor="middle" { (tick.label) " %" }
            }
        }
        @for (k, row) in rows.iter().enumerate() {
            @let y = top + ROW * k as f64 + 0.5 * ROW;
            @let style = if row.chosen { Style::After } else { Style::Noise };
            text class=(if row.chosen { "chosen" } else { "" }) x=(px(left - 12.0)) y=(px(y)) dy="0.35em" text-anchor="end" { (cut(&row.name)) }
            line class=(format!("whisker {}", style.class()))
                x1=(px(at(row.interval[0]))) x2=(px(at(row.interval[1]).max(at(row.interval[0]) + 1.0))) y1=(px(y)) y2=(px(y)) {}
            circle class=(format!("dot {}", style.class())) cx=(px(at(row.value))) cy=(px(y)) r="4.5" {}
            @if let Some(probability) = row.probability {
                @let length = bar * if probability.is_finite() { probability.clamp(0.0, 1.0) } else { 0.0 };
                rect class=(format!("bar {}", style.class())) x=(px(right + 24.0)) y=(px(y - 7.0))
                    width=(px(length.max(1.0))) height="14" {}
                text x=(px(right + 30.0 + length)) y=(px(y)) dy="0.35em" { (percent(probability)) }
            }
        }
    };
    frame(id, title, description, bottom + 22.0, &content)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rows_are_drawn_for_any_numbers_and_names() {
        let row = |name: &str, value: f64| WhiskerRow {
            name: name.into(),
            value,
            interval: [value - 0.1, value],
            probability: Some(value),
            chosen: true,
        };
        let svg = whiskers("w", "t", "d", &[row("<b>", 1.0), row(&"x".repeat(99), -4.0), row("y", f64::NAN)])
            .into_string();
        assert!(svg.contains("&lt;b&gt;") && !svg.contains("NaN"), "{svg}");
        assert_eq!(svg.matches("<circle").count(), 3);
        assert!(svg.contains("90 %") && svg.contains("99 %"), "{svg}");
        let bar = BarRow { name: "a&b".into(), share: 0.25, note: "RMS 1 mm".into() };
        let svg = bars("b", "t", "d", &[bar]).into_string();
        assert!(svg.contains("a&amp;b") && svg.contains("25\u{a0}%"), "{svg}");
    }
}
