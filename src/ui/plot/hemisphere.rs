//! Damage by direction in space, as a map of the upper half sphere that keeps areas: z is in the middle, the plane of x
//! and y at the rim, and a direction has its opposite's damage.

use std::fmt::Write;

use maud::{Markup, html};

use super::{file, px};
use crate::ui::text::cut;

/// Radius of the map, pixels.
const RADIUS: f64 = 170.0;
const LEFT: f64 = 40.0;
const ABOVE: f64 = 34.0;
const BELOW: f64 = 34.0;
/// Space right of the map for its legend.
const LEGEND: f64 = 250.0;

/// Classes of a ratio: name of the class in the style sheet, upper bound, words.
const RATIOS: [(&str, f64, &str); 7] = [
    ("under u2", 0.1, "below 0.1"),
    ("under u1", 0.5, "0.1 to 0.5"),
    ("under u0", 0.8, "0.5 to 0.8"),
    ("near", 1.25, "0.8 to 1.25"),
    ("above a0", 2.0, "1.25 to 2"),
    ("above a1", 10.0, "2 to 10"),
    ("above a2", f64::INFINITY, "above 10"),
];

/// Classes of a share of the largest damage.
const SHARES: [(&str, f64, &str); 5] = [
    ("share h0", 0.05, "below 0.05"),
    ("share h1", 0.2, "0.05 to 0.2"),
    ("share h2", 0.5, "0.2 to 0.5"),
    ("share h3", 0.8, "0.5 to 0.8"),
    ("share", f64::INFINITY, "0.8 to 1"),
];

/// Damage of three channels in each of some directions.
#[derive(Debug, Clone)]
pub struct Hemisphere {
    /// Identifies the plot on its page.
    pub id: String,
    /// Title.
    pub title: String,
    /// Description of its content in words.
    pub description: String,
    /// Names of the channels x, y and z.
    pub axes: [String; 3],
    /// Unit vectors `[x, y, z]` with `z` of at least 0.
    pub directions: Vec<[f64; 3]>,
    /// Damage of the prediction in each direction.
    pub predicted: Vec<f64>,
    /// Damage of the measurement in each direction, if there is one.
    pub measured: Option<Vec<f64>>,
}

impl Hemisphere {
    /// The map as an `svg` element. With a measurement it shows the ratio, else the share of the largest damage.
    pub fn svg(&self) -> Markup {
        let (title, description) = (format!("{}-title", self.id), format!("{}-desc", self.id));
        let (width, height) = (LEFT + 2.0 * RADIUS + 40.0 + LEGEND, ABOVE + 2.0 * RADIUS + BELOW);
        let (cx, cy) = (LEFT + RADIUS, ABOVE + RADIUS);
        let [x, y, z] = self.axes.each_ref().map(|name| cut(name));
        let legend = LEFT + 2.0 * RADIUS + 40.0;
        let quantity = if self.measured.is_some() {
            "Predicted over measured damage"
        } else {
            "Share of the largest damage"
        };
        let classes = self.classes();
        html! {
            svg xmlns="http://www.w3.org/2000/svg" role="img" aria-labelledby=(format!("{title} {description}"))
                viewBox=(format!("0 0 {} {}", px(width), px(height))) width=(px(width)) height=(px(height)) {
                title id=(title) { (self.title) }
                desc id=(description) { (self.description) }
                @for (k, (class, ..)) in classes.iter().enumerate() {
                    path class=(format!("ray {class}")) stroke-width=(px(self.dot())) d=(self.dots_of(k)) {}
                }
                g class="grid" {
                    circle.axis cx=(px(cx)) cy=(px(cy)) r=(px(RADIUS + 0.5 * self.dot())) {}
                    @for elevation in [30.0_f64, 60.0] {
                        @let r = RADIUS * (1.0 - elevation.to_radians().sin()).sqrt();
                        circle cx=(px(cx)) cy=(px(cy)) r=(px(r)) {}
                    }
                }
                text.name x=(px(cx + RADIUS + 12.0)) y=(px(cy)) dy="0.35em" { "x" }
                text.name x=(px(cx)) y=(px(ABOVE - 12.0)) text-anchor="middle" { "y" }
                text x=(px(cx - RADIUS - 12.0)) y=(px(cy)) dy="0.35em" text-anchor="end" { "−x" }
                text x=(px(cx)) y=(px(cy + RADIUS + 22.0)) text-anchor="middle" { "−y" }
                (self.peak(&self.predicted, false))
                @if let Some(measured) = &self.measured { (self.peak(measured, true)) }
                text.name x=(px(legend)) y="14" { (quantity) }
                @for (k, (class, _, words)) in classes.iter().enumerate().rev() {
                    @let at = 34.0 + 22.0 * (classes.len() - 1 - k) as f64;
                    path class=(format!("ray {class}")) stroke-width=(px(self.dot())) d=(format!("M{} {}h0", px(legend + 8.0), px(at))) {}
                    text x=(px(legend + 26.0)) y=(px(at)) dy="0.35em" { (words) }
                }
                @let below = 34.0 + 22.0 * classes.len() as f64 + 8.0;
                (ring(legend + 8.0, below))
                text x=(px(legend + 26.0)) y=(px(below)) dy="0.35em" { "largest predicted damage" }
                @if self.measured.is_some() {
                    (square(legend + 8.0, below + 22.0))
                    text x=(px(legend + 26.0)) y=(px(below + 22.0)) dy="0.35em" { "largest measured damage" }
                }
                @for (row, words) in [format!("x: {x}"), format!("y: {y}"), format!("z, in the middle: {z}"), "circles at 30° and 60° above the plane".to_owned()].iter().enumerate() {
                    text x=(px(legend)) y=(px(below + 56.0 + 18.0 * row as f64)) dy="0.35em" { (words) }
                }
            }
        }
    }

    /// A row for each direction.
    pub fn csv(&self) -> String {
        let mut out = String::from("x,y,z,azimuth in degrees,elevation in degrees,predicted damage");
        out.push_str(if self.measured.is_some() { ",measured damage,damage ratio\r\n" } else { "\r\n" });
        for (k, [x, y, z]) in self.directions.iter().enumerate() {
            let fields = [*x, *y, *z, y.atan2(*x).to_degrees(), z.asin().to_degrees(), self.predicted[k]];
            let measured = self.measured.as_ref().map(|measured| measured[k]);
            let ratio = measured.map(|measured| self.predicted[k] / measured);
            let fields: Vec<String> =
                fields.into_iter().chain(measured).chain(ratio).map(file::text).collect();
            file::row(&mut out, fields.iter().map(String::as_str));
        }
        out
    }

    fn classes(&self) -> &'static [(&'static str, f64, &'static str)] {
        if self.measured.is_some() { &RATIOS } else { &SHARES }
    }

    /// The number that decides the class of a direction.
    fn value(&self, k: usize) -> f64 {
        match &self.measured {
            Some(measured) => self.predicted[k] / measured[k],
            None => self.predicted[k] / self.predicted.iter().copied().fold(0.0, f64::max),
        }
    }

    fn dots_of(&self, class: usize) -> String {
        let classes = self.classes();
        let from = if class == 0 { f64::NEG_INFINITY } else { classes[class - 1].1 };
        let mut d = String::new();
        for (k, direction) in self.directions.iter().enumerate() {
            let value = self.value(k);
            if value >= from && value < classes[class].1 {
                let (x, y) = place(*direction);
                let _ = write!(d, "M{} {}h0", px(x), px(y));
            }
        }
        d
    }

    /// Diameter of a dot: every direction has the same area.
    fn dot(&self) -> f64 {
        (0.82 * RADIUS * (std::f64::consts::PI / self.directions.len().max(1) as f64).sqrt()).clamp(2.0, 24.0)
    }

    fn peak(&self, damages: &[f64], measured: bool) -> Markup {
        let largest = (0..damages.len()).max_by(|a, b| damages[*a].total_cmp(&damages[*b]));
        let Some(largest) = largest.filter(|k| damages[*k] > 0.0) else { return html! {} };
        let (x, y) = place(self.directions[largest]);
        if measured { square(x, y) } else { ring(x, y) }
    }
}

/// The mark of the largest predicted damage.
fn ring(x: f64, y: f64) -> Markup {
    html! { circle.peak cx=(px(x)) cy=(px(y)) r="8" {} }
}

/// The mark of the largest measured damage.
fn square(x: f64, y: f64) -> Markup {
    html! { rect.peak x=(px(x - 10.0)) y=(px(y - 10.0)) width="20" height="20" {} }
}

/// Lambert's azimuthal map, which keeps areas, of the half sphere.
fn place([x, y, z]: [f64; 3]) -> (f64, f64) {
    let radius = RADIUS * (1.0 - z.clamp(0.0, 1.0)).sqrt();
    let level = x.hypot(y);
    let (along, up) = if level > 0.0 { (x / level, y / level) } else { (0.0, 0.0) };
    (LEFT + RADIUS + radius * along, ABOVE + RADIUS - radius * up)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn map(predicted: &[f64], measured: Option<&[f64]>) -> Hemisphere {
        let directions = vec![[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]];
        Hemisphere {
            id: "m".into(),
            title: "<t>".into(),
            description: "d".into(),
            axes: ["<x>", "y", "z"].map(String::from),
            directions,
            predicted: predicted.to_vec(),
            measured: measured.map(<[f64]>::to_vec),
        }
    }

    /// The path of a class.
    fn path(svg: &str, class: &str) -> String {
        let rest = svg.split(&format!("class=\"ray {class}\"")).nth(1).unwrap();
        rest.split(" d=\"").nth(1).unwrap().split('"').next().unwrap().to_owned()
    }

    #[test]
    fn each_direction_lies_at_its_place_in_the_class_of_its_ratio() {
        let svg = map(&[1.0, 30.0, 0.2], Some(&[1.0, 1.0, 1.0])).svg().into_string();
        assert!(svg.contains("&lt;x&gt;") && !svg.contains("<x>") && !svg.contains("NaN"), "{svg}");
        let (cx, cy) = (LEFT + RADIUS, ABOVE + RADIUS);
        assert_eq!(path(&svg, "near"), format!("M{} {}h0", px(cx), px(cy)), "z is in the middle");
        assert_eq!(path(&svg, "above a2"), format!("M{} {}h0", px(cx + RADIUS), px(cy)), "x is on the right");
        assert_eq!(path(&svg, "under u1"), format!("M{} {}h0", px(cx), px(cy - RADIUS)), "y is above");
        assert_eq!(path(&svg, "under u2"), "");
    }

    #[test]
    fn without_a_measurement_it_shows_shares_and_without_damage_nothing() {
        let svg = map(&[1.0, 0.5, 0.01], None).svg().into_string();
        assert!(path(&svg, "share h0").len() > 2 && path(&svg, "share h3").len() > 2, "{svg}");
        let none = map(&[0.0; 3], Some(&[0.0; 3]));
        assert!(!none.svg().into_string().contains("NaN"));
        assert!(none.csv().contains(",0,0,\r\n"), "no ratio: {}", none.csv());
    }

    #[test]
    fn the_table_has_angles_and_the_ratio() {
        let csv = map(&[1.0, 3.0, 1.0], Some(&[2.0, 1.0, 1.0])).csv();
        let rows: Vec<&str> = csv.lines().collect();
        assert_eq!((rows[1], rows[2]), ("0,0,1,0,90,1,2,0.5", "1,0,0,0,0,3,1,3"));
    }
}
