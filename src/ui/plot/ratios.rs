//! Ratios as dots, one row an item, on a logarithmic axis about 1.

use maud::{Markup, html};

use super::rows::{ROW, WIDTH, cut, frame, names_width};
use super::{Axis, Scale, Style, px};
use crate::ui::text::number;

/// Space right of the axis for the value as a number.
const RIGHT: f64 = 70.0;

/// A name with ratios.
#[derive(Debug, Clone)]
pub struct RatioRow {
    /// Its name.
    pub name: String,
    /// The ratio that is drawn as a full dot and written beside the row; there may be none.
    pub value: Option<f64>,
    /// The ratio that is drawn as a second dot, if there is one to compare with.
    pub other: Option<f64>,
}

/// Rows of dots; `label` says what the ratios are.
pub fn ratios(id: &str, title: &str, description: &str, label: &str, rows: &[RatioRow]) -> Markup {
    let left = names_width(rows.iter().map(|row| row.name.as_str()));
    let right = WIDTH - RIGHT;
    let found = rows.iter().flat_map(|row| [row.value, row.other]).flatten();
    // At least from half to twice, so that ratios near 1 look near 1.
    let axis = Axis::around(Scale::Log, found.chain([0.5, 2.0]));
    let at = |x: f64| left + (right - left) * axis.place(x);
    let top = 24.0;
    let bottom = top + ROW * rows.len() as f64;
    let dot = |ratio: Option<f64>, y: f64, style: Style| {
        html! {
            @if let Some(ratio) = ratio.filter(|r| r.is_finite() && *r > 0.0) {
                circle class=(format!("dot {}", style.class())) cx=(px(at(ratio))) cy=(px(y)) r="4.5" {}
            }
        }
    };
    let content = html! {
        text.name x=(px(left)) y="14" { (label) }
        g class="grid" {
            @for tick in axis.ticks(8) {
                @let x = px(at(tick.value));
                line x1=(x) x2=(x) y1=(px(top)) y2=(px(bottom)) {}
                text x=(x) y=(px(bottom + 16.0)) text-anchor="middle" { (tick.label) }
            }
            line.axis x1=(px(at(1.0))) x2=(px(at(1.0))) y1=(px(top)) y2=(px(bottom)) {}
        }
        @for (k, row) in rows.iter().enumerate() {
            @let y = top + ROW * k as f64 + 0.5 * ROW;
            text x=(px(left - 12.0)) y=(px(y)) dy="0.35em" text-anchor="end" { (cut(&row.name)) }
            (dot(row.other, y, Style::Noise))
            (dot(row.value, y, Style::After))
            text x=(px(right + 12.0)) y=(px(y)) dy="0.35em" { (row.value.map_or("none".to_owned(), number)) }
        }
    };
    frame(id, title, description, bottom + 22.0, &content)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ratios_lie_about_one_and_what_is_missing_is_said() {
        let row = |name: &str, value, other| RatioRow { name: name.into(), value, other };
        let rows = [row("<x>", Some(1.0), Some(8.0)), row("y", None, None), row("z", Some(0.0), None)];
        let svg = ratios("r", "t", "d", "Damage ratio", &rows).into_string();
        assert!(svg.contains("&lt;x&gt;") && svg.contains(">none<") && !svg.contains("NaN"), "{svg}");
        assert_eq!(svg.matches("<circle").count(), 2, "a ratio of 0 has no place on the axis");
        let places: Vec<f64> =
            svg.split("cx=\"").skip(1).map(|rest| rest.split('"').next().unwrap().parse().unwrap()).collect();
        assert!(places[0] > places[1], "8 is right of 1: {places:?}");
    }
}
