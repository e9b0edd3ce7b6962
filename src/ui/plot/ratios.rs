//! Ratios as dots, one row an item, on a logarithmic axis about 1.

use maud::{Markup, html};

use super::rows::{ROW, WIDTH, frame, names_width};
use super::{Axis, Scale, Style, file, px};
use crate::ui::text::{cut, number};

/// Space right of the axis for the value as a number.
const RIGHT: f64 = 70.0;

/// A name with ratios.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct RatioRow {
    /// Its name.
    pub name: String,
    /// The ratio that is drawn as a full dot and written beside the row; there may be none.
    pub value: Option<f64>,
    /// The ratio that is drawn as a second dot, if there is one to compare with.
    pub other: Option<f64>,
    /// The interval that is drawn through the full dot, if one is known.
    pub interval: Option<[f64; 2]>,
}

/// Rows of dots.
#[derive(Debug, Clone)]
pub struct Ratios {
    /// Identifies the plot on its page.
    pub id: String,
    /// Title.
    pub title: String,
    /// Description of its content in words.
    pub description: String,
    /// What the ratios are.
    pub label: String,
    /// The rows from top to bottom.
    pub rows: Vec<RatioRow>,
}

impl Ratios {
    /// The plot as an `svg` element.
    pub fn svg(&self) -> Markup {
        let left = names_width(self.rows.iter().map(|row| row.name.as_str()));
        let right = WIDTH - RIGHT;
        let intervals = self.rows.iter().filter_map(|row| row.interval).flatten();
        let found = self.rows.iter().flat_map(|row| [row.value, row.other]).flatten().chain(intervals);
        // At least from half to twice, so that ratios near 1 look near 1.
        let axis = Axis::around(Scale::Log, found.chain([0.5, 2.0]));
        let at = |x: f64| left + (right - left) * axis.place(x);
        let top = 24.0;
        let bottom = top + ROW * self.rows.len() as f64;
        let dot = |ratio: Option<f64>, y: f64, style: Style| {
            html! {
                @if let Some(ratio) = ratio.filter(|r| r.is_finite() && *r > 0.0) {
                    circle class=(format!("dot {}", style.class())) cx=(px(at(ratio))) cy=(px(y)) r="4.5" {}
                }
            }
        };
        let content = html! {
            text.name x=(px(left)) y="14" { (self.label) }
            g class="grid" {
                @for tick in axis.ticks(8) {
                    @let x = px(at(tick.value));
                    line x1=(x) x2=(x) y1=(px(top)) y2=(px(bottom)) {}
                    text x=(x) y=(px(bottom + 16.0)) text-anchor="middle" { (tick.label) }
                }
                line.axis x1=(px(at(1.0))) x2=(px(at(1.0))) y1=(px(top)) y2=(px(bottom)) {}
            }
            @for (k, row) in self.rows.iter().enumerate() {
                @let y = top + ROW * k as f64 + 0.5 * ROW;
                text x=(px(left - 12.0)) y=(px(y)) dy="0.35em" text-anchor="end" { (cut(&row.name)) }
                @if let Some([low, high]) = row.interval.filter(|ends| ends.iter().all(|end| end.is_finite())) {
                    line class=(format!("whisker {}", Style::After.class()))
                        x1=(px(at(low))) x2=(px(at(high).max(at(low) + 1.0))) y1=(px(y)) y2=(px(y)) {}
                }
                (dot(row.other, y, Style::Noise))
                (dot(row.value, y, Style::After))
                text x=(px(right + 12.0)) y=(px(y)) dy="0.35em" { (row.value.map_or("none".to_owned(), number)) }
            }
        };
        frame(&self.id, &self.title, &self.description, bottom + 22.0, &content)
    }

    /// The numbers, with a column for each sort that there is.
    pub fn csv(&self) -> String {
        let (compared, told) = (
            self.rows.iter().any(|row| row.other.is_some()),
            self.rows.iter().any(|row| row.interval.is_some()),
        );
        let mut out = String::new();
        let mut head = vec!["name", "ratio"];
        head.extend(compared.then_some("compared with"));
        head.extend(told.then_some(["lower", "upper"]).into_iter().flatten());
        file::row(&mut out, head.into_iter());
        for row in &self.rows {
            let text = |x: Option<f64>| x.map(file::text).unwrap_or_default();
            let mut fields = vec![row.name.clone(), text(row.value)];
            fields.extend(compared.then(|| text(row.other)));
            fields.extend(
                told.then(|| [0, 1].map(|end| text(row.interval.map(|ends| ends[end]))))
                    .into_iter()
                    .flatten(),
            );
            file::row(&mut out, fields.iter().map(String::as_str));
        }
        out
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn plot(rows: Vec<RatioRow>) -> Ratios {
        let [id, title, description, label] = ["r", "t", "d", "Damage ratio"].map(String::from);
        Ratios { id, title, description, label, rows }
    }

    fn row(name: &str, value: Option<f64>, other: Option<f64>) -> RatioRow {
        RatioRow { name: name.into(), value, other, interval: None }
    }

    #[test]
    fn ratios_lie_about_one_and_what_is_missing_is_said() {
        let rows = vec![row("<x>", Some(1.0), Some(8.0)), row("y", None, None), row("z", Some(0.0), None)];
        let svg = plot(rows).svg().into_string();
        assert!(svg.contains("&lt;x&gt;") && svg.contains(">none<") && !svg.contains("NaN"), "{svg}");
        assert_eq!(svg.matches("<circle").count(), 2, "a ratio of 0 has no place on the axis");
        let places: Vec<f64> =
            svg.split("cx=\"").skip(1).map(|rest| rest.split('"').next().unwrap().parse().unwrap()).collect();
        assert!(places[0] > places[1], "8 is right of 1: {places:?}");
    }

    #[test]
    fn an_interval_is_drawn_through_its_dot_and_only_columns_with_numbers_are_saved() {
        let with = RatioRow { interval: Some([0.0, 2.0]), ..row("a,b", Some(1.5), None) };
        let plot = plot(vec![with, row("y", None, None)]);
        let svg = plot.svg().into_string();
        assert!(svg.matches("whisker").count() == 1 && !svg.contains("NaN"), "{svg}");
        assert_eq!(plot.csv(), "name,ratio,lower,upper\r\n\"a,b\",1.5,0,2\r\ny,,,\r\n");
    }
}
