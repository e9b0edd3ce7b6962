//! Plots as inline SVG: axes, lines, envelopes, bands, dots, bars, spans, whiskers, matrices. Colours are classes that the page's
//! style sheet sets for light, dark and print; every line differs from its neighbours by more than its
//! colour (width or dashes), and every plot has a description in words.

mod figure;
mod file;
mod hemisphere;
mod matrix;
mod ratios;
mod rows;
mod scale;

pub use figure::{Figure, Key, Mark};
pub use file::picture;
pub use hemisphere::Hemisphere;
pub use matrix::Matrix;
pub use ratios::{RatioRow, Ratios};
pub use rows::{BarRow, WhiskerRow, bars, whiskers};
pub use scale::{Axis, Scale};

/// The meaning of a mark; the style sheet gives each its colour and dashes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Style {
    /// The measurement.
    Measured,
    /// The error of the model.
    Before,
    /// The error with the effect in the model, and the effect itself.
    After,
    /// The noise floor.
    Noise,
    /// One of several lines of equal rank, by its place; eight differ in colour and dashes.
    Series(usize),
}

/// Classes of lines of equal rank.
const SERIES: [&str; 8] = ["s0", "s1", "s2", "s3", "s4", "s5", "s6", "s7"];

impl Style {
    fn class(self) -> &'static str {
        match self {
            Self::Measured => "measured",
            Self::Before => "before",
            Self::After => "after",
            Self::Noise => "noise",
            Self::Series(place) => SERIES[place % SERIES.len()],
        }
    }
}

/// Width of a text in a font of 12 pixels, estimated.
fn text_width(text: &str) -> f64 {
    text.chars()
        .map(|c| match c {
            'i' | 'j' | 'l' | 'I' | 't' | 'f' | 'r' | ' ' | '.' | ',' | ':' => 4.2,
            'm' | 'w' | 'M' | 'W' | '%' => 10.5,
            c if c.is_uppercase() => 8.4,
            _ => 7.1,
        })
        .sum()
}

/// A coordinate: a tenth of a pixel is enough.
fn px(x: f64) -> String {
    let text = format!("{x:.1}");
    text.strip_suffix(".0").unwrap_or(&text).to_owned()
}
