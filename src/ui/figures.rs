//! Pictures of pages: drawn into the page or after it, zoomed, and saved as CSV and SVG.

use maud::{Markup, html};

use super::plot::{Figure, Hemisphere, Matrix, RatioRow, Ratios, picture};

/// The content of a figure.
#[derive(Debug, Clone)]
pub enum Drawing {
    /// Plots one below the other, which share their horizontal axis.
    Plots(Vec<Figure>),
    /// Counts of pairs of classes.
    Matrix(Box<Matrix>),
    /// Ratios, one row an item.
    Ratios(Box<Ratios>),
    /// Damage by direction in space.
    Hemisphere(Box<Hemisphere>),
    /// Nothing to draw, and why.
    Nothing(String),
}

impl From<Figure> for Drawing {
    fn from(figure: Figure) -> Self {
        Self::Plots(vec![figure])
    }
}

impl From<Ratios> for Drawing {
    fn from(ratios: Ratios) -> Self {
        Self::Ratios(Box::new(ratios))
    }
}

/// Named ratios on a logarithmic axis about 1, as an SVG file; a name without a ratio keeps its row.
pub fn ratios_svg(title: &str, label: &str, rows: impl IntoIterator<Item = (String, Option<f64>)>) -> String {
    let row = |(name, value): (String, Option<f64>)| RatioRow { name, value, ..RatioRow::default() };
    let ratios = Ratios {
        id: "ratios".into(),
        title: title.into(),
        description: format!("{label}, one row an item, on a logarithmic axis about 1."),
        label: label.into(),
        rows: rows.into_iter().map(row).collect(),
    };
    picture(ratios.svg())
}

impl Drawing {
    /// As a part of a page.
    pub fn part(&self) -> Markup {
        html! {
            @match self {
                // Pictures as wide as the page grow with it; narrower ones keep their size.
                Self::Plots(figures) => div.plot.fill[figures.iter().all(|figure| figure.size.0 > 900.0)] { @for figure in figures { (figure.svg()) } },
                Self::Matrix(matrix) => div.plot { (matrix.svg()) },
                Self::Ratios(ratios) => div.plot { (ratios.svg()) },
                Self::Hemisphere(hemisphere) => div.plot { (hemisphere.svg()) },
                Self::Nothing(why) => p.soft { (why) },
            }
        }
    }

    /// As an SVG file.
    pub fn svg(&self) -> String {
        match self {
            Self::Plots(figures) => match figures.as_slice() {
                [one] => picture(one.svg()),
                several => picture(stacked(several)),
            },
            Self::Matrix(matrix) => picture(matrix.svg()),
            Self::Ratios(ratios) => picture(ratios.svg()),
            Self::Hemisphere(hemisphere) => picture(hemisphere.svg()),
            Self::Nothing(why) => picture(html! {
                svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 600 40" width="600" height="40" { text x="4" y="24" { (why) } }
            }),
        }
    }

    /// The numbers behind it as a CSV file.
    pub fn csv(&self) -> String {
        match self {
            Self::Plots(figures) => match figures.split_first() {
                Some((first, rest)) => {
                    let marks =
                        first.marks.iter().chain(rest.iter().flat_map(|figure| &figure.marks)).cloned();
                    Figure { marks: marks.collect(), ..first.clone() }.csv()
                }
                None => String::new(),
            },
            Self::Matrix(matrix) => matrix.csv(),
            Self::Ratios(ratios) => ratios.csv(),
            Self::Hemisphere(hemisphere) => hemisphere.csv(),
            Self::Nothing(_) => String::new(),
        }
    }
}

/// Several plots in one file, one below the other.
fn stacked(figures: &[Figure]) -> Markup {
    let width = figures.iter().map(|figure| figure.size.0).fold(0.0, f64::max);
    let height: f64 = figures.iter().map(|figure| figure.size.1).sum();
    let tops = figures.iter().scan(0.0, |below, figure| {
        let top = *below;
        *below += figure.size.1;
        Some(top)
    });
    html! {
        svg xmlns="http://www.w3.org/2000/svg" viewBox=(format!("0 0 {width} {height}")) width=(width) height=(height) {
            @for (figure, top) in figures.iter().zip(tops) {
                g transform=(format!("translate(0 {top})")) { (figure.svg()) }
            }
        }
    }
}

/// The address of a figure: the page's own with the figure's name.
pub(super) fn address(page: &str, name: &str) -> String {
    let mark = if page.contains('?') { '&' } else { '?' };
    format!("{page}{mark}figure={name}")
}

/// Links that save a figure.
pub(super) fn saves(address: &str) -> Markup {
    html! {
        p.saves {
            a data-save href={ (address) "&as=csv" } download { "Numbers (CSV)" }
            a data-save href={ (address) "&as=svg" } download { "Picture (SVG)" }
        }
    }
}

/// A figure that is drawn after the page has come.
pub(super) fn late(address: &str, caption: &Markup) -> Markup {
    html! {
        figure {
            div.loading data-figure=(address) data-late aria-live="off" { "Being drawn …" }
            figcaption { (caption) }
            (saves(address))
        }
    }
}

/// A figure over time that zooms.
pub(super) struct Zoom<'a> {
    /// Its address.
    pub address: &'a str,
    /// Name for people who do not see it.
    pub name: &'a str,
    /// Range of time of the whole, s.
    pub range: [f64; 2],
    /// Shortest range of time that is shown, s.
    pub least: f64,
}

impl Zoom<'_> {
    /// The figure; with a drawing at once, else after the page has come.
    pub(super) fn figure(&self, drawing: Option<&Drawing>, caption: &Markup) -> Markup {
        let [from, to] = self.range;
        html! {
            figure {
                div.tools role="group" aria-label="Range of time that is shown" {
                    button type="button" data-zoom="in" { "Closer" }
                    button type="button" data-zoom="out" { "Wider" }
                    button type="button" data-zoom="left" aria-label="Earlier" { "◀" }
                    button type="button" data-zoom="right" aria-label="Later" { "▶" }
                    button type="button" data-zoom="all" { "All" }
                    span.soft { "Drag over a range to see it; or the keys + − ← → 0." }
                }
                div.zoom.loading[drawing.is_none()] tabindex="0" role="group" aria-label=(self.name) data-figure=(self.address)
                    data-from=(from) data-to=(to) data-least=(self.least) data-late[drawing.is_none()] {
                    @match drawing { Some(drawing) => (drawing.part()), None => "Being drawn …" }
                }
                figcaption { (caption) }
                (saves(self.address))
            }
        }
    }
}

/// A line with at most about `2 n` points: of each of `n` stretches the smallest and the largest, so that no peak is
/// lost.
pub(super) fn thinned(x: &[f64], y: &[f64], n: usize) -> (Vec<f64>, Vec<f64>) {
    if y.len() <= 2 * n {
        return (x.to_vec(), y.to_vec());
    }
    let (mut thin_x, mut thin_y) = (Vec::with_capacity(2 * n), Vec::with_capacity(2 * n));
    for k in 0..n {
        let range = k * y.len() / n..(k + 1) * y.len() / n;
        let by = |a: &usize, b: &usize| y[*a].total_cmp(&y[*b]);
        let (Some(low), Some(high)) = (range.clone().min_by(by), range.max_by(by)) else { continue };
        let both = if low == high { vec![low] } else { vec![low.min(high), low.max(high)] };
        for at in both {
            thin_x.push(x[at]);
            thin_y.push(y[at]);
        }
    }
    (thin_x, thin_y)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_thinned_line_keeps_its_peaks() {
        let x: Vec<f64> = (0..10_000).map(f64::from).collect();
        let mut y = vec![0.0; 10_000];
        (y[1234], y[8765]) = (5.0, -4.0);
        let (thin_x, thin_y) = thinned(&x, &y, 100);
        assert!(thin_y.len() <= 200 && thin_x.windows(2).all(|pair| pair[0] < pair[1]));
        assert!(thin_x.contains(&1234.0) && thin_y.contains(&5.0) && thin_y.contains(&-4.0));
        assert_eq!(thinned(&x[..5], &y[..5], 100).0, x[..5]);
    }

    #[test]
    fn nothing_to_draw_is_said_in_every_form() {
        let nothing = Drawing::Nothing("a < b".into());
        assert!(nothing.part().into_string().contains("a &lt; b"));
        assert!(nothing.svg().contains("a &lt; b") && nothing.csv().is_empty());
    }
}
