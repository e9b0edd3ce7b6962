//! A matrix of counts as a picture: a cell for each pair of classes, the darker the more.

use std::fmt::Write;

use maud::{Markup, html};

use super::{Axis, px};

/// Side of the picture's square, pixels.
const SIDE: f64 = 320.0;
const LEFT: f64 = 58.0;
const ABOVE: f64 = 26.0;
const BELOW: f64 = 42.0;

/// Steps of darkness.
const STEPS: usize = 6;

/// A matrix `[row][column]` over classes with these edges.
#[derive(Debug, Clone)]
pub struct Matrix {
    /// Identifies the plot on its page.
    pub id: String,
    /// Title.
    pub title: String,
    /// Description of its content in words.
    pub description: String,
    /// Edges of the classes.
    pub edges: Vec<f64>,
    /// Axis over the edges.
    pub axis: Axis,
    /// Names of the rows' axis, which runs up, and of the columns' axis.
    pub names: [String; 2],
    /// Counts.
    pub cells: Vec<Vec<f64>>,
}

impl Matrix {
    /// The picture as an `svg` element; cells of equal darkness are one path.
    pub fn svg(&self) -> Markup {
        let (title, description) = (format!("{}-title", self.id), format!("{}-desc", self.id));
        let (width, height) = (LEFT + SIDE + 110.0, ABOVE + SIDE + BELOW);
        let most = self.most();
        let at = |value: f64| SIDE * self.axis.place(value);
        html! {
            svg xmlns="http://www.w3.org/2000/svg" role="img" aria-labelledby=(format!("{title} {description}"))
                viewBox=(format!("0 0 {} {}", px(width), px(height))) width=(px(width)) height=(px(height)) {
                title id=(title) { (self.title) }
                desc id=(description) { (self.description) }
                rect.span x=(px(LEFT)) y=(px(ABOVE)) width=(px(SIDE)) height=(px(SIDE)) {}
                @for step in 0..STEPS {
                    path class=(format!("heat h{step}")) d=(self.cells_of(step, most)) {}
                }
                g class="grid" {
                    @for tick in self.axis.ticks(6) {
                        @let (x, y) = (LEFT + at(tick.value), ABOVE + SIDE - at(tick.value));
                        text x=(px(LEFT - 6.0)) y=(px(y)) dy="0.35em" text-anchor="end" { (tick.label) }
                        text x=(px(x)) y=(px(ABOVE + SIDE + 17.0)) text-anchor="middle" { (tick.label) }
                        line x1=(px(x)) x2=(px(x)) y1=(px(ABOVE + SIDE)) y2=(px(ABOVE + SIDE + 4.0)) {}
                        line x1=(px(LEFT - 4.0)) x2=(px(LEFT)) y1=(px(y)) y2=(px(y)) {}
                    }
                }
                text.name x="2" y="14" { (self.names[0]) }
                text.name x=(px(LEFT + 0.5 * SIDE)) y=(px(ABOVE + SIDE + 35.0)) text-anchor="middle" { (self.names[1]) }
                text.name x=(px(LEFT + SIDE + 18.0)) y=(px(ABOVE + 10.0)) { "Cycles" }
                @for step in (0..STEPS).filter(|step| !self.cells_of(*step, most).is_empty()) {
                    @let y = ABOVE + 24.0 + 22.0 * (STEPS - 1 - step) as f64;
                    path class=(format!("heat h{step}")) d=(format!("M{} {}h18v14h-18z", px(LEFT + SIDE + 18.0), px(y))) {}
                    text x=(px(LEFT + SIDE + 42.0)) y=(px(y + 11.0)) { (bound(step, most)) }
                }
            }
        }
    }

    /// The counts that are not zero, a row for each.
    pub fn csv(&self) -> String {
        let mut out = String::from("from,from_end,to,to_end,cycles\r\n");
        for (row, cells) in self.cells.iter().enumerate() {
            for (column, count) in cells.iter().enumerate().filter(|(_, count)| **count > 0.0) {
                let edges = [row, row + 1, column, column + 1].map(|edge| self.edges[edge]);
                let _ = write!(out, "{},{},{},{},{count}\r\n", edges[0], edges[1], edges[2], edges[3]);
            }
        }
        out
    }

    fn most(&self) -> f64 {
        self.cells.iter().flatten().copied().filter(|count| count.is_finite()).fold(0.0, f64::max)
    }

    fn cells_of(&self, step: usize, most: f64) -> String {
        let at = |edge: usize| SIDE * self.axis.place(self.edges[edge]);
        let mut d = String::new();
        for (row, cells) in self.cells.iter().enumerate() {
            for (column, count) in cells.iter().enumerate() {
                if *count > 0.0 && darkness(*count, most) == step {
                    let (x, y) = (LEFT + at(column), ABOVE + SIDE - at(row + 1));
                    let (w, h) = (at(column + 1) - at(column), at(row + 1) - at(row));
                    let _ = write!(d, "M{} {}h{}v{}h-{}z", px(x), px(y), px(w), px(h), px(w));
                }
            }
        }
        d
    }
}

/// The logarithm decides: few large cycles matter beside many small ones.
fn darkness(count: f64, most: f64) -> usize {
    let share = if most > 1.0 { (1.0 + count).ln() / (1.0 + most).ln() } else { 1.0 };
    ((share * STEPS as f64).ceil() as usize).clamp(1, STEPS) - 1
}

/// The largest count of a step.
fn bound(step: usize, most: f64) -> String {
    let top = (1.0 + most).powf((step + 1) as f64 / STEPS as f64) - 1.0;
    format!("≤ {}", crate::ui::text::number(top.max(if step + 1 == STEPS { most } else { 0.0 })))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ui::plot::Scale;

    #[test]
    fn each_cell_is_drawn_once_and_the_table_holds_the_counts() {
        let matrix = Matrix {
            id: "m".into(),
            title: "<t>".into(),
            description: "d".into(),
            edges: vec![0.0, 1.0, 2.0],
            axis: Axis::exact(Scale::Linear, 0.0, 2.0),
            names: ["From in kN".into(), "To in kN".into()],
            cells: vec![vec![0.0, 100.0], vec![1.0, 0.0]],
        };
        let svg = matrix.svg().into_string();
        assert!(svg.contains("&lt;t&gt;") && !svg.contains("NaN"));
        // Two cells, and the six of the legend.
        assert_eq!(svg.matches("h160v160").count(), 2, "{svg}");
        assert_eq!(matrix.csv(), "from,from_end,to,to_end,cycles\r\n0,1,1,2,100\r\n1,2,0,1,1\r\n");
        let empty = Matrix { cells: vec![vec![0.0; 2]; 2], ..matrix };
        assert!(!empty.svg().into_string().contains("NaN"));
    }
}
