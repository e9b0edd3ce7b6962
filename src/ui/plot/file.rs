//! A figure as a file: the numbers behind it as CSV, the picture as SVG that is complete in itself.

use maud::Markup;

use super::figure::{Figure, Mark};

/// Rules for the parts of a plot; the style sheet of the pages holds them too.
const STYLE: &str = include_str!("plot.css");

/// Colours on paper, in place of the variables of the style sheet.
const PAPER: [(&str, &str); 18] = [
    ("--paper", "#fff"),
    ("--ink", "#1c2024"),
    ("--soft", "#5c6670"),
    ("--rule", "#d9dee3"),
    ("--span", "#e6ebf0"),
    ("--measured", "#33383d"),
    ("--before", "#c8500a"),
    ("--after", "#0069b0"),
    ("--noise", "#7d8791"),
    ("--s0", "#0069b0"),
    ("--s1", "#c8500a"),
    ("--s2", "#00795a"),
    ("--s3", "#a3498b"),
    ("--s4", "#946200"),
    ("--s5", "#2b7da8"),
    ("--s6", "#5a5f00"),
    ("--s7", "#33383d"),
    ("--heat", "#0069b0"),
];

/// A picture of the pages as an SVG file.
pub fn picture(svg: Markup) -> String {
    let mut style = STYLE.to_owned();
    for (name, colour) in PAPER {
        style = style.replace(&format!("var({name})"), colour);
    }
    let svg = svg.into_string();
    let (tag, rest) = svg.split_once('>').unwrap_or((&svg, ""));
    format!("<?xml version=\"1.0\" encoding=\"UTF-8\"?>\n{tag}><style>{style}</style>{rest}\n")
}

impl Figure {
    /// The numbers of the figure: one table where all lines share their points, else a row for each point with the name
    /// of its line.
    pub fn csv(&self) -> String {
        let columns: Vec<(String, Vec<f64>, Vec<f64>)> = self.marks.iter().flat_map(columns).collect();
        let x_name = &self.x.1;
        let mut out = String::new();
        let shared = columns.windows(2).all(|pair| pair[0].1 == pair[1].1);
        if shared && let Some((_, x, _)) = columns.first() {
            row(
                &mut out,
                std::iter::once(x_name.as_str()).chain(columns.iter().map(|(name, ..)| name.as_str())),
            );
            for (at, x) in x.iter().enumerate() {
                let values = columns.iter().map(|(_, _, y)| text(y[at]));
                let values: Vec<String> = std::iter::once(text(*x)).chain(values).collect();
                row(&mut out, values.iter().map(String::as_str));
            }
            return out;
        }
        row(&mut out, ["line", x_name, &self.y.1].into_iter());
        for (name, x, y) in &columns {
            for (x, y) in x.iter().zip(y) {
                row(&mut out, [name.as_str(), &text(*x), &text(*y)].into_iter());
            }
        }
        out
    }
}

/// The columns of a mark: name, points, values.
fn columns(mark: &Mark) -> Vec<(String, Vec<f64>, Vec<f64>)> {
    match mark {
        Mark::Line { x, y, name, .. } | Mark::Dots { x, y, name, .. } => {
            vec![(name.clone(), x.clone(), y.clone())]
        }
        Mark::Envelope { from, to, low, high, name, .. } => {
            let x = starts(*from, *to, low.len());
            vec![
                (format!("{name} smallest"), x.clone(), low.clone()),
                (format!("{name} largest"), x, high.clone()),
            ]
        }
        Mark::Corridor { from, to, low, high, name, .. } => {
            let x = starts(*from, *to, low.len());
            vec![
                (format!("{name} lower"), x.clone(), low.clone()),
                (format!("{name} upper"), x, high.clone()),
            ]
        }
        Mark::Band { x, low, high, name, .. } => vec![
            (format!("{name} lower"), x.clone(), low.clone()),
            (format!("{name} upper"), x.clone(), high.clone()),
        ],
        Mark::Bar { from, to, height, .. } => {
            vec![(String::new(), vec![*from, *to], vec![*height, *height])]
        }
        Mark::Span { .. } | Mark::Rule { .. } => Vec::new(),
    }
}

/// Where `n` equal stretches of a range begin.
fn starts(from: f64, to: f64, n: usize) -> Vec<f64> {
    let step = (to - from) / n.max(1) as f64;
    (0..n).map(|k| from + step * k as f64).collect()
}

/// The shortest text that reads back as the same number; nothing for a value that is not known.
pub(super) fn text(x: f64) -> String {
    if x.is_finite() { format!("{x}") } else { String::new() }
}

/// A row of a CSV file.
pub(super) fn row<'a>(out: &mut String, fields: impl Iterator<Item = &'a str>) {
    for (at, field) in fields.enumerate() {
        if at > 0 {
            out.push(',');
        }
        if field.contains([',', '"', '\n', '\r']) {
            out.push_str(&format!("\"{}\"", field.replace('"', "\"\"")));
        } else {
            out.push_str(field);
        }
    }
    out.push_str("\r\n");
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ui::plot::{Axis, Key, Scale, Style};

    fn figure(marks: Vec<Mark>) -> Figure {
        Figure {
            id: "f".into(),
            title: "t".into(),
            description: "d".into(),
            size: (300.0, 200.0),
            x: (Axis::exact(Scale::Linear, 0.0, 1.0), "Time in s".into()),
            y: (Axis::exact(Scale::Linear, 0.0, 1.0), "Force in kN".into()),
            key: Key::Above,
            marks,
        }
    }

    fn line(name: &str, x: &[f64], y: &[f64]) -> Mark {
        Mark::Line { x: x.to_vec(), y: y.to_vec(), style: Style::Series(0), name: name.into() }
    }

    #[test]
    fn lines_over_the_same_points_are_one_table_and_others_a_list() {
        let table =
            figure(vec![line("a,b", &[0.0, 0.5], &[1.0, 0.1]), line("c", &[0.0, 0.5], &[2.0, f64::NAN])]);
        assert_eq!(table.csv(), "Time in s,\"a,b\",c\r\n0,1,2\r\n0.5,0.1,\r\n");
        let list = figure(vec![line("a", &[0.0], &[1.0]), line("c", &[0.5], &[2.0])]);
        assert_eq!(list.csv(), "line,Time in s,Force in kN\r\na,0,1\r\nc,0.5,2\r\n");
    }

    #[test]
    fn a_picture_is_complete_in_itself() {
        let file = picture(figure(vec![line("a", &[0.0], &[1.0])]).svg());
        assert!(file.starts_with("<?xml") && file.contains("xmlns=") && file.trim_end().ends_with("</svg>"));
        assert!(file.contains("<style>") && !file.contains("var("), "{file}");
    }
}
